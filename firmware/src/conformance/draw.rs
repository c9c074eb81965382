//! Random operands of a step in borrowed memory.

use crate::image::known_answer::Generator;
use crate::kernels::{RequantArgs, SumArgs};
use crate::program::{Clamp, Requant};
use crate::tensor::{Codes, CodesMut, ElementType, Shape};
use bytemuck::{AnyBitPattern, NoUninit, Pod};

/// Alignment of every operand, bytes.
const ALIGNMENT: usize = 16;

/// Draws numbers, and arrays out of a workspace. Methods that take memory give `None` where it is used up.
pub(super) struct Draw<'m> {
    generator: Generator,
    memory: &'m mut [u8],
}

/// Codes of either type.
pub(super) struct Buffer<'m> {
    pub element: ElementType,
    pub bytes: &'m mut [u8],
}

impl<'m> Buffer<'m> {
    pub fn codes_mut(&mut self) -> Option<CodesMut<'_>> {
        match self.element {
            ElementType::I8 => Some(CodesMut::I8(bytemuck::try_cast_slice_mut(self.bytes).ok()?)),
            _ => Some(CodesMut::I16(bytemuck::try_cast_slice_mut(self.bytes).ok()?)),
        }
    }

    pub fn codes(self) -> Option<Codes<'m>> {
        let bytes: &'m [u8] = self.bytes;
        match self.element {
            ElementType::I8 => Some(Codes::I8(bytemuck::try_cast_slice(bytes).ok()?)),
            _ => Some(Codes::I16(bytemuck::try_cast_slice(bytes).ok()?)),
        }
    }
}

/// How the elements of an array are drawn.
#[derive(Clone, Copy)]
enum Style {
    Random,
    /// Random, one in four an extreme.
    Mixed,
    Lowest,
    Highest,
    /// Lowest and highest in turn.
    Alternating,
}

impl<'m> Draw<'m> {
    pub fn new(generator: Generator, memory: &'m mut [u8]) -> Self {
        Self { generator, memory }
    }

    /// A value of `low..=high`.
    pub fn range(&mut self, low: i64, high: i64) -> i64 {
        let span = high.abs_diff(low).saturating_add(1);
        low.saturating_add_unsigned(self.generator.draw() % span)
    }

    /// [`Self::range`] for sizes.
    pub fn size(&mut self, low: u16, high: u16) -> u16 {
        u16::try_from(self.range(low.into(), high.into())).unwrap_or(low)
    }

    pub fn byte(&mut self, low: u8, high: u8) -> u8 {
        u8::try_from(self.range(low.into(), high.into())).unwrap_or(low)
    }

    pub fn word(&mut self, low: i32, high: i32) -> i32 {
        i32::try_from(self.range(low.into(), high.into())).unwrap_or(low)
    }

    pub fn half_word(&mut self, low: i16, high: i16) -> i16 {
        i16::try_from(self.range(low.into(), high.into())).unwrap_or(low)
    }

    pub fn flag(&mut self) -> bool {
        self.generator.draw() & 1 == 1
    }

    /// One of several; of none the default.
    pub fn one_of<T: Copy + Default>(&mut self, from: &[T]) -> T {
        self.pick(from).unwrap_or_default()
    }

    pub fn pick<T: Copy>(&mut self, from: &[T]) -> Option<T> {
        let count = (from.len() as u64).max(1);
        from.get(usize::try_from(self.generator.draw() % count).unwrap_or(0)).copied()
    }

    pub fn element(&mut self) -> ElementType {
        if self.flag() { ElementType::I8 } else { ElementType::I16 }
    }

    /// A zero point of this type.
    pub fn zero_point(&mut self, element: ElementType) -> i16 {
        let allowed = element.zero_points();
        self.half_word(*allowed.start(), *allowed.end())
    }

    /// Bounds within this type, often the whole of it.
    pub fn clamp(&mut self, element: ElementType) -> Clamp {
        let codes = element.codes();
        let (min, max) = (*codes.start(), *codes.end());
        if self.flag() {
            return Clamp { min, max };
        }
        let min = self.half_word(min, max);
        Clamp { min, max: self.half_word(min, max) }
    }

    /// A multiplier that stands alone.
    pub fn multiplier(&mut self) -> i32 {
        self.word(1 << 23, (1 << 24) - 1)
    }

    /// A factor that maps values of `bits` digits to about `span` digits.
    pub fn requant(&mut self, bits: u32, span: u32) -> Requant {
        let shift = i64::from(bits) - i64::from(span) + 23 + self.range(-2, 3);
        Requant { multiplier: self.multiplier(), shift: u8::try_from(shift.clamp(1, 52)).unwrap_or(1) }
    }

    /// The end of a sum of terms.
    pub fn sum(&mut self, output: ElementType, shifts: (u8, u8)) -> SumArgs {
        SumArgs {
            shift: self.byte(shifts.0, shifts.1).into(),
            zero_point: self.zero_point(output),
            clamp: self.clamp(output),
        }
    }

    /// A one-factor epilogue from values of `bits` digits.
    pub fn requant_args(&mut self, input: ElementType, bits: u32, output: ElementType) -> RequantArgs {
        RequantArgs {
            input_zero_point: self.zero_point(input),
            requant: self.requant(bits, super::code_bits(output)),
            zero_point: self.zero_point(output),
            clamp: self.clamp(output),
        }
    }

    /// Memory with whatever lies in it.
    pub fn take<T: NoUninit + AnyBitPattern>(&mut self, count: usize) -> Option<&'m mut [T]> {
        let skip = self.memory.as_ptr().align_offset(ALIGNMENT);
        let bytes = count.checked_mul(size_of::<T>())?;
        if skip.checked_add(bytes)? > self.memory.len() {
            return None;
        }
        let (_, memory) = core::mem::take(&mut self.memory).split_at_mut_checked(skip)?;
        let (front, rest) = memory.split_at_mut_checked(bytes)?;
        self.memory = rest;
        bytemuck::try_cast_slice_mut(front).ok()
    }

    /// Scratch full of garbage.
    pub fn scratch(&mut self, bytes: u32) -> Option<&'m mut [u8]> {
        let scratch = self.take::<u8>(crate::tensor::index(bytes))?;
        self.generator.fill(ElementType::Scratch, scratch);
        Some(scratch)
    }

    /// An array of values of `low..=high`, in any style.
    pub fn values<T: Pod + TryFrom<i64>>(&mut self, count: usize, low: i64, high: i64) -> Option<&'m mut [T]> {
        let values = self.take::<T>(count)?;
        let style = match self.generator.draw() % 8 {
            0 => Style::Lowest,
            1 => Style::Highest,
            2 => Style::Alternating,
            3 | 4 => Style::Mixed,
            _ => Style::Random,
        };
        for (i, value) in values.iter_mut().enumerate() {
            let drawn = match style {
                Style::Lowest => low,
                Style::Highest => high,
                Style::Alternating => [low, high][i % 2],
                Style::Mixed if self.generator.draw().is_multiple_of(4) => [low, high][usize::from(self.flag())],
                Style::Mixed | Style::Random => self.range(low, high),
            };
            *value = T::try_from(drawn).ok()?;
        }
        Some(values)
    }

    /// Codes of a type.
    pub fn codes(&mut self, element: ElementType, count: usize) -> Option<Buffer<'m>> {
        let codes = element.codes();
        let (low, high) = (i64::from(*codes.start()), i64::from(*codes.end()));
        let bytes = match element {
            ElementType::I8 => bytemuck::cast_slice_mut(self.values::<i8>(count, low, high)?),
            _ => bytemuck::cast_slice_mut(self.values::<i16>(count, low, high)?),
        };
        Some(Buffer { element, bytes })
    }

    /// Codes of a map.
    pub fn map(&mut self, element: ElementType, shape: Shape) -> Option<Buffer<'m>> {
        self.codes(element, usize::try_from(shape.elements()).ok()?)
    }
}
