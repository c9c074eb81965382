//! The matrix product under convolution and linear layers: a tile of rows times weights, with the epilogue.

use super::codes::{Code, block, element, operand, take};
use crate::fault::{self, Fault};
use crate::fixed_point::{finish, round_shift};
use crate::kernels::k4n16::Packed;
use crate::kernels::{RescaleArgs, ResidualArgs};
use crate::program::{KernelId, Requant};

/// Rows that are multiplied at once: each weight is loaded and widened once for all of them.
pub(super) const TILE: usize = crate::kernels::plan::TILE_ROWS as usize;

/// Packed weights, read one output channel at a time.
#[derive(Clone, Copy)]
pub(super) enum Weights<'a> {
    /// Depth contiguous: each row lies there as it is.
    Direct { codes: &'a [i8], depth: usize },
    /// Blocks: each row is copied together.
    K4N16(Packed<'a>),
}

impl<'a> Weights<'a> {
    /// Weights of groups of `outputs` output channels with `depth` weights each.
    pub(super) fn new(kernel: KernelId, codes: &'a [i8], outputs: u16, depth: usize) -> Self {
        match kernel {
            KernelId::Direct => Self::Direct { codes, depth },
            KernelId::K4N16 => Self::K4N16(Packed::new(codes, outputs, depth)),
        }
    }

    /// Room for one row out of scratch, where rows are copied together.
    pub(super) fn buffer<'s>(&self, scratch: &mut &'s mut [u8], depth: usize) -> Option<&'s mut [i8]> {
        match self {
            Self::Direct { .. } => Some(&mut []),
            Self::K4N16(_) => take(scratch, depth),
        }
    }

    /// The weights of an output channel, depth contiguous.
    fn row<'r>(&'r self, channel: usize, buffer: &'r mut [i8]) -> Option<&'r [i8]> {
        match self {
            Self::Direct { codes, depth } => block(codes, channel, *depth),
            Self::K4N16(packed) => packed.unpack(channel, buffer).map(|()| &*buffer),
        }
    }
}

/// Weights of consecutive output channels and what follows their accumulators.
pub(super) struct Product<'a> {
    /// Weights of all output channels.
    pub weights: Weights<'a>,
    /// Elements of one dot product.
    pub depth: usize,
    /// The output channels that are computed.
    pub channels: core::ops::Range<usize>,
    /// Channels of one position of the output (all groups).
    pub outputs: usize,
    /// Epilogue; arrays are indexed by output channel.
    pub rescale: &'a RescaleArgs<'a>,
    /// Accumulate in 64 bits.
    pub wide: bool,
}

impl Product<'_> {
    /// Multiplies up to [`TILE`] rows of `depth` widened codes and writes `channels` at as many positions of `output`
    /// from `position` on. `rows.len()` is a multiple of `depth`; `buffer` is that of [`Weights::buffer`].
    pub(super) fn tile<T: Code>(&self, rows: &[i16], position: usize, output: &mut [T], buffer: &mut [i8]) {
        let row = |i| block(rows, i, self.depth);
        if let [Some(a), Some(b), Some(c), Some(d)] = [row(0), row(1), row(2), row(3)] {
            return self.rows([a, b, c, d], position, output, buffer);
        }
        for (i, row) in (0..TILE).map_while(|i| Some((i, row(i)?))) {
            self.rows([row], position + i, output, buffer);
        }
    }

    fn rows<T: Code, const ROWS: usize>(
        &self,
        rows: [&[i16]; ROWS],
        position: usize,
        output: &mut [T],
        buffer: &mut [i8],
    ) {
        if self.depth == 0 {
            return;
        }
        let depth = self.depth - usize::from(fault::active(Fault::DepthTail));
        let rows = rows.map(|row| row.get(..depth).unwrap_or_default());
        let swapped = fault::active(Fault::ChannelsSwapped) && self.channels.start == 0 && self.channels.end > 1;
        for channel in self.channels.clone() {
            let source = if swapped && channel < 2 { 1 - channel } else { channel };
            let Some(weights) = self.weights.row(source, buffer).and_then(|row| row.get(..depth)) else { return };
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
