//! Logistic function of each element; may write over its input.

use super::StepContext;
use crate::arena::{Changed, Operands};
use crate::fixed_point::TANH_TABLE_LEN;
use crate::image::ParseError;
use crate::kernels::{Kernels, SigmoidArgs};
use crate::program::Sigmoid;
use crate::tensor::{CodesMut, ElementType};

pub(super) fn validate(step: &Sigmoid, context: &StepContext<'_, '_>) -> Result<u64, ParseError> {
    let shape = context.typed(step.output, ElementType::I16)?.shape;
    context.same_shape(context.activation(step.input)?.shape, shape)?;
    context.zero_point(step.input, step.input_zero_point)?;
    context.requant(step.requant)?;
    context.constants::<i16>(step.tanh_table, TANH_TABLE_LEN as u64)?;
    Ok(shape.elements().saturating_mul(2))
}

pub(super) fn run<K: Kernels>(
    step: &Sigmoid,
    context: &StepContext<'_, '_>,
    kernels: &K,
    operands: Operands<'_>,
) -> Result<(), Changed> {
    let args = SigmoidArgs {
        input_zero_point: step.input_zero_point,
        requant: step.requant,
        tanh_table: context.slice(step.tanh_table)?,
    };
    let CodesMut::I16(output) = operands.output.codes()? else { return Err(Changed) };
    kernels.sigmoid(&args, operands.reads.optional_codes(0)?, output);
    Ok(())
}
