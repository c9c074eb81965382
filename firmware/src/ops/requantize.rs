//! Change of scale or type.

use super::StepContext;
use crate::arena::{Changed, Operands};
use crate::image::ParseError;
use crate::kernels::{Kernels, RequantArgs};
use crate::program::Requantize;

pub(super) fn validate(step: &Requantize, context: &StepContext<'_, '_>) -> Result<u64, ParseError> {
    let output = context.activation(step.output)?.shape;
    context.same_shape(context.activation(step.input)?.shape, output)?;
    context.zero_point(step.input, step.input_zero_point)?;
    context.requant(step.requant)?;
    context.output_codes(step.output, step.zero_point, step.clamp)?;
    Ok(output.elements())
}

pub(super) fn run<K: Kernels>(step: &Requantize, kernels: &K, operands: Operands<'_>) -> Result<(), Changed> {
    let args = RequantArgs {
        input_zero_point: step.input_zero_point,
        requant: step.requant,
        zero_point: step.zero_point,
        clamp: step.clamp,
    };
    kernels.requantize(&args, operands.reads.codes(0)?, operands.output.codes()?);
    Ok(())
}
