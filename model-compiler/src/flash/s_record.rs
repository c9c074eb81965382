//! Motorola S-records: a header with the model's name (S0), data with 32-bit addresses (S3), the end (S7).

use std::fmt::Write as _;

/// Bytes of a data record.
const RECORD_BYTES: usize = 32;

pub(super) fn file(image: &[u8], name: &str, address: u32) -> String {
    let mut text = String::with_capacity(image.len() / RECORD_BYTES * (2 * RECORD_BYTES + 15));
    put(&mut text, '0', &[0, 0], name.as_bytes());
    for (record, data) in image.chunks(RECORD_BYTES).enumerate() {
        // The image ends within 32-bit addresses.
        let at = address + (record * RECORD_BYTES) as u32;
        put(&mut text, '3', &at.to_be_bytes(), data);
    }
    put(&mut text, '7', &address.to_be_bytes(), &[]);
    text
}

/// One record: `S`, kind, number of bytes that follow, address, data, and the ones' complement of their sum's low byte.
fn put(text: &mut String, kind: char, address: &[u8], data: &[u8]) {
    let count = (address.len() + data.len() + 1) as u8;
    let sum = std::iter::once(&count).chain(address).chain(data).fold(0_u8, |sum, byte| sum.wrapping_add(*byte));
    let _ = write!(text, "S{kind}{count:02X}");
    for byte in address.iter().chain(data).chain([&!sum]) {
        let _ = write!(text, "{byte:02X}");
    }
    text.push('\n');
}

#[cfg(test)]
mod tests {
    use super::*;

    /// The header, a data record and the end as published descriptions of the format show them.
    #[test]
    fn records_are_those_of_the_format_s_description() {
        let mut text = String::new();
        put(&mut text, '0', &[0, 0], b"HDR");
        put(&mut text, '1', &[0x00, 0x38], b"Hello world.\n\0");
        put(&mut text, '9', &[0, 0], &[]);
        assert_eq!(text, "S00600004844521B\nS111003848656C6C6F20776F726C642E0A0042\nS9030000FC\n");
    }
}
