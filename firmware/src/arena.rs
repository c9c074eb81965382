//! The arena: operands of a step as disjoint slices of the memory regions' buffers, by checked means only.
//!
//! A step writes its output and its scratch and reads up to three tensors, each in one region. The slices of a region
//! come from one `get_disjoint_mut`, so the borrow checker's rule holds at run time whatever the image says: where two
//! of them would overlap there is no slice at all. Element types come from checked casts.

#![deny(
    clippy::indexing_slicing,
    clippy::arithmetic_side_effects,
    clippy::unwrap_used,
    clippy::expect_used,
    clippy::panic
)]

use crate::image::{TensorRecord, layout};
use crate::tensor::{Codes, CodesMut, ElementType, index};
use bytemuck::Pod;
use core::ops::Range;

/// The engine's memory: a buffer per region of the image, in the image's order. One buffer becomes this by itself, as
/// does an array of them:
///
/// ```
/// # use firmware::arena::Regions;
/// # let (mut fast, mut main) = ([0; 64], [0; 256]);
/// let one: Regions = (&mut main[..]).into();
/// let two: Regions = [&mut fast[..], &mut main[..]].into();
/// ```
///
/// Where the image decides, collect them: `image.regions().map(|region| …).collect()`.
#[derive(Debug)]
pub struct Regions<'a> {
    buffers: [&'a mut [u8]; layout::REGION_SLOTS],
    /// Buffers given; more than there is room for is refused by the engine.
    count: usize,
}

impl<'a> From<&'a mut [u8]> for Regions<'a> {
    fn from(buffer: &'a mut [u8]) -> Self {
        [buffer].into()
    }
}

impl<'a, const N: usize> From<[&'a mut [u8]; N]> for Regions<'a> {
    fn from(buffers: [&'a mut [u8]; N]) -> Self {
        buffers.into_iter().collect()
    }
}

impl<'a> FromIterator<&'a mut [u8]> for Regions<'a> {
    fn from_iter<I: IntoIterator<Item = &'a mut [u8]>>(buffers: I) -> Self {
        let mut regions = Self { buffers: Default::default(), count: 0 };
        for buffer in buffers {
            if let Some(slot) = regions.buffers.get_mut(regions.count) {
                *slot = buffer;
            }
            regions.count = regions.count.saturating_add(1);
        }
        regions
    }
}

impl<'a> Regions<'a> {
    /// The same buffers for a shorter time.
    pub fn reborrow(&mut self) -> Regions<'_> {
        let mut regions = Regions { buffers: Default::default(), count: self.count };
        regions.buffers.iter_mut().zip(&mut self.buffers).for_each(|(to, from)| *to = from);
        regions
    }

    /// Buffers given.
    pub(crate) fn count(&self) -> usize {
        self.count
    }

    /// The buffers, to be replaced by parts of themselves.
    pub(crate) fn buffers_mut(&mut self) -> impl Iterator<Item = &mut &'a mut [u8]> {
        self.buffers.iter_mut().take(self.count)
    }

    /// The bytes of a tensor.
    pub(crate) fn tensor(&self, record: &TensorRecord) -> Option<&[u8]> {
        let Span { region, bytes } = Span::of(record);
        self.buffers.get(usize::from(region))?.get(bytes)
    }

    /// The bytes of a tensor, to be written.
    pub(crate) fn tensor_mut(&mut self, record: &TensorRecord) -> Option<&mut [u8]> {
        let Span { region, bytes } = Span::of(record);
        self.buffers.get_mut(usize::from(region))?.get_mut(bytes)
    }
}

/// Bytes of one region.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub(crate) struct Span {
    /// Position of the region.
    pub region: u8,
    pub bytes: Range<usize>,
}

impl Span {
    /// No bytes: overlaps nothing.
    pub const EMPTY: Self = Self { region: 0, bytes: 0..0 };

    /// The bytes of a tensor.
    pub fn of(record: &TensorRecord) -> Self {
        let start = index(record.offset);
        Self { region: record.region, bytes: start..start.saturating_add(index(record.bytes)) }
    }
}

/// The operands do not fit the regions or each other: the image is not what `parse` accepted.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct Changed;

/// One operand that a step reads.
#[derive(Clone, Debug)]
pub(crate) struct Source {
    pub element: ElementType,
    /// `None` where the operand lies in the output buffer (in place).
    pub span: Option<Span>,
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

impl Regions<'_> {
    /// Cuts the operands of a step out of the buffers. An operand that is read twice gives the same slice twice.
    pub(crate) fn split<'m>(
        &'m mut self,
        output: (ElementType, Span),
        scratch: Span,
        sources: [Option<Source>; 3],
    ) -> Result<Operands<'m>, Changed> {
        let [a, b, c] = sources.map(|source| source.unwrap_or(Source { element: ElementType::Scratch, span: None }));
        // A repeated span must be cut once.
        let b_is_a = b.span.is_some() && b.span == a.span;
        let c_is_a = c.span.is_some() && c.span == a.span;
        let c_is_b = c.span.is_some() && c.span == b.span;
        let span = |source: &Source, repeated: bool| match &source.span {
            Some(span) if !repeated => span.clone(),
            _ => Span::EMPTY,
        };
        let spans = [output.1, scratch, span(&a, false), span(&b, b_is_a), span(&c, c_is_a || c_is_b)];
        let [output_bytes, scratch, a_bytes, b_bytes, c_bytes] = self.cut(spans)?;
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

    /// Disjoint slices, region by region: what lies elsewhere is the empty range there, which overlaps nothing.
    fn cut<const N: usize>(&mut self, spans: [Span; N]) -> Result<[&mut [u8]; N], Changed> {
        let mut slices = [const { None }; N];
        for (region, buffer) in (0_u8..).zip(self.buffers_mut()) {
            let here = |span: &Span| span.region == region;
            let ranges = spans.each_ref().map(|span| if here(span) { span.bytes.clone() } else { 0..0 });
            let parts = buffer.get_disjoint_mut(ranges).map_err(|_| Changed)?;
            for ((slice, part), _) in slices.iter_mut().zip(parts).zip(&spans).filter(|(_, span)| here(span)) {
                *slice = Some(part);
            }
        }
        // A region that no buffer was given for has no slices.
        let missing = slices.iter().any(Option::is_none);
        if missing { Err(Changed) } else { Ok(slices.map(Option::unwrap_or_default)) }
    }
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
#[allow(clippy::expect_used, clippy::indexing_slicing, reason = "a failed expectation is a failed test")]
mod tests {
    use super::*;

    fn at(region: u8, bytes: Range<usize>) -> Span {
        Span { region, bytes }
    }

    fn source(region: u8, bytes: Range<usize>) -> Option<Source> {
        Some(Source { element: ElementType::I8, span: Some(at(region, bytes)) })
    }

    fn output(region: u8, bytes: Range<usize>) -> (ElementType, Span) {
        (ElementType::I8, at(region, bytes))
    }

    #[test]
    fn repeated_operand_is_cut_once() {
        let mut arena = [0, 1, 2, 3, 4, 5, 6, 7];
        let mut regions = Regions::from(&mut arena[..]);
        let sources = [source(0, 2..4), source(0, 2..4), source(0, 2..4)];
        let operands = regions.split(output(0, 0..2), at(0, 4..8), sources).expect("disjoint");
        for operand in 0..3 {
            assert_eq!(operands.reads.elements::<u8>(operand), Ok(&[2, 3][..]));
        }
        assert_eq!(operands.scratch, [4, 5, 6, 7]);
    }

    #[test]
    fn third_operand_may_repeat_the_second() {
        let mut arena = [0, 1, 2, 3, 4, 5, 6, 7];
        let mut regions = Regions::from(&mut arena[..]);
        let sources = [source(0, 6..8), source(0, 2..4), source(0, 2..4)];
        let operands = regions.split(output(0, 0..2), Span::EMPTY, sources).expect("disjoint");
        assert_eq!(operands.reads.elements::<u8>(0), Ok(&[6, 7][..]));
        assert_eq!(operands.reads.elements::<u8>(1), Ok(&[2, 3][..]));
        assert_eq!(operands.reads.elements::<u8>(2), Ok(&[2, 3][..]));
    }

    #[test]
    fn overlap_and_overrun_give_no_slices() {
        let mut arena = [0; 8];
        let mut regions = Regions::from(&mut arena[..]);
        let none = [None, None, None];
        let overlap = regions.split(output(0, 0..3), Span::EMPTY, [source(0, 2..4), None, None]);
        assert_eq!(overlap.err(), Some(Changed));
        let overrun = regions.split(output(0, 0..3), at(0, 6..9), none);
        assert_eq!(overrun.err(), Some(Changed));
        let reads_overlap = regions.split(output(0, 0..2), Span::EMPTY, [source(0, 2..5), source(0, 4..6), None]);
        assert_eq!(reads_overlap.err(), Some(Changed));
    }

    #[test]
    fn operands_come_from_their_own_regions() {
        let (mut fast, mut main) = ([0, 1, 2, 3], [10, 11, 12, 13, 14, 15]);
        let mut regions = Regions::from([&mut fast[..], &mut main[..]]);
        // The same bytes of two regions do not overlap; a repeated operand may lie in either.
        let sources = [source(1, 0..2), source(0, 2..4), source(1, 0..2)];
        let operands = regions.split(output(0, 0..2), at(1, 2..6), sources).expect("disjoint");
        assert_eq!(operands.output.bytes, [0, 1]);
        assert_eq!(operands.scratch, [12, 13, 14, 15]);
        assert_eq!(operands.reads.elements::<u8>(0), Ok(&[10, 11][..]));
        assert_eq!(operands.reads.elements::<u8>(1), Ok(&[2, 3][..]));
        assert_eq!(operands.reads.elements::<u8>(2), Ok(&[10, 11][..]));
        let overlap = regions.split(output(1, 0..3), Span::EMPTY, [source(0, 0..2), source(1, 2..4), None]);
        assert_eq!(overlap.err(), Some(Changed));
        let overrun = regions.split(output(0, 0..5), Span::EMPTY, [None, None, None]);
        assert_eq!(overrun.err(), Some(Changed), "the other region is larger");
    }

    #[test]
    fn region_without_a_buffer_has_no_slices() {
        let mut arena = [0; 8];
        for region in [1, 3, 4, u8::MAX] {
            let mut regions = Regions::from(&mut arena[..]);
            assert_eq!(regions.split(output(region, 0..2), Span::EMPTY, [None, None, None]).err(), Some(Changed));
            let record = TensorRecord { region, ..TensorRecord::scratch(0, 4, 0) };
            assert_eq!(regions.tensor(&record), None);
            assert_eq!(regions.tensor_mut(&record), None);
        }
    }

    #[test]
    fn surplus_buffers_are_counted() {
        let mut buffers = [[0_u8; 4]; 6];
        let regions: Regions<'_> = buffers.iter_mut().map(|buffer| &mut buffer[..]).collect();
        assert_eq!(regions.count(), 6);
    }

    #[test]
    fn operand_in_place_has_no_codes_of_its_own() {
        let mut arena = [0; 8];
        let mut regions = Regions::from(&mut arena[..]);
        let in_place = Some(Source { element: ElementType::I8, span: None });
        let operands = regions.split(output(0, 0..4), Span::EMPTY, [in_place, None, None]).expect("fits");
        assert!(matches!(operands.reads.optional_codes(0), Ok(None)));
        assert!(operands.reads.codes(0).is_err());
        assert!(matches!(operands.output.codes(), Ok(CodesMut::I8(codes)) if codes.len() == 4));
    }

    #[test]
    fn element_types_are_not_mixed_up() {
        let mut arena = [0; 8];
        let mut regions = Regions::from(&mut arena[..]);
        let words = (ElementType::I32, at(0, 0..4));
        let operands = regions.split(words, Span::EMPTY, [source(0, 4..8), None, None]).expect("fits");
        assert!(operands.reads.elements::<i16>(0).is_err());
        assert!(operands.output.codes().is_err());
    }
}
