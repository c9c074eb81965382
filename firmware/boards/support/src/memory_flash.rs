//! Memory of an emulated board that behaves like a memory-mapped NOR flash: an erase sets all bits of a sector, a write
//! only clears bits.
//!
//! The image that runs is lent out for the rest of the program, and its bytes are neither erased nor written from then
//! on; the rest can be:
//!
//! ```ignore
//! // SAFETY: this is PSRAM of the board that nothing else uses.
//! let mut flash = unsafe { MemoryFlash::new(PSRAM, PSRAM_BYTES) };
//! let slots = flash.slots()?;
//! let running = update::select(&mut flash, &slots, &requirements, &mut || watchdog.feed())?;
//! let image = Image::parse(flash.lend(running.range())?)?;
//! let mut engine = Engine::new(image, Portable, arena)?;
//! let mut updater = Updater::new(flash, slots, requirements, Some(running));
//! engine.self_test()?;
//! updater.confirm()?;
//! // For each message of the link: `updater.begin(&manifest)`, `updater.write(offset, bytes)`, `updater.finish(4096)`.
//! ```
//!
//! | board | slot A | slot B |
//! |---|---|---|
//! | `an386` | 0x2100_0000, 8 MiB | 0x2180_0000, 8 MiB |
//! | `an500` | 0x6000_0000, 8 MiB | 0x6080_0000, 8 MiB |
//! | `an547` | 0x6000_0000, 128 MiB | 0x6800_0000, 128 MiB |
//! | `virt` | 0x5000_0000, 96 MiB | 0x5600_0000, 96 MiB |

use core::ops::Range;
use core::{ptr, slice};
use embedded_storage::nor_flash::{
    ErrorType, NorFlash, NorFlashErrorKind, ReadNorFlash, check_erase, check_read, check_write,
};
use firmware::update::{MappedFlash, Slots, SlotsError};

/// Memory that is written and erased like a flash.
#[derive(Debug)]
pub struct MemoryFlash {
    base: *mut u8,
    bytes: u32,
    /// What is lent out for good.
    lent: Range<u32>,
}

impl MemoryFlash {
    /// The flash at an address.
    ///
    /// # Safety
    /// `bytes` bytes of memory lie at `base`, a multiple of 16, and nothing else in the program refers to them.
    pub const unsafe fn new(base: usize, bytes: u32) -> Self {
        Self { base: base as *mut u8, bytes, lent: 0..0 }
    }

    /// Two slots, each half of the flash; A is the first.
    ///
    /// # Errors
    /// The flash is too small for two slots, or its half is no whole number of sectors.
    pub fn slots(&self) -> Result<Slots, SlotsError> {
        let half = self.bytes / 2;
        Slots::new(self, [0, half], half)
    }

    /// Lends bytes for the rest of the program: they can no longer be erased or written. `None` beyond the end, and
    /// where other bytes are lent already.
    pub fn lend(&mut self, range: Range<u32>) -> Option<&'static [u8]> {
        if !self.lent.is_empty() && self.lent != range {
            return None;
        }
        let pointer = self.pointer(&range)?;
        self.lent = range.clone();
        // SAFETY: `new` demands memory here that is ours alone, and `may_change` keeps us from writing these bytes from
        // now on.
        Some(unsafe { slice::from_raw_parts(pointer, range.len()) })
    }

    /// Where these bytes lie; `None` beyond the end.
    fn pointer(&self, range: &Range<u32>) -> Option<*mut u8> {
        let is_inside = range.start <= range.end && range.end <= self.bytes;
        is_inside.then(|| self.base.wrapping_add(range.start as usize))
    }

    /// The first of these bytes, if they may be changed.
    fn may_change(&mut self, range: &Range<u32>) -> Result<*mut u8, NorFlashErrorKind> {
        let is_lent = range.start < self.lent.end && self.lent.start < range.end;
        self.pointer(range).filter(|_| !is_lent).ok_or(NorFlashErrorKind::OutOfBounds)
    }
}

impl ErrorType for MemoryFlash {
    type Error = NorFlashErrorKind;
}

impl ReadNorFlash for MemoryFlash {
    const READ_SIZE: usize = 1;

    fn read(&mut self, offset: u32, bytes: &mut [u8]) -> Result<(), NorFlashErrorKind> {
        check_read(self, offset, bytes.len())?;
        let stored = self.mapped(offset..offset.saturating_add(bytes.len() as u32));
        stored.map(|stored| bytes.copy_from_slice(stored)).ok_or(NorFlashErrorKind::OutOfBounds)
    }

    fn capacity(&self) -> usize {
        self.bytes as usize
    }
}

impl NorFlash for MemoryFlash {
    const WRITE_SIZE: usize = 8;
    const ERASE_SIZE: usize = 4096;

    fn erase(&mut self, from: u32, to: u32) -> Result<(), NorFlashErrorKind> {
        check_erase(self, from, to)?;
        let first = self.may_change(&(from..to))?;
        // SAFETY: `new` demands memory here that is ours alone; none of it is lent, and `&mut self` ends every other
        // view of it.
        unsafe { ptr::write_bytes(first, 0xFF, (to - from) as usize) };
        Ok(())
    }

    fn write(&mut self, offset: u32, bytes: &[u8]) -> Result<(), NorFlashErrorKind> {
        check_write(self, offset, bytes.len())?;
        let first = self.may_change(&(offset..offset.saturating_add(bytes.len() as u32)))?;
        // SAFETY: as in `erase`.
        let stored = unsafe { slice::from_raw_parts_mut(first, bytes.len()) };
        stored.iter_mut().zip(bytes).for_each(|(stored, byte)| *stored &= byte);
        Ok(())
    }
}

impl MappedFlash for MemoryFlash {
    fn mapped(&self, range: Range<u32>) -> Option<&[u8]> {
        let pointer = self.pointer(&range)?;
        // SAFETY: `new` demands memory here that is ours alone, and nothing writes it while `self` is borrowed.
        Some(unsafe { slice::from_raw_parts(pointer, range.len()) })
    }
}
