//! Portable bilinear resize.

use super::codes::{Code, block, block_mut, operand_len, value};
use super::elementwise::weighted;
use crate::fault::{self, Fault};
use crate::fixed_point::{finish, round_shift};
use crate::kernels::{ResizeArgs, TermArgs};
use crate::tensor::{Codes, CodesMut};

/// `t = R(Σ wy·wx·(q − z), 2w − 8)` over four neighbors, `y = clamp(z_o + R(t·M + (r − z_r)·M_r, n))`.
///
/// Input: i8 or i16 map `H×W×C`; output: i8 or i16 map `OH×OW×C`, which may hold the residual. `rows` and `columns`: per
/// output line `[i0, w1]`, with `i1 = min(i0 + 1, last)` and weights `2^w − w1` and `w1`; w in 4..=11.
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
            vertical.weights.reverse();
        }
        for (x, column) in args.columns.iter().enumerate() {
            let horizontal = Neighbors::new(*column, args.input_shape.width, args.weight_bits);
            let corners = [(0, 0), (0, 1), (1, 0), (1, 1)].map(|(v, h): (usize, usize)| {
                let pixel = vertical.indices[v] * input_width + horizontal.indices[h];
                (block(input, pixel, channels).unwrap_or_default(), vertical.weights[v] * horizontal.weights[h])
            });
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

/// The two input lines that an output line reads, with their weights.
struct Neighbors {
    indices: [usize; 2],
    weights: [i64; 2],
}

impl Neighbors {
    fn new([first, weight]: [u16; 2], size: u16, weight_bits: u32) -> Self {
        let second = first.saturating_add(1).min(size.saturating_sub(1));
        Self {
            indices: [usize::from(first), usize::from(second)],
            weights: [(1 << weight_bits.min(31)) - i64::from(weight), i64::from(weight)],
        }
    }
}
