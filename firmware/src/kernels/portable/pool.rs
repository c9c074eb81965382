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
    let channels = windows.channels;
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
    for (pixel, window) in output.chunks_exact_mut(windows.channels).zip(windows.iter()) {
        for (channel, code) in pixel.iter_mut().enumerate() {
            let sum = window.pixels().filter_map(|tap| input.get(tap * windows.channels + channel));
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
struct Windows {
    rows: Axis,
    columns: Axis,
    input_width: usize,
    output_height: usize,
    output_width: usize,
    channels: usize,
}

/// One window: the taps that lie on the map.
struct PoolWindow<'a> {
    windows: &'a Windows,
    y: usize,
    x: usize,
}

impl Windows {
    /// `None` where the buffers do not have the lengths of the shapes (the output's may be longer) or there is nothing
    /// to do.
    fn new(args: &PoolArgs, input_len: usize, output_len: usize) -> Option<Self> {
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

    fn iter(&self) -> impl Iterator<Item = PoolWindow<'_>> {
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
        let (width, columns) = (self.windows.input_width, self.windows.columns.taps(self.x));
        self.windows.rows.taps(self.y).flat_map(move |y| columns.clone().map(move |x| y * width + x))
    }

    /// Number of taps that lie on the map.
    fn reads(&self) -> usize {
        self.pixels().count()
    }
}
