//! Multi-head attention; may write over its queries.

use super::StepContext;
use crate::arena::{Changed, Operands};
use crate::image::{Check, ParseError};
use crate::kernels::{AttentionArgs, Kernels, RequantArgs, plan};
use crate::program::Attention;
use crate::tensor::ElementType;

/// Most tokens, and widest head, whose sums stay exact.
const MAX_TOKENS: i64 = 512;
const MAX_HEAD_WIDTH: u16 = 512;
/// Entries of the exponential table.
const EXP_ENTRIES: u64 = 257;

pub(super) fn validate(step: &Attention, context: &StepContext<'_, '_>) -> Result<u64, ParseError> {
    let shape = context.activation(step.output)?.shape;
    for operand in [step.query, step.key, step.value] {
        context.same_shape(context.typed(operand, ElementType::I8)?.shape, shape)?;
    }
    let tokens = shape.positions();
    context.ensure_within(Check::StepTokens, tokens, 1..=MAX_TOKENS)?;
    let divides = shape.channels.checked_rem(step.heads) == Some(0);
    let width = shape.channels.checked_div(step.heads).unwrap_or_default();
    context.ensure(Check::StepHeads, divides && width <= MAX_HEAD_WIDTH, step.heads, shape.channels)?;
    context.requant(step.exponent)?;
    context.requant(step.requant)?;
    context.constants::<i16>(step.exp_table, EXP_ENTRIES)?;
    context.output_codes(step.output, step.zero_point, step.clamp)?;
    context.scratch(step.scratch, plan::attention_scratch_bytes(tokens, shape.channels, step.heads))?;
    Ok(shape.elements().saturating_mul(tokens.into()).saturating_mul(2))
}

pub(super) fn run<K: Kernels>(
    step: &Attention,
    context: &StepContext<'_, '_>,
    kernels: &K,
    operands: Operands<'_>,
) -> Result<(), Changed> {
    let Operands { output, scratch, reads } = operands;
    let shape = context.tensor(step.output)?.shape;
    let args = AttentionArgs {
        tokens: shape.positions(),
        channels: shape.channels,
        heads: step.heads,
        exponent: step.exponent,
        exp_table: context.slice(step.exp_table)?,
        requant: RequantArgs {
            input_zero_point: 0,
            requant: step.requant,
            zero_point: step.zero_point,
            clamp: step.clamp,
        },
    };
    let (query, key, value) = (reads.optional_elements(0)?, reads.elements(1)?, reads.elements(2)?);
    kernels.attention(&args, query, key, value, output.codes()?, scratch);
    Ok(())
}
