//! The packing [`KernelId::K4N16`](crate::program::KernelId::K4N16): weights of 16 outputs, 4 depth elements of each
//! side by side, so that one 64-byte load holds what one broadcast of 4 input codes is multiplied with.
//!
//! Per channel group, blocks of 16 outputs follow each other; the last one is filled up with zero weights. A block is
//!
//! | bytes | content |
//! |---|---|
//! | 64 | `i32` per output, little-endian: the compensation `−128·Σw`, for kernels that add 128 to the input codes |
//! | 16 · depth, depth filled up with zeros to a multiple of 64 | `i8` weights `[depth / 4][16][4]` |

/// Outputs of a block.
pub const OUTPUTS: usize = 16;
/// Depth elements of one output that lie side by side.
pub const QUAD: usize = 4;
/// Bytes of 16 outputs × 4 depth elements.
pub const QUAD_BYTES: usize = OUTPUTS * QUAD;
/// The depth of a block is a multiple of this.
pub const DEPTH_STEP: usize = 64;
/// Bytes of the compensations in front of the weights of a block.
pub const COMPENSATION_BYTES: usize = 4 * OUTPUTS;
/// Compensation per unit of `Σw`: input codes are raised by 128 to become unsigned.
pub const COMPENSATION_FACTOR: i32 = -128;

/// Bytes of a block of 16 outputs with `depth` weights each; saturated.
pub const fn block_bytes(depth: u64) -> u64 {
    let steps = depth.div_ceil(DEPTH_STEP as u64);
    steps.saturating_mul((OUTPUTS * DEPTH_STEP) as u64).saturating_add(COMPENSATION_BYTES as u64)
}

/// Bytes of the weights of `groups` groups of `outputs` outputs each; saturated.
pub const fn packed_bytes(groups: u16, outputs: u16, depth: u64) -> u64 {
    let blocks = groups as u64 * (outputs as u64).div_ceil(OUTPUTS as u64);
    blocks.saturating_mul(block_bytes(depth))
}

/// Packs weights `[groups·outputs][depth]` into `packed`, zeros of [`packed_bytes`] for the same numbers. What does not
/// fit there is left out.
pub fn pack(weights: &[i8], outputs: u16, depth: usize, packed: &mut [i8]) {
    let (outputs, depth) = (usize::from(outputs).max(1), depth.max(1));
    let block_bytes = usize::try_from(block_bytes(depth as u64)).unwrap_or(usize::MAX);
    let groups = weights.chunks(outputs.saturating_mul(depth));
    let rows = groups.flat_map(|group| group.chunks(depth.saturating_mul(OUTPUTS)));
    for (rows, block) in rows.zip(packed.chunks_exact_mut(block_bytes)) {
        let Some((compensations, quads)) = block.split_at_mut_checked(COMPENSATION_BYTES) else { return };
        for (lane, (row, compensation)) in rows.chunks(depth).zip(compensations.as_chunks_mut().0).enumerate() {
            let sum = row.iter().fold(0_i32, |sum, weight| sum.wrapping_add((*weight).into()));
            *compensation = sum.wrapping_mul(COMPENSATION_FACTOR).to_le_bytes().map(u8::cast_signed);
            for (weights, quad) in row.chunks(QUAD).zip(quads.chunks_exact_mut(QUAD_BYTES)) {
                quad.iter_mut().skip(QUAD * lane).zip(weights).for_each(|(packed, weight)| *packed = *weight);
            }
        }
    }
}

/// Packed weights of a step, read by output and depth.
#[derive(Clone, Copy, Debug)]
pub struct Packed<'a> {
    bytes: &'a [i8],
    outputs: usize,
    depth: usize,
    block_bytes: usize,
}

impl<'a> Packed<'a> {
    /// `bytes` of [`packed_bytes`] for groups of `outputs` outputs and `depth` weights each.
    pub fn new(bytes: &'a [i8], outputs: u16, depth: usize) -> Self {
        let block_bytes = usize::try_from(block_bytes(depth as u64)).unwrap_or(usize::MAX);
        Self { bytes, outputs: outputs.into(), depth, block_bytes }
    }

    /// The block that holds an output channel, and the place of the channel in it.
    fn block(&self, channel: usize) -> Option<(&'a [i8], usize)> {
        let (group, output) = (channel.checked_div(self.outputs)?, channel.checked_rem(self.outputs)?);
        let block = group * self.outputs.div_ceil(OUTPUTS) + output / OUTPUTS;
        let start = block.checked_mul(self.block_bytes)?;
        Some((self.bytes.get(start..start.checked_add(self.block_bytes)?)?, output % OUTPUTS))
    }

    /// The blocks of a group, one after the other.
    pub fn group(&self, group: usize) -> Option<&'a [i8]> {
        let length = self.outputs.div_ceil(OUTPUTS).checked_mul(self.block_bytes)?;
        let start = group.checked_mul(length)?;
        self.bytes.get(start..start.checked_add(length)?)
    }

    /// The compensation of an output channel.
    pub fn compensation(&self, channel: usize) -> Option<i32> {
        let (block, lane) = self.block(channel)?;
        let bytes: &[i8; 4] = block.get(4 * lane..)?.first_chunk()?;
        Some(i32::from_le_bytes(bytes.map(i8::cast_unsigned)))
    }

    /// The quads of weights of an output channel, with the zeros behind its depth.
    fn quads(&self, channel: usize) -> Option<impl Iterator<Item = &'a [i8; QUAD]> + use<'a>> {
        let (block, lane) = self.block(channel)?;
        let (quads, _) = block.get(COMPENSATION_BYTES..)?.as_chunks::<QUAD_BYTES>();
        Some(quads.iter().filter_map(move |quad| quad.as_chunks::<QUAD>().0.get(lane)))
    }

    /// Copies the weights of an output channel, depth contiguous; `None` where they are not there.
    pub fn unpack(&self, channel: usize, weights: &mut [i8]) -> Option<()> {
        let (whole, tail) = weights.get_mut(..self.depth)?.as_chunks_mut::<QUAD>();
        let mut quads = self.quads(channel)?;
        for (weights, quad) in whole.iter_mut().zip(&mut quads) {
            *weights = *quad;
        }
        if let Some(quad) = quads.next() {
            tail.iter_mut().zip(quad).for_each(|(weight, packed)| *weight = *packed);
        }
        Some(())
    }

    /// The weights of an output channel with the zeros that fill up its depth.
    pub fn padded(&self, channel: usize) -> Option<impl Iterator<Item = i8> + use<'a>> {
        Some(self.quads(channel)?.flatten().copied())
    }
}

#[cfg(test)]
#[allow(clippy::unwrap_used, reason = "a failed expectation is a failed test")]
mod tests {
    extern crate std;
    use super::*;
    use std::vec;

    #[test]
    fn bytes_lie_where_the_page_says() {
        // Two groups of 17 outputs, depth 70: two blocks a group, depth filled up to 128.
        let (outputs, depth) = (17, 70);
        let block = 64 + 16 * 128;
        assert_eq!(packed_bytes(2, outputs, 70), 4 * block as u64);
        let mut bytes = vec![0; 4 * block];
        // Group 1, output 16: the first output of the last block; k = 69 is place 1 of quad 17.
        bytes[3 * block + 64 + 17 * 64 + 1] = 7;
        bytes[3 * block..][..4].copy_from_slice(&[-128, -4, -1, -1]);
        let packed = Packed::new(&bytes, outputs, depth);
        let mut weights = [1; 70];
        packed.unpack(33, &mut weights).unwrap();
        let mut expected = [0; 70];
        expected[69] = 7;
        assert_eq!(weights, expected);
        assert_eq!(packed.compensation(33), Some(-128 * 7));
        assert_eq!(packed.padded(33).unwrap().map(i32::from).sum::<i32>(), 7);
        assert_eq!(packed.group(1), Some(&bytes[2 * block..]));
        let mut weights = vec![0; 34 * 70];
        weights[33 * 70 + 69] = 7;
        let mut repacked = vec![0; bytes.len()];
        pack(&weights, outputs, depth, &mut repacked);
        assert!(repacked == bytes);
    }

    #[test]
    fn unpacking_gives_back_what_was_packed() {
        for depth in 1..=130 {
            for (groups, outputs) in [(1, 1), (1, 16), (2, 17), (3, 32)] {
                let channels = usize::from(groups * outputs);
                let weights: vec::Vec<i8> = (0..channels * depth).map(|i| (i * 37 % 255) as u8 as i8).collect();
                let mut bytes = vec![0; packed_bytes(groups, outputs, depth as u64) as usize];
                pack(&weights, outputs, depth, &mut bytes);
                let packed = Packed::new(&bytes, outputs, depth);
                let mut row = vec![0; depth];
                for (channel, expected) in weights.chunks(depth).enumerate() {
                    packed.unpack(channel, &mut row).unwrap();
                    assert_eq!(row, expected, "depth {depth}, {groups} groups of {outputs}, channel {channel}");
                    let sum: i32 = expected.iter().map(|&w| i32::from(w)).sum();
                    assert_eq!(packed.compensation(channel), Some(-128 * sum));
                    assert!(packed.padded(channel).unwrap().skip(depth).all(|w| w == 0));
                }
            }
        }
    }

    #[test]
    fn what_is_not_there_is_none() {
        let bytes = vec![0; 64 + 16 * 64];
        let packed = Packed::new(&bytes, 16, 3);
        assert!(packed.unpack(15, &mut [0; 3]).is_some());
        assert!(packed.unpack(16, &mut [0; 3]).is_none());
        assert!(packed.unpack(0, &mut [0; 2]).is_none());
        assert!(packed.group(1).is_none());
        assert!(Packed::new(&bytes, 0, 3).compensation(0).is_none());
        assert!(Packed::new(&bytes, 16, usize::MAX).compensation(0).is_none());
        assert_eq!(packed_bytes(u16::MAX, u16::MAX, u64::MAX), u64::MAX);
    }
}
