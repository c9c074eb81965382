//! Matrix product over the channels of every position.

use super::{StepContext, rescale};
use crate::arena::{Changed, Operands};
use crate::image::{Check, ParseError};
use crate::kernels::{Kernels, LinearArgs, plan};
use crate::program::Linear;

pub(super) fn validate(step: &Linear, context: &StepContext<'_, '_>) -> Result<u64, ParseError> {
    let record = context.activation(step.input)?;
    let (input, output) = (record.shape, context.activation(step.output)?.shape);
    context.ensure_equal(Check::StepShape, output.positions(), input.positions())?;
    let weights = plan::weight_bytes(step.kernel, 1, output.channels, input.channels.into());
    context.constants::<i8>(step.weights, weights)?;
    rescale::validate(&step.rescale, step.output, 1, context)?;
    let scratch = plan::linear_scratch_bytes(step.kernel, input.positions(), input.channels, record.element);
    context.scratch(step.scratch, scratch)?;
    Ok(output.elements().saturating_mul(input.channels.into()))
}

pub(super) fn run<K: Kernels>(
    step: &Linear,
    context: &StepContext<'_, '_>,
    kernels: &K,
    operands: Operands<'_>,
) -> Result<(), Changed> {
    let Operands { output, scratch, reads } = operands;
    let (input, shape) = (context.tensor(step.input)?.shape, context.tensor(step.output)?.shape);
    let args = LinearArgs {
        positions: shape.positions(),
        inputs: input.channels,
        outputs: shape.channels,
        kernel: step.kernel,
        weights: context.slice(step.weights)?,
        wide: step.wide,
        rescale: rescale::args(&step.rescale, context, &reads)?,
    };
    kernels.linear(&args, reads.codes(0)?, output.codes()?, scratch);
    Ok(())
}
