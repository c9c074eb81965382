//! Portable element-wise operators.

use super::codes::{Code, operand, operand_len, value};
use crate::fault::{self, Fault};
use crate::fixed_point::finish;
use crate::kernels::{RequantArgs, SumArgs, TermArgs};
use crate::tensor::{Codes, CodesMut};

/// `y = clamp(z_o + R((a − z_a)·M_a + (b − z_b)·M_b, n))`.
///
/// Operands: i8 or i16, as long as `output`; either may be in place (then it has the output's type). `M_k < 2^31`,
/// n ≤ 40.
pub fn add(sum: &SumArgs, terms: &[TermArgs<'_>; 2], output: CodesMut<'_>) {
    match output {
        CodesMut::I8(output) => add_into(sum, terms, output),
        CodesMut::I16(output) => add_into(sum, terms, output),
    }
}

fn add_into<T: Code>(sum: &SumArgs, [first, second]: &[TermArgs<'_>; 2], output: &mut [T]) {
    let len = output.len();
    if operand_len(first.codes, len) != len || operand_len(second.codes, len) != len {
        return;
    }
    let second = if fault::active(Fault::ResidualZeroPoint) { &TermArgs { zero_point: 0, ..*second } } else { second };
    for (index, code) in output.iter_mut().enumerate() {
        let total = weighted(first, index, *code).wrapping_add(weighted(second, index, *code));
        *code = T::from_code(finish(total, sum.shift, i64::from(sum.zero_point), sum.clamp));
    }
}

/// `(q − z)·M` of element `index` of a term; `stored` is that element of the output buffer.
#[inline]
pub(super) fn weighted<T: Code>(term: &TermArgs<'_>, index: usize, stored: T) -> i64 {
    (operand(term.codes, index, stored) - i64::from(term.zero_point)) * i64::from(term.multiplier)
}

/// `y = clamp(z_o + R((q − z)·M, n))`.
///
/// `input`: i8 or i16, as long as `output`. M in `[2^23, 2^24)`, n in 1..=52.
pub fn requantize(args: &RequantArgs, input: Codes<'_>, output: CodesMut<'_>) {
    match (input, output) {
        (Codes::I8(input), CodesMut::I8(output)) => requantize_into(args, input, output),
        (Codes::I8(input), CodesMut::I16(output)) => requantize_into(args, input, output),
        (Codes::I16(input), CodesMut::I8(output)) => requantize_into(args, input, output),
        (Codes::I16(input), CodesMut::I16(output)) => requantize_into(args, input, output),
    }
}

fn requantize_into<I: Code, O: Code>(args: &RequantArgs, input: &[I], output: &mut [O]) {
    if input.len() != output.len() {
        return;
    }
    for (code, q) in output.iter_mut().zip(input) {
        *code = args.code(value(*q) - i64::from(args.input_zero_point));
    }
}

impl RequantArgs {
    /// `clamp(z_o + R(value·M, n))` for a value that already has its zero point subtracted.
    #[inline]
    pub(super) fn code<T: Code>(&self, value: i64) -> T {
        let product = value.wrapping_mul(i64::from(self.requant.multiplier));
        T::from_code(finish(product, u32::from(self.requant.shift), i64::from(self.zero_point), self.clamp))
    }
}
