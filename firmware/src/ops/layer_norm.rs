//! LayerNorm over the channels of some rows of a stream.

use super::{StepContext, term};
use crate::arena::{Changed, Operands};
use crate::image::{Check, ParseError};
use crate::kernels::{Kernels, LayerNormArgs};
use crate::program::LayerNorm;
use crate::tensor::{Codes, index};

/// Most channels whose sums stay exact.
const MAX_CHANNELS: i64 = 1024;
/// Epsilon stays below the bound of the variance.
const MAX_EPSILON: i64 = 1 << 52;

pub(super) fn validate(step: &LayerNorm, context: &StepContext<'_, '_>) -> Result<u64, ParseError> {
    let (input, output) = (context.activation(step.input)?.shape, context.activation(step.output)?.shape);
    context.ensure_equal(Check::StepShape, output.channels, input.channels)?;
    context.ensure_within(Check::StepChannels, input.channels, 1..=MAX_CHANNELS)?;
    let last = u64::from(step.first_row).saturating_add(output.positions().into());
    let rows = input.positions();
    context.ensure(Check::StepRows, last <= u64::from(rows), i64::try_from(last).unwrap_or(i64::MAX), rows)?;
    context.ensure_within(Check::StepEpsilon, step.epsilon, 1..=MAX_EPSILON)?;
    context.constants::<i32>(step.gains, input.channels.into())?;
    context.constants::<i64>(step.offsets, input.channels.into())?;
    context.sum_shift(step.shift)?;
    context.output_codes(step.output, step.zero_point, step.clamp)?;
    Ok(output.elements().saturating_mul(2))
}

pub(super) fn run<K: Kernels>(
    step: &LayerNorm,
    context: &StepContext<'_, '_>,
    kernels: &K,
    operands: Operands<'_>,
) -> Result<(), Changed> {
    let shape = context.tensor(step.output)?.shape;
    let start = usize::from(step.first_row).checked_mul(shape.channels.into()).ok_or(Changed)?;
    let length = index(shape.positions()).checked_mul(shape.channels.into()).ok_or(Changed)?;
    let rows = start..start.checked_add(length).ok_or(Changed)?;
    let input = match operands.reads.codes(0)? {
        Codes::I8(codes) => Codes::I8(codes.get(rows).ok_or(Changed)?),
        Codes::I16(codes) => Codes::I16(codes.get(rows).ok_or(Changed)?),
    };
    let args = LayerNormArgs {
        rows: shape.positions(),
        channels: shape.channels,
        epsilon: step.epsilon,
        gains: context.slice(step.gains)?,
        offsets: context.slice(step.offsets)?,
        sum: term::sum(step.shift, step.zero_point, step.clamp),
    };
    kernels.layer_norm(&args, input, operands.output.codes()?);
    Ok(())
}
