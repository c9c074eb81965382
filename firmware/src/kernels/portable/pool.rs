//! Portable pools.

use super::axis::Axis;
use super::codes::{Code, operand, operand_len, value};
use crate::fault::{self, Fault};
use crate::fixed_point::finish;
use crate::kernels::{PoolArgs, RequantArgs, SumArgs, TermArgs};
use crate::tensor::{Codes, CodesMut};

/// Channels that a max pool handles at once.
const BLOCK: usize = 16;

/// Largest code of each window; padding takes no part. A window that lies in the padding altogether gives the lowest
/// code of the type.
///
/// `input`: i8 or i16 map `H×W×C`; `output`: map `OH×OW×C` of the same type. In place, `output` holds the input and is
/// as long; [`crate::kernels::plan::max_pool_in_place`] says when that is right.
pub fn max_pool(args: &PoolArgs, input: Option<Codes<'_>>, output: CodesMut<'_>) {
    match (input, output) {
        (None, CodesMut::I8(output)) => max_pool_into(args, None, output),
        (None, CodesMut::I16(output)) => max_pool_into(args, None, output),
        (Some(Codes::I8(input)), CodesMut::I8(output)) => max_pool_into(args, Some(input), output),
        (Some(Codes::I16(input)), CodesMut::I16(output)) => max_pool_into(args, Some(input), output),
        (Some(Codes::I8(_)), CodesMut::I16(_)) | (Some(Codes::I16(_)), CodesMut::I8(_)) => {}
    }
}

fn max_pool_into<T: Code>(args: &PoolArgs, input: Option<&[T]>, output: &mut [T]) {
    let Some(windows) = Windows::new(args, input.map_or(output.len(), <[T]>::len), output.len()) else { return };
    let channels = windows.channels();
    for (pixel, window) in windows.iter().enumerate() {
        for first in (0..channels).step_by(BLOCK) {
            let len = BLOCK.min(channels - first);
            let mut best = [T::LOWEST; BLOCK];
            if fault::active(Fault::MaxPoolPadding) && window.reads() < windows.taps() {
                best = [T::ZERO; BLOCK];
            }
            let source = input.unwrap_or(output);
            for tap in window.pixels() {
                let codes = source.get(tap * channels + first..).unwrap_or_default();
                for (best, code) in best.iter_mut().take(len).zip(codes) {
                    *best = (*best).max(*code);
                }
            }
            let codes = output.get_mut(pixel * channels + first..).unwrap_or_default();
            for (code, best) in codes.iter_mut().zip(best).take(len) {
                *code = best;
            }
        }
    }
}

/// `y = clamp(z_o + R(Σ(q − z)·M, n))` over each window.
///
/// `input`: i8 or i16 map `H×W×C`; `output`: i8 or i16 map `OH×OW×C`. M includes the number of taps, so windows are
/// full (padding would count as `q = z`). Precondition: `|Σ(q − z)·M| < 2^52`.
pub fn average_pool(args: &PoolArgs, requant: &RequantArgs, input: Codes<'_>, output: CodesMut<'_>) {
    match (input, output) {
        (Codes::I8(input), CodesMut::I8(output)) => average_pool_into(args, requant, input, output),
        (Codes::I8(input), CodesMut::I16(output)) => average_pool_into(args, requant, input, output),
        (Codes::I16(input), CodesMut::I8(output)) => average_pool_into(args, requant, input, output),
        (Codes::I16(input), CodesMut::I16(output)) => average_pool_into(args, requant, input, output),
    }
}

fn average_pool_into<I: Code, O: Code>(args: &PoolArgs, requant: &RequantArgs, input: &[I], output: &mut [O]) {
    let Some(windows) = Windows::new(args, input.len(), output.len()) else { return };
    let zero_point = i64::from(requant.input_zero_point);
    for (pixel, window) in output.chunks_exact_mut(windows.channels()).zip(windows.iter()) {
        for (channel, code) in pixel.iter_mut().enumerate() {
            let sum = window.pixels().filter_map(|tap| input.get(tap * windows.channels() + channel));
            *code = requant.code(sum.map(|q| value(*q) - zero_point).sum());
        }
    }
}

/// `y_c = clamp(z_o + R(Σ_k M_k·Σ_p (q_kpc − z_k), n))`.
///
/// `terms`: i8 or i16 maps of `channels` channels, of any number of positions; `output`: `channels` codes, i8 or i16.
/// M includes the number of positions. Preconditions: `M_k < 2^31`, n ≤ 40, `|Σ| < 2^52`.
pub fn global_pool(channels: u16, sum: &SumArgs, terms: &[TermArgs<'_>], output: CodesMut<'_>) {
    let channels = usize::from(channels);
    match output {
        CodesMut::I8(output) => global_pool_into(channels, sum, terms, output),
        CodesMut::I16(output) => global_pool_into(channels, sum, terms, output),
    }
}

fn global_pool_into<T: Code>(channels: usize, sum: &SumArgs, terms: &[TermArgs<'_>], output: &mut [T]) {
    if channels == 0 || output.len() != channels {
        return;
    }
    let terms = if fault::active(Fault::PoolSecondMap) { terms.get(..1).unwrap_or_default() } else { terms };
    for (channel, code) in output.iter_mut().enumerate() {
        let total = terms.iter().fold(0, |total: i64, term| {
            let positions = (channel..operand_len(term.codes, 0)).step_by(channels);
            let pooled: i64 = positions.map(|at| operand(term.codes, at, T::ZERO) - i64::from(term.zero_point)).sum();
            total.wrapping_add(pooled.wrapping_mul(i64::from(term.multiplier)))
        });
        *code = T::from_code(finish(total, sum.shift, i64::from(sum.zero_point), sum.clamp));
    }
}

/// The windows of a pool in raster order of the output.
pub(in crate::kernels) struct Windows {
    rows: Axis,
    columns: Axis,
    input_width: usize,
    output_height: usize,
    output_width: usize,
    channels: usize,
}

/// One window: the taps that lie on the map.
pub(in crate::kernels) struct PoolWindow<'a> {
    windows: &'a Windows,
    y: usize,
    x: usize,
}

impl Windows {
    /// `None` where the buffers do not have the lengths of the shapes (the output's may be longer) or there is nothing
    /// to do.
    pub(in crate::kernels) fn new(args: &PoolArgs, input_len: usize, output_len: usize) -> Option<Self> {
        let (input, output) = (args.input_shape, args.output_shape);
        let fits = input.elements() == input_len as u64 && output.elements() <= output_len as u64;
        (fits && input.channels == output.channels && input.channels > 0).then(|| Self {
            rows: Axis::rows(&args.window, input),
            columns: Axis::columns(&args.window, input),
            input_width: usize::from(input.width),
            output_height: usize::from(output.height),
            output_width: usize::from(output.width),
            channels: usize::from(input.channels),
        })
    }

    /// Channels of the map.
    pub(in crate::kernels) fn channels(&self) -> usize {
        self.channels
    }

    /// All windows.
    pub(in crate::kernels) fn iter(&self) -> impl Iterator<Item = PoolWindow<'_>> {
        (0..self.output_height)
            .flat_map(move |y| (0..self.output_width).map(move |x| PoolWindow { windows: self, y, x }))
    }

    /// Taps of a full window.
    fn taps(&self) -> usize {
        self.rows.kernel() * self.columns.kernel()
    }
}

impl PoolWindow<'_> {
    /// Input pixels that the window covers.
    #[inline]
    fn pixels(&self) -> impl Iterator<Item = usize> {
        let (rows, columns) = (self.windows.rows.kernel(), self.windows.columns.kernel());
        (0..rows).flat_map(move |row| (0..columns).filter_map(move |column| self.tap(row, column)))
    }

    /// Input pixel of one tap; `None` in the padding.
    #[inline]
    pub(in crate::kernels) fn tap(&self, row: usize, column: usize) -> Option<usize> {
        let (y, x) = (self.windows.rows.tap(self.y, row)?, self.windows.columns.tap(self.x, column)?);
        Some(y * self.windows.input_width + x)
    }

    /// Number of taps that lie on the map.
    pub(in crate::kernels) fn reads(&self) -> usize {
        self.pixels().count()
    }
}

#[cfg(test)]
mod tests {
    extern crate std;
    use super::super::oracle::{Buffer, FULL, clamp, for_seeds, pool_args, round};
    use super::*;
    use crate::kernels::plan::max_pool_in_place;
    use crate::program::{Clamp, Requant, Window};
    use crate::tensor::{ElementType, Shape};
    use std::vec::Vec;

    /// Codes under the window of each output element, padding left out.
    fn windows(args: &PoolArgs, input: &Buffer) -> Vec<Vec<i128>> {
        let (i, o, w) = (args.input_shape, args.output_shape, args.window);
        let mut all = Vec::new();
        for element in 0..o.elements() as i64 {
            let (pixel, channel) = (element / i64::from(o.channels), element % i64::from(o.channels));
            let (y, x) = (pixel / i64::from(o.width), pixel % i64::from(o.width));
            let mut codes = Vec::new();
            for ky in 0..i64::from(w.kernel_h) {
                for kx in 0..i64::from(w.kernel_w) {
                    let iy = y * i64::from(w.stride_h) + ky - i64::from(w.pad_top);
                    let ix = x * i64::from(w.stride_w) + kx - i64::from(w.pad_left);
                    if (0..i64::from(i.height)).contains(&iy) && (0..i64::from(i.width)).contains(&ix) {
                        let at = (iy * i64::from(i.width) + ix) * i64::from(i.channels) + channel;
                        codes.push(input.get(at as usize));
                    }
                }
            }
            all.push(codes);
        }
        all
    }

    #[test]
    fn max_pool_takes_the_largest_also_in_place() {
        let in_place = core::cell::Cell::new(0);
        for_seeds(600, |rng| {
            let Some(args) = pool_args(rng, true, 35) else { return };
            let element_type = rng.element_type();
            let mut input = rng.buffer(element_type, args.input_shape.elements() as usize);
            let expected: Vec<i128> = windows(&args, &input).iter().map(|codes| *codes.iter().max().unwrap()).collect();
            let mut output = rng.buffer(element_type, expected.len());
            max_pool(&args, Some(input.codes()), output.codes_mut());
            output.assert_equals(&expected, "max_pool");
            if max_pool_in_place(args.input_shape, args.output_shape, args.window) {
                max_pool(&args, None, input.codes_mut());
                for (index, expected) in expected.iter().enumerate() {
                    assert_eq!(input.get(index), *expected, "in place: element {index} of {args:?}");
                }
                in_place.set(in_place.get() + 1);
            }
        });
        assert!(in_place.get() > 100, "only {} in place", in_place.get());
    }

    #[test]
    fn a_window_of_padding_gives_the_lowest_code() {
        let window = Window {
            kernel_h: 1,
            kernel_w: 1,
            stride_h: 1,
            stride_w: 1,
            pad_top: 1,
            pad_bottom: 0,
            pad_left: 0,
            pad_right: 0,
            dilation_h: 1,
            dilation_w: 1,
        };
        let args = PoolArgs { input_shape: Shape::map(1, 1, 1), output_shape: Shape::map(2, 1, 1), window };
        let mut output = [0; 2];
        max_pool(&args, Some(Codes::I8(&[5])), CodesMut::I8(&mut output));
        assert_eq!(output, [-128, 5]);
    }

    #[test]
    fn average_pool_equals_the_formula() {
        for_seeds(400, |rng| {
            let Some(args) = pool_args(rng, false, 35) else { return };
            let (from, to) = (rng.element_type(), rng.element_type());
            let input = rng.buffer(from, args.input_shape.elements() as usize);
            let bits = |t| if t == ElementType::I8 { 8 } else { 16 };
            let requant = RequantArgs {
                input_zero_point: rng.zero_point(from),
                requant: rng.requant(bits(from) + 2, bits(to)),
                zero_point: rng.zero_point(to),
                clamp: rng.clamp(to),
            };
            let code = |codes: &Vec<i128>| {
                let sum: i128 = codes.iter().map(|q| q - i128::from(requant.input_zero_point)).sum();
                let scaled = round(sum * i128::from(requant.requant.multiplier), u32::from(requant.requant.shift));
                clamp(i128::from(requant.zero_point) + scaled, requant.clamp)
            };
            let expected: Vec<i128> = windows(&args, &input).iter().map(code).collect();
            let mut output = rng.buffer(to, expected.len());
            average_pool(&args, &requant, input.codes(), output.codes_mut());
            output.assert_equals(&expected, "average_pool");
        });
    }

    #[test]
    fn global_pool_adds_the_sums_of_its_maps() {
        for_seeds(300, |rng| {
            let channels = rng.range(1, 20) as usize;
            let count = rng.range(1, 2) as usize;
            let output_type = rng.element_type();
            let maps: Vec<_> = (0..count)
                .map(|_| {
                    let element_type = rng.element_type();
                    let positions = rng.range(1, 30) as usize;
                    let map = rng.buffer(element_type, positions * channels);
                    (map, rng.zero_point(element_type), rng.range(1, 1 << 24) as i32)
                })
                .collect();
            let sum = SumArgs {
                shift: rng.range(24, 40) as u32,
                zero_point: rng.zero_point(output_type),
                clamp: rng.clamp(output_type),
            };
            let expected: Vec<i128> = (0..channels)
                .map(|channel| {
                    let term = |(map, zero_point, multiplier): &(Buffer, i16, i32)| {
                        let cells = (0..map.len()).filter(|at| at % channels == channel);
                        let pooled: i128 = cells.map(|at| map.get(at) - i128::from(*zero_point)).sum();
                        pooled * i128::from(*multiplier)
                    };
                    let total = maps.iter().map(term).sum();
                    clamp(i128::from(sum.zero_point) + round(total, sum.shift), sum.clamp)
                })
                .collect();
            let terms: Vec<TermArgs<'_>> = maps
                .iter()
                .map(|(map, zero_point, multiplier)| TermArgs {
                    codes: Some(map.codes()),
                    zero_point: *zero_point,
                    multiplier: *multiplier,
                })
                .collect();
            let mut output = rng.buffer(output_type, channels);
            global_pool(channels as u16, &sum, &terms, output.codes_mut());
            output.assert_equals(&expected, "global_pool");
        });
    }

    #[test]
    fn hostile_constants_and_lengths_do_not_panic() {
        let wild = Window {
            kernel_h: 255,
            kernel_w: 255,
            stride_h: 255,
            stride_w: 0,
            pad_top: 255,
            pad_bottom: 0,
            pad_left: 255,
            pad_right: 0,
            dilation_h: 255,
            dilation_w: 0,
        };
        let requant = RequantArgs {
            input_zero_point: i16::MIN,
            requant: Requant { multiplier: i32::MIN, shift: 255 },
            zero_point: i16::MAX,
            clamp: Clamp { min: 1, max: -1 },
        };
        let shape = Shape::map(2, 2, 3);
        for output_shape in
            [shape, Shape::map(1, 1, 3), Shape::map(1, 1, 2), Shape::map(65535, 65535, 3), Shape::vector(0)]
        {
            let args = PoolArgs { input_shape: shape, output_shape, window: wild };
            let input = [i16::MAX; 12];
            max_pool(&args, Some(Codes::I16(&input)), CodesMut::I16(&mut [0; 12]));
            max_pool(&args, None, CodesMut::I16(&mut [0; 12]));
            max_pool(&args, None, CodesMut::I8(&mut [0; 11]));
            average_pool(&args, &requant, Codes::I16(&input), CodesMut::I8(&mut [0; 12]));
            average_pool(&args, &requant, Codes::I8(&[]), CodesMut::I8(&mut []));
        }
        let term = TermArgs { codes: Some(Codes::I16(&[i16::MIN; 7])), zero_point: i16::MAX, multiplier: i32::MIN };
        let sum = SumArgs { shift: 255, zero_point: i16::MIN, clamp: FULL };
        global_pool(3, &sum, &[term, TermArgs { codes: None, ..term }], CodesMut::I16(&mut [0; 3]));
        global_pool(0, &sum, &[term], CodesMut::I16(&mut []));
        global_pool(3, &sum, &[], CodesMut::I8(&mut [0; 2]));
    }
}
