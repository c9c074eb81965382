//! Where the two slots lie, and what they ask of the flash.

use super::record::{self, Unit};
use core::fmt;
use core::ops::Range;
use embedded_storage::nor_flash::NorFlash;

/// Bytes that are written at once: the largest write unit, and a divisor of every sector.
pub(super) const PAGE: usize = 256;

/// One of the two places for an image.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub enum Slot {
    /// The first: where the factory puts the image.
    A,
    /// The second.
    B,
}

impl Slot {
    /// The other one.
    pub const fn other(self) -> Self {
        match self {
            Self::A => Self::B,
            Self::B => Self::A,
        }
    }
}

impl fmt::Display for Slot {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            Self::A => "slot A",
            Self::B => "slot B",
        })
    }
}

/// Why slots cannot lie there.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub enum SlotsError {
    /// The flash's read or write size is no power of two, or larger than 256.
    UnitSize(u32),
    /// The flash's erase size is no multiple of 256, or too small for a slot record.
    EraseSize(u32),
    /// An offset or the size of the slots is no multiple of the erase size.
    Misaligned {
        /// The offset or size.
        found: u32,
        /// The erase size.
        erase_size: u32,
    },
    /// A slot has no sector for an image beside the one for its record.
    TooSmall {
        /// Bytes of a slot.
        found: u32,
        /// Bytes of two sectors.
        needed: u32,
    },
    /// The slots overlap.
    Overlap,
    /// A slot ends behind the flash.
    OutsideFlash {
        /// The byte behind the slot.
        found: u64,
        /// Bytes of the flash.
        capacity: u64,
    },
}

impl fmt::Display for SlotsError {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::UnitSize(found) => {
                write!(f, "flash reads or writes {found} bytes at a time, expected a power of two up to {PAGE}")
            }
            Self::EraseSize(found) => {
                write!(f, "flash erases {found} bytes at a time, expected a multiple of {PAGE} with room for a record")
            }
            Self::Misaligned { found, erase_size } => {
                write!(f, "slots: {found:#x} is no multiple of the erase size, {erase_size:#x}")
            }
            Self::TooSmall { found, needed } => write!(f, "slots: {found} bytes each, at least {needed} are needed"),
            Self::Overlap => write!(f, "the slots overlap"),
            Self::OutsideFlash { found, capacity } => {
                write!(f, "a slot ends at byte {found}, the flash has {capacity}")
            }
        }
    }
}

impl core::error::Error for SlotsError {}

/// Where the two slots lie in a flash; each holds an image and, in its last sector, the slot record.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Slots {
    offsets: [u32; 2],
    bytes: u32,
    erase_size: u32,
    /// Distance of a record's units.
    unit: u32,
}

impl Slots {
    /// Slots A and B of `bytes` each at these offsets of the flash: multiples of its erase size.
    ///
    /// # Errors
    /// They do not fit the flash, or the flash does not fit slots.
    pub fn new<F: NorFlash>(flash: &F, offsets: [u32; 2], bytes: u32) -> Result<Self, SlotsError> {
        let shown = |size: usize| u32::try_from(size).unwrap_or(u32::MAX);
        for size in [F::READ_SIZE, F::WRITE_SIZE] {
            if !size.is_power_of_two() || size > PAGE {
                return Err(SlotsError::UnitSize(shown(size)));
            }
        }
        let unit = F::READ_SIZE.max(F::WRITE_SIZE).max(record::UNIT_BYTES);
        let erase_size = shown(F::ERASE_SIZE);
        let record_bytes = unit.saturating_mul(record::UNITS);
        if !F::ERASE_SIZE.is_multiple_of(PAGE) || F::ERASE_SIZE < record_bytes {
            return Err(SlotsError::EraseSize(erase_size));
        }
        for found in offsets.into_iter().chain([bytes]) {
            if !found.is_multiple_of(erase_size) {
                return Err(SlotsError::Misaligned { found, erase_size });
            }
        }
        let needed = erase_size.saturating_mul(2);
        if bytes < needed {
            return Err(SlotsError::TooSmall { found: bytes, needed });
        }
        let [a, b] = offsets;
        if a.abs_diff(b) < bytes {
            return Err(SlotsError::Overlap);
        }
        let found = u64::from(a.max(b)).saturating_add(bytes.into());
        // Offsets are 32 bits wide.
        let capacity = (flash.capacity() as u64).min(u32::MAX.into());
        if found > capacity {
            return Err(SlotsError::OutsideFlash { found, capacity });
        }
        Ok(Self { offsets, bytes, erase_size, unit: shown(unit) })
    }

    /// Where the image of a slot starts.
    pub fn image_offset(&self, slot: Slot) -> u32 {
        let [a, b] = self.offsets;
        match slot {
            Slot::A => a,
            Slot::B => b,
        }
    }

    /// Bytes of the largest image.
    pub fn image_capacity(&self) -> u32 {
        self.bytes.saturating_sub(self.erase_size)
    }

    /// The first `bytes` bytes of a slot's image, no more than there is room for.
    pub(super) fn image(&self, slot: Slot, bytes: u32) -> Range<u32> {
        let start = self.image_offset(slot);
        start..start.saturating_add(bytes.min(self.image_capacity()))
    }

    /// The first sector of a slot's image.
    pub(super) fn first_sector(&self, slot: Slot) -> Range<u32> {
        self.image(slot, self.erase_size)
    }

    /// The sector of a slot's image that starts with this byte of it, if one does.
    pub(super) fn sector(&self, slot: Slot, position: u32) -> Option<Range<u32>> {
        let start = self.image_offset(slot).saturating_add(position);
        position.is_multiple_of(self.erase_size).then(|| start..start.saturating_add(self.erase_size))
    }

    /// The sector of a slot's record.
    pub(super) fn record(&self, slot: Slot) -> Range<u32> {
        let start = self.image_offset(slot).saturating_add(self.image_capacity());
        start..start.saturating_add(self.erase_size)
    }

    /// Where a unit of a slot's record starts.
    pub(super) fn unit(&self, slot: Slot, unit: Unit) -> u32 {
        self.record(slot).start.saturating_add(unit.position().saturating_mul(self.unit))
    }

    /// Bytes of a record's unit with its padding: up to [`PAGE`].
    pub(super) fn unit_bytes(&self) -> usize {
        crate::tensor::index(self.unit)
    }
}
