//! From the sums of one row to output codes, 16 channels at a time: [`crate::program::Rescale`] in loops over arrays that
//! the compiler turns into the vector instructions of whoever inlines them.
//!
//! Unlike the portable epilogue it holds `acc` and `R(acc, p)` in 32 bits. Under the compiler's bound on partial sums
//! that is the same; beyond it both give numbers, not the same ones.

use super::CHANNELS;
use crate::fixed_point::clamp_code;
use crate::kernels::k4n16::OUTPUTS;
use crate::kernels::portable::codes::{Code, operand_len};
use crate::kernels::{RescaleArgs, ResidualArgs};
use crate::tensor::Codes;

/// The constants of up to [`CHANNELS`] output channels; beyond them zeros.
pub(in super::super) struct Epilogue<'a> {
    rescale: &'a RescaleArgs<'a>,
    channels: usize,
    blocks: [Block; CHANNELS / OUTPUTS],
}

/// The constants of 16 output channels.
#[derive(Clone, Copy, Default)]
struct Block {
    bias: [i32; OUTPUTS],
    multipliers: [i32; OUTPUTS],
    residual_multipliers: [i32; OUTPUTS],
    /// n, at most 62.
    shifts: [i64; OUTPUTS],
    /// `2^(n−1)`, 0 for n = 0.
    halves: [i64; OUTPUTS],
}

impl<'a> Epilogue<'a> {
    /// The constants of `count` channels from `first` on; `None` where an array is too short.
    pub(super) fn new(rescale: &'a RescaleArgs<'a>, first: usize, count: usize) -> Option<Self> {
        let channels = first..first + count;
        let bias = rescale.bias.get(channels.clone())?.chunks(OUTPUTS);
        let multipliers = rescale.multipliers.get(channels.clone())?.chunks(OUTPUTS);
        let shifts = rescale.shifts.get(channels.clone())?.chunks(OUTPUTS);
        let mut blocks = [Block::default(); CHANNELS / OUTPUTS];
        for (((block, bias), multipliers), shifts) in blocks.iter_mut().zip(bias).zip(multipliers).zip(shifts) {
            block.bias.get_mut(..bias.len())?.copy_from_slice(bias);
            block.multipliers.get_mut(..multipliers.len())?.copy_from_slice(multipliers);
            for ((shift, half), n) in block.shifts.iter_mut().zip(&mut block.halves).zip(shifts) {
                *shift = i64::from(*n).min(62);
                *half = (1 << *shift) >> 1;
            }
        }
        if let ResidualArgs::Scaled { multipliers, .. } = rescale.residual {
            for (block, multipliers) in blocks.iter_mut().zip(multipliers.get(channels)?.chunks(OUTPUTS)) {
                block.residual_multipliers.get_mut(..multipliers.len())?.copy_from_slice(multipliers);
            }
        }
        Some(Self { rescale, channels: count, blocks })
    }

    /// Turns the sums of one row into the codes of `output` from element `first` on. Writes nothing where they or a
    /// residual are not there.
    #[inline(always)]
    pub(super) fn finish<T: Code>(&self, sums: &[i32; CHANNELS], first: usize, output: &mut [T]) {
        let len = output.len();
        let Some(row) = first.checked_add(self.channels).and_then(|end| output.get_mut(first..end)) else { return };
        let (sums, _) = sums.as_chunks::<OUTPUTS>();
        let offset = i64::from(self.rescale.zero_point);
        match self.rescale.residual {
            ResidualArgs::None => {
                for ((codes, sums), block) in row.chunks_mut(OUTPUTS).zip(sums).zip(&self.blocks) {
                    self.store(codes, |i| self.round(block, i, self.product(block, i, sums)) + offset);
                }
            }
            ResidualArgs::Scaled { codes: residual, zero_point, .. } => {
                if operand_len(residual, len) != len {
                    return;
                }
                for (n, ((codes, sums), block)) in row.chunks_mut(OUTPUTS).zip(sums).zip(&self.blocks).enumerate() {
                    let residual = load(residual, first + n * OUTPUTS, codes);
                    self.store(codes, |i| {
                        let difference = i64::from(residual[i] - i32::from(zero_point));
                        let second = difference * i64::from(block.residual_multipliers[i]);
                        self.round(block, i, self.product(block, i, sums).wrapping_add(second)) + offset
                    });
                }
            }
            ResidualArgs::Stream { codes: residual } => {
                if operand_len(residual, len) != len {
                    return;
                }
                for (n, ((codes, sums), block)) in row.chunks_mut(OUTPUTS).zip(sums).zip(&self.blocks).enumerate() {
                    let residual = load(residual, first + n * OUTPUTS, codes);
                    self.store(codes, |i| self.round(block, i, self.product(block, i, sums)) + i64::from(residual[i]));
                }
            }
        }
    }

    /// `R(acc, p)·M` of channel `i` of a block.
    #[inline(always)]
    fn product(&self, block: &Block, i: usize, sums: &[i32; OUTPUTS]) -> i64 {
        let shift = self.rescale.pre_shift.min(31);
        let half = (1_i64 << shift >> 1) as i32;
        let rounded = sums[i].wrapping_add(block.bias[i]).wrapping_add(half) >> shift;
        i64::from(rounded) * i64::from(block.multipliers[i])
    }

    /// `R(sum, n)` of channel `i` of a block.
    #[inline(always)]
    fn round(&self, block: &Block, i: usize, sum: i64) -> i64 {
        sum.wrapping_add(block.halves[i]) >> (block.shifts[i] & 63)
    }

    /// Clamps and stores what `code` gives for each of up to 16 channels.
    #[inline(always)]
    fn store<T: Code>(&self, codes: &mut [T], code: impl Fn(usize) -> i64) {
        let clamp = self.rescale.clamp;
        let mut results = [T::ZERO; OUTPUTS];
        for (i, result) in results.iter_mut().enumerate() {
            *result = T::from_code(clamp_code(code(i), clamp));
        }
        match codes.as_mut_array::<OUTPUTS>() {
            Some(codes) => *codes = results,
            None => codes.iter_mut().zip(results).for_each(|(code, result)| *code = result),
        }
    }
}

/// Up to 16 residual codes from element `first` on, or of `stored` where they are in place.
#[inline(always)]
fn load<T: Code>(residual: Option<Codes<'_>>, first: usize, stored: &[T]) -> [i32; OUTPUTS] {
    let at = |codes_len: usize| first..(first + stored.len()).min(codes_len);
    match residual {
        None => widen(stored),
        Some(Codes::I8(codes)) => widen(codes.get(at(codes.len())).unwrap_or_default()),
        Some(Codes::I16(codes)) => widen(codes.get(at(codes.len())).unwrap_or_default()),
    }
}

#[inline(always)]
fn widen<T: Code>(codes: &[T]) -> [i32; OUTPUTS] {
    match codes.as_array::<OUTPUTS>() {
        Some(codes) => codes.map(|code| i32::from(code.widen())),
        None => {
            let mut wide = [0; OUTPUTS];
            wide.iter_mut().zip(codes).for_each(|(wide, code)| *wide = i32::from(code.widen()));
            wide
        }
    }
}
