//! A model image in memory-mapped flash or RAM.

use core::slice;
use firmware::image::layout;

/// The image that lies at `base`, as long as its header says, and no longer than `capacity`; the caller parses it.
///
/// # Safety
/// `capacity` readable bytes lie at `base`, a multiple of 16, and nothing writes them from now on.
pub unsafe fn stored(base: usize, capacity: usize) -> &'static [u8] {
    // SAFETY: the caller vouches for these bytes.
    let memory = unsafe { slice::from_raw_parts(base as *const u8, capacity) };
    layout::stated_length(memory).and_then(|length| memory.get(..length)).unwrap_or(memory)
}
