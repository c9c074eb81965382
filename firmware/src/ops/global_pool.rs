//! Mean over all positions of one or two maps.

use super::{StepContext, term};
use crate::arena::{Changed, Operands};
use crate::image::{Check, ParseError};
use crate::kernels::Kernels;
use crate::program::GlobalPool;
use crate::tensor::Shape;

pub(super) fn validate(step: &GlobalPool, context: &StepContext<'_, '_>) -> Result<u64, ParseError> {
    let first = term::validate(&step.first, context)?.shape;
    let mut work = first.elements();
    if let Some(second) = &step.second {
        let second = term::validate(second, context)?.shape;
        context.ensure_equal(Check::StepShape, second.channels, first.channels)?;
        work = work.saturating_add(second.elements());
    }
    context.same_shape(context.activation(step.output)?.shape, Shape::vector(first.channels))?;
    context.sum_shift(step.shift)?;
    context.output_codes(step.output, step.zero_point, step.clamp)?;
    Ok(work)
}

pub(super) fn run<K: Kernels>(
    step: &GlobalPool,
    context: &StepContext<'_, '_>,
    kernels: &K,
    operands: Operands<'_>,
) -> Result<(), Changed> {
    let channels = context.tensor(step.output)?.shape.channels;
    let sum = term::sum(step.shift, step.zero_point, step.clamp);
    let first = term::args(&step.first, &operands.reads, 0)?;
    let output = operands.output.codes()?;
    match &step.second {
        Some(second) => {
            let second = term::args(second, &operands.reads, 1)?;
            kernels.global_pool(channels, &sum, &[first, second], output);
        }
        None => kernels.global_pool(channels, &sum, &[first], output),
    }
    Ok(())
}
