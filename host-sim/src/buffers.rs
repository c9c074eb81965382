//! Working memory of the engine on the host: per memory region of an image a buffer between guard bytes.

use firmware::arena::Regions;
use firmware::image::{Image, Region};
use model_compiler::error::{Error, ErrorCode, Result};

const GUARD_BYTES: usize = 64;
const GUARD: u8 = 0xA5;

/// Buffers of the sizes and alignments that an image asks for, with guard bytes on both sides of each.
#[derive(Debug)]
pub struct GuardedArena {
    buffers: Vec<GuardedBuffer>,
}

impl GuardedArena {
    /// The memory that an image needs.
    pub fn new(image: &Image<'_>) -> Self {
        Self { buffers: image.regions().map(GuardedBuffer::new).collect() }
    }

    /// The buffers for an engine, every byte set to `pattern`: what the engine does not write before it reads becomes
    /// visible.
    ///
    /// Each ends behind its guard, so an engine that uses more than the image declares meets it.
    pub fn poisoned(&mut self, pattern: u8) -> Regions<'_> {
        self.buffers.iter_mut().map(|buffer| buffer.poisoned(pattern)).collect()
    }

    /// Checks that nothing was written outside.
    ///
    /// # Errors
    /// [`ErrorCode::Check`] with the region and the first changed byte, counted from the start of its arena.
    pub fn check_guards(&self) -> Result<()> {
        self.buffers.iter().try_for_each(GuardedBuffer::check_guards)
    }
}

/// The arena of one region.
#[derive(Debug)]
struct GuardedBuffer {
    region: Region,
    /// u128, so that an address that is a multiple of 16 is nearby.
    storage: Vec<u128>,
    first: usize,
    length: usize,
}

impl GuardedBuffer {
    fn new(region: Region) -> Self {
        let (length, alignment) = (region.bytes as usize, region.alignment as usize);
        let bytes = length + 2 * GUARD_BYTES + alignment;
        let storage = vec![0_u128; bytes.div_ceil(size_of::<u128>())];
        let address = storage.as_ptr().addr() + GUARD_BYTES;
        let first = GUARD_BYTES + (address.next_multiple_of(alignment) - address);
        let mut buffer = Self { region, storage, first, length };
        buffer.bytes_mut().fill(GUARD);
        buffer
    }

    fn poisoned(&mut self, pattern: u8) -> &mut [u8] {
        let (first, length) = (self.first, self.length);
        let bytes = self.bytes_mut();
        bytes[first..first + length].fill(pattern);
        &mut bytes[first..first + length + GUARD_BYTES]
    }

    fn check_guards(&self) -> Result<()> {
        let bytes: &[u8] = bytemuck::cast_slice(&self.storage);
        let end = self.first + self.length;
        let mut outside = (0..self.first).chain(end..bytes.len());
        match outside.find(|&i| bytes[i] != GUARD) {
            None => Ok(()),
            Some(i) => {
                let offset = i as i64 - self.first as i64;
                let message =
                    format!("a byte outside was written: offset {offset} of an arena of {} bytes", self.length);
                Err(Error::new(ErrorCode::Check, format!("arena {}", self.region.name), message))
            }
        }
    }

    fn bytes_mut(&mut self) -> &mut [u8] {
        bytemuck::cast_slice_mut(&mut self.storage)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use firmware::image::RegionName;

    fn buffer(bytes: u32, alignment: u32) -> GuardedBuffer {
        GuardedBuffer::new(Region { name: RegionName::MAIN, bytes, alignment })
    }

    #[test]
    fn the_arena_is_aligned_and_poisoned() {
        for (length, alignment) in [(0, 16), (1, 16), (100, 64), (4096, 4096)] {
            let mut buffer = buffer(length, alignment);
            let bytes = buffer.poisoned(0x5A);
            assert_eq!(bytes.as_ptr().addr() % alignment as usize, 0);
            assert!(bytes[..length as usize].iter().all(|&b| b == 0x5A));
            buffer.check_guards().unwrap();
        }
    }

    #[test]
    fn a_write_on_either_side_of_any_buffer_is_found() {
        let mut behind = GuardedArena { buffers: vec![buffer(16, 16), buffer(32, 16)] };
        behind.check_guards().unwrap();
        behind.buffers[1].poisoned(0)[32] = 1;
        let error = behind.check_guards().unwrap_err();
        assert!(error.message.contains("offset 32 of an arena of 32 bytes") && error.location == "arena main");
        let mut before = buffer(32, 16);
        let first = before.first;
        before.bytes_mut()[first - 1] = 1;
        assert!(before.check_guards().unwrap_err().message.contains("offset -1 "));
    }
}
