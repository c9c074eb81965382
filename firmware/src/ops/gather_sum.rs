//! Sums of cells of a map that a second operand names.

use super::StepContext;
use crate::arena::{Changed, Operands};
use crate::image::{Check, ParseError};
use crate::kernels::{GatherSumArgs, Kernels, RequantArgs};
use crate::program::GatherSum;
use crate::tensor::ElementType;

pub(super) fn validate(step: &GatherSum, context: &StepContext<'_, '_>) -> Result<u64, ParseError> {
    let (input, output) = (context.activation(step.input)?.shape, context.activation(step.output)?.shape);
    let indices = context.typed(step.indices, ElementType::I8)?.shape;
    context.ensure_equal(Check::StepShape, output.channels, input.channels)?;
    context.ensure_equal(Check::StepShape, indices.height, output.height)?;
    context.ensure_equal(Check::StepShape, indices.width, output.width)?;
    context.ensure_equal(Check::StepShape, indices.channels, indices.channels & !1)?;
    context.zero_point(step.input, step.input_zero_point)?;
    context.requant(step.requant)?;
    context.output_codes(step.output, step.zero_point, step.clamp)?;
    Ok(output.elements().saturating_mul(u64::from(indices.channels >> 1)))
}

pub(super) fn run<K: Kernels>(
    step: &GatherSum,
    context: &StepContext<'_, '_>,
    kernels: &K,
    operands: Operands<'_>,
) -> Result<(), Changed> {
    let args = GatherSumArgs {
        input_shape: context.tensor(step.input)?.shape,
        output_shape: context.tensor(step.output)?.shape,
        indices: operands.reads.elements(1)?,
        requant: RequantArgs {
            input_zero_point: step.input_zero_point,
            requant: step.requant,
            zero_point: step.zero_point,
            clamp: step.clamp,
        },
    };
    kernels.gather_sum(&args, operands.reads.codes(0)?, operands.output.codes()?);
    Ok(())
}
