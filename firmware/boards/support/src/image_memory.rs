//! A model image in memory-mapped flash or RAM.

use core::slice;
use firmware::image::layout::header;

/// The image that lies at `base`, as long as its header says, and what lies behind it, both within `capacity`; the
/// caller parses the image. Where the stated length is none, everything counts as image.
///
/// # Safety
/// `capacity` readable bytes lie at `base`, a multiple of 16, and nothing writes them from now on.
pub unsafe fn stored(base: usize, capacity: usize) -> (&'static [u8], &'static [u8]) {
    // SAFETY: the caller vouches for these bytes.
    let memory = unsafe { slice::from_raw_parts(base as *const u8, capacity) };
    let stated = memory.get(header::TOTAL_BYTES).and_then(|field| field.try_into().ok()).map(u32::from_le_bytes);
    let length = stated.and_then(|bytes| usize::try_from(bytes).ok()).unwrap_or(0);
    memory.split_at_checked(length).unwrap_or((memory, &[]))
}
