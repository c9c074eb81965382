//! The common end of weighted steps: from accumulator to output code, with an optional stored operand.

use super::StepContext;
use crate::arena::{Changed, Reads};
use crate::image::{Check, ParseError};
use crate::kernels::{RescaleArgs, ResidualArgs};
use crate::program::{Rescale, Residual};
use crate::tensor::TensorId;

/// Arrays of the output's channel count, times the number of blocks; a residual of the output's shape, and of its type
/// where it is a stream.
pub(super) fn validate(
    rescale: &Rescale,
    output: TensorId,
    blocks: u16,
    context: &StepContext<'_, '_>,
) -> Result<(), ParseError> {
    let record = context.activation(output)?;
    let channels = u64::from(record.shape.channels).saturating_mul(blocks.into());
    context.ensure_within(Check::StepPreShift, rescale.pre_shift, 0..=36)?;
    context.constants::<i32>(rescale.bias, channels)?;
    context.constants::<i32>(rescale.multipliers, channels)?;
    context.constants::<u8>(rescale.shifts, channels)?;
    context.output_codes(output, rescale.zero_point, rescale.clamp)?;
    match rescale.residual {
        Residual::None => Ok(()),
        Residual::Scaled { tensor, zero_point, multipliers } => {
            context.same_shape(context.activation(tensor)?.shape, record.shape)?;
            context.zero_point(tensor, zero_point)?;
            context.constants::<i32>(multipliers, channels)
        }
        Residual::Stream { tensor } => context.same_shape(context.typed(tensor, record.element)?.shape, record.shape),
    }
}

/// The view for the kernels; the residual is the second operand of the step.
pub(super) fn args<'v>(
    rescale: &Rescale,
    context: &StepContext<'_, 'v>,
    reads: &Reads<'v>,
) -> Result<RescaleArgs<'v>, Changed> {
    Ok(RescaleArgs {
        pre_shift: rescale.pre_shift.into(),
        bias: context.slice(rescale.bias)?,
        multipliers: context.slice(rescale.multipliers)?,
        shifts: context.slice(rescale.shifts)?,
        zero_point: rescale.zero_point,
        clamp: rescale.clamp,
        residual: match rescale.residual {
            Residual::None => ResidualArgs::None,
            Residual::Scaled { zero_point, multipliers, .. } => ResidualArgs::Scaled {
                codes: reads.optional_codes(1)?,
                zero_point,
                multipliers: context.slice(multipliers)?,
            },
            Residual::Stream { .. } => ResidualArgs::Stream { codes: reads.optional_codes(1)? },
        },
    })
}
