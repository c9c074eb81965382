//! What can be checked of a pointer.

use super::Status;
use core::ffi::c_void;
use core::slice;

/// First byte and number of bytes of some memory.
pub(super) type Place = (*const u8, usize);

/// No bytes: overlaps nothing.
pub(super) const NOWHERE: Place = (core::ptr::null(), 0);

/// Whether two places share a byte.
pub(super) fn overlap((a, a_bytes): Place, (b, b_bytes): Place) -> bool {
    let (a, b) = (a.addr(), b.addr());
    a_bytes != 0 && b_bytes != 0 && a < b.saturating_add(b_bytes) && b < a.saturating_add(a_bytes)
}

/// A pointer that something is read from or written to: neither null nor misaligned.
pub(super) fn result<T>(pointer: *mut T) -> Result<*mut T, Status> {
    match pointer {
        pointer if pointer.is_null() => Err(Status::NullPointer),
        pointer if !pointer.is_aligned() => Err(Status::Misaligned),
        pointer => Ok(pointer),
    }
}

/// So many bytes, which can be there at all.
pub(super) fn place(start: *const c_void, bytes: usize) -> Result<Place, Status> {
    if start.is_null() {
        return Err(Status::NullPointer);
    }
    let ends = start.addr().checked_add(bytes).is_some() && isize::try_from(bytes).is_ok();
    if ends { Ok((start.cast(), bytes)) } else { Err(Status::WrongSize) }
}

/// Memory that is read.
///
/// # Safety
/// The place is one that [`place`] gave, readable, and nothing writes it during `'a`.
pub(super) unsafe fn memory<'a>((start, bytes): Place) -> &'a [u8] {
    // SAFETY: not null, of a possible length, and the caller vouches for the bytes.
    unsafe { slice::from_raw_parts(start, bytes) }
}

/// Memory that is written.
///
/// # Safety
/// The place is one that [`place`] gave, from a pointer that may write, and nothing else reads or writes it during
/// `'a`.
pub(super) unsafe fn memory_mut<'a>((start, bytes): Place) -> &'a mut [u8] {
    // SAFETY: not null, of a possible length, and the caller vouches for the bytes.
    unsafe { slice::from_raw_parts_mut(start.cast_mut(), bytes) }
}
