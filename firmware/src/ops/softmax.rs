//! Softmax over the channels of each position; may write over its input.

use super::StepContext;
use crate::arena::{Changed, Operands};
use crate::fixed_point::EXP_TABLE_LEN;
use crate::image::{Check, ParseError};
use crate::kernels::{Kernels, SoftmaxArgs};
use crate::program::Softmax;
use crate::tensor::{CodesMut, ElementType};

/// Most channels whose sum has at most 30 bits.
const MAX_CHANNELS: i64 = 1 << 15;

pub(super) fn validate(step: &Softmax, context: &StepContext<'_, '_>) -> Result<u64, ParseError> {
    let shape = context.typed(step.output, ElementType::I16)?.shape;
    context.same_shape(context.activation(step.input)?.shape, shape)?;
    context.ensure_within(Check::StepChannels, shape.channels, 1..=MAX_CHANNELS)?;
    context.requant(step.exponent)?;
    context.constants::<i16>(step.exp_table, EXP_TABLE_LEN as u64)?;
    Ok(shape.elements().saturating_mul(3))
}

pub(super) fn run<K: Kernels>(
    step: &Softmax,
    context: &StepContext<'_, '_>,
    kernels: &K,
    operands: Operands<'_>,
) -> Result<(), Changed> {
    let args = SoftmaxArgs {
        channels: context.tensor(step.output)?.shape.channels,
        exponent: step.exponent,
        exp_table: context.slice(step.exp_table)?,
    };
    let CodesMut::I16(output) = operands.output.codes()? else { return Err(Changed) };
    kernels.softmax(&args, operands.reads.optional_codes(0)?, output);
    Ok(())
}
