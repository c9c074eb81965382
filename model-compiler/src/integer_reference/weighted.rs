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
    positions.div_ceil(rayon::current_num_threads()).clamp(1, 256)
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

#[cfg(test)]
mod tests {
    use crate::error::ErrorCode;
    use crate::integer_reference::testing::{Random, clamp, execute_alone, rescale_code};
    use crate::qmodel::{QOp, QRescale, QResidual, QTensorId};
    use firmware::program::Window;
    use firmware::tensor::{ElementType, Shape};

    const INPUT: QTensorId = QTensorId(0);

    fn plain(bias: Vec<i32>, multiplier: i32, shift: u8) -> QRescale {
        QRescale {
            pre_shift: 0,
            multipliers: vec![multiplier; bias.len()],
            shifts: vec![shift; bias.len()],
            bias,
            zero_point: 0,
            clamp: clamp(-128, 127),
            residual: QResidual::None,
        }
    }

    fn linear(inputs: &[f64], weights: Vec<i8>, rescale: QRescale) -> Vec<f64> {
        let output = Shape::vector(rescale.bias.len() as u16);
        let op = QOp::Linear { input: INPUT, output: QTensorId(1), weights, wide: false, rescale };
        let input = (Shape::vector(inputs.len() as u16), ElementType::I8, inputs.to_vec());
        execute_alone(op, &[input], (output, ElementType::I8)).unwrap()
    }

    #[test]
    fn linear_rounds_ties_up_and_saturates() {
        // Sums 3, −3, 1000, −1000 with factor 1/2: 1.5 → 2, −1.5 → −1.
        let half = plain(vec![0, 0, 997, -1003], 1 << 23, 24);
        assert_eq!(linear(&[1.0, 2.0], vec![1, 1, -1, -1, 1, 1, 1, 1], half), [2.0, -1.0, 127.0, -128.0]);
    }

    #[test]
    fn pre_shift_rounds_before_the_multiplication() {
        // 6 → R(6, 2) = 2 → 4; −6 → −1 → −2 (one rounding of 6·2/4 would give 3 and −3).
        let rescale = QRescale { pre_shift: 2, ..plain(vec![0, 0], 1 << 23, 22) };
        assert_eq!(linear(&[6.0], vec![1, -1], rescale), [4.0, -2.0]);
    }

    #[test]
    fn zero_point_and_relu_follow_the_shift() {
        let rescale = QRescale { zero_point: -128, clamp: clamp(-128, 127), ..plain(vec![0, 0], 1 << 23, 23) };
        assert_eq!(linear(&[9.0], vec![1, -1], rescale), [-119.0, -128.0]);
    }

    #[test]
    fn padding_uses_the_code_of_its_channel() {
        let op = QOp::Conv2d {
            input: INPUT,
            output: QTensorId(1),
            window: Window { pad_bottom: 0, pad_right: 0, ..Window::square(2, 1, 1) },
            groups: 1,
            weights: vec![1; 8],
            padding_codes: vec![-4, 30],
            rescale: plain(vec![0], 1 << 23, 23),
        };
        let input = (Shape::map(2, 1, 2), ElementType::I8, vec![1.0, 2.0, 3.0, 4.0]);
        let codes = execute_alone(op, &[input], (Shape::map(2, 1, 1), ElementType::I8)).unwrap();
        assert_eq!(codes, [3.0 * 26.0 + 3.0, 2.0 * 26.0 + 3.0 + 7.0]);
    }

    /// A convolution with its operands, drawn from a seed.
    struct Case {
        op: QOp,
        shape: Shape,
        output: Shape,
        input: Vec<f64>,
        residual: Vec<f64>,
    }

    fn case(random: &mut Random, wide_residual: bool, residual: impl Fn(&mut Random, usize) -> QResidual) -> Case {
        let groups = random.between(1, 3) as u16;
        let channels = groups * random.between(1, 4) as u16;
        let outputs = groups * random.between(1, 5) as u16;
        let shape = Shape::map(random.between(5, 12) as u16, random.between(5, 12) as u16, channels);
        let mut small = |min, max| random.between(min, max) as u8;
        let window = Window {
            kernel_h: small(1, 3),
            kernel_w: small(1, 3),
            stride_h: small(1, 3),
            stride_w: small(1, 3),
            pad_top: small(0, 3),
            pad_bottom: small(0, 3),
            pad_left: small(0, 3),
            pad_right: small(0, 3),
            dilation_h: small(1, 2),
            dilation_w: small(1, 2),
        };
        let (height, width) = window.output_size(shape.height, shape.width).unwrap();
        let output = Shape::map(height, width, outputs);
        let depth = usize::from(window.kernel_h) * usize::from(window.kernel_w) * usize::from(channels / groups);
        let count = usize::from(outputs);
        let rescale = QRescale {
            pre_shift: random.between(0, 3) as u8,
            bias: random.vec(count, -50_000, 50_000),
            multipliers: random.vec(count, 1 << 23, (1 << 24) - 1),
            shifts: random.vec(count, 30, 34),
            zero_point: random.between(-128, 127) as i16,
            clamp: clamp(random.between(-128, -100) as i16, random.between(100, 127) as i16),
            residual: residual(random, count),
        };
        let limit = if wide_residual { 32767 } else { 127 };
        Case {
            op: QOp::Conv2d {
                input: INPUT,
                output: QTensorId(2),
                window,
                groups,
                weights: random.vec(usize::from(outputs) * depth, -127, 127),
                padding_codes: random.vec(usize::from(channels), -128, 127),
                rescale,
            },
            shape,
            output,
            input: random.codes(shape.elements() as usize, -128, 127),
            residual: random.codes(output.elements() as usize, -limit - 1, limit),
        }
    }

    /// The same convolution by its definition, in wide integers.
    fn naive(case: &Case) -> Vec<f64> {
        let QOp::Conv2d { window: w, groups, weights, padding_codes, rescale, .. } = &case.op else {
            unreachable!("a case is a convolution")
        };
        let (height, width) = (i64::from(case.shape.height), i64::from(case.shape.width));
        let channels = i64::from(case.shape.channels);
        let (outputs, groups) = (i64::from(case.output.channels), i64::from(*groups));
        let (kernel_h, kernel_w, depth) = (i64::from(w.kernel_h), i64::from(w.kernel_w), channels / groups);
        let mut codes = Vec::new();
        for y in 0..i64::from(case.output.height) {
            for x in 0..i64::from(case.output.width) {
                for o in 0..outputs {
                    let mut sum = 0i128;
                    for ky in 0..kernel_h {
                        for kx in 0..kernel_w {
                            for c in 0..depth {
                                let iy =
                                    y * i64::from(w.stride_h) + ky * i64::from(w.dilation_h) - i64::from(w.pad_top);
                                let ix =
                                    x * i64::from(w.stride_w) + kx * i64::from(w.dilation_w) - i64::from(w.pad_left);
                                let channel = o / (outputs / groups) * depth + c;
                                let code = if (0..height).contains(&iy) && (0..width).contains(&ix) {
                                    case.input[((iy * width + ix) * channels + channel) as usize] as i128
                                } else {
                                    i128::from(padding_codes[channel as usize])
                                };
                                let weight = weights[(((o * kernel_h + ky) * kernel_w + kx) * depth + c) as usize];
                                sum += code * i128::from(weight);
                            }
                        }
                    }
                    codes.push(rescale_code(rescale, o as usize, sum, case.residual[codes.len()] as i128) as f64);
                }
            }
        }
        codes
    }

    fn equal_to_naive(seed: u64, element: ElementType, residual: impl Fn(&mut Random, usize) -> QResidual) {
        let mut random = Random(seed);
        for round in 0..60 {
            let case = case(&mut random, element == ElementType::I16, &residual);
            let operands =
                [(case.shape, ElementType::I8, case.input.clone()), (case.output, element, case.residual.clone())];
            let codes = execute_alone(case.op.clone(), &operands, (case.output, element)).unwrap();
            assert_eq!(codes, naive(&case), "seed {seed:#x}, round {round}: {:?}", case.op);
        }
    }

    #[test]
    fn convolution_equals_its_definition() {
        equal_to_naive(0xc0, ElementType::I8, |_, _| QResidual::None);
    }

    #[test]
    fn convolution_with_scaled_residual_equals_its_definition() {
        equal_to_naive(0xc1, ElementType::I8, |random, count| QResidual::Scaled {
            tensor: QTensorId(1),
            zero_point: random.between(-128, 127) as i16,
            multipliers: random.vec(count, 1 << 29, i64::from(i32::MAX)),
        });
    }

    #[test]
    fn convolution_into_a_stream_equals_its_definition() {
        equal_to_naive(0xc2, ElementType::I16, |_, _| QResidual::Stream { tensor: QTensorId(1) });
    }

    #[test]
    fn wide_linear_over_many_positions_equals_its_definition() {
        let seed = 0x11ea;
        let mut random = Random(seed);
        let (positions, depth, outputs) = (700, 90, 7);
        let shape = Shape::tokens(positions, depth);
        let input = random.codes(shape.elements() as usize, -32768, 32767);
        let weights: Vec<i8> = random.vec(usize::from(depth * outputs), -127, 127);
        let rescale = QRescale {
            pre_shift: 2,
            clamp: clamp(-32768, 32767),
            ..plain(random.vec(usize::from(outputs), -1 << 30, 1 << 30), 12_345_678, 37)
        };
        let op = QOp::Linear {
            input: INPUT,
            output: QTensorId(1),
            weights: weights.clone(),
            wide: true,
            rescale: rescale.clone(),
        };
        let output = (Shape::tokens(positions, outputs), ElementType::I16);
        let codes = execute_alone(op, &[(shape, ElementType::I16, input.clone())], output).unwrap();
        let mut expected = Vec::new();
        for row in input.chunks_exact(usize::from(depth)) {
            for (o, weights) in weights.chunks_exact(usize::from(depth)).enumerate() {
                let sum = row.iter().zip(weights).map(|(&q, &w)| q as i128 * i128::from(w)).sum();
                expected.push(rescale_code(&rescale, o, sum, 0) as f64);
            }
        }
        assert_eq!(codes, expected, "seed {seed:#x}");
    }

    #[test]
    fn misfitting_arrays_are_malformed() {
        let run = |weights: usize, biases: usize, output: Shape| {
            let op = QOp::Conv2d {
                input: INPUT,
                output: QTensorId(1),
                window: Window::square(3, 1, 1),
                groups: 1,
                weights: vec![1; weights],
                padding_codes: vec![0; 2],
                rescale: plain(vec![0; biases], 1 << 23, 30),
            };
            let input = (Shape::map(4, 4, 2), ElementType::I8, vec![0.0; 32]);
            execute_alone(op, &[input], (output, ElementType::I8)).map_err(|e| e.code)
        };
        assert_eq!(run(54, 3, Shape::map(4, 4, 3)), Ok(vec![0.0; 48]));
        assert_eq!(run(53, 3, Shape::map(4, 4, 3)), Err(ErrorCode::Malformed));
        assert_eq!(run(54, 2, Shape::map(4, 4, 3)), Err(ErrorCode::Malformed));
        assert_eq!(run(54, 3, Shape::map(4, 5, 3)), Err(ErrorCode::Malformed));
    }
}
