//! The matrix product under convolution and linear layers: a tile of rows times weights, with the epilogue.

use super::codes::{Code, block, element, operand};
use crate::fault::{self, Fault};
use crate::fixed_point::{finish, round_shift};
use crate::kernels::{RescaleArgs, ResidualArgs};
use crate::program::Requant;

/// Rows that are multiplied at once: each weight is loaded and widened once for all of them.
pub(super) const TILE: usize = crate::kernels::plan::TILE_ROWS as usize;

/// Weights `[channels][depth]` of consecutive output channels and what follows their accumulators.
pub(super) struct Product<'a> {
    /// `i8` codes, `channels · depth`.
    pub weights: &'a [i8],
    /// Elements of one dot product.
    pub depth: usize,
    /// Output channel of the first row of `weights`.
    pub first_channel: usize,
    /// Channels of one position of the output (all groups).
    pub outputs: usize,
    /// Epilogue; arrays are indexed by output channel.
    pub rescale: &'a RescaleArgs<'a>,
    /// Accumulate in 64 bits.
    pub wide: bool,
}

impl Product<'_> {
    /// Multiplies up to [`TILE`] rows of `depth` widened codes and writes the channels of `weights` at as many
    /// positions of `output` from `position` on. `rows.len()` is a multiple of `depth`.
    pub(super) fn tile<T: Code>(&self, rows: &[i16], position: usize, output: &mut [T]) {
        let row = |i| block(rows, i, self.depth);
        if let [Some(a), Some(b), Some(c), Some(d)] = [row(0), row(1), row(2), row(3)] {
            return self.rows([a, b, c, d], position, output);
        }
        for (i, row) in (0..TILE).map_while(|i| Some((i, row(i)?))) {
            self.rows([row], position + i, output);
        }
    }

    fn rows<T: Code, const ROWS: usize>(&self, rows: [&[i16]; ROWS], position: usize, output: &mut [T]) {
        if self.depth == 0 {
            return;
        }
        let depth = self.depth - usize::from(fault::active(Fault::DepthTail));
        let rows = rows.map(|row| row.get(..depth).unwrap_or_default());
        let swapped = fault::active(Fault::ChannelsSwapped) && self.first_channel == 0;
        for (i, weights) in self.weights.chunks_exact(self.depth).enumerate() {
            let weights =
                if swapped && i < 2 { block(self.weights, 1 - i, self.depth).unwrap_or(weights) } else { weights };
            let weights = weights.get(..depth).unwrap_or_default();
            let channel = self.first_channel + i;
            let epilogue = Epilogue::new(self.rescale, channel);
            let sums = if self.wide { dot_wide(weights, rows) } else { dot(weights, rows).map(i64::from) };
            for (row, sum) in sums.into_iter().enumerate() {
                let index = (position + row) * self.outputs + channel;
                if let Some(code) = output.get_mut(index) {
                    *code = T::from_code(epilogue.code(sum, index, *code));
                }
            }
        }
    }
}

/// The constants of one output channel.
struct Epilogue<'a> {
    rescale: &'a RescaleArgs<'a>,
    bias: i64,
    requant: Requant,
    residual_multiplier: i64,
}

impl<'a> Epilogue<'a> {
    fn new(rescale: &'a RescaleArgs<'a>, channel: usize) -> Self {
        let one_more = i32::from(fault::active(Fault::MultiplierPlusOne) && channel == 0);
        let residual_multiplier = match rescale.residual {
            ResidualArgs::Scaled { multipliers, .. } => i64::from(element(multipliers, channel)),
            ResidualArgs::None | ResidualArgs::Stream { .. } => 0,
        };
        Self {
            rescale,
            bias: i64::from(element(rescale.bias, channel)),
            requant: Requant {
                multiplier: element(rescale.multipliers, channel).wrapping_add(one_more),
                shift: element(rescale.shifts, channel),
            },
            residual_multiplier,
        }
    }

    /// Output code for `Σ w·q`; `stored` is the code that lies at `index` of the output.
    #[inline]
    fn code<T: Code>(&self, sum: i64, index: usize, stored: T) -> i16 {
        let rescale = self.rescale;
        let acc = self.bias.wrapping_add(sum);
        let product = round_shift(acc, rescale.pre_shift).wrapping_mul(i64::from(self.requant.multiplier));
        let (sum, offset) = match rescale.residual {
            ResidualArgs::None => (product, i64::from(rescale.zero_point)),
            ResidualArgs::Scaled { codes, zero_point, .. } => {
                let zero_point = if fault::active(Fault::ResidualZeroPoint) { 0 } else { i64::from(zero_point) };
                let residual = (operand(codes, index, stored) - zero_point) * self.residual_multiplier;
                (product.wrapping_add(residual), i64::from(rescale.zero_point))
            }
            ResidualArgs::Stream { codes } => (product, operand(codes, index, stored)),
        };
        finish(sum, u32::from(self.requant.shift), offset, rescale.clamp)
    }
}

/// `Σ w·q` of one row of weights with each of `ROWS` rows of codes, all of the length of `weights`, in 32 bits.
///
/// Wraps on overflow, which the compiler's bound on partial sums excludes. Blocks of 32 constant-length products let
/// the compiler form its widest multiply-add of 16-bit pairs; each weight is widened once per block.
#[inline]
pub(super) fn dot<const ROWS: usize>(weights: &[i8], rows: [&[i16]; ROWS]) -> [i32; ROWS] {
    const BLOCK: usize = 32;
    let rows = rows.map(|row| row.get(..weights.len()).unwrap_or_default());
    let (weight_blocks, weight_tail) = weights.as_chunks::<BLOCK>();
    let mut blocks = rows.map(|row| row.as_chunks::<BLOCK>().0.iter());
    let mut sums = [0i32; ROWS];
    for weights in weight_blocks {
        let weights = weights.map(i16::from);
        for (sum, row) in sums.iter_mut().zip(&mut blocks) {
            if let Some(row) = row.next() {
                *sum = sum.wrapping_add(dot_slices(&weights, row));
            }
        }
    }
    for (sum, row) in sums.iter_mut().zip(rows) {
        *sum = sum.wrapping_add(dot_slices(weight_tail, row.as_chunks::<BLOCK>().1));
    }
    sums
}

#[inline(always)]
fn dot_slices<W: Copy + Into<i32>>(weights: &[W], row: &[i16]) -> i32 {
    weights.iter().zip(row).fold(0, |sum: i32, (w, q)| sum.wrapping_add((*w).into() * i32::from(*q)))
}

/// [`dot`] in 64 bits: blocks that cannot overflow 32 bits (256·2^7·2^15 = 2^30), added in 64.
fn dot_wide<const ROWS: usize>(weights: &[i8], rows: [&[i16]; ROWS]) -> [i64; ROWS] {
    const BLOCK: usize = 256;
    let mut sums = [0i64; ROWS];
    for (i, weights) in weights.chunks(BLOCK).enumerate() {
        let rows = rows.map(|row| row.get(i * BLOCK..).unwrap_or_default());
        for (sum, part) in sums.iter_mut().zip(dot(weights, rows)) {
            *sum += i64::from(part);
        }
    }
    sums
}
