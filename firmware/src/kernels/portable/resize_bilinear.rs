//! Portable bilinear resize.

use super::codes::{Code, block, block_mut, operand_len, value};
use super::elementwise::weighted;
use crate::fault::{self, Fault};
use crate::fixed_point::{finish, round_shift};
use crate::kernels::{ResizeArgs, TermArgs};
use crate::tensor::{Codes, CodesMut};

/// `t = R(Σ wy·wx·(q − z), 2w − 8)` over four neighbors, `y = clamp(z_o + R(t·M + (r − z_r)·M_r, n))`.
///
/// Input: i8 or i16 map `H×W×C`; output: i8 or i16 map `OH×OW×C`, which may hold the residual. `rows` and `columns`:
/// per output line `[i0, w1]`, with `i1 = min(i0 + 1, last)` and weights `2^w − w1` and `w1`; w in 4..=11.
pub fn resize_bilinear(args: &ResizeArgs<'_>, output: CodesMut<'_>) {
    match (args.input.codes, output) {
        (Some(Codes::I8(input)), CodesMut::I8(output)) => run(args, input, output),
        (Some(Codes::I8(input)), CodesMut::I16(output)) => run(args, input, output),
        (Some(Codes::I16(input)), CodesMut::I8(output)) => run(args, input, output),
        (Some(Codes::I16(input)), CodesMut::I16(output)) => run(args, input, output),
        (None, _) => {}
    }
}

fn run<I: Code, O: Code>(args: &ResizeArgs<'_>, input: &[I], output: &mut [O]) {
    let channels = usize::from(args.output_shape.channels);
    let width = usize::from(args.output_shape.width);
    let residual_len = args.residual.map_or(output.len(), |term| operand_len(term.codes, output.len()));
    if args.output_shape.elements() != output.len() as u64
        || args.input_shape.elements() != input.len() as u64
        || args.input_shape.channels != args.output_shape.channels
        || residual_len != output.len()
        || args.columns.len() != width
    {
        return;
    }
    let mut residual = args.residual;
    if let Some(term) = residual.as_mut().filter(|_| fault::active(Fault::ResidualZeroPoint)) {
        term.zero_point = 0;
    }
    let input_width = usize::from(args.input_shape.width);
    for (y, row) in args.rows.iter().enumerate() {
        let mut vertical = Neighbors::new(*row, args.input_shape.height, args.weight_bits);
        if fault::active(Fault::ResizeWeights) {
            vertical = vertical.swapped();
        }
        for (x, column) in args.columns.iter().enumerate() {
            let horizontal = Neighbors::new(*column, args.input_shape.width, args.weight_bits);
            let corner = |(row, wy): (usize, i64), (column, wx): (usize, i64)| {
                (block(input, row * input_width + column, channels).unwrap_or_default(), wy * wx)
            };
            let ([top, bottom], [left, right]) = (vertical.0, horizontal.0);
            let corners = [corner(top, left), corner(top, right), corner(bottom, left), corner(bottom, right)];
            let pixel = y * width + x;
            let codes = block_mut(output, pixel, channels).unwrap_or_default();
            write_pixel(args, &corners, residual.as_ref(), pixel * channels, codes);
        }
    }
}

/// Writes the channels of one output pixel, whose first element has index `first` in the output.
fn write_pixel<I: Code, O: Code>(
    args: &ResizeArgs<'_>,
    corners: &[(&[I], i64); 4],
    residual: Option<&TermArgs<'_>>,
    first: usize,
    codes: &mut [O],
) {
    let zero_point = i64::from(args.input.zero_point);
    let shift = (2 * args.weight_bits.min(31)).saturating_sub(8);
    for (channel, code) in codes.iter_mut().enumerate() {
        let sum = corners.iter().map(|(codes, weight)| {
            let q = codes.get(channel).map_or(zero_point, |q| value(*q));
            weight.wrapping_mul(q - zero_point)
        });
        let t = round_shift(sum.fold(0, i64::wrapping_add), shift);
        let term = residual.map_or(0, |residual| weighted(residual, first + channel, *code));
        let total = t.wrapping_mul(i64::from(args.input.multiplier)).wrapping_add(term);
        *code = O::from_code(finish(total, args.sum.shift, i64::from(args.sum.zero_point), args.sum.clamp));
    }
}

/// The two input lines that an output line reads, each with its weight.
pub(in crate::kernels) struct Neighbors(pub(in crate::kernels) [(usize, i64); 2]);

impl Neighbors {
    pub(in crate::kernels) fn new([first, weight]: [u16; 2], size: u16, weight_bits: u32) -> Self {
        let second = first.saturating_add(1).min(size.saturating_sub(1));
        let (one, weight) = (1 << weight_bits.min(31), i64::from(weight));
        Self([(usize::from(first), one - weight), (usize::from(second), weight)])
    }

    /// The same lines with their weights exchanged.
    fn swapped(self) -> Self {
        let [(first, w0), (second, w1)] = self.0;
        Self([(first, w1), (second, w0)])
    }
}

#[cfg(test)]
mod tests {
    extern crate std;
    use super::super::oracle::{Buffer, clamp, for_seeds, half_pixel_lines, round};
    use super::*;
    use crate::kernels::SumArgs;
    use crate::program::Clamp;
    use crate::tensor::{ElementType, Shape};
    use std::vec::Vec;

    fn expected(args: &ResizeArgs<'_>, input: &Buffer, residual: &Buffer) -> Vec<i128> {
        let (i, o, one) = (args.input_shape, args.output_shape, 1i128 << args.weight_bits);
        let lines = |[i0, w1]: [u16; 2], last: u16| {
            [(i0, one - i128::from(w1)), ((i0 + 1).min(last), i128::from(w1))].map(|(i, w)| (usize::from(i), w))
        };
        let (width, channels) = (usize::from(o.width), usize::from(o.channels));
        let code = |element: usize| {
            let (pixel, channel) = (element / channels, element % channels);
            let mut sum = 0;
            for (iy, wy) in lines(args.rows[pixel / width], i.height - 1) {
                for (ix, wx) in lines(args.columns[pixel % width], i.width - 1) {
                    let q = input.get((iy * usize::from(i.width) + ix) * channels + channel);
                    sum += wy * wx * (q - i128::from(args.input.zero_point));
                }
            }
            let t = round(sum, 2 * args.weight_bits - 8) * i128::from(args.input.multiplier);
            let second = args
                .residual
                .map_or(0, |term| (residual.get(element) - i128::from(term.zero_point)) * i128::from(term.multiplier));
            clamp(i128::from(args.sum.zero_point) + round(t + second, args.sum.shift), args.sum.clamp)
        };
        (0..o.elements() as usize).map(code).collect()
    }

    #[test]
    fn equals_the_formula_with_residual_apart_and_in_place() {
        for_seeds(400, |rng| {
            let factor = [1, 2, 3, 4, 5, 8][rng.range(0, 5) as usize];
            let weight_bits = if rng.flag() { 4 } else { 11 };
            let input_shape = Shape::map(rng.range(1, 5) as u16, rng.range(1, 5) as u16, rng.range(1, 19) as u16);
            let output_shape =
                Shape { height: input_shape.height * factor, width: input_shape.width * factor, ..input_shape };
            let (from, to) = (rng.element_type(), rng.element_type());
            let input = rng.buffer(from, input_shape.elements() as usize);
            let in_place = rng.flag();
            let residual_type = if in_place { to } else { rng.element_type() };
            let residual = rng.buffer(residual_type, output_shape.elements() as usize);
            let rows = half_pixel_lines(input_shape.height, output_shape.height, weight_bits);
            let columns = half_pixel_lines(input_shape.width, output_shape.width, weight_bits);
            let second = TermArgs {
                codes: (!in_place).then(|| residual.codes()),
                zero_point: rng.zero_point(residual_type),
                multiplier: rng.range(1, 1 << 24) as i32,
            };
            let spread = if from == ElementType::I8 { 8 } else { 0 };
            let args = ResizeArgs {
                input_shape,
                output_shape,
                input: TermArgs {
                    codes: Some(input.codes()),
                    zero_point: rng.zero_point(from),
                    multiplier: rng.range(1, 1 << (16 + spread)) as i32,
                },
                residual: rng.flag().then_some(second),
                rows: &rows,
                columns: &columns,
                weight_bits,
                sum: SumArgs { shift: rng.range(24, 36) as u32, zero_point: rng.zero_point(to), clamp: rng.clamp(to) },
            };
            let expected = expected(&args, &input, &residual);
            let mut output = if in_place { residual.clone() } else { rng.buffer(to, output_shape.elements() as usize) };
            resize_bilinear(&args, output.codes_mut());
            output.assert_equals(&expected, "resize_bilinear");
        });
    }

    #[test]
    fn hostile_constants_and_lengths_do_not_panic() {
        let codes = [i16::MIN; 4];
        let term = TermArgs { codes: Some(Codes::I16(&codes)), zero_point: i16::MAX, multiplier: i32::MIN };
        let lines = [[u16::MAX; 2]; 2];
        let shape = Shape::map(2, 2, 1);
        let args = ResizeArgs {
            input_shape: shape,
            output_shape: shape,
            input: term,
            residual: Some(TermArgs { codes: None, ..term }),
            rows: &lines,
            columns: &lines,
            weight_bits: u32::MAX,
            sum: SumArgs { shift: 255, zero_point: i16::MIN, clamp: Clamp { min: 1, max: -1 } },
        };
        for args in [
            args,
            ResizeArgs { weight_bits: 0, residual: Some(term), ..args },
            ResizeArgs { rows: &[[0, 0]; 9], columns: &[[1, 0]; 2], ..args },
            ResizeArgs { columns: &[], ..args },
            ResizeArgs { input: TermArgs { codes: None, ..term }, ..args },
            ResizeArgs { output_shape: Shape::map(2, 2, 3), ..args },
        ] {
            resize_bilinear(&args, CodesMut::I16(&mut [i16::MIN; 4]));
            resize_bilinear(&args, CodesMut::I8(&mut [0; 12]));
        }
    }
}
