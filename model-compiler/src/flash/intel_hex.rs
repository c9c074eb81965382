//! Intel HEX: data records of 32 bytes, and the upper half of the address wherever it changes.

use crate::error::{Error, ErrorCode, Result};
use ihex::Record;

/// Bytes of a data record. It divides 64 KiB, so a record that begins at a multiple of 16 may be cut at its end only.
const RECORD_BYTES: usize = 32;
/// Bytes that records reach under one upper half of the address.
const PAGE_BYTES: usize = 1 << 16;

pub(super) fn file(image: &[u8], address: u32) -> Result<Vec<u8>> {
    let mut text = String::with_capacity(image.len() / RECORD_BYTES * (2 * RECORD_BYTES + 12));
    let mut put = |record: Record| -> Result<()> {
        let line = record.to_record_string();
        text += &line.map_err(|e| Error::new(ErrorCode::Malformed, "Intel HEX", e.to_string()))?;
        text.push('\n');
        Ok(())
    };
    let (mut at, mut rest) = (address, image);
    while !rest.is_empty() {
        put(Record::ExtendedLinearAddress((at >> 16) as u16))?;
        let offset = at as u16;
        let (page, behind) = rest.split_at(rest.len().min(PAGE_BYTES - usize::from(offset)));
        for (record, value) in page.chunks(RECORD_BYTES).enumerate() {
            // Within the page, so within 16 bits.
            let offset = offset + (record * RECORD_BYTES) as u16;
            put(Record::Data { offset, value: value.to_vec() })?;
        }
        at = at.wrapping_add(page.len() as u32);
        rest = behind;
    }
    put(Record::EndOfFile)?;
    Ok(text.into_bytes())
}
