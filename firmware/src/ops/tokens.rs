//! Two pooled maps, velocity and position to tokens.

use super::{StepContext, term};
use crate::arena::{Changed, Operands, Reads};
use crate::image::{Check, ParseError};
use crate::kernels::{Kernels, TokenSourceArgs, TokensArgs};
use crate::program::{TokenSource, Tokens};
use crate::tensor::ElementType;

pub(super) fn validate(step: &Tokens, context: &StepContext<'_, '_>) -> Result<u64, ParseError> {
    let output = context.activation(step.output)?.shape;
    let first = validate_source(&step.first, output.channels, context)?;
    let second = validate_source(&step.second, output.channels, context)?;
    context.ensure_equal(Check::StepShape, output.positions(), first.tokens.saturating_add(second.tokens))?;
    let velocity = context.typed(step.velocity, ElementType::I16)?.shape;
    context.ensure_equal(Check::StepShape, velocity.elements(), 1_u64)?;
    context.constants::<i32>(step.velocity_multipliers, output.channels.into())?;
    context.constants::<i16>(step.position, output.elements())?;
    context.sum_shift(step.shift)?;
    context.output_codes(step.output, step.zero_point, step.clamp)?;
    Ok(output.elements().saturating_add(first.work).saturating_add(second.work))
}

struct Source {
    tokens: u32,
    work: u64,
}

fn validate_source(source: &TokenSource, channels: u16, context: &StepContext<'_, '_>) -> Result<Source, ParseError> {
    let map = context.activation(source.map)?.shape;
    context.ensure_equal(Check::StepShape, map.channels, channels)?;
    context.zero_point(source.map, source.zero_point)?;
    context.ensure_within(Check::StepMultiplier, source.multiplier, 0..=i32::MAX.into())?;
    let divides = |size: u16, pool: u8| size.checked_rem(pool.into()) == Some(0);
    context.ensure(Check::StepTokenPool, divides(map.height, source.pool_h), source.pool_h, map.height)?;
    context.ensure(Check::StepTokenPool, divides(map.width, source.pool_w), source.pool_w, map.width)?;
    let rows = u32::from(map.height.checked_div(source.pool_h.into()).unwrap_or_default());
    let columns = u32::from(map.width.checked_div(source.pool_w.into()).unwrap_or_default());
    Ok(Source { tokens: rows.saturating_mul(columns), work: map.elements() })
}

pub(super) fn run<K: Kernels>(
    step: &Tokens,
    context: &StepContext<'_, '_>,
    kernels: &K,
    operands: Operands<'_>,
) -> Result<(), Changed> {
    let velocity: &[i16] = operands.reads.elements(2)?;
    let args = TokensArgs {
        sources: [
            source_args(&step.first, context, &operands.reads, 0)?,
            source_args(&step.second, context, &operands.reads, 1)?,
        ],
        velocity: *velocity.first().ok_or(Changed)?,
        velocity_multipliers: context.slice(step.velocity_multipliers)?,
        position: context.slice(step.position)?,
        sum: term::sum(step.shift, step.zero_point, step.clamp),
    };
    kernels.tokens(&args, operands.output.codes()?);
    Ok(())
}

fn source_args<'v>(
    source: &TokenSource,
    context: &StepContext<'_, '_>,
    reads: &Reads<'v>,
    operand: usize,
) -> Result<TokenSourceArgs<'v>, Changed> {
    Ok(TokenSourceArgs {
        codes: reads.codes(operand)?,
        shape: context.tensor(source.map)?.shape,
        zero_point: source.zero_point,
        pool: [source.pool_h, source.pool_w],
        multiplier: source.multiplier,
    })
}
