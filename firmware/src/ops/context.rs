//! A step under examination: look-ups in the tensor table, the checks that operators share, and the cut of operands.

use crate::arena::{Changed, Operands, Regions, Source, Span};
use crate::fault::{self, Fault};
use crate::image::{Check, Image, ParseError, Place, TensorRecord, ensure, layout, shown};
use crate::program::{Clamp, ConstRange, Requant, Step, Window};
use crate::tensor::{ElementType, Shape, TensorId, index};
use bytemuck::Pod;

/// An image and the position of one of its steps.
#[derive(Clone, Copy, Debug)]
pub(crate) struct StepContext<'i, 'a> {
    pub image: &'i Image<'a>,
    pub position: u16,
}

/// Look-ups and checks. All errors name the step.
impl<'a> StepContext<'_, 'a> {
    pub fn ensure(
        &self,
        check: Check,
        holds: bool,
        found: impl Into<i64>,
        expected: impl Into<i64>,
    ) -> Result<(), ParseError> {
        ensure(check, Place::Step(self.position), holds, found, expected)
    }

    pub fn ensure_equal(
        &self,
        check: Check,
        found: impl Into<u64>,
        expected: impl Into<u64>,
    ) -> Result<(), ParseError> {
        let (found, expected) = (found.into(), expected.into());
        self.ensure(check, found == expected, shown(found), shown(expected))
    }

    pub fn ensure_within(
        &self,
        check: Check,
        found: impl Into<i64>,
        allowed: core::ops::RangeInclusive<i64>,
    ) -> Result<(), ParseError> {
        let found = found.into();
        let nearest = found.clamp(*allowed.start(), *allowed.end());
        self.ensure(check, allowed.contains(&found), found, nearest)
    }

    fn of_tensor(&self, id: TensorId) -> Place {
        Place::StepTensor(self.position, id.0)
    }

    /// The record of a tensor that the step names.
    pub fn tensor(&self, id: TensorId) -> Result<TensorRecord, ParseError> {
        let record = self.image.tensor(id);
        let last = self.image.tensor_count().saturating_sub(1);
        ensure(Check::StepTensor, self.of_tensor(id), record.is_some(), id.0, last)?;
        // Only a test that switched this check off gets the empty buffer.
        Ok(record.unwrap_or(TensorRecord::scratch(0, 0, self.position)))
    }

    /// A tensor of 8- or 16-bit codes.
    pub fn activation(&self, id: TensorId) -> Result<TensorRecord, ParseError> {
        let record = self.tensor(id)?;
        let codes = matches!(record.element, ElementType::I8 | ElementType::I16);
        let (found, expected) = (record.element as u8, ElementType::I8 as u8);
        ensure(Check::StepElement, self.of_tensor(id), codes, found, expected)?;
        Ok(record)
    }

    /// A tensor of one element type.
    pub fn typed(&self, id: TensorId, element: ElementType) -> Result<TensorRecord, ParseError> {
        let record = self.tensor(id)?;
        let (found, expected) = (record.element as u8, element as u8);
        ensure(Check::StepElement, self.of_tensor(id), found == expected, found, expected)?;
        Ok(record)
    }

    /// Two shapes are equal in every dimension.
    pub fn same_shape(&self, found: Shape, expected: Shape) -> Result<(), ParseError> {
        self.ensure_equal(Check::StepShape, found.height, expected.height)?;
        self.ensure_equal(Check::StepShape, found.width, expected.width)?;
        self.ensure_equal(Check::StepShape, found.channels, expected.channels)
    }

    /// The output has the size that the window gives over the input, and no window lies in padding alone.
    pub fn window(&self, window: &Window, input: Shape, output: Shape) -> Result<(), ParseError> {
        let (height, width) = window.output_size(input.height, input.width).unwrap_or_default();
        self.ensure_equal(Check::StepWindow, output.height, height)?;
        self.ensure_equal(Check::StepWindow, output.width, width)?;
        let pad = window.pad_top.max(window.pad_bottom).max(window.pad_left).max(window.pad_right);
        self.ensure(Check::StepPadding, window.padding_is_inside(), pad, 0)
    }

    /// A pool's window has dilation 1.
    pub fn undilated(&self, window: &Window) -> Result<(), ParseError> {
        self.ensure_equal(Check::StepDilation, window.dilation_h, 1_u8)?;
        self.ensure_equal(Check::StepDilation, window.dilation_w, 1_u8)
    }

    /// A range of exactly `count` elements of type `T`.
    pub fn constants<T>(&self, range: ConstRange, count: u64) -> Result<(), ParseError> {
        let place = Place::StepConstant(self.position, range.offset);
        let remainder = index(range.offset) % layout::ALIGNMENT;
        ensure(Check::ConstAligned, place, remainder == 0, shown(remainder as u64), 0)?;
        let end = u64::from(range.offset).saturating_add(range.bytes.into());
        let section = self.image.section(crate::image::SectionKind::Constants).len() as u64;
        ensure(Check::ConstInside, place, end <= section, shown(end), shown(section))?;
        let implied = count.saturating_mul(size_of::<T>() as u64);
        ensure(Check::ConstLength, place, u64::from(range.bytes) == implied, range.bytes, shown(implied))
    }

    /// The elements of a range.
    pub fn slice<T: Pod>(&self, range: ConstRange) -> Result<&'a [T], Changed> {
        self.image.constants(range).ok_or(Changed)
    }

    /// A zero point lies in its tensor's type.
    pub fn zero_point(&self, id: TensorId, zero_point: i16) -> Result<(), ParseError> {
        let allowed = self.tensor(id)?.element.zero_points();
        let nearest = zero_point.clamp(*allowed.start(), *allowed.end());
        ensure(Check::StepZeroPoint, self.of_tensor(id), allowed.contains(&zero_point), zero_point, nearest)
    }

    /// Zero point and bounds of the output.
    pub fn output_codes(&self, id: TensorId, zero_point: i16, clamp: Clamp) -> Result<(), ParseError> {
        self.zero_point(id, zero_point)?;
        let codes = self.tensor(id)?.element.codes();
        let lower = codes.contains(&clamp.min);
        ensure(Check::StepClamp, self.of_tensor(id), lower, clamp.min, *codes.start())?;
        let upper = codes.contains(&clamp.max) && clamp.min <= clamp.max;
        ensure(Check::StepClamp, self.of_tensor(id), upper, clamp.max, *codes.end())
    }

    /// A factor that stands alone: M in [2^23, 2^24), n in 1..=52.
    pub fn requant(&self, requant: Requant) -> Result<(), ParseError> {
        self.ensure_within(Check::StepMultiplier, requant.multiplier, 1 << 23..=(1 << 24) - 1)?;
        self.ensure_within(Check::StepShift, requant.shift, 1..=52)
    }

    /// The shift of a sum of terms: n at most 40.
    pub fn sum_shift(&self, shift: u8) -> Result<(), ParseError> {
        self.ensure_within(Check::StepShift, shift, 0..=40)
    }

    /// Working memory of at least `needed` bytes.
    pub fn scratch(&self, scratch: Option<TensorId>, needed: u32) -> Result<(), ParseError> {
        let found = match scratch {
            Some(id) => self.tensor(id)?.bytes,
            None => 0,
        };
        self.ensure(Check::StepScratchBytes, found >= needed, found, needed)
    }
}

/// Memory.
impl StepContext<'_, '_> {
    /// Operands hold something when they are read, the output is this step's own, and an in-place pair is legal.
    pub fn check_operands(&self, step: &Step) -> Result<(), ParseError> {
        for id in step.reads().into_iter().flatten() {
            self.check_read(id)?;
        }
        let id = step.output();
        let output = self.tensor(id)?;
        let place = self.of_tensor(id);
        let scratch = output.element == ElementType::Scratch;
        ensure(Check::StepReadsScratch, place, !scratch, id.0, id.0)?;
        ensure(Check::StepWritesInput, place, !self.image.is_input(id), id.0, id.0)?;
        let own = output.first_step == self.position;
        ensure(Check::StepWritesOnce, place, own, self.position, output.first_step)?;
        if let Some(overwritten) = output.in_place_of {
            self.check_in_place(step, &output, overwritten)?;
        }
        if let Some(id) = step.scratch() {
            let record = self.tensor(id)?;
            let own = record.element == ElementType::Scratch && record.first_step == self.position;
            ensure(Check::StepScratch, self.of_tensor(id), own, record.first_step, self.position)?;
        }
        Ok(())
    }

    fn check_read(&self, id: TensorId) -> Result<(), ParseError> {
        let record = self.tensor(id)?;
        let place = self.of_tensor(id);
        ensure(Check::StepReadsScratch, place, record.element != ElementType::Scratch, id.0, id.0)?;
        let written = self.image.is_input(id) || record.first_step < self.position;
        let live = written && record.is_live(self.position);
        ensure(Check::StepReadLive, place, live, self.position, record.last_step)
    }

    fn check_in_place(&self, step: &Step, output: &TensorRecord, id: TensorId) -> Result<(), ParseError> {
        let place = self.of_tensor(id);
        let candidate = step.overwritable().contains(&Some(id));
        ensure(Check::InPlaceOperand, place, candidate, id.0, id.0)?;
        let uses = step.reads().into_iter().filter(|read| *read == Some(id)).count();
        ensure(Check::InPlaceOnce, place, uses == 1, shown(uses as u64), 1)?;
        let operand = self.tensor(id)?;
        // A max pool shrinks its input; every other pair is element for element.
        let sized = operand.bytes == output.bytes || matches!(step, Step::MaxPool(_));
        let placed = (operand.region, operand.offset) == (output.region, output.offset);
        let same = placed && operand.element == output.element && sized;
        ensure(Check::InPlacePosition, place, same, operand.offset, output.offset)?;
        let last_use = operand.last_step == self.position && !self.image.is_output(id);
        ensure(Check::InPlaceLastUse, place, last_use, operand.last_step, self.position)
    }

    /// Neither output nor scratch lies on a tensor that is live now, except on the operand that is overwritten. Since
    /// each buffer is written in one step only, this over all steps means that live ranges never overlap.
    pub fn check_overlaps(&self, step: &Step) -> Result<(), ParseError> {
        let written = [Some(step.output()), step.scratch()];
        for id in written.into_iter().flatten() {
            let record = self.tensor(id)?;
            for other in (0..self.image.tensor_count()).map(TensorId) {
                if other == id || record.in_place_of == Some(other) {
                    continue;
                }
                let Some(live) = self.image.tensor(other).filter(|other| other.is_live(self.position)) else {
                    continue;
                };
                ensure(Check::StepOverlap, self.of_tensor(other), !record.overlaps(&live), record.offset, live.offset)?;
            }
        }
        Ok(())
    }

    /// Cuts output, scratch and operands out of the memory regions.
    pub fn operands<'m>(&self, step: &Step, regions: &'m mut Regions<'_>) -> Result<Operands<'m>, Changed> {
        let output = self.tensor(step.output())?;
        let mut output_span = Span::of(&output);
        let mut sources = [const { None }; 3];
        for (source, id) in sources.iter_mut().zip(step.reads()) {
            let Some(id) = id else { continue };
            let record = self.tensor(id)?;
            let in_place = output.in_place_of == Some(id);
            if in_place {
                output_span.bytes.end = output_span.bytes.end.max(Span::of(&record).bytes.end);
            }
            *source = Some(Source { element: record.element, span: (!in_place).then(|| Span::of(&record)) });
        }
        let scratch = match step.scratch() {
            Some(id) => scratch_span(&self.tensor(id)?),
            None => Span::EMPTY,
        };
        regions.split((output.element, output_span), scratch, sources)
    }
}

fn scratch_span(record: &TensorRecord) -> Span {
    let early = if fault::active(Fault::ScratchOverlap) { 16 } else { 0 };
    Span::of(&TensorRecord { offset: record.offset.saturating_sub(early), ..*record })
}
