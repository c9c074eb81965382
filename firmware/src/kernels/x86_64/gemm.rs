//! Convolution and linear layers over weights of [`KernelId::K4N16`](crate::program::KernelId::K4N16): an implicit
//! matrix product, the same for every instruction set.
//!
//! Scratch takes the windows of as many output positions as fit, one row each, copied once for all output channels.
//! Then 64 output channels at a time meet all these rows, a tile of 6 rows after the other, so that their weights come
//! from memory once and from the second-level cache after that.

use super::super::k4n16::{OUTPUTS, Packed, QUAD, block_bytes};
use super::super::plan::{PACKED_TILE_ROWS, row_stride_bytes};
use super::super::portable::Windows;
use super::super::portable::codes::{Code, take};
use super::super::{Conv2dArgs, LinearArgs, RescaleArgs};
use crate::tensor::{CodesMut, index};
use bytemuck::{AnyBitPattern, NoUninit};
use core::ops::Range;
use epilogue::Epilogue;

mod avx2;
mod avx512_vnni;
mod epilogue;

/// Rows of a tile.
const ROWS: usize = PACKED_TILE_ROWS as usize;
/// Most blocks of 16 output channels that meet a tile at once.
const BLOCKS: usize = 4;
/// Output channels of [`BLOCKS`] blocks.
const CHANNELS: usize = BLOCKS * OUTPUTS;

/// `Σ w·q` per row of a tile and output channel.
type Sums = [[i32; CHANNELS]; ROWS];

/// What an instruction set brings: the loops over elements. Its token proves that the instructions exist.
pub(super) trait Tile: Copy {
    /// An input code in scratch.
    type Code: Copy + Default + NoUninit + AnyBitPattern;

    /// Copies the front of `codes` to `row`.
    fn widen(self, codes: &[i8], row: &mut [Self::Code]);

    /// Multiplies every row with every block. Sums wrap, which the compiler's bound on partial sums excludes. Where
    /// lengths do not fit, nothing is written.
    fn accumulate(self, operands: &Operands<'_, Self::Code>, sums: &mut Sums);

    /// [`Epilogue::finish`].
    fn finish<T: Code>(self, epilogue: &Epilogue<'_>, sums: &[[i32; CHANNELS]], first: usize, output: &mut [T]);
}

/// Operands of [`Tile::accumulate`].
#[derive(Clone, Copy)]
pub(super) struct Operands<'a, C> {
    /// [`ROWS`] rows of codes.
    rows: &'a [C],
    /// Codes from one row to the next.
    stride: usize,
    /// Quads of codes in a row.
    quads: usize,
    /// Packed weights of up to [`BLOCKS`] blocks.
    weights: &'a [i8],
    /// Bytes of a block.
    block_bytes: usize,
}

/// Convolution; operands as for [`crate::kernels::portable::conv2d::conv2d`].
pub(super) fn conv2d(
    tile: impl Tile,
    args: &Conv2dArgs<'_>,
    input: &[i8],
    mut output: CodesMut<'_>,
    scratch: &mut [u8],
) -> Option<()> {
    let windows = Windows::new(args, input)?;
    let width = usize::from(args.output_shape.width);
    let (outputs, depth) = (args.output_shape.channels.checked_div(args.groups)?, windows.depth());
    let weights = Packed::new(args.weights, outputs, depth);
    let (outputs, positions) = (usize::from(outputs), index(args.output_shape.positions()));
    for group in 0..usize::from(args.groups) {
        let first_channel = group * outputs;
        let product = Product {
            weights: weights.group(group)?,
            depth,
            positions,
            channels: first_channel..first_channel + outputs,
            outputs: args.output_shape.channels.into(),
            rescale: &args.rescale,
        };
        let fill = |position: usize, row: &mut [_]| {
            windows.gather(group, position / width, position % width, row, |codes, line| tile.widen(codes, line));
        };
        product.run(tile, fill, &mut output, scratch)?;
    }
    Some(())
}

/// Linear layer; operands as for [`crate::kernels::portable::linear::linear`], but 32-bit sums only.
pub(super) fn linear(
    tile: impl Tile,
    args: &LinearArgs<'_>,
    input: &[i8],
    output: CodesMut<'_>,
    scratch: &mut [u8],
) -> Option<()> {
    linear_rows(tile, args, input, |codes, row| tile.widen(codes, row), output, scratch)
}

/// The same with 16-bit input.
pub(super) fn linear_i16(
    tile: impl Tile<Code = i16>,
    args: &LinearArgs<'_>,
    input: &[i16],
    output: CodesMut<'_>,
    scratch: &mut [u8],
) -> Option<()> {
    linear_rows(tile, args, input, |codes, row| row.copy_from_slice(codes), output, scratch)
}

fn linear_rows<T: Tile, Q>(
    tile: T,
    args: &LinearArgs<'_>,
    input: &[Q],
    widen: impl Fn(&[Q], &mut [T::Code]),
    mut output: CodesMut<'_>,
    scratch: &mut [u8],
) -> Option<()> {
    let (depth, positions, outputs) = (usize::from(args.inputs), index(args.positions), usize::from(args.outputs));
    if positions.checked_mul(depth) != Some(input.len()) {
        return None;
    }
    let product = Product {
        weights: Packed::new(args.weights, args.outputs, depth).group(0)?,
        depth,
        positions,
        channels: 0..outputs,
        outputs,
        rescale: &args.rescale,
    };
    let fill = |position: usize, row: &mut [_]| {
        if let Some(codes) = input.get(position * depth..(position + 1) * depth) {
            widen(codes, row);
        }
    };
    product.run(tile, fill, &mut output, scratch)
}

/// The product of one channel group.
struct Product<'a> {
    /// Packed weights of the group.
    weights: &'a [i8],
    /// Elements of one dot product.
    depth: usize,
    /// Rows in all.
    positions: usize,
    /// Output channels of the group.
    channels: Range<usize>,
    /// Channels of one position of the output (all groups).
    outputs: usize,
    /// Epilogue; arrays are indexed by output channel.
    rescale: &'a RescaleArgs<'a>,
}

impl Product<'_> {
    /// `fill` copies the codes of a position to a row of `depth` codes. `None` where operands
    /// do not have the lengths that the arguments say.
    fn run<T: Tile>(
        &self,
        tile: T,
        fill: impl Fn(usize, &mut [T::Code]),
        output: &mut CodesMut<'_>,
        scratch: &mut [u8],
    ) -> Option<()> {
        let quads = self.depth.div_ceil(QUAD);
        let stride_bytes = usize::try_from(row_stride_bytes((quads * QUAD * size_of::<T::Code>()) as u64)).ok()?;
        let stride = stride_bytes / size_of::<T::Code>();
        let chunk_rows = scratch.len() / stride_bytes / ROWS * ROWS;
        let mut scratch = scratch;
        let rows = take::<T::Code>(&mut scratch, chunk_rows * stride)?;
        if chunk_rows == 0 || self.depth == 0 {
            return None;
        }
        for first in (0..self.positions).step_by(chunk_rows) {
            let count = chunk_rows.min(self.positions - first);
            for (i, row) in rows.chunks_exact_mut(stride).take(count).enumerate() {
                let (codes, padding) = row.get_mut(..quads * QUAD)?.split_at_mut_checked(self.depth)?;
                fill(first + i, codes);
                padding.fill(T::Code::default());
            }
            match output {
                CodesMut::I8(output) => self.chunk(tile, rows, stride, first..first + count, output)?,
                CodesMut::I16(output) => self.chunk(tile, rows, stride, first..first + count, output)?,
            }
        }
        Some(())
    }

    /// Multiplies the rows of some positions with all weights.
    fn chunk<T: Tile, O: Code>(
        &self,
        tile: T,
        rows: &[T::Code],
        stride: usize,
        positions: Range<usize>,
        output: &mut [O],
    ) -> Option<()> {
        let block_bytes = usize::try_from(block_bytes(self.depth as u64)).ok()?;
        let channels = self.channels.clone().step_by(CHANNELS);
        for (first_channel, weights) in channels.zip(self.weights.chunks(BLOCKS * block_bytes)) {
            let count = CHANNELS.min(self.channels.end - first_channel);
            let epilogue = Epilogue::new(self.rescale, first_channel..first_channel + count, self.outputs)?;
            for (first, rows) in positions.clone().step_by(ROWS).zip(rows.chunks_exact(ROWS * stride)) {
                let operands = Operands { rows, stride, quads: self.depth.div_ceil(QUAD), weights, block_bytes };
                let mut sums = [[0; CHANNELS]; ROWS];
                tile.accumulate(&operands, &mut sums);
                tile.finish(&epilogue, sums.get(..ROWS.min(positions.end - first))?, first, output);
            }
        }
        Some(())
    }
}

#[cfg(test)]
mod tests {
    extern crate std;
    use crate::kernels::x86_64::{Avx2, Avx512Vnni};
    use crate::kernels::{Conv2dArgs, Kernels, LinearArgs, RescaleArgs, ResidualArgs};
    use crate::program::{Clamp, KernelId, Window};
    use crate::tensor::{Codes, CodesMut, Shape};
    use std::boxed::Box;
    use std::vec;
    use std::vec::Vec;

    /// The backends of this machine.
    fn backends() -> Vec<Box<dyn Kernels>> {
        let mut all: Vec<Box<dyn Kernels>> = Vec::new();
        Avx2::detect().into_iter().for_each(|token| all.push(Box::new(token)));
        Avx512Vnni::detect().into_iter().for_each(|token| all.push(Box::new(token)));
        std::println!("{} of 2 backends are here", all.len());
        all
    }

    /// An epilogue that no compiler writes.
    const HOSTILE: RescaleArgs<'static> = RescaleArgs {
        pre_shift: 255,
        bias: &[i32::MIN, i32::MAX],
        multipliers: &[i32::MIN, i32::MAX],
        shifts: &[255, 0],
        zero_point: i16::MIN,
        clamp: Clamp { min: i16::MAX, max: i16::MIN },
        residual: ResidualArgs::Scaled { codes: None, zero_point: i16::MIN, multipliers: &[i32::MIN, i32::MIN] },
    };

    #[test]
    fn hostile_constants_and_lengths_do_not_panic() {
        let shape = Shape::map(3, 3, 2);
        let one = Window::square(1, 1, 0);
        let weights = [-128; 64 + 16 * 64];
        for kernels in backends() {
            let args = Conv2dArgs {
                input_shape: shape,
                output_shape: shape,
                window: one,
                groups: 1,
                kernel: KernelId::K4N16,
                weights: &weights,
                padding_codes: &[],
                rescale: HOSTILE,
            };
            let (input, mut output, mut scratch) = ([-128; 18], [i16::MIN; 18], vec![0; 6 * 192]);
            kernels.conv2d(&args, &input, CodesMut::I16(&mut output), &mut scratch);
            assert_eq!(output, [i16::MIN; 18], "the upper bound wins");
            let short = RescaleArgs { bias: &[], ..HOSTILE };
            for args in [
                Conv2dArgs { rescale: short, ..args },
                Conv2dArgs { groups: 0, ..args },
                Conv2dArgs { groups: 2, ..args },
                Conv2dArgs { weights: &[], ..args },
                Conv2dArgs { weights: &weights[1..], ..args },
                Conv2dArgs { input_shape: Shape::map(0, 3, 2), ..args },
                Conv2dArgs { output_shape: Shape::map(3, 0, 2), ..args },
                Conv2dArgs { output_shape: Shape::map(u16::MAX, u16::MAX, u16::MAX), ..args },
                Conv2dArgs { window: Window { kernel_h: 0, ..one }, ..args },
                Conv2dArgs { window: Window { kernel_h: 255, dilation_h: 255, pad_top: 255, ..one }, ..args },
                Conv2dArgs { window: Window { stride_h: 0, stride_w: 255, pad_left: 255, ..one }, ..args },
            ] {
                kernels.conv2d(&args, &input, CodesMut::I16(&mut output), &mut scratch);
                kernels.conv2d(&args, &input, CodesMut::I8(&mut [0; 18]), &mut []);
                kernels.conv2d(&args, &[], CodesMut::I8(&mut []), &mut scratch);
            }
            for (positions, inputs, outputs) in [(2, 9, 2), (1, 18, 1), (0, 3, 1), (3, 0, 0), (u32::MAX, u16::MAX, 1)] {
                let kernel = KernelId::K4N16;
                let args =
                    LinearArgs { positions, inputs, outputs, kernel, weights: &weights, wide: false, rescale: HOSTILE };
                kernels.linear(&args, Codes::I8(&input), CodesMut::I8(&mut [i8::MIN; 4]), &mut scratch);
                kernels.linear(&args, Codes::I16(&[i16::MIN; 18]), CodesMut::I16(&mut [i16::MIN; 4]), &mut scratch);
                kernels.linear(&args, Codes::I8(&[]), CodesMut::I8(&mut [i8::MIN; 1]), &mut scratch);
            }
        }
    }
}
