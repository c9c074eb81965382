//! Stored operands of a sum and the sum's end.

use super::StepContext;
use crate::arena::{Changed, Reads};
use crate::image::{Check, ParseError, TensorRecord};
use crate::kernels::{SumArgs, TermArgs};
use crate::program::{Clamp, Term};

/// A term's tensor holds codes, its zero point lies in their type, its multiplier is not negative.
pub(super) fn validate(term: &Term, context: &StepContext<'_, '_>) -> Result<TensorRecord, ParseError> {
    let record = context.activation(term.tensor)?;
    context.zero_point(term.tensor, term.zero_point)?;
    context.ensure_within(Check::StepMultiplier, term.multiplier, 0..=i32::MAX.into())?;
    Ok(record)
}

/// The view for the kernels of the operand number `operand`.
pub(super) fn args<'v>(term: &Term, reads: &Reads<'v>, operand: usize) -> Result<TermArgs<'v>, Changed> {
    let Term { zero_point, multiplier, .. } = *term;
    Ok(TermArgs { codes: reads.optional_codes(operand)?, zero_point, multiplier })
}

/// The end of the sum.
pub(super) fn sum(shift: u8, zero_point: i16, clamp: Clamp) -> SumArgs {
    SumArgs { shift: shift.into(), zero_point, clamp }
}
