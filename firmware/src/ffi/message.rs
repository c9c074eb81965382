//! Messages in a caller's buffer.

use core::fmt::{self, Write};

/// A text that ends with a zero, cut at the last character that fits.
struct Buffer<'a> {
    bytes: &'a mut [u8],
    length: usize,
}

impl Write for Buffer<'_> {
    fn write_str(&mut self, text: &str) -> fmt::Result {
        for character in text.chars() {
            let mut utf8 = [0; 4];
            let encoded = character.encode_utf8(&mut utf8).as_bytes();
            let end = self.length.saturating_add(encoded.len());
            // One byte stays for the zero.
            if end >= self.bytes.len() {
                return Err(fmt::Error);
            }
            let room = self.bytes.get_mut(self.length..end).unwrap_or_default();
            room.iter_mut().zip(encoded).for_each(|(place, byte)| *place = *byte);
            self.length = end;
        }
        Ok(())
    }
}

/// Writes a message; the rest of the buffer is zero.
pub(super) fn write(bytes: &mut [u8], message: impl fmt::Display) {
    bytes.fill(0);
    // A message that is cut is still one.
    let _ = write!(Buffer { bytes, length: 0 }, "{message}");
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_message_is_cut_between_characters_and_ends_with_zero() {
        let cases: [(usize, &[u8]); 5] =
            [(0, b""), (1, b"\0"), (4, b"ab\0\0"), (5, b"ab\0\0\0"), (6, b"ab\xE2\x82\xAC\0")];
        for (capacity, expected) in cases {
            let mut bytes = [0xFF; 6];
            let (buffer, behind) = bytes.split_at_mut(capacity);
            write(buffer, "ab€");
            assert_eq!(buffer, expected);
            assert!(behind.iter().all(|byte| *byte == 0xFF));
        }
    }
}
