//! Convolution and linear layers as matrix products over tiles of output positions.

use super::arithmetic::to_f64;
use super::operands::{Operands, expect, positions};
use super::rescale::Epilogue;
use crate::error::{Error, ErrorCode, Result};
use crate::qmodel::{QRescale, QTensorId};
use firmware::program::Window;
use firmware::tensor::Shape;
use ndarray::linalg::general_mat_mul;
use ndarray::{ArrayView2, ArrayViewMut2, Axis, Slice};
use rayon::prelude::*;

/// What a convolution slides over its input.
pub(super) struct Filter<'a> {
    pub(super) window: &'a Window,
    pub(super) groups: usize,
    /// `[O][kh][kw][C/groups]`.
    pub(super) weights: &'a [i8],
    /// Per input channel.
    pub(super) padding_codes: &'a [i8],
}

/// `acc = b' + Σ w·q` over windows with padding codes, then the epilogue.
pub(super) fn conv2d(
    operands: &Operands,
    input: QTensorId,
    output: QTensorId,
    filter: &Filter,
    rescale: &QRescale,
) -> Result<Vec<f64>> {
    let shape = operands.shape(input)?;
    let out_shape = operands.shape(output)?;
    check_window(filter.window, shape, out_shape)?;
    let (channels, outputs) = (usize::from(shape.channels), usize::from(out_shape.channels));
    if filter.groups == 0 || !channels.is_multiple_of(filter.groups) || !outputs.is_multiple_of(filter.groups) {
        let message = format!("{channels} and {outputs} channels are not divisible into {} groups", filter.groups);
        return Err(Error::new(ErrorCode::Malformed, "", message));
    }
    let patches = Patches {
        codes: operands.codes(input)?,
        shape,
        out_width: usize::from(out_shape.width),
        window: filter.window,
        padding: to_f64(filter.padding_codes),
        group_channels: channels / filter.groups,
    };
    expect("padding codes", patches.padding.len(), channels)?;
    expect("weights", filter.weights.len(), outputs * patches.depth())?;
    let weights = to_f64(filter.weights);
    let weights = matrix(outputs, patches.depth(), &weights);
    let group_outputs = outputs / filter.groups;
    let epilogue = Epilogue::new(rescale, output, operands)?;
    in_tiles(positions(out_shape), outputs, |first, sums| {
        for group in 0..filter.groups {
            let of_group = Slice::from(group * group_outputs..(group + 1) * group_outputs);
            let rows = sums.len() / outputs;
            let left = patches.gather(first, rows, group);
            let left = matrix(rows, patches.depth(), &left);
            let mut sums = matrix_mut(rows, outputs, sums);
            let mut sums = sums.slice_axis_mut(Axis(1), of_group);
            general_mat_mul(1.0, &left, &weights.slice_axis(Axis(0), of_group).t(), 0.0, &mut sums);
        }
        epilogue.apply(first, sums)
    })
}

/// `acc = b' + Σ w·q` per position, then the epilogue.
pub(super) fn linear(
    operands: &Operands,
    input: QTensorId,
    output: QTensorId,
    weights: &[i8],
    rescale: &QRescale,
) -> Result<Vec<f64>> {
    let (shape, out_shape) = (operands.shape(input)?, operands.shape(output)?);
    let (depth, outputs) = (usize::from(shape.channels), usize::from(out_shape.channels));
    expect("output positions", positions(out_shape), positions(shape))?;
    expect("weights", weights.len(), outputs * depth)?;
    let weights = to_f64(weights);
    let weights = matrix(outputs, depth, &weights);
    let codes = matrix(positions(shape), depth, operands.codes(input)?);
    let epilogue = Epilogue::new(rescale, output, operands)?;
    in_tiles(positions(out_shape), outputs, |first, sums| {
        let rows = sums.len() / outputs;
        let left = codes.slice_axis(Axis(0), Slice::from(first..first + rows));
        general_mat_mul(1.0, &left, &weights.t(), 0.0, &mut matrix_mut(rows, outputs, sums));
        epilogue.apply(first, sums)
    })
}

/// Positions of one tile: enough to pay for a pass over the weights, few enough to feed every core. The result does not
/// depend on it, all sums being exact.
fn tile_rows(positions: usize) -> usize {
    positions.div_ceil(2 * rayon::current_num_threads()).clamp(1, 256)
}

/// Fills `positions × outputs` values tile by tile; `fill` gets the first position and the tile.
fn in_tiles(
    positions: usize,
    outputs: usize,
    fill: impl Fn(usize, &mut [f64]) -> Result<()> + Sync,
) -> Result<Vec<f64>> {
    let rows = tile_rows(positions);
    let mut values = vec![0.0; positions * outputs];
    let tiles = values.par_chunks_mut(rows * outputs).enumerate();
    tiles.try_for_each(|(tile, values)| fill(tile * rows, values))?;
    Ok(values)
}

fn matrix(rows: usize, columns: usize, values: &[f64]) -> ArrayView2<'_, f64> {
    ArrayView2::from_shape((rows, columns), values).expect("lengths are checked where operands are taken")
}

fn matrix_mut(rows: usize, columns: usize, values: &mut [f64]) -> ArrayViewMut2<'_, f64> {
    ArrayViewMut2::from_shape((rows, columns), values).expect("a tile holds whole positions")
}

/// The windows of a map as rows of a matrix (`im2col`).
struct Patches<'a> {
    codes: &'a [f64],
    shape: Shape,
    out_width: usize,
    window: &'a Window,
    padding: Vec<f64>,
    group_channels: usize,
}

impl Patches<'_> {
    /// Elements of one dot product.
    fn depth(&self) -> usize {
        usize::from(self.window.kernel_h) * usize::from(self.window.kernel_w) * self.group_channels
    }

    /// Windows of the output positions `first .. first + rows`, channels of one group: `[rows][kh][kw][C/groups]`.
    fn gather(&self, first: usize, rows: usize, group: usize) -> Vec<f64> {
        let mut patches = Vec::with_capacity(rows * self.depth());
        for position in first..first + rows {
            let (out_y, out_x) = (position / self.out_width, position % self.out_width);
            for tap_y in 0..self.window.kernel_h {
                let y = tap(out_y, self.window.stride_h, tap_y, self.window.dilation_h, self.window.pad_top);
                for tap_x in 0..self.window.kernel_w {
                    let x = tap(out_x, self.window.stride_w, tap_x, self.window.dilation_w, self.window.pad_left);
                    patches.extend_from_slice(self.pixel(y, x, group));
                }
            }
        }
        patches
    }

    fn pixel(&self, y: isize, x: isize, group: usize) -> &[f64] {
        let of_group = group * self.group_channels..(group + 1) * self.group_channels;
        match pixel_index(self.shape, y, x) {
            Some(pixel) => &self.codes[pixel * usize::from(self.shape.channels)..][of_group],
            None => &self.padding[of_group],
        }
    }
}

/// Input row (or column) of a tap; negative or beyond the map in the padding.
pub(super) fn tap(out: usize, stride: u8, tap: u8, dilation: u8, pad: u8) -> isize {
    (out * usize::from(stride) + usize::from(tap) * usize::from(dilation)) as isize - isize::from(pad)
}

/// Index of a position inside the map, or `None` in the padding.
pub(super) fn pixel_index(shape: Shape, y: isize, x: isize) -> Option<usize> {
    let y = usize::try_from(y).ok().filter(|&y| y < usize::from(shape.height))?;
    let x = usize::try_from(x).ok().filter(|&x| x < usize::from(shape.width))?;
    Some(y * usize::from(shape.width) + x)
}

/// The output has as many positions as full windows fit into the padded input.
pub(super) fn check_window(window: &Window, shape: Shape, output: Shape) -> Result<()> {
    let fits = |size: u16, pads: [u8; 2], kernel: u8, dilation: u8, stride: u8| {
        let padded = usize::from(size) + usize::from(pads[0]) + usize::from(pads[1]);
        let reach = usize::from(dilation) * usize::from(kernel.checked_sub(1)?) + 1;
        padded.checked_sub(reach)?.checked_div(usize::from(stride)).map(|steps| steps + 1)
    };
    let w = window;
    let rows = fits(shape.height, [w.pad_top, w.pad_bottom], w.kernel_h, w.dilation_h, w.stride_h);
    let columns = fits(shape.width, [w.pad_left, w.pad_right], w.kernel_w, w.dilation_w, w.stride_w);
    if rows == Some(usize::from(output.height)) && columns == Some(usize::from(output.width)) {
        return Ok(());
    }
    let message = format!("{window:?} over {shape:?} does not give the output's {}×{}", output.height, output.width);
    Err(Error::new(ErrorCode::Malformed, "", message))
}
