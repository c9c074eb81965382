//! Little-endian fields of a byte slice, without panics.

use core::ops::Range;

/// The byte at a one-byte range.
pub fn u8_at(bytes: &[u8], at: Range<usize>) -> Option<u8> {
    bytes.get(at)?.first().copied()
}

/// `u16` at a two-byte range.
pub fn u16_at(bytes: &[u8], at: Range<usize>) -> Option<u16> {
    Some(u16::from_le_bytes(bytes.get(at)?.try_into().ok()?))
}

/// `u32` at a four-byte range.
pub fn u32_at(bytes: &[u8], at: Range<usize>) -> Option<u32> {
    Some(u32::from_le_bytes(bytes.get(at)?.try_into().ok()?))
}

/// `u64` at an eight-byte range.
pub fn u64_at(bytes: &[u8], at: Range<usize>) -> Option<u64> {
    Some(u64::from_le_bytes(bytes.get(at)?.try_into().ok()?))
}

/// The `index`-th record of `size` bytes.
pub fn record_at(bytes: &[u8], index: usize, size: usize) -> Option<&[u8]> {
    let start = index.checked_mul(size)?;
    bytes.get(start..start.checked_add(size)?)
}

/// Writes a field of a record; a range and a value of different lengths leave the record as it is.
pub(super) fn put(record: &mut [u8], at: Range<usize>, value: &[u8]) {
    if let Some(field) = record.get_mut(at)
        && field.len() == value.len()
    {
        field.copy_from_slice(value);
    }
}
