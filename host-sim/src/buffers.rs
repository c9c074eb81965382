//! Working memory of the engine on the host: an arena between guard bytes.

use model_compiler::error::{Error, ErrorCode, Result};

const GUARD_BYTES: usize = 64;
const GUARD: u8 = 0xA5;

/// An arena of the size and alignment that an image asks for, with guard bytes on both sides.
#[derive(Debug)]
pub struct GuardedArena {
    /// u128, so that an address that is a multiple of 16 is nearby.
    storage: Vec<u128>,
    first: usize,
    length: usize,
}

impl GuardedArena {
    /// An arena of `length` bytes that starts at a multiple of `alignment` (a power of two).
    pub fn new(length: usize, alignment: usize) -> Self {
        let bytes = length + 2 * GUARD_BYTES + alignment;
        let storage = vec![0_u128; bytes.div_ceil(size_of::<u128>())];
        let address = storage.as_ptr().addr() + GUARD_BYTES;
        let first = GUARD_BYTES + (address.next_multiple_of(alignment) - address);
        let mut arena = Self { storage, first, length };
        arena.bytes_mut().fill(GUARD);
        arena
    }

    /// The arena, every byte set to `pattern`: what the engine does not write before it reads becomes visible.
    ///
    /// The slice ends behind the guard, so an engine that uses more than the image declares meets it.
    pub fn poisoned(&mut self, pattern: u8) -> &mut [u8] {
        let (first, length) = (self.first, self.length);
        let bytes = self.bytes_mut();
        bytes[first..first + length].fill(pattern);
        &mut bytes[first..first + length + GUARD_BYTES]
    }

    /// Checks that nothing was written outside.
    ///
    /// # Errors
    /// [`ErrorCode::Check`] with the first changed byte, counted from the start of the arena.
    pub fn check_guards(&self) -> Result<()> {
        let bytes: &[u8] = bytemuck::cast_slice(&self.storage);
        let end = self.first + self.length;
        let mut outside = (0..self.first).chain(end..bytes.len());
        match outside.find(|&i| bytes[i] != GUARD) {
            None => Ok(()),
            Some(i) => {
                let offset = i as i64 - self.first as i64;
                let message =
                    format!("a byte outside was written: offset {offset} of an arena of {} bytes", self.length);
                Err(Error::new(ErrorCode::Check, "arena", message))
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

    #[test]
    fn the_arena_is_aligned_and_poisoned() {
        for (length, alignment) in [(0, 16), (1, 16), (100, 64), (4096, 4096)] {
            let mut arena = GuardedArena::new(length, alignment);
            let bytes = arena.poisoned(0x5A);
            assert_eq!(bytes.as_ptr().addr() % alignment, 0);
            assert!(bytes[..length].iter().all(|&b| b == 0x5A));
            arena.check_guards().unwrap();
        }
    }

    #[test]
    fn a_write_on_either_side_is_found() {
        let mut behind = GuardedArena::new(32, 16);
        behind.poisoned(0)[32] = 1;
        assert!(behind.check_guards().unwrap_err().message.contains("offset 32 of an arena of 32 bytes"));
        let mut before = GuardedArena::new(32, 16);
        let first = before.first;
        before.bytes_mut()[first - 1] = 1;
        assert!(before.check_guards().unwrap_err().message.contains("offset -1 "));
    }
}
