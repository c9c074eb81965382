//! The slot record: its units, how they are written, and what they say.

use super::error::{FlashError, FlashOperation};
use super::flash;
use super::slots::{PAGE, Slot, Slots};
use crate::image::crc32;
use embedded_storage::nor_flash::{NorFlash, NorFlashErrorKind};

/// Content of a unit, without padding.
pub(super) const UNIT_BYTES: usize = 16;
/// Units of a record.
pub(super) const UNITS: usize = 2 + 2 * TRIALS as usize;
/// Starts that a new image has to be confirmed in. More than one, since a power cut is no fault of the image.
pub const TRIALS: u8 = 3;

/// The unit that says that updates own the slot, in the first version of this record.
pub const CLAIM: [u8; UNIT_BYTES] = *b"\x93DRIVE SLOT 1\r\n\0";
/// The unit that says that a start took the image on trial.
pub const TRIED: [u8; UNIT_BYTES] = *b"tried           ";
/// The unit that says that the image passed its trial.
pub const CONFIRMED: [u8; UNIT_BYTES] = *b"confirmed       ";

const BLANK: [u8; UNIT_BYTES] = [0xFF; UNIT_BYTES];

/// A unit of the record's sector.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Unit {
    Claim,
    Body,
    Tried(u8),
    Confirmed(u8),
}

impl Unit {
    pub(super) fn position(self) -> u32 {
        match self {
            Self::Claim => 0,
            Self::Body => 1,
            Self::Tried(trial) => u32::from(trial).saturating_mul(2).saturating_add(2),
            Self::Confirmed(trial) => u32::from(trial).saturating_mul(2).saturating_add(3),
        }
    }
}

/// What a record says of the image in its slot.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct Body {
    /// Higher for the newer image.
    pub(super) counter: u32,
    /// Length of the image.
    pub(super) image_bytes: u32,
    /// CRC in the image's header, which tells images apart.
    pub(super) header_crc: u32,
}

impl Body {
    /// Whether this record was written after another one; counters are serial numbers.
    pub(super) fn is_newer_than(&self, other: &Self) -> bool {
        self.counter.wrapping_sub(other.counter).cast_signed() > 0
    }

    fn to_bytes(self) -> [u8; UNIT_BYTES] {
        let [a, b, c] = [self.counter, self.image_bytes, self.header_crc].map(u32::to_le_bytes);
        let crc = crc32([a, b, c].as_flattened()).to_le_bytes();
        let mut bytes = BLANK;
        bytes.iter_mut().zip([a, b, c, crc].as_flattened()).for_each(|(to, from)| *to = *from);
        bytes
    }

    fn from_bytes(bytes: &[u8; UNIT_BYTES]) -> Option<Self> {
        let (words, _) = bytes.as_chunks();
        let &[counter, image_bytes, header_crc, _] = words else { return None };
        let [counter, image_bytes, header_crc] = [counter, image_bytes, header_crc].map(u32::from_le_bytes);
        let body = Self { counter, image_bytes, header_crc };
        (body.to_bytes() == *bytes).then_some(body)
    }
}

/// How far the trial of an image is.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Trial {
    /// Passed.
    Confirmed,
    /// The next start is this trial.
    Next(u8),
    /// No trial is left.
    Failed,
}

/// What the record's sector says.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Record {
    /// No update has been here: if there is an image, it is the factory's.
    Unclaimed,
    /// An update began and did not end.
    Claimed,
    /// The slot holds an image.
    Complete(Body, Trial),
}

impl Record {
    /// Reads the record of a slot.
    pub(super) fn read<F: NorFlash>(flash: &mut F, slots: &Slots, slot: Slot) -> Self {
        let mut unit = |unit| read_unit(flash, slots, slot, unit);
        if unit(Unit::Claim) != CLAIM {
            return Self::Unclaimed;
        }
        let Some(body) = Body::from_bytes(&unit(Unit::Body)) else { return Self::Claimed };
        let mut trials = (0..TRIALS).map(|trial| (trial, unit(Unit::Tried(trial)), unit(Unit::Confirmed(trial))));
        let mut next = None;
        for (trial, tried, confirmed) in &mut trials {
            if confirmed == CONFIRMED {
                return Self::Complete(body, Trial::Confirmed);
            }
            if next.is_none() && tried == BLANK && confirmed == BLANK {
                next = Some(trial);
            }
        }
        Self::Complete(body, next.map_or(Trial::Failed, Trial::Next))
    }
}

/// Makes the slot's image void, whatever is left of it.
///
/// While the record is erased, it may say anything. So what must not run (the rest of an update that was broken off, an
/// image that was given up) loses its header first; an image that may run stays whole until there is a claim.
pub(super) fn claim<F: NorFlash>(flash: &mut F, slots: &Slots, slot: Slot) -> Result<(), FlashError> {
    match Record::read(flash, slots, slot) {
        Record::Unclaimed | Record::Complete(_, Trial::Confirmed | Trial::Next(_)) => {}
        Record::Claimed | Record::Complete(_, Trial::Failed) => {
            flash::erase(flash, slots.first_sector(slot))?;
        }
    }
    flash::erase(flash, slots.record(slot))?;
    write_unit(flash, slots, slot, Unit::Claim, &CLAIM)
}

/// Makes the slot's image the newest.
pub(super) fn complete<F: NorFlash>(flash: &mut F, slots: &Slots, slot: Slot, body: Body) -> Result<(), FlashError> {
    write_unit(flash, slots, slot, Unit::Body, &body.to_bytes())
}

/// Uses up a trial.
pub(super) fn mark_tried<F: NorFlash>(flash: &mut F, slots: &Slots, slot: Slot, trial: u8) -> Result<(), FlashError> {
    write_unit(flash, slots, slot, Unit::Tried(trial), &TRIED)
}

/// Ends the trials.
pub(super) fn mark_confirmed<F: NorFlash>(
    flash: &mut F,
    slots: &Slots,
    slot: Slot,
    trial: u8,
) -> Result<(), FlashError> {
    write_unit(flash, slots, slot, Unit::Confirmed(trial), &CONFIRMED)
}

/// Writes a unit of an erased sector and reads it back.
fn write_unit<F: NorFlash>(
    flash: &mut F,
    slots: &Slots,
    slot: Slot,
    unit: Unit,
    content: &[u8; UNIT_BYTES],
) -> Result<(), FlashError> {
    let mut buffer = [0xFF; PAGE];
    buffer.iter_mut().zip(content).for_each(|(to, from)| *to = *from);
    let offset = slots.unit(slot, unit);
    flash::write(flash, offset, buffer.get(..slots.unit_bytes()).unwrap_or_default())?;
    let failed = FlashError { operation: FlashOperation::Write, offset, kind: NorFlashErrorKind::Other };
    if read_unit(flash, slots, slot, unit) == *content { Ok(()) } else { Err(failed) }
}

/// The content of a unit; zeros, which mean nothing, where the flash cannot read it.
fn read_unit<F: NorFlash>(flash: &mut F, slots: &Slots, slot: Slot, unit: Unit) -> [u8; UNIT_BYTES] {
    let mut buffer = [0; PAGE];
    let bytes = buffer.get_mut(..slots.unit_bytes()).unwrap_or_default();
    let readable = flash::read(flash, slots.unit(slot, unit), bytes).is_ok();
    buffer.first_chunk().copied().filter(|_| readable).unwrap_or_default()
}

#[cfg(test)]
mod tests {
    use super::*;

    const BODY: Body = Body { counter: 7, image_bytes: 4096, header_crc: 0x1234_5678 };

    #[test]
    fn a_body_is_read_back() {
        assert_eq!(Body::from_bytes(&BODY.to_bytes()), Some(BODY));
    }

    #[test]
    fn a_body_that_differs_in_one_bit_is_none() {
        for bit in 0..128 {
            let bytes = u128::from_le_bytes(BODY.to_bytes()) ^ 1 << bit;
            assert_eq!(Body::from_bytes(&bytes.to_le_bytes()), None, "bit {bit}");
        }
        assert_eq!(Body::from_bytes(&BLANK), None);
        assert_eq!(Body::from_bytes(&[0; UNIT_BYTES]), None);
    }

    #[test]
    fn counters_are_serial_numbers() {
        let body = |counter| Body { counter, ..BODY };
        for (older, newer) in [(0, 1), (u32::MAX, 0), (u32::MAX - 1, 1), (1 << 31, (1 << 31) + 1)] {
            assert!(body(newer).is_newer_than(&body(older)), "{older}, {newer}");
            assert!(!body(older).is_newer_than(&body(newer)), "{older}, {newer}");
        }
        assert!(!BODY.is_newer_than(&BODY));
    }

    #[test]
    fn units_follow_each_other() {
        let trials = (0..TRIALS).flat_map(|trial| [Unit::Tried(trial), Unit::Confirmed(trial)]);
        let units = [Unit::Claim, Unit::Body].into_iter().chain(trials);
        assert!(units.map(Unit::position).eq(0..UNITS as u32));
    }
}
