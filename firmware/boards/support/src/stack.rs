//! How deep the stack was used: start-up paints it, the program overwrites.

use core::arch::asm;
use core::ptr;

/// What start-up paints the stack with (cortex-m-rt's value, which `virt` uses, too).
const PAINT: u32 = 0xCCCC_CCCC;

unsafe extern "C" {
    /// Lowest address of the stack, from the linker script.
    #[link_name = "_stack_end"]
    static mut END: u32;
    /// Address behind the stack, which grows downward from here.
    #[link_name = "_stack_start"]
    static START: u32;
}

/// Bytes that the stack has for itself.
pub fn capacity_bytes() -> usize {
    (&raw const START).addr().saturating_sub((&raw const END).addr())
}

/// Bytes of the stack that were ever written since start-up, or since the last [`Mark`].
pub fn peak_bytes() -> usize {
    (&raw const START).addr().saturating_sub(lowest().addr())
}

/// A depth of the stack, below which it is painted anew.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Mark(usize);

impl Mark {
    /// Marks the depth of the caller and paints everything below.
    #[inline(always)]
    #[expect(clippy::new_without_default, reason = "it paints")]
    pub fn new() -> Self {
        let pointer: usize;
        // SAFETY: reads a register.
        unsafe { asm!("mov {}, sp", out(reg) pointer, options(nomem, nostack, preserves_flags)) };
        let mut word = &raw mut END;
        while word.addr() < pointer {
            // SAFETY: memory of the stack below the stack pointer: nothing is kept there.
            unsafe { ptr::write_volatile(word, PAINT) };
            word = word.wrapping_add(1);
        }
        Self(pointer)
    }

    /// Bytes below the mark that calls wrote since.
    pub fn depth_bytes(self) -> usize {
        self.0.saturating_sub(lowest().addr())
    }
}

/// The lowest word that is not painted.
fn lowest() -> *const u32 {
    let (mut word, start) = (&raw const END, &raw const START);
    // SAFETY: memory of the stack, all of it painted by start-up; the words read lie below whatever is in use, or are
    // the first in use.
    while word < start && unsafe { ptr::read_volatile(word) } == PAINT {
        word = word.wrapping_add(1);
    }
    word
}
