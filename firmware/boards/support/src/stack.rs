//! How deep the stack was used: start-up paints it, the program overwrites.

use core::ptr;

/// What start-up paints the stack with (cortex-m-rt's value, which `virt` uses, too).
const PAINT: u32 = 0xCCCC_CCCC;

unsafe extern "C" {
    /// Lowest address of the stack, from the linker script.
    #[link_name = "_stack_end"]
    static END: u32;
    /// Address behind the stack, which grows downward from here.
    #[link_name = "_stack_start"]
    static START: u32;
}

/// Bytes that the stack has for itself.
pub fn capacity_bytes() -> usize {
    (&raw const START).addr().saturating_sub((&raw const END).addr())
}

/// Bytes of the stack that were ever written since start-up.
pub fn peak_bytes() -> usize {
    let (mut word, start) = (&raw const END, &raw const START);
    // SAFETY: memory of the stack, all of it painted by start-up; the words read lie below whatever is in use, or are
    // the first in use.
    while word < start && unsafe { ptr::read_volatile(word) } == PAINT {
        word = word.wrapping_add(1);
    }
    start.addr().saturating_sub(word.addr())
}
