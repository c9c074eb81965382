//! What every operator ends in: blocks of 64-bit sums of products, one rounding, a clamp.
//!
//! A block lies in the first-level cache between its passes, so an operator is a sequence of simple loops, one per
//! operand, whatever the types of the operands are.
//!
//! All loops of these kernels are plain Rust that the compiler turns into vectors of the instructions for which the
//! function around them is compiled. So whatever holds such a loop is inlined always: a closure or function that stays
//! apart is compiled for the least x86-64.

use crate::fixed_point::clamp_code;
use crate::kernels::portable::codes::Code;
use crate::kernels::{RequantArgs, SumArgs, TermArgs};
use crate::program::Clamp;
use crate::tensor::Codes;

/// Elements of a block.
pub(super) const BLOCK: usize = 256;

/// Working memory whose vectors do not straddle cache lines.
#[repr(align(64))]
pub(super) struct Aligned<T>(pub T);

/// `clamp(offset + R(sum, n))` with its constants at hand; equal to [`crate::fixed_point::finish`].
#[derive(Clone, Copy)]
pub(super) struct Ending {
    half: i64,
    shift: u32,
    zero_point: i64,
    clamp: Clamp,
}

impl Ending {
    #[inline(always)]
    pub(super) fn of_sum(sum: &SumArgs) -> Self {
        let shift = sum.shift.min(62);
        Self { half: (1 << shift) >> 1, shift, zero_point: sum.zero_point.into(), clamp: sum.clamp }
    }

    #[inline(always)]
    pub(super) fn of_requant(args: &RequantArgs) -> Self {
        Self::of_sum(&SumArgs { shift: args.requant.shift.into(), zero_point: args.zero_point, clamp: args.clamp })
    }

    /// The code of a sum, in the zero point of the output.
    #[inline(always)]
    pub(super) fn code<T: Code>(self, sum: i64) -> T {
        self.code_at(sum, 0)
    }

    /// The code of a sum to which `offset` is added after the rounding.
    #[inline(always)]
    pub(super) fn code_at<T: Code>(self, sum: i64, offset: i64) -> T {
        let rounded = sum.wrapping_add(self.half) >> self.shift;
        T::from_code(clamp_code(rounded.wrapping_add(self.zero_point + offset), self.clamp))
    }

    /// The codes of a block.
    #[inline(always)]
    pub(super) fn write<T: Code>(self, sums: &[i64], output: &mut [T]) {
        for (code, sum) in output.iter_mut().zip(sums) {
            *code = self.code(*sum);
        }
    }
}

/// Adds `(q − z)·M` for the elements `first ..` of a term; `stored` are these elements of the output buffer.
#[inline(always)]
pub(super) fn add_term<T: Code>(sums: &mut [i64], term: &TermArgs<'_>, first: usize, stored: &[T]) {
    match term.codes {
        None => add_products(sums, stored, term),
        Some(Codes::I8(codes)) => add_products(sums, codes.get(first..).unwrap_or_default(), term),
        Some(Codes::I16(codes)) => add_products(sums, codes.get(first..).unwrap_or_default(), term),
    }
}

#[inline(always)]
fn add_products<T: Code>(sums: &mut [i64], codes: &[T], term: &TermArgs<'_>) {
    for (sum, q) in sums.iter_mut().zip(codes) {
        let difference = i32::from(q.widen()).wrapping_sub(term.zero_point.into());
        *sum = sum.wrapping_add(i64::from(difference).wrapping_mul(term.multiplier.into()));
    }
}

/// Adds codes to 32-bit sums, which hold 2^16 codes of any type.
#[inline(always)]
pub(super) fn add_codes<T: Code>(sums: &mut [i32], codes: &[T]) {
    for (sum, q) in sums.iter_mut().zip(codes) {
        *sum = sum.wrapping_add(q.widen().into());
    }
}
