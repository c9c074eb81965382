//! Pools for AVX2 and AVX-512: [`portable::pool`] with the channels of a window in vectors.

use super::sums::{Aligned, BLOCK, Ending, add_codes};
use crate::kernels::portable;
use crate::kernels::portable::codes::{Code, operand_len};
use crate::kernels::portable::pool::Windows;
use crate::kernels::{PoolArgs, RequantArgs, SumArgs, TermArgs};
use crate::tensor::{Codes, CodesMut};

/// Channels whose largest codes are found at once: what fits in registers.
const MAX_BLOCK: usize = 64;

/// Positions whose codes a 32-bit sum holds.
const MAX_POSITIONS: usize = 1 << 16;

/// [`portable::pool::max_pool`] with AVX2.
#[target_feature(enable = "avx2")]
pub(super) fn max_pool_avx2(args: &PoolArgs, input: Option<Codes<'_>>, output: CodesMut<'_>) {
    max_pool(args, input, output);
}

/// [`portable::pool::max_pool`] with AVX-512.
#[target_feature(enable = "avx512f,avx512bw,avx512dq,avx512vl")]
pub(super) fn max_pool_avx512(args: &PoolArgs, input: Option<Codes<'_>>, output: CodesMut<'_>) {
    max_pool(args, input, output);
}

/// [`portable::pool::average_pool`] with AVX2.
#[target_feature(enable = "avx2")]
pub(super) fn average_pool_avx2(args: &PoolArgs, requant: &RequantArgs, input: Codes<'_>, output: CodesMut<'_>) {
    average_pool(args, requant, input, output);
}

/// [`portable::pool::average_pool`] with AVX-512.
#[target_feature(enable = "avx512f,avx512bw,avx512dq,avx512vl")]
pub(super) fn average_pool_avx512(args: &PoolArgs, requant: &RequantArgs, input: Codes<'_>, output: CodesMut<'_>) {
    average_pool(args, requant, input, output);
}

/// [`portable::pool::global_pool`] with AVX2.
#[target_feature(enable = "avx2")]
pub(super) fn global_pool_avx2(channels: u16, sum: &SumArgs, terms: &[TermArgs<'_>], output: CodesMut<'_>) {
    global_pool(channels, sum, terms, output);
}

/// [`portable::pool::global_pool`] with AVX-512.
#[target_feature(enable = "avx512f,avx512bw,avx512dq,avx512vl")]
pub(super) fn global_pool_avx512(channels: u16, sum: &SumArgs, terms: &[TermArgs<'_>], output: CodesMut<'_>) {
    global_pool(channels, sum, terms, output);
}

#[inline(always)]
fn max_pool(args: &PoolArgs, input: Option<Codes<'_>>, output: CodesMut<'_>) {
    match (input, output) {
        (None, CodesMut::I8(output)) => max_pool_into(args, None, output),
        (None, CodesMut::I16(output)) => max_pool_into(args, None, output),
        (Some(Codes::I8(input)), CodesMut::I8(output)) => max_pool_into(args, Some(input), output),
        (Some(Codes::I16(input)), CodesMut::I16(output)) => max_pool_into(args, Some(input), output),
        (Some(Codes::I8(_)), CodesMut::I16(_)) | (Some(Codes::I16(_)), CodesMut::I8(_)) => {}
    }
}

#[inline(always)]
fn max_pool_into<T: Code>(args: &PoolArgs, input: Option<&[T]>, output: &mut [T]) {
    let Some(windows) = Windows::new(args, input.map_or(output.len(), <[T]>::len), output.len()) else { return };
    let channels = windows.channels();
    for (pixel, window) in windows.iter().enumerate() {
        for first in (0..channels).step_by(MAX_BLOCK) {
            let len = MAX_BLOCK.min(channels - first);
            let mut best = Aligned([T::LOWEST; MAX_BLOCK]);
            let source = input.unwrap_or(output);
            for row in 0..usize::from(args.window.kernel_h) {
                for column in 0..usize::from(args.window.kernel_w) {
                    let Some(tap) = window.tap(row, column) else { continue };
                    let codes = source.get(tap * channels + first..).unwrap_or_default();
                    match codes.first_chunk::<MAX_BLOCK>() {
                        // Codes beyond `len` belong to the next pixel; what they give is not written.
                        Some(codes) => raise(&mut best.0, codes),
                        None => raise(&mut best.0, codes),
                    }
                }
            }
            let codes = output.get_mut(pixel * channels + first..).unwrap_or_default();
            if let (Some(codes), Some(best)) = (codes.get_mut(..len), best.0.get(..len)) {
                codes.copy_from_slice(best);
            }
        }
    }
}

/// Replaces each code by the larger of the two.
#[inline(always)]
fn raise<T: Code>(best: &mut [T; MAX_BLOCK], codes: &[T]) {
    for (best, code) in best.iter_mut().zip(codes) {
        *best = (*best).max(*code);
    }
}

#[inline(always)]
fn average_pool(args: &PoolArgs, requant: &RequantArgs, input: Codes<'_>, output: CodesMut<'_>) {
    match (input, output) {
        (Codes::I8(input), CodesMut::I8(output)) => average_pool_into(args, requant, input, output),
        (Codes::I8(input), CodesMut::I16(output)) => average_pool_into(args, requant, input, output),
        (Codes::I16(input), CodesMut::I8(output)) => average_pool_into(args, requant, input, output),
        (Codes::I16(input), CodesMut::I16(output)) => average_pool_into(args, requant, input, output),
    }
}

#[inline(always)]
fn average_pool_into<I: Code, O: Code>(args: &PoolArgs, requant: &RequantArgs, input: &[I], output: &mut [O]) {
    let Some(windows) = Windows::new(args, input.len(), output.len()) else { return };
    let ending = Ending::of_requant(requant);
    let channels = windows.channels();
    for (pixel, window) in output.chunks_exact_mut(channels).zip(windows.iter()) {
        let offset = offset(window.reads(), requant.input_zero_point);
        for (block, codes) in pixel.chunks_mut(BLOCK).enumerate() {
            // At most 255·255 positions.
            let mut sums = Aligned([0_i32; BLOCK]);
            for row in 0..usize::from(args.window.kernel_h) {
                for column in 0..usize::from(args.window.kernel_w) {
                    let Some(tap) = window.tap(row, column) else { continue };
                    let input = input.get(tap * channels + block * BLOCK..).unwrap_or_default();
                    add_codes(&mut sums.0, input.get(..codes.len()).unwrap_or_default());
                }
            }
            for (code, sum) in codes.iter_mut().zip(sums.0) {
                let pooled = i64::from(sum).wrapping_sub(offset);
                *code = ending.code(pooled.wrapping_mul(requant.requant.multiplier.into()));
            }
        }
    }
}

/// `Σ z` over some positions.
#[inline(always)]
pub(super) fn offset(positions: usize, zero_point: i16) -> i64 {
    i64::try_from(positions).unwrap_or(i64::MAX).wrapping_mul(zero_point.into())
}

/// Maps of more than 2^16 positions, or of a length that is no multiple of the channels, take the portable kernel.
#[inline(always)]
fn global_pool(channels: u16, sum: &SumArgs, terms: &[TermArgs<'_>], output: CodesMut<'_>) {
    let narrow = |term: &TermArgs<'_>| {
        let len = operand_len(term.codes, 0);
        len.checked_rem(channels.into()) == Some(0) && len / usize::from(channels) <= MAX_POSITIONS
    };
    if !terms.iter().all(narrow) {
        return portable::pool::global_pool(channels, sum, terms, output);
    }
    match output {
        CodesMut::I8(output) => global_pool_into(channels.into(), sum, terms, output),
        CodesMut::I16(output) => global_pool_into(channels.into(), sum, terms, output),
    }
}

#[inline(always)]
fn global_pool_into<T: Code>(channels: usize, sum: &SumArgs, terms: &[TermArgs<'_>], output: &mut [T]) {
    if output.len() != channels {
        return;
    }
    let ending = Ending::of_sum(sum);
    for (block, codes) in output.chunks_mut(BLOCK).enumerate() {
        let mut totals = [0_i64; BLOCK];
        for term in terms {
            let sums = match term.codes {
                Some(Codes::I8(map)) => map_sums(map, block * BLOCK, channels),
                Some(Codes::I16(map)) => map_sums(map, block * BLOCK, channels),
                None => continue,
            };
            let offset = offset(operand_len(term.codes, 0) / channels, term.zero_point);
            for (total, sum) in totals.iter_mut().zip(sums) {
                let pooled = i64::from(sum).wrapping_sub(offset);
                *total = total.wrapping_add(pooled.wrapping_mul(term.multiplier.into()));
            }
        }
        ending.write(&totals, codes);
    }
}

/// `Σ q` of the channels `first ..` over a map of at most [`MAX_POSITIONS`].
#[inline(always)]
fn map_sums<T: Code>(map: &[T], first: usize, channels: usize) -> [i32; BLOCK] {
    let end = channels.min(first + BLOCK);
    let mut sums = [0; BLOCK];
    for position in map.chunks_exact(channels) {
        add_codes(&mut sums, position.get(first..end).unwrap_or_default());
    }
    sums
}

#[cfg(test)]
mod tests {
    extern crate std;
    use super::super::testing::{code_bits, for_backends, multiplier, requant, sum, zero_point};
    use super::{BLOCK, MAX_POSITIONS};
    use crate::kernels::plan::max_pool_in_place;
    use crate::kernels::portable::oracle::{Buffer, Rng, pool_args};
    use crate::kernels::{Kernels, PoolArgs, Portable, RequantArgs, SumArgs, TermArgs};
    use crate::program::{Clamp, Requant, Window};
    use crate::tensor::{Codes, CodesMut, ElementType, Shape};
    use std::vec::Vec;

    #[test]
    fn max_pool_equals_portable_apart_and_in_place() {
        let in_place = core::cell::Cell::new(0);
        for_backends(600, |kernels, rng| {
            let Some(args) = pool_args(rng, true, 140) else { return };
            let element_type = rng.element_type();
            let input = rng.buffer(element_type, args.input_shape.elements() as usize);
            let mut expected = rng.buffer(element_type, args.output_shape.elements() as usize);
            let mut output = expected.clone();
            Portable.max_pool(&args, Some(input.codes()), expected.codes_mut());
            kernels.max_pool(&args, Some(input.codes()), output.codes_mut());
            assert_eq!(output, expected, "{args:?}");
            if max_pool_in_place(args.input_shape, args.output_shape, args.window) {
                let (mut expected, mut output) = (input.clone(), input);
                Portable.max_pool(&args, None, expected.codes_mut());
                kernels.max_pool(&args, None, output.codes_mut());
                assert_eq!(output, expected, "in place: {args:?}");
                in_place.set(in_place.get() + 1);
            }
        });
        assert!(in_place.get() == 0 || in_place.get() > 100, "only {} in place", in_place.get());
    }

    #[test]
    fn average_pool_equals_portable() {
        for_backends(400, |kernels, rng| {
            let padded = rng.flag();
            let Some(args) = pool_args(rng, padded, 2 * BLOCK as i64 + 20) else { return };
            let (from, to) = (rng.element_type(), rng.element_type());
            let input = rng.buffer(from, args.input_shape.elements() as usize);
            let requant = requant(rng, from, code_bits(from) + 2, to);
            let mut expected = rng.buffer(to, args.output_shape.elements() as usize);
            let mut output = expected.clone();
            Portable.average_pool(&args, &requant, input.codes(), expected.codes_mut());
            kernels.average_pool(&args, &requant, input.codes(), output.codes_mut());
            assert_eq!(output, expected, "{args:?} {requant:?}");
        });
    }

    #[test]
    fn global_pool_equals_portable() {
        for_backends(300, |kernels, rng| {
            let channels = rng.range(1, 2 * BLOCK as i64 + 20) as usize;
            let count = rng.range(0, 2);
            // Now and then a map that ends within a position.
            let ragged = usize::from(rng.next().is_multiple_of(8));
            let maps: Vec<Buffer> = (0..count)
                .map(|_| {
                    let (element_type, positions) = (rng.element_type(), rng.range(1, 70) as usize);
                    rng.buffer(element_type, positions * channels + ragged)
                })
                .collect();
            let terms: Vec<TermArgs<'_>> = maps
                .iter()
                .map(|map| TermArgs {
                    codes: Some(map.codes()),
                    zero_point: zero_point(rng, ElementType::I8),
                    multiplier: multiplier(rng),
                })
                .collect();
            let to = rng.element_type();
            let sum = sum(rng, to);
            let mut expected = rng.buffer(to, channels);
            let mut output = expected.clone();
            Portable.global_pool(channels as u16, &sum, &terms, expected.codes_mut());
            kernels.global_pool(channels as u16, &sum, &terms, output.codes_mut());
            assert_eq!(output, expected, "{sum:?} {channels} channels");
        });
    }

    #[test]
    fn sums_of_the_largest_maps_do_not_wrap() {
        for_backends(1, |kernels, _| {
            let full = Clamp { min: i16::MIN, max: i16::MAX };
            for positions in [MAX_POSITIONS, MAX_POSITIONS + 1] {
                for code in [i16::MIN, i16::MAX] {
                    let map = std::vec![code; positions];
                    let term = TermArgs { codes: Some(Codes::I16(&map)), zero_point: 0, multiplier: 1 };
                    let sum = SumArgs { shift: 17, zero_point: 0, clamp: full };
                    let (mut expected, mut output) = ([0], [1]);
                    Portable.global_pool(1, &sum, &[term], CodesMut::I16(&mut expected));
                    kernels.global_pool(1, &sum, &[term], CodesMut::I16(&mut output));
                    assert_eq!(output, expected, "{positions} codes {code}");
                    assert!(output[0].unsigned_abs() >= 1 << 13);
                }
            }
            let shape = |size| Shape::map(size, size, 1);
            let args = PoolArgs { input_shape: shape(255), output_shape: shape(1), window: Window::square(255, 1, 0) };
            let map = std::vec![i16::MIN; 255 * 255];
            let requant = Requant { multiplier: 1 << 23, shift: 40 };
            let requant = RequantArgs { input_zero_point: 0, requant, zero_point: 0, clamp: full };
            let mut output = [0];
            kernels.average_pool(&args, &requant, Codes::I16(&map), CodesMut::I16(&mut output));
            assert_eq!(output, [-16256], "-32768 · 255² / 2^17, rounded");
        });
    }

    #[test]
    fn hostile_shapes_give_what_portable_gives() {
        for_backends(300, |kernels, rng| {
            let Some(mut args) = pool_args(rng, true, 5) else { return };
            let byte = |rng: &mut Rng| [0, 1, 2, 255][rng.range(0, 3) as usize];
            args.window.stride_h = byte(rng);
            args.window.dilation_w = byte(rng);
            args.window.pad_top = byte(rng);
            args.window.kernel_w = byte(rng);
            args.output_shape.height = rng.range(0, 4) as u16;
            let len = args.input_shape.elements() as usize - usize::from(rng.flag());
            let input = rng.buffer(ElementType::I8, len);
            let len = rng.range(0, 300) as usize;
            let mut expected = rng.buffer(ElementType::I8, len);
            let mut output = expected.clone();
            Portable.max_pool(&args, Some(input.codes()), expected.codes_mut());
            kernels.max_pool(&args, Some(input.codes()), output.codes_mut());
            assert_eq!(output, expected, "{args:?}");
            let requant = requant(rng, ElementType::I8, 8, ElementType::I8);
            Portable.average_pool(&args, &requant, input.codes(), expected.codes_mut());
            kernels.average_pool(&args, &requant, input.codes(), output.codes_mut());
            assert_eq!(output, expected, "{args:?} {requant:?}");
        });
    }
}
