//! Bilinear resize for AVX2 and AVX-512: [`portable::resize_bilinear`] with the channels of a pixel in vectors.

use super::sums::{Aligned, BLOCK, Ending, add_term};
use crate::fixed_point::saturate_i32;
use crate::kernels::ResizeArgs;
use crate::kernels::portable;
use crate::kernels::portable::codes::{Code, block, block_mut, operand_len};
use crate::kernels::portable::resize_bilinear::Neighbors;
use crate::tensor::{Codes, CodesMut};

/// [`portable::resize_bilinear::resize_bilinear`] with AVX2.
#[target_feature(enable = "avx2")]
pub(super) fn avx2(args: &ResizeArgs<'_>, output: CodesMut<'_>) {
    resize_bilinear(args, output);
}

/// [`portable::resize_bilinear::resize_bilinear`] with AVX-512.
#[target_feature(enable = "avx512f,avx512bw,avx512dq,avx512vl")]
pub(super) fn avx512(args: &ResizeArgs<'_>, output: CodesMut<'_>) {
    resize_bilinear(args, output);
}

/// Sums of more than 32 bits (16-bit maps with w above 7) take the portable kernel.
#[inline(always)]
fn resize_bilinear(args: &ResizeArgs<'_>, output: CodesMut<'_>) {
    let output_len = match &output {
        CodesMut::I8(output) => output.len(),
        CodesMut::I16(output) => output.len(),
    };
    if !is_narrow(args, output_len) {
        return portable::resize_bilinear::resize_bilinear(args, output);
    }
    match (args.input.codes, output) {
        (Some(Codes::I8(input)), CodesMut::I8(output)) => run(args, input, output),
        (Some(Codes::I8(input)), CodesMut::I16(output)) => run(args, input, output),
        (Some(Codes::I16(input)), CodesMut::I8(output)) => run(args, input, output),
        (Some(Codes::I16(input)), CodesMut::I16(output)) => run(args, input, output),
        (None, _) => {}
    }
}

/// Whether operands have the lengths of their shapes, weights are as documented, and `Σ wy·wx·(q − z)`, of which the
/// weights add up to 2^(2w), fits 32 bits with its rounding.
fn is_narrow(args: &ResizeArgs<'_>, output_len: usize) -> bool {
    let (input, output) = (args.input_shape, args.output_shape);
    let lines = |lines: &[[u16; 2]], size: u16, count: u16| {
        let inside = |[first, weight]: &[u16; 2]| *first < size && u32::from(*weight) <= 1 << args.weight_bits;
        lines.len() == usize::from(count) && lines.iter().all(inside)
    };
    let code_bits = match args.input.codes {
        Some(Codes::I8(_)) if (-128..=127).contains(&args.input.zero_point) => 8,
        _ => 16,
    };
    (4..=11).contains(&args.weight_bits)
        && 2 * args.weight_bits + code_bits <= 30
        && input.channels == output.channels
        && input.elements() == operand_len(args.input.codes, 0) as u64
        && output.elements() == output_len as u64
        && args.residual.is_none_or(|term| operand_len(term.codes, output_len) == output_len)
        && lines(args.rows, input.height, output.height)
        && lines(args.columns, input.width, output.width)
}

#[inline(always)]
fn run<I: Code, O: Code>(args: &ResizeArgs<'_>, input: &[I], output: &mut [O]) {
    let channels = usize::from(args.output_shape.channels);
    let (width, input_width) = (args.columns.len(), usize::from(args.input_shape.width));
    let ending = Ending::of_sum(&args.sum);
    let mut sums = Aligned([0; BLOCK]);
    for (y, row) in args.rows.iter().enumerate() {
        let vertical = Neighbors::new(*row, args.input_shape.height, args.weight_bits);
        for (x, column) in args.columns.iter().enumerate() {
            let horizontal = Neighbors::new(*column, args.input_shape.width, args.weight_bits);
            let corner = |(row, wy): (usize, i64), (column, wx): (usize, i64)| {
                let codes = block(input, row * input_width + column, channels).unwrap_or_default();
                (codes, saturate_i32(wy * wx))
            };
            let ([top, bottom], [left, right]) = (vertical.0, horizontal.0);
            let corners = [corner(top, left), corner(top, right), corner(bottom, left), corner(bottom, right)];
            let pixel = y * width + x;
            let codes = block_mut(output, pixel, channels).unwrap_or_default();
            for (i, codes) in codes.chunks_mut(BLOCK).enumerate() {
                let sums = sums.0.get_mut(..codes.len()).unwrap_or_default();
                interpolate(args, &corners, i * BLOCK, sums);
                if let Some(residual) = &args.residual {
                    add_term(sums, residual, pixel * channels + i * BLOCK, codes);
                }
                ending.write(sums, codes);
            }
        }
    }
}

/// `t·M` for the channels `first ..` of a pixel, with `t = R(Σ wy·wx·(q − z), 2w − 8)`.
#[inline(always)]
fn interpolate<I: Code>(args: &ResizeArgs<'_>, corners: &[(&[I], i32); 4], first: usize, sums: &mut [i64]) {
    let shift = 2 * args.weight_bits - 8;
    let offset = ((1_i32 << shift) >> 1) - (i32::from(args.input.zero_point) << (2 * args.weight_bits));
    let [top_left, top_right, bottom_left, bottom_right] = corners.map(|(codes, weight)| {
        let codes = codes.get(first..).unwrap_or_default().iter();
        codes.map(move |q| i32::from(q.widen()).wrapping_mul(weight))
    });
    let top = top_left.zip(top_right);
    let bottom = bottom_left.zip(bottom_right);
    for (sum, ((a, b), (c, d))) in sums.iter_mut().zip(top.zip(bottom)) {
        let t = a.wrapping_add(b).wrapping_add(c).wrapping_add(d).wrapping_add(offset) >> shift;
        *sum = i64::from(t).wrapping_mul(args.input.multiplier.into());
    }
}

#[cfg(test)]
mod tests {
    use super::super::testing::{for_backends, multiplier, sum, zero_point};
    use super::{BLOCK, is_narrow};
    use crate::kernels::portable::oracle::half_pixel_lines;
    use crate::kernels::{Kernels, Portable, ResizeArgs, TermArgs};
    use crate::tensor::{ElementType, Shape};
    use core::cell::Cell;

    #[test]
    fn equals_portable_with_residual_apart_and_in_place() {
        let narrow = Cell::new([0; 2]);
        for_backends(500, |kernels, rng| {
            let factor = [1, 2, 3, 4, 8][rng.range(0, 4) as usize];
            let weight_bits = [4, 7, 8, 11][rng.range(0, 3) as usize];
            let channels = [rng.range(1, 40), rng.range(1, BLOCK as i64 + 20)][rng.range(0, 1) as usize] as u16;
            let input_shape = Shape::map(rng.range(1, 4) as u16, rng.range(1, 4) as u16, channels);
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
                zero_point: zero_point(rng, residual_type),
                multiplier: multiplier(rng),
            };
            let args = ResizeArgs {
                input_shape,
                output_shape,
                input: TermArgs {
                    codes: Some(input.codes()),
                    zero_point: zero_point(rng, from),
                    multiplier: multiplier(rng),
                },
                residual: rng.flag().then_some(second),
                rows: &rows,
                columns: &columns,
                weight_bits,
                sum: sum(rng, to),
            };
            let initial = if in_place { residual.clone() } else { rng.buffer(to, residual.len()) };
            let (mut expected, mut output) = (initial.clone(), initial);
            Portable.resize_bilinear(&args, expected.codes_mut());
            kernels.resize_bilinear(&args, output.codes_mut());
            assert_eq!(output, expected, "{from:?} {input_shape:?} to {to:?} {output_shape:?}, {weight_bits} bits");
            let mut counts = narrow.get();
            counts[usize::from(is_narrow(&args, output.len()))] += 1;
            narrow.set(counts);
        });
        assert!(narrow.get() == [0; 2] || narrow.get().iter().all(|count| *count > 100), "{narrow:?}");
    }

    #[test]
    fn hostile_lines_and_shapes_give_what_portable_gives() {
        for_backends(400, |kernels, rng| {
            let input = rng.buffer(ElementType::I8, 12);
            let mut line = || [rng.range(0, 3) as u16, [0, 1, 16, 17, 65535][rng.range(0, 4) as usize]];
            let rows = [line(), line(), line()];
            let columns = [line(), line(), line()];
            let term = TermArgs { codes: Some(input.codes()), zero_point: -7, multiplier: 1 << 20 };
            let args = ResizeArgs {
                input_shape: Shape::map(2, 2, rng.range(2, 3) as u16),
                output_shape: Shape::map(2, rng.range(2, 3) as u16, 3),
                input: term,
                residual: rng.flag().then_some(TermArgs { codes: None, ..term }),
                rows: &rows[..rng.range(1, 3) as usize],
                columns: &columns[..rng.range(1, 3) as usize],
                weight_bits: [0, 4, 5, 11, 12, 31, u32::MAX][rng.range(0, 6) as usize],
                sum: sum(rng, ElementType::I8),
            };
            let len = rng.range(11, 18) as usize;
            let mut expected = rng.buffer(ElementType::I8, len);
            let mut output = expected.clone();
            Portable.resize_bilinear(&args, expected.codes_mut());
            kernels.resize_bilinear(&args, output.codes_mut());
            assert_eq!(output, expected, "{args:?}");
        });
    }
}
