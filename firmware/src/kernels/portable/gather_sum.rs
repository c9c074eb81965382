//! Portable sums of gathered cells.

use super::codes::{Code, value};
use crate::fault::{self, Fault};
use crate::kernels::GatherSumArgs;
use crate::tensor::{Codes, CodesMut};

/// Channels that are summed at once.
const BLOCK: usize = 16;

/// `y_ijc = clamp(z_o + R(Σ_k (q[p_ijk]_c − z)·M, n))`; an index outside the map means the nearest row or column.
///
/// `input`: i8 or i16 map `H×W×C`; `indices`: `OH×OW×2K`, a row and a column per cell; `output`: i8 or i16 map
/// `OH×OW×C`. Precondition: `|Σ(q − z)·M| < 2^52`.
pub fn gather_sum(args: &GatherSumArgs<'_>, input: Codes<'_>, output: CodesMut<'_>) {
    match (input, output) {
        (Codes::I8(input), CodesMut::I8(output)) => gather_sum_into(args, input, output),
        (Codes::I8(input), CodesMut::I16(output)) => gather_sum_into(args, input, output),
        (Codes::I16(input), CodesMut::I8(output)) => gather_sum_into(args, input, output),
        (Codes::I16(input), CodesMut::I16(output)) => gather_sum_into(args, input, output),
    }
}

fn gather_sum_into<I: Code, O: Code>(args: &GatherSumArgs<'_>, input: &[I], output: &mut [O]) {
    let channels = usize::from(args.output_shape.channels);
    let Some(positions) = output.len().checked_div(channels) else { return };
    let pair_bytes = args.indices.len().checked_div(positions).unwrap_or_default();
    let fits = args.input_shape.elements() == input.len() as u64 && args.output_shape.elements() == output.len() as u64;
    let whole = pair_bytes.is_multiple_of(2) && pair_bytes * positions == args.indices.len();
    if !fits || !whole || pair_bytes == 0 || input.is_empty() || args.input_shape.channels != args.output_shape.channels
    {
        return;
    }
    let zero_point = i64::from(args.requant.input_zero_point);
    for (pixel, pairs) in output.chunks_exact_mut(channels).zip(args.indices.chunks_exact(pair_bytes)) {
        for (block, codes) in pixel.chunks_mut(BLOCK).enumerate() {
            let mut sums = [0; BLOCK];
            for pair in pairs.as_chunks::<2>().0 {
                let first = cell(args, *pair) * channels + block * BLOCK;
                for (sum, q) in sums.iter_mut().zip(input.get(first..).unwrap_or_default()).take(codes.len()) {
                    *sum += value(*q) - zero_point;
                }
            }
            for (code, sum) in codes.iter_mut().zip(sums) {
                *code = args.requant.code(sum);
            }
        }
    }
}

/// Number of the cell that an index pair names.
fn cell(args: &GatherSumArgs<'_>, [mut row, mut column]: [i8; 2]) -> usize {
    if fault::active(Fault::GatherTransposed) {
        core::mem::swap(&mut row, &mut column);
    }
    let inside = |index: i8, size: u16| usize::try_from(index).unwrap_or_default().min(usize::from(size) - 1);
    let shape = args.input_shape;
    inside(row, shape.height) * usize::from(shape.width) + inside(column, shape.width)
}

#[cfg(test)]
mod tests {
    extern crate std;
    use super::super::oracle::{FULL, clamp, for_seeds, round};
    use super::*;
    use crate::kernels::RequantArgs;
    use crate::program::{Clamp, Requant};
    use crate::tensor::{ElementType, Shape};
    use std::vec::Vec;

    #[test]
    fn equals_the_formula_with_indices_inside_and_outside() {
        for_seeds(400, |rng| {
            let channels = rng.range(1, 40) as u16;
            let input_shape = Shape::map(rng.range(1, 9) as u16, rng.range(1, 9) as u16, channels);
            let output_shape = Shape::map(rng.range(1, 5) as u16, rng.range(1, 5) as u16, channels);
            let cells = rng.range(1, 6) as usize;
            let (from, to) = (rng.element_type(), rng.element_type());
            let bits = |t| if t == ElementType::I8 { 8 } else { 16 };
            let requant = RequantArgs {
                input_zero_point: rng.zero_point(from),
                requant: rng.requant(bits(from) + 2, bits(to)),
                zero_point: rng.zero_point(to),
                clamp: rng.clamp(to),
            };
            let (low, high) = if rng.flag() { (0, 8) } else { (-128, 127) };
            let positions = output_shape.positions() as usize;
            let indices: Vec<i8> = rng.values(positions * cells * 2, low, high);
            let map = rng.buffer(from, input_shape.elements() as usize);
            let mut output = rng.buffer(to, output_shape.elements() as usize);
            let nearest = |index: i8, size: u16| i64::from(index).clamp(0, i64::from(size) - 1) as usize;
            let expected = |at: usize| {
                let (position, channel) = (at / usize::from(channels), at % usize::from(channels));
                let of_cell = |cell: usize| {
                    let pair = &indices[(position * cells + cell) * 2..][..2];
                    let (row, column) = (nearest(pair[0], input_shape.height), nearest(pair[1], input_shape.width));
                    let element = (row * usize::from(input_shape.width) + column) * usize::from(channels) + channel;
                    map.get(element) - i128::from(requant.input_zero_point)
                };
                let product = (0..cells).map(of_cell).sum::<i128>() * i128::from(requant.requant.multiplier);
                let code = i128::from(requant.zero_point) + round(product, requant.requant.shift.into());
                clamp(code, requant.clamp)
            };
            let expected: Vec<i128> = (0..output.len()).map(expected).collect();
            let args = GatherSumArgs { input_shape, output_shape, indices: &indices, requant };
            gather_sum(&args, map.codes(), output.codes_mut());
            output.assert_equals(&expected, "gather_sum");
        });
    }

    #[test]
    fn hostile_constants_and_lengths_do_not_panic() {
        let requant = RequantArgs {
            input_zero_point: i16::MIN,
            requant: Requant { multiplier: i32::MIN, shift: 255 },
            zero_point: i16::MIN,
            clamp: Clamp { min: 1, max: -1 },
        };
        let map = Shape::map(2, 2, 3);
        for (input_shape, output_shape, indices) in [
            (map, map, &[i8::MIN, i8::MAX].repeat(4)[..]),
            (map, map, &[0; 7]),
            (map, map, &[]),
            (map, Shape::map(2, 3, 2), &[0; 12]),
            (map, Shape::map(u16::MAX, u16::MAX, u16::MAX), &[0; 8]),
            (Shape::map(0, 2, 3), map, &[0; 8]),
            (map, Shape::vector(0), &[0; 2]),
        ] {
            let args = GatherSumArgs { input_shape, output_shape, indices, requant };
            gather_sum(&args, Codes::I16(&[i16::MAX; 12]), CodesMut::I8(&mut [0; 12]));
            gather_sum(&args, Codes::I8(&[]), CodesMut::I16(&mut [0; 12]));
            gather_sum(&args, Codes::I16(&[i16::MAX; 12]), CodesMut::I16(&mut []));
        }
    }

    #[test]
    fn nothing_is_written_where_lengths_do_not_fit() {
        let requant = Requant { multiplier: 1 << 23, shift: 23 };
        let requant = RequantArgs { input_zero_point: 0, requant, zero_point: 0, clamp: FULL };
        let shape = Shape::map(1, 2, 1);
        let mut output = [5; 2];
        let args = GatherSumArgs { input_shape: shape, output_shape: shape, indices: &[0, 1, 0], requant };
        gather_sum(&args, Codes::I8(&[1, 2]), CodesMut::I8(&mut output));
        assert_eq!(output, [5; 2]);
        let args = GatherSumArgs { indices: &[0, 1, 0, 0], ..args };
        gather_sum(&args, Codes::I8(&[1, 2]), CodesMut::I8(&mut output));
        assert_eq!(output, [2, 1]);
    }
}
