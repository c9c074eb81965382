//! What an update needs of a flash.

use super::error::{FlashError, FlashOperation};
use core::ops::Range;
use embedded_storage::nor_flash::{NorFlash, NorFlashError, NorFlashErrorKind};

/// A NOR flash whose bytes the processor sees in its address space, where images are executed in place.
///
/// What [`MappedFlash::mapped`] shows is what was written: an implementation invalidates caches and leaves any command
/// mode before a write or an erase returns. If the flash cannot be read while it is written, those calls wait until it
/// can (and run from RAM).
pub trait MappedFlash: NorFlash {
    /// The bytes at these offsets, where the processor sees them; `None` beyond the end. Offset 0 lies at an address
    /// that is a multiple of 16.
    fn mapped(&self, range: Range<u32>) -> Option<&[u8]>;
}

impl<F: MappedFlash> MappedFlash for &mut F {
    fn mapped(&self, range: Range<u32>) -> Option<&[u8]> {
        F::mapped(self, range)
    }
}

pub(super) fn erase<F: NorFlash>(flash: &mut F, range: Range<u32>) -> Result<(), FlashError> {
    let failed = failed(FlashOperation::Erase, range.start);
    flash.erase(range.start, range.end).map_err(|error| failed(error.kind()))
}

pub(super) fn write<F: NorFlash>(flash: &mut F, offset: u32, bytes: &[u8]) -> Result<(), FlashError> {
    flash.write(offset, bytes).map_err(|error| failed(FlashOperation::Write, offset)(error.kind()))
}

pub(super) fn read<F: NorFlash>(flash: &mut F, offset: u32, bytes: &mut [u8]) -> Result<(), FlashError> {
    flash.read(offset, bytes).map_err(|error| failed(FlashOperation::Read, offset)(error.kind()))
}

pub(super) fn mapped<F: MappedFlash>(flash: &F, range: Range<u32>) -> Result<&[u8], FlashError> {
    let missing = failed(FlashOperation::Map, range.start)(NorFlashErrorKind::OutOfBounds);
    flash.mapped(range).ok_or(missing)
}

fn failed(operation: FlashOperation, offset: u32) -> impl FnOnce(NorFlashErrorKind) -> FlashError {
    move |kind| FlashError { operation, offset, kind }
}
