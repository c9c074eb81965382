//! Memory-mapped flash, or RAM in its place, that holds model images.

use crate::memory_flash::MemoryFlash;
use core::slice;
use firmware::image::layout;

/// Memory that holds model images; taken either as they lie there, or as a flash that is written, too.
#[derive(Debug)]
pub struct ImageMemory {
    base: usize,
    bytes: u32,
}

impl ImageMemory {
    /// The memory at an address.
    ///
    /// # Safety
    /// `bytes` bytes of memory lie at `base`, a multiple of 16, and nothing else in the program refers to them.
    pub const unsafe fn new(base: usize, bytes: u32) -> Self {
        Self { base, bytes }
    }

    /// The image at the start, as long as its header says, and what lies behind it; the caller parses the image. Where
    /// the stated length is none, everything counts as image.
    pub fn stored(self) -> (&'static [u8], &'static [u8]) {
        // SAFETY: `new` demands memory here that is ours alone, and nothing writes it from now on.
        let memory = unsafe { slice::from_raw_parts(self.base as *const u8, self.bytes as usize) };
        let length = layout::stated_length(memory).unwrap_or(0);
        memory.split_at_checked(length).unwrap_or((memory, &[]))
    }

    /// A flash with two slots.
    pub fn flash(self) -> MemoryFlash {
        // SAFETY: `new` demands memory here that is ours alone.
        unsafe { MemoryFlash::new(self.base, self.bytes) }
    }
}
