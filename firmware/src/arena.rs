//! The arena: operands of a step as disjoint slices of one buffer, by checked means only.
//!
//! A step writes its output and its scratch and reads up to three tensors. The slices come from one
//! `get_disjoint_mut`, so the borrow checker's rule holds at run time whatever the image says: where two of them
//! would overlap there is no slice at all. Element types come from checked casts.

#![deny(
    clippy::indexing_slicing,
    clippy::arithmetic_side_effects,
    clippy::unwrap_used,
    clippy::expect_used,
    clippy::panic
)]

use crate::tensor::{Codes, CodesMut, ElementType};
use bytemuck::Pod;
use core::ops::Range;

/// The operands do not fit the arena or each other: the image is not what `parse` accepted.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct Changed;

/// One operand that a step reads.
#[derive(Clone, Debug)]
pub(crate) struct Source {
    pub element: ElementType,
    /// `None` where the operand lies in the output buffer (in place).
    pub span: Option<Range<usize>>,
}

/// The slices of one step.
#[derive(Debug)]
pub(crate) struct Operands<'m> {
    pub output: Output<'m>,
    pub scratch: &'m mut [u8],
    pub reads: Reads<'m>,
}

/// The output buffer with its element type.
#[derive(Debug)]
pub(crate) struct Output<'m> {
    element: ElementType,
    bytes: &'m mut [u8],
}

/// The operands read, in the order of [`crate::program::Step::reads`].
#[derive(Clone, Copy, Debug)]
pub(crate) struct Reads<'m> {
    operands: [(ElementType, Option<&'m [u8]>); 3],
}

/// Cuts the operands of a step out of the arena. An operand that is read twice gives the same slice twice.
pub(crate) fn split<'m>(
    arena: &'m mut [u8],
    output: (ElementType, Range<usize>),
    scratch: Range<usize>,
    sources: [Option<Source>; 3],
) -> Result<Operands<'m>, Changed> {
    let [a, b, c] = sources.map(|source| source.unwrap_or(Source { element: ElementType::Scratch, span: None }));
    // A repeated span must be cut once; the empty range at 0 overlaps nothing.
    let b_is_a = b.span.is_some() && b.span == a.span;
    let c_is_a = c.span.is_some() && c.span == a.span;
    let c_is_b = c.span.is_some() && c.span == b.span;
    let cut = |source: &Source, repeated: bool| match &source.span {
        Some(span) if !repeated => span.clone(),
        _ => 0..0,
    };
    let ranges = [output.1, scratch, cut(&a, false), cut(&b, b_is_a), cut(&c, c_is_a || c_is_b)];
    let [output_bytes, scratch, a_bytes, b_bytes, c_bytes] = arena.get_disjoint_mut(ranges).map_err(|_| Changed)?;
    let a_bytes: &[u8] = a_bytes;
    let b_bytes: &[u8] = if b_is_a { a_bytes } else { b_bytes };
    let c_bytes: &[u8] = match (c_is_a, c_is_b) {
        (true, _) => a_bytes,
        (_, true) => b_bytes,
        _ => c_bytes,
    };
    let operand = |source: &Source, bytes: &'m [u8]| (source.element, source.span.as_ref().map(|_| bytes));
    let operands = [operand(&a, a_bytes), operand(&b, b_bytes), operand(&c, c_bytes)];
    let output = Output { element: output.0, bytes: output_bytes };
    Ok(Operands { output, scratch, reads: Reads { operands } })
}

impl<'m> Reads<'m> {
    /// Codes of an operand; `None` where it lies in the output buffer.
    pub fn optional_codes(&self, operand: usize) -> Result<Option<Codes<'m>>, Changed> {
        let (element, bytes) = *self.operands.get(operand).ok_or(Changed)?;
        let Some(bytes) = bytes else { return Ok(None) };
        match element {
            ElementType::I8 => Ok(Some(Codes::I8(cast(bytes)?))),
            ElementType::I16 => Ok(Some(Codes::I16(cast(bytes)?))),
            ElementType::I32 | ElementType::Scratch => Err(Changed),
        }
    }

    /// Codes of an operand that has memory of its own.
    pub fn codes(&self, operand: usize) -> Result<Codes<'m>, Changed> {
        self.optional_codes(operand)?.ok_or(Changed)
    }

    /// Elements of an operand that has memory of its own.
    pub fn elements<T: Pod>(&self, operand: usize) -> Result<&'m [T], Changed> {
        self.optional_elements(operand)?.ok_or(Changed)
    }

    /// Elements of an operand; `None` where it lies in the output buffer.
    pub fn optional_elements<T: Pod>(&self, operand: usize) -> Result<Option<&'m [T]>, Changed> {
        let (element, bytes) = *self.operands.get(operand).ok_or(Changed)?;
        if crate::tensor::index(element.bytes()) != size_of::<T>() {
            return Err(Changed);
        }
        bytes.map(cast).transpose()
    }
}

impl<'m> Output<'m> {
    /// The output as codes.
    pub fn codes(self) -> Result<CodesMut<'m>, Changed> {
        match self.element {
            ElementType::I8 => Ok(CodesMut::I8(cast_mut(self.bytes)?)),
            ElementType::I16 => Ok(CodesMut::I16(cast_mut(self.bytes)?)),
            ElementType::I32 | ElementType::Scratch => Err(Changed),
        }
    }

    /// The output as 32-bit words.
    pub fn words(self) -> Result<&'m mut [i32], Changed> {
        if self.element == ElementType::I32 { cast_mut(self.bytes) } else { Err(Changed) }
    }
}

fn cast<T: Pod>(bytes: &[u8]) -> Result<&[T], Changed> {
    bytemuck::try_cast_slice(bytes).map_err(|_| Changed)
}

fn cast_mut<T: Pod>(bytes: &mut [u8]) -> Result<&mut [T], Changed> {
    bytemuck::try_cast_slice_mut(bytes).map_err(|_| Changed)
}

#[cfg(test)]
#[allow(clippy::expect_used, reason = "a failed expectation is a failed test")]
mod tests {
    use super::*;

    fn source(span: Range<usize>) -> Option<Source> {
        Some(Source { element: ElementType::I8, span: Some(span) })
    }

    #[test]
    fn repeated_operand_is_cut_once() {
        let mut arena = [0, 1, 2, 3, 4, 5, 6, 7];
        let sources = [source(2..4), source(2..4), source(2..4)];
        let operands = split(&mut arena, (ElementType::I8, 0..2), 4..8, sources).expect("disjoint");
        for operand in 0..3 {
            assert_eq!(operands.reads.elements::<u8>(operand), Ok(&[2, 3][..]));
        }
        assert_eq!(operands.scratch, [4, 5, 6, 7]);
    }

    #[test]
    fn third_operand_may_repeat_the_second() {
        let mut arena = [0, 1, 2, 3, 4, 5, 6, 7];
        let sources = [source(6..8), source(2..4), source(2..4)];
        let operands = split(&mut arena, (ElementType::I8, 0..2), 0..0, sources).expect("disjoint");
        assert_eq!(operands.reads.elements::<u8>(0), Ok(&[6, 7][..]));
        assert_eq!(operands.reads.elements::<u8>(1), Ok(&[2, 3][..]));
        assert_eq!(operands.reads.elements::<u8>(2), Ok(&[2, 3][..]));
    }

    #[test]
    fn overlap_and_overrun_give_no_slices() {
        let mut arena = [0; 8];
        let overlap = split(&mut arena, (ElementType::I8, 0..3), 0..0, [source(2..4), None, None]);
        assert_eq!(overlap.err(), Some(Changed));
        let overrun = split(&mut arena, (ElementType::I8, 0..3), 6..9, [None, None, None]);
        assert_eq!(overrun.err(), Some(Changed));
        let reads_overlap = split(&mut arena, (ElementType::I8, 0..2), 0..0, [source(2..5), source(4..6), None]);
        assert_eq!(reads_overlap.err(), Some(Changed));
    }

    #[test]
    fn operand_in_place_has_no_codes_of_its_own() {
        let mut arena = [0; 8];
        let in_place = Some(Source { element: ElementType::I8, span: None });
        let operands = split(&mut arena, (ElementType::I8, 0..4), 0..0, [in_place, None, None]).expect("fits");
        assert!(matches!(operands.reads.optional_codes(0), Ok(None)));
        assert!(operands.reads.codes(0).is_err());
        assert!(matches!(operands.output.codes(), Ok(CodesMut::I8(codes)) if codes.len() == 4));
    }

    #[test]
    fn element_types_are_not_mixed_up() {
        let mut arena = [0; 8];
        let operands = split(&mut arena, (ElementType::I32, 0..4), 0..0, [source(4..8), None, None]).expect("fits");
        assert!(operands.reads.elements::<i16>(0).is_err());
        assert!(operands.output.codes().is_err());
    }
}
