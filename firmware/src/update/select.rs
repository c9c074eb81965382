//! The start: which image to run.

use super::error::FlashError;
use super::flash::{self, MappedFlash};
use super::record::{self, Body, Record, Trial};
use super::requirements::{Refusal, Requirements};
use super::slots::{Slot, Slots};
use crate::image::{CheckProgress, Checker, Image, layout};
use core::fmt;
use core::ops::Range;

/// Bytes that are checked between two calls of `between`.
const SLICE: usize = 4096;

/// The image to run.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub struct Selected {
    pub(super) slot: Slot,
    pub(super) offset: u32,
    pub(super) bytes: u32,
    pub(super) revision: u32,
    pub(super) header_crc: u32,
    pub(super) trial: Option<u8>,
}

impl Selected {
    /// The slot that it lies in.
    pub fn slot(&self) -> Slot {
        self.slot
    }

    /// Where it lies in the flash.
    pub fn range(&self) -> Range<u32> {
        self.offset..self.offset.saturating_add(self.bytes)
    }

    /// Revision of its model.
    pub fn revision(&self) -> u32 {
        self.revision
    }

    /// Whether it has yet to be confirmed ([`super::Updater::confirm`]).
    pub fn is_on_trial(&self) -> bool {
        self.trial.is_some()
    }
}

/// Why a slot's image does not run.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub enum Unusable {
    /// There is none.
    Empty,
    /// An update began and did not end.
    Unfinished,
    /// It was not confirmed in any of its trials.
    NotConfirmed,
    /// It is damaged, or not one for this board.
    Refused(Refusal),
    /// The flash failed.
    Flash(FlashError),
}

impl From<Refusal> for Unusable {
    fn from(refusal: Refusal) -> Self {
        Self::Refused(refusal)
    }
}

impl From<FlashError> for Unusable {
    fn from(error: FlashError) -> Self {
        Self::Flash(error)
    }
}

impl fmt::Display for Unusable {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Empty => f.write_str("empty"),
            Self::Unfinished => f.write_str("an update did not end"),
            Self::NotConfirmed => write!(f, "not confirmed in {} trials", record::TRIALS),
            Self::Refused(refusal) => write!(f, "{refusal}"),
            Self::Flash(error) => write!(f, "{error}"),
        }
    }
}

/// No slot holds an image to run.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub struct SelectError {
    /// What is wrong with slot A.
    pub a: Unusable,
    /// What is wrong with slot B.
    pub b: Unusable,
}

impl fmt::Display for SelectError {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "no image to run: {}: {}; {}: {}", Slot::A, self.a, Slot::B, self.b)
    }
}

impl core::error::Error for SelectError {}

/// Chooses the image to run: that of the newest record that is confirmed or has a trial left, if every byte of it is
/// right and it meets the requirements; else the other slot's. Takes an image that is not confirmed on its next trial.
///
/// Calls `between` after at most 4 KiB that were checked, for a watchdog. Between two calls lies, beside these, at most
/// one [`Image::parse`].
///
/// # Errors
/// No slot holds an image to run.
pub fn select<F: MappedFlash>(
    flash: &mut F,
    slots: &Slots,
    requirements: &Requirements<'_>,
    between: &mut dyn FnMut(),
) -> Result<Selected, SelectError> {
    let [a, b] = [Slot::A, Slot::B].map(|slot| Record::read(flash, slots, slot));
    let b_is_first = match (a, b) {
        (Record::Complete(a, _), Record::Complete(b, _)) => b.is_newer_than(&a),
        (_, b) => matches!(b, Record::Complete(..)),
    };
    let mut take = |slot, record| take(flash, slots, slot, record, requirements, between);
    if b_is_first {
        take(Slot::B, b).or_else(|b| take(Slot::A, a).map_err(|a| SelectError { a, b }))
    } else {
        take(Slot::A, a).or_else(|a| take(Slot::B, b).map_err(|b| SelectError { a, b }))
    }
}

/// The image of a slot, if it can run; uses up a trial if it is on trial.
fn take<F: MappedFlash>(
    flash: &mut F,
    slots: &Slots,
    slot: Slot,
    record: Record,
    requirements: &Requirements<'_>,
    between: &mut dyn FnMut(),
) -> Result<Selected, Unusable> {
    let (body, trial) = match record {
        Record::Unclaimed if slot == Slot::A => (None, None),
        Record::Unclaimed => return Err(Unusable::Empty),
        Record::Claimed => return Err(Unusable::Unfinished),
        Record::Complete(_, Trial::Failed) => return Err(Unusable::NotConfirmed),
        Record::Complete(body, Trial::Next(trial)) => (Some(body), Some(trial)),
        Record::Complete(body, Trial::Confirmed) => (Some(body), None),
    };
    let image = examine(flash, slots, slot, body, requirements, between)?;
    let selected = Selected {
        slot,
        offset: slots.image_offset(slot),
        bytes: u32::try_from(image.bytes().len()).unwrap_or(u32::MAX),
        revision: image.revision(),
        header_crc: image.header_crc(),
        trial,
    };
    if let Some(trial) = trial {
        record::mark_tried(flash, slots, slot, trial)?;
    }
    Ok(selected)
}

/// The image of a slot, if every byte of it is right and it meets the requirements.
fn examine<'f, F: MappedFlash>(
    flash: &'f F,
    slots: &Slots,
    slot: Slot,
    body: Option<Body>,
    requirements: &Requirements<'_>,
    between: &mut dyn FnMut(),
) -> Result<Image<'f>, Unusable> {
    let length = match body {
        Some(body) => body.image_bytes,
        None => factory_length(flash, slots, slot)?,
    };
    between();
    let image = Image::parse(flash::mapped(flash, slots.image(slot, length))?).map_err(Refusal::Parse)?;
    if body.is_some_and(|body| body.header_crc != image.header_crc()) {
        return Err(Refusal::NotAnnounced.into());
    }
    requirements.accept(&image)?;
    let mut checker = Checker::new(&image);
    while checker.advance(SLICE).map_err(Refusal::Check)? != CheckProgress::Done {
        between();
    }
    Ok(image)
}

/// Length of an image that has no record: what its header says.
fn factory_length<F: MappedFlash>(flash: &F, slots: &Slots, slot: Slot) -> Result<u32, Unusable> {
    let header = flash::mapped(flash, slots.image(slot, layout::header::BYTES as u32))?;
    if header.get(layout::header::MAGIC) != Some(&layout::MAGIC) {
        return Err(Unusable::Empty);
    }
    let field = header.get(layout::header::TOTAL_BYTES).and_then(|field| field.try_into().ok());
    Ok(field.map_or(0, u32::from_le_bytes))
}
