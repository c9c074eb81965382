//! The known answer: what every step must give for inputs that a seed determines.
//!
//! The input rule: one [`Generator`] (splitmix64 started with the seed) fills the inputs in header order. Every draw
//! gives eight bytes, little-endian; the last draw of an input is cut to its end, the next input begins with a fresh
//! draw. The bytes are the codes, except that 32-bit values are then shifted right by 8 arithmetically (±128 m in Q16).

use super::bytes;
use super::layout::known_answer::{CRC_BYTES, CRCS, SEED};
use crate::tensor::ElementType;

/// View of the section.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct KnownAnswer<'a> {
    section: &'a [u8],
}

impl<'a> KnownAnswer<'a> {
    pub(super) fn new(section: &'a [u8]) -> Self {
        Self { section }
    }

    /// Seed of the input rule.
    pub fn seed(&self) -> u64 {
        bytes::u64_at(self.section, SEED).unwrap_or(0)
    }

    /// CRC-32 of the output bytes of the step at `position`.
    pub fn step_crc(&self, position: u16) -> Option<u32> {
        let record = bytes::record_at(self.section.get(CRCS..)?, position.into(), CRC_BYTES)?;
        bytes::u32_at(record, 0..CRC_BYTES)
    }
}

/// splitmix64, the source of the input rule.
#[derive(Clone, Debug)]
pub struct Generator {
    state: u64,
}

impl Generator {
    /// Starts with a seed.
    pub const fn new(seed: u64) -> Self {
        Self { state: seed }
    }

    /// The next draw.
    pub const fn draw(&mut self) -> u64 {
        self.state = self.state.wrapping_add(0x9E37_79B9_7F4A_7C15);
        let z = (self.state ^ (self.state >> 30)).wrapping_mul(0xBF58_476D_1CE4_E5B9);
        let z = (z ^ (z >> 27)).wrapping_mul(0x94D0_49BB_1331_11EB);
        z ^ (z >> 31)
    }

    /// Fills one input by the rule of the module page.
    pub fn fill(&mut self, element: ElementType, input: &mut [u8]) {
        for chunk in input.chunks_mut(8) {
            for (byte, drawn) in chunk.iter_mut().zip(self.draw().to_le_bytes()) {
                *byte = drawn;
            }
        }
        if element == ElementType::I32 {
            for word in input.as_chunks_mut::<4>().0 {
                *word = (i32::from_le_bytes(*word) >> 8).to_le_bytes();
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn generator_is_splitmix64() {
        // First outputs of the reference implementation for seed 1234567.
        let mut generator = Generator::new(1_234_567);
        assert_eq!(generator.draw(), 6_457_827_717_110_365_317);
        assert_eq!(generator.draw(), 3_203_168_211_198_807_973);
    }

    #[test]
    fn words_stay_within_24_bits() {
        let mut input = [0; 40];
        Generator::new(7).fill(ElementType::I32, &mut input);
        for word in input.as_chunks::<4>().0 {
            assert!(i32::from_le_bytes(*word).abs() <= 1 << 23);
        }
        assert!(input.iter().any(|byte| *byte != 0));
    }
}
