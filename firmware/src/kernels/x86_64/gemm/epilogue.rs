//! From the sums of a tile to output codes, 16 channels at a time: [`crate::program::Rescale`] in loops over arrays
//! that the compiler turns into the vector instructions of whoever inlines them.
//!
//! Unlike the portable epilogue it holds `acc` and `R(acc, p)` in 32 bits. Under the compiler's bound on partial sums
//! that is the same; beyond it both give numbers, not the same ones.

use super::CHANNELS;
use crate::fixed_point::clamp_code;
use crate::kernels::k4n16::OUTPUTS;
use crate::kernels::portable::codes::{Code, operand_len};
use crate::kernels::{RescaleArgs, ResidualArgs};
use crate::tensor::Codes;
use core::ops::Range;

/// The constants of up to [`CHANNELS`] output channels; beyond them zeros.
pub(in super::super) struct Epilogue<'a> {
    rescale: &'a RescaleArgs<'a>,
    channels: Range<usize>,
    /// Channels of one position of the output.
    outputs: usize,
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
    /// The constants of some of `outputs` channels; `None` where an array is too short.
    pub(super) fn new(rescale: &'a RescaleArgs<'a>, channels: Range<usize>, outputs: usize) -> Option<Self> {
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
            for (block, multipliers) in blocks.iter_mut().zip(multipliers.get(channels.clone())?.chunks(OUTPUTS)) {
                block.residual_multipliers.get_mut(..multipliers.len())?.copy_from_slice(multipliers);
            }
        }
        Some(Self { rescale, channels, outputs, blocks })
    }

    /// Turns sums of positions from `first` on into the codes of `output`. Writes nothing where these or a residual are
    /// not there.
    #[inline(always)]
    pub(super) fn finish<T: Code>(&self, sums: &[[i32; CHANNELS]], first: usize, output: &mut [T]) {
        let len = output.len();
        let offset = i64::from(self.rescale.zero_point);
        match self.rescale.residual {
            ResidualArgs::None => self.each(sums, first, output, |block, sums, _, _| {
                core::array::from_fn(|i| self.round(block, i, self.product(block, i, sums)) + offset)
            }),
            ResidualArgs::Scaled { codes, zero_point, .. } if operand_len(codes, len) == len => {
                self.each(sums, first, output, |block, sums, at, stored| {
                    let residual = load(codes, at, stored);
                    core::array::from_fn(|i| {
                        let difference = i64::from(residual[i] - i32::from(zero_point));
                        let second = difference * i64::from(block.residual_multipliers[i]);
                        self.round(block, i, self.product(block, i, sums).wrapping_add(second)) + offset
                    })
                });
            }
            ResidualArgs::Stream { codes } if operand_len(codes, len) == len => {
                self.each(sums, first, output, |block, sums, at, stored| {
                    let residual = load(codes, at, stored);
                    core::array::from_fn(|i| {
                        self.round(block, i, self.product(block, i, sums)) + i64::from(residual[i])
                    })
                });
            }
            ResidualArgs::Scaled { .. } | ResidualArgs::Stream { .. } => {}
        }
    }

    /// Stores what `codes` gives for every block of every position, clamped; it sees the block's constants and sums,
    /// and where its codes lie in the output and what is stored there.
    #[inline(always)]
    fn each<T: Code>(
        &self,
        sums: &[[i32; CHANNELS]],
        first: usize,
        output: &mut [T],
        codes: impl Fn(&Block, &[i32; OUTPUTS], usize, &[T]) -> [i64; OUTPUTS],
    ) {
        let clamp = self.rescale.clamp;
        for (n, (block, channel)) in self.blocks.iter().zip(self.channels.clone().step_by(OUTPUTS)).enumerate() {
            let count = OUTPUTS.min(self.channels.end - channel);
            for (position, sums) in (first..).zip(sums) {
                let at = position * self.outputs + channel;
                let sums = sums.as_chunks::<OUTPUTS>().0.get(n);
                let (Some(stored), Some(sums)) = (output.get_mut(at..at + count), sums) else { return };
                let results = codes(block, sums, at, stored).map(|code| T::from_code(clamp_code(code, clamp)));
                match stored.as_mut_array::<OUTPUTS>() {
                    Some(stored) => *stored = results,
                    None => stored.iter_mut().zip(results).for_each(|(code, result)| *code = result),
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
