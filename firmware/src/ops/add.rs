//! Sum of two operands; may write over one of them.

use super::{StepContext, term};
use crate::arena::{Changed, Operands};
use crate::image::ParseError;
use crate::kernels::Kernels;
use crate::program::Add;

pub(super) fn validate(step: &Add, context: &StepContext<'_, '_>) -> Result<u64, ParseError> {
    let output = context.activation(step.output)?.shape;
    context.same_shape(term::validate(&step.first, context)?.shape, output)?;
    context.same_shape(term::validate(&step.second, context)?.shape, output)?;
    context.sum_shift(step.shift)?;
    context.output_codes(step.output, step.zero_point, step.clamp)?;
    Ok(output.elements())
}

pub(super) fn run<K: Kernels>(step: &Add, kernels: &K, operands: Operands<'_>) -> Result<(), Changed> {
    let terms = [term::args(&step.first, &operands.reads, 0)?, term::args(&step.second, &operands.reads, 1)?];
    let sum = term::sum(step.shift, step.zero_point, step.clamp);
    kernels.add(&sum, &terms, operands.output.codes()?);
    Ok(())
}
