//! Narrow and wide codes behind one small trait, and typed views of scratch.

use crate::fixed_point::saturate_i8;
use crate::tensor::Codes;
use bytemuck::{AnyBitPattern, NoUninit};

/// An element type of activations.
pub(in crate::kernels) trait Code: Copy + Ord {
    /// The smallest code.
    const LOWEST: Self;
    /// Code 0.
    const ZERO: Self;

    /// The code in 16 bits.
    fn widen(self) -> i16;

    /// The code of a clamped result (saturated, should the clamp be wider than the type).
    fn from_code(code: i16) -> Self;
}

impl Code for i8 {
    const LOWEST: Self = i8::MIN;
    const ZERO: Self = 0;

    #[inline]
    fn widen(self) -> i16 {
        i16::from(self)
    }

    #[inline]
    fn from_code(code: i16) -> Self {
        saturate_i8(code)
    }
}

impl Code for i16 {
    const LOWEST: Self = i16::MIN;
    const ZERO: Self = 0;

    #[inline]
    fn widen(self) -> i16 {
        self
    }

    #[inline]
    fn from_code(code: i16) -> Self {
        code
    }
}

/// A code as a term of a sum.
#[inline]
pub(in crate::kernels) fn value<T: Code>(code: T) -> i64 {
    i64::from(code.widen())
}

/// Element `index` of an operand, or `stored` (the same element of the output buffer) where it is in place.
#[inline]
pub(in crate::kernels) fn operand<T: Code>(codes: Option<Codes<'_>>, index: usize, stored: T) -> i64 {
    match codes {
        None => value(stored),
        Some(Codes::I8(codes)) => i64::from(element(codes, index)),
        Some(Codes::I16(codes)) => i64::from(element(codes, index)),
    }
}

/// Elements of an operand; of one in place, `stored`.
pub(in crate::kernels) fn operand_len(codes: Option<Codes<'_>>, stored: usize) -> usize {
    match codes {
        None => stored,
        Some(Codes::I8(codes)) => codes.len(),
        Some(Codes::I16(codes)) => codes.len(),
    }
}

/// `slice[index]`, or zero beyond the end.
#[inline]
pub(in crate::kernels) fn element<T: Copy + Default>(slice: &[T], index: usize) -> T {
    slice.get(index).copied().unwrap_or_default()
}

/// `slice[index·len ..][..len]`, or `None` beyond the end.
#[inline]
pub(in crate::kernels) fn block<T>(slice: &[T], index: usize, len: usize) -> Option<&[T]> {
    let start = index.checked_mul(len)?;
    slice.get(start..start.checked_add(len)?)
}

/// Mutable [`block`].
#[inline]
pub(in crate::kernels) fn block_mut<T>(slice: &mut [T], index: usize, len: usize) -> Option<&mut [T]> {
    let start = index.checked_mul(len)?;
    slice.get_mut(start..start.checked_add(len)?)
}

/// Copies codes to 16 bits.
#[inline]
pub(in crate::kernels) fn widen<T: Code>(codes: &[T], widened: &mut [i16]) {
    for (wide, code) in widened.iter_mut().zip(codes) {
        *wide = code.widen();
    }
}

/// Takes `len` elements off the front of `scratch`; `None` where they do not fit or are not aligned.
pub(in crate::kernels) fn take<'a, T: NoUninit + AnyBitPattern>(
    scratch: &mut &'a mut [u8],
    len: usize,
) -> Option<&'a mut [T]> {
    let bytes = len.checked_mul(size_of::<T>())?;
    let (front, rest) = core::mem::take(scratch).split_at_mut_checked(bytes)?;
    *scratch = rest;
    bytemuck::try_cast_slice_mut(front).ok()
}
