//! Packets: sequence number and message, CRC-32, COBS.

use crate::image::{Digest, crc32, digest};
use core::fmt;
use heapless::Vec;
use postcard::ser_flavors::Flavor;
use postcard::serialize_with_flavor;
use serde::{Deserialize, Serialize};

/// Most bytes of a packet before COBS: sequence number, message, CRC.
pub const MAX_PACKET: usize = 1024;
/// Most bytes of a packet on the line: COBS adds one byte per 254 begun, and the zero.
pub const MAX_ENCODED: usize = MAX_PACKET + MAX_PACKET / 254 + 2;

const CRC_BYTES: usize = 4;

/// A message does not fit in a packet.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub struct TooLong;

impl fmt::Display for TooLong {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "the message does not fit in a packet of {MAX_PACKET} bytes")
    }
}

impl core::error::Error for TooLong {}

/// Why what came between two zeros is no packet.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub enum Damage {
    /// It is longer than any packet.
    Overlong,
    /// It ended within a block of COBS.
    Truncated,
    /// Its CRC is wrong.
    Crc,
    /// Its bytes are no message of this protocol.
    Message,
}

impl fmt::Display for Damage {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            Self::Overlong => "packet too long",
            Self::Truncated => "packet cut short",
            Self::Crc => "packet with a wrong CRC",
            Self::Message => "packet that holds no message of this protocol",
        })
    }
}

impl core::error::Error for Damage {}

/// Writes bytes as blocks of COBS and takes their CRC on the way. (postcard's own flavors index their buffer, which can
/// panic.)
struct Writer<'b> {
    buffer: &'b mut [u8],
    /// Where the code of the block under way goes.
    code: usize,
    /// Where its next byte goes.
    end: usize,
    crc: Digest,
}

impl Writer<'_> {
    fn put(&mut self, byte: u8) -> postcard::Result<()> {
        if byte != 0 {
            self.set(self.end, byte)?;
            self.end = self.end.wrapping_add(1);
        }
        let is_full = self.end.wrapping_sub(self.code) == usize::from(u8::MAX);
        if byte == 0 || is_full { self.end_block() } else { Ok(()) }
    }

    /// Writes the code of the block: its length with the code itself.
    fn end_block(&mut self) -> postcard::Result<()> {
        let length = u8::try_from(self.end.wrapping_sub(self.code)).map_err(|_| FULL)?;
        self.set(self.code, length)?;
        self.code = self.end;
        self.end = self.end.wrapping_add(1);
        Ok(())
    }

    fn set(&mut self, at: usize, byte: u8) -> postcard::Result<()> {
        self.buffer.get_mut(at).map(|slot| *slot = byte).ok_or(FULL)
    }
}

const FULL: postcard::Error = postcard::Error::SerializeBufferFull;

impl<'b> Flavor for Writer<'b> {
    type Output = &'b mut [u8];

    fn try_push(&mut self, byte: u8) -> postcard::Result<()> {
        self.crc.update(&[byte]);
        self.put(byte)
    }

    fn finalize(mut self) -> postcard::Result<&'b mut [u8]> {
        let crc = self.crc.clone().finalize().to_le_bytes();
        crc.into_iter().try_for_each(|byte| self.put(byte))?;
        self.end_block()?;
        // The place of the next block's code is the delimiter's.
        self.set(self.code, 0)?;
        self.buffer.get_mut(..self.end).ok_or(FULL)
    }
}

/// The bytes of a message on the line, its zero included, in `buffer` of [`MAX_ENCODED`] bytes.
///
/// # Errors
/// The message is longer than a packet or than the buffer.
pub fn encode<'b>(sequence: u16, message: &impl Serialize, buffer: &'b mut [u8]) -> Result<&'b mut [u8], TooLong> {
    let writer = Writer { buffer, code: 0, end: 1, crc: digest() };
    let encoded = serialize_with_flavor(&(sequence, message), writer);
    encoded.ok().filter(|encoded| encoded.len() <= MAX_ENCODED).ok_or(TooLong)
}

/// Sequence number and message of a packet that [`Receiver::push`] announced.
///
/// # Errors
/// [`Damage::Crc`], [`Damage::Message`].
pub fn decode<'p, M: Deserialize<'p>>(packet: &'p [u8]) -> Result<(u16, M), Damage> {
    let (body, crc) = packet.split_last_chunk::<CRC_BYTES>().ok_or(Damage::Crc)?;
    if crc32(body) != u32::from_le_bytes(*crc) {
        return Err(Damage::Crc);
    }
    match postcard::take_from_bytes::<(u16, M)>(body) {
        Ok((packet, [])) => Ok(packet),
        _ => Err(Damage::Message),
    }
}

/// Takes bytes from the line one by one and undoes COBS on the way. (The decoders of the usual crates need the whole
/// packet, or hold on to its buffer.)
#[derive(Debug, Default)]
pub struct Receiver {
    packet: Vec<u8, MAX_PACKET>,
    /// Bytes until the next code byte.
    remaining: u8,
    /// Whether the block under way stands for a zero at its end.
    has_zero: bool,
    /// Whether anything came since the last zero.
    is_begun: bool,
    is_overlong: bool,
}

impl Receiver {
    /// A receiver between two packets.
    pub const fn new() -> Self {
        Self { packet: Vec::new(), remaining: 0, has_zero: false, is_begun: false, is_overlong: false }
    }

    /// Takes a byte. `Some` at the end of a packet: its bytes without COBS, for [`decode`].
    pub fn push(&mut self, byte: u8) -> Option<Result<&[u8], Damage>> {
        if byte == 0 {
            return self.finish();
        }
        if !self.is_begun {
            *self = Self { is_begun: true, ..Self::new() };
        }
        if let Some(remaining) = self.remaining.checked_sub(1) {
            self.remaining = remaining;
            self.append(byte);
        } else {
            if self.has_zero {
                self.append(0);
            }
            self.remaining = byte.saturating_sub(1);
            self.has_zero = byte < u8::MAX;
        }
        None
    }

    fn append(&mut self, byte: u8) {
        self.is_overlong |= self.packet.push(byte).is_err();
    }

    fn finish(&mut self) -> Option<Result<&[u8], Damage>> {
        // Zeros between packets are harmless: a sender may begin with some.
        core::mem::take(&mut self.is_begun).then_some(())?;
        let is_whole = core::mem::take(&mut self.remaining) == 0;
        self.has_zero = false;
        Some(match (core::mem::take(&mut self.is_overlong), is_whole) {
            (true, _) => Err(Damage::Overlong),
            (_, false) => Err(Damage::Truncated),
            (_, true) => Ok(&self.packet),
        })
    }
}

#[cfg(test)]
#[allow(
    clippy::unwrap_used,
    clippy::indexing_slicing,
    clippy::arithmetic_side_effects,
    reason = "what is missing fails the test"
)]
mod tests {
    extern crate std;
    use super::*;
    use proptest::prelude::*;
    use std::vec::Vec as StdVec;

    fn encoded(sequence: u16, message: &impl Serialize) -> StdVec<u8> {
        let mut buffer = [0; MAX_ENCODED];
        encode(sequence, message, &mut buffer).unwrap().to_vec()
    }

    /// What a stream holds: messages of bytes, or damage.
    fn received(stream: &[u8]) -> StdVec<Result<(u16, StdVec<u8>), Damage>> {
        let mut receiver = Receiver::new();
        let mut all = StdVec::new();
        for &byte in stream {
            if let Some(packet) = receiver.push(byte) {
                let message = packet.and_then(decode::<&[u8]>);
                all.push(message.map(|(sequence, bytes)| (sequence, bytes.to_vec())));
            }
        }
        all
    }

    #[test]
    fn the_bytes_on_the_line_are_these() {
        // 0x0102 as a varint, one byte of message, CRC-32 of these three bytes, COBS around all.
        let crc = crc32(&[0x82, 0x02, 0x00]).to_le_bytes();
        let [a, b, c, d] = crc;
        assert!(!crc.contains(&0));
        assert_eq!(encoded(0x0102, &0_u8), [3, 0x82, 0x02, 5, a, b, c, d, 0]);
    }

    #[test]
    fn a_message_of_any_length_arrives_up_to_a_whole_packet() {
        // Sequence number and length take a byte or two each, the CRC four.
        for length in 0..=MAX_PACKET - 7 {
            for fill in [0, 1, 255] {
                let message = std::vec![fill; length];
                let stream = encoded(7, &message.as_slice());
                assert!(stream.len() <= MAX_ENCODED && stream.iter().rev().skip(1).all(|byte| *byte != 0));
                assert_eq!(received(&stream), [Ok((7, message))]);
            }
        }
        let mut buffer = [0; 2 * MAX_ENCODED];
        assert_eq!(encode(7, &[1_u8; MAX_ENCODED].as_slice(), &mut buffer), Err(TooLong));
        assert_eq!(encode(7, &[1_u8; 100].as_slice(), &mut buffer[..100]), Err(TooLong));
    }

    #[test]
    fn damage_is_named_and_the_next_packet_arrives() {
        let good = encoded(1, &[5_u8, 0, 6].as_slice());
        let mut wrong = good.clone();
        wrong[2] ^= 1;
        let mut cut = good.clone();
        cut.remove(good.len() - 2);
        let overlong = [[1; 2 * MAX_PACKET].as_slice(), &[0]].concat();
        let no_message = encoded(1, &300_u32);
        for (stream, damage) in [
            (wrong, Damage::Crc),
            (cut, Damage::Truncated),
            (overlong, Damage::Overlong),
            (std::vec![1, 1, 0], Damage::Crc),
            (no_message, Damage::Message),
        ] {
            let stream = [&stream[..], &[0, 0], &good].concat();
            assert_eq!(received(&stream), [Err(damage), Ok((1, std::vec![5, 0, 6]))], "{damage}");
        }
    }

    proptest! {
        #[test]
        fn any_bytes_are_survived_and_a_packet_behind_them_arrives(noise: StdVec<u8>, message: StdVec<u8>) {
            let stream = [&noise[..], &[0], &encoded(3, &message.as_slice())].concat();
            let expected = (3, message);
            prop_assert_eq!(received(&stream).pop(), Some(Ok(expected)));
        }

        #[test]
        fn every_flipped_bit_is_noticed(message in prop::collection::vec(any::<u8>(), 0..40), bit: prop::sample::Index) {
            let mut stream = encoded(3, &message.as_slice());
            let bit = bit.index(8 * (stream.len() - 1));
            stream[bit / 8] ^= 1 << (bit % 8);
            prop_assert!(received(&stream).iter().all(Result::is_err));
        }
    }
}
