//! LayerNorm for AVX2 and AVX-512: [`portable::layer_norm`] with the channels of a row in vectors.

use super::sums::Ending;
use crate::fixed_point::{bits, saturate_i32, saturate_i64};
use crate::kernels::LayerNormArgs;
use crate::kernels::portable;
use crate::kernels::portable::codes::{Code, block_mut};
use crate::tensor::{Codes, CodesMut, index};

/// Most channels whose sums and differences stay in 32 bits, as in every image.
const MAX_CHANNELS: u16 = 1024;
/// Largest E of an image.
const MAX_EPSILON: i64 = 1 << 52;

/// [`portable::layer_norm::layer_norm`] with AVX2.
#[target_feature(enable = "avx2")]
pub(super) fn avx2(args: &LayerNormArgs<'_>, input: Codes<'_>, output: CodesMut<'_>) {
    layer_norm(args, input, output);
}

/// [`portable::layer_norm::layer_norm`] with AVX-512.
#[target_feature(enable = "avx512f,avx512bw,avx512dq,avx512vl")]
pub(super) fn avx512(args: &LayerNormArgs<'_>, input: Codes<'_>, output: CodesMut<'_>) {
    layer_norm(args, input, output);
}

/// More channels or another E than an image may have take the portable kernel.
#[inline(always)]
fn layer_norm(args: &LayerNormArgs<'_>, input: Codes<'_>, output: CodesMut<'_>) {
    if args.channels > MAX_CHANNELS || !(1..=MAX_EPSILON).contains(&args.epsilon) {
        return portable::layer_norm::layer_norm(args, input, output);
    }
    match (input, output) {
        (Codes::I8(input), CodesMut::I8(output)) => run(args, input, output),
        (Codes::I8(input), CodesMut::I16(output)) => run(args, input, output),
        (Codes::I16(input), CodesMut::I8(output)) => run(args, input, output),
        (Codes::I16(input), CodesMut::I16(output)) => run(args, input, output),
    }
}

#[inline(always)]
fn run<I: Code, O: Code>(args: &LayerNormArgs<'_>, input: &[I], output: &mut [O]) {
    let channels = usize::from(args.channels);
    if channels == 0 {
        return;
    }
    let ending = Ending::of_sum(&args.sum);
    for (i, row) in input.chunks_exact(channels).take(index(args.rows)).enumerate() {
        let Some(codes) = block_mut(output, i, channels) else { return };
        let statistics = Statistics::of(args, row);
        let constants = args.gains.iter().zip(args.offsets);
        for ((code, x), (gain, offset)) in codes.iter_mut().zip(row).zip(constants) {
            let t = statistics.normalize(x.widen());
            *code = ending.code(t.wrapping_mul((*gain).into()).wrapping_add(*offset));
        }
    }
}

/// What a row is normalized with.
#[derive(Clone, Copy)]
struct Statistics {
    /// C.
    channels: i32,
    /// S, below 2^25.
    sum: i32,
    /// `R_σ`, at most 2^22 because σ is at least 2^25.
    reciprocal: i32,
    /// `33 − h`, at least 8.
    shift: u32,
}

impl Statistics {
    #[inline(always)]
    fn of<I: Code>(args: &LayerNormArgs<'_>, row: &[I]) -> Self {
        let values = || row.iter().map(|x| i32::from(x.widen()));
        let sum = values().fold(0, i32::wrapping_add);
        let squares = values().fold(0, |sum: i64, x| sum.wrapping_add(i64::from(x.wrapping_mul(x))));
        let (channels, total) = (i64::from(args.channels), i64::from(sum));
        let variance = (channels * squares - total * total + args.epsilon).max(1);
        let headroom = 52u32.saturating_sub(bits(variance)) >> 1;
        let sigma = (variance.unsigned_abs() << (2 * headroom)).isqrt();
        let reciprocal = (1u64 << 47).checked_div(sigma).unwrap_or(0);
        let reciprocal = saturate_i32(saturate_i64(reciprocal));
        Self { channels: args.channels.into(), sum, reciprocal, shift: 33 - headroom.min(33) }
    }

    /// `t = R((C·x − S)·R_σ, 33 − h)`, Q14, at most √C·2^14.
    #[inline(always)]
    fn normalize(self, x: i16) -> i64 {
        let difference = self.channels.wrapping_mul(x.into()).wrapping_sub(self.sum);
        let half = (1i64 << self.shift) >> 1;
        i64::from(difference).wrapping_mul(self.reciprocal.into()).wrapping_add(half) >> self.shift
    }
}

#[cfg(test)]
mod tests {
    extern crate std;
    use super::super::testing::{for_backends, sum};
    use super::MAX_EPSILON;
    use crate::kernels::portable::oracle::{Buffer, FULL};
    use crate::kernels::{Kernels, LayerNormArgs, Portable, SumArgs};
    use crate::tensor::{Codes, CodesMut};
    use std::vec::Vec;

    #[test]
    fn equals_portable_for_any_constants() {
        for_backends(500, |kernels, rng| {
            let channels = [1, 2, 7, 64, rng.range(1, 200), 1024, 1025][rng.range(0, 6) as usize] as u16;
            let rows = rng.range(0, 4) as u32;
            let (from, to) = (rng.element_type(), rng.element_type());
            let count = rows as usize * usize::from(channels);
            let input = match rng.next() % 4 {
                0 => Buffer::I16(rng.values(count, -3, 3)),
                1 => Buffer::I16(std::vec![rng.range(-32768, 32767) as i16; count]),
                // Largest variance: half of the codes at either end.
                2 => Buffer::I16((0..count).map(|i| if i % 2 == 0 { i16::MIN } else { i16::MAX }).collect()),
                _ => rng.buffer(from, count),
            };
            let (gain, offset) = if rng.flag() { (1 << 24, 1 << 51) } else { (1 << 31, i64::MAX) };
            // One in eight with an array that is too short, as in no image.
            let missing = usize::from(rng.next().is_multiple_of(8));
            let gains: Vec<i32> = rng.values(usize::from(channels) - missing, -gain, gain - 1);
            let offsets: Vec<i64> = (0..channels).map(|_| rng.next() as i64 % offset).collect();
            let epsilons = [1, rng.range(1, 1 << 30), MAX_EPSILON, MAX_EPSILON + 1, i64::MAX, i64::MIN, 0, -1];
            let args = LayerNormArgs {
                rows,
                channels,
                epsilon: epsilons[rng.range(0, 7) as usize],
                gains: &gains,
                offsets: &offsets,
                sum: sum(rng, to),
            };
            let mut expected = rng.buffer(to, count - usize::from(rows > 0 && missing > 0));
            let mut output = expected.clone();
            Portable.layer_norm(&args, input.codes(), expected.codes_mut());
            kernels.layer_norm(&args, input.codes(), output.codes_mut());
            assert_eq!(output, expected, "{rows} x {channels}, epsilon {}, {:?}", args.epsilon, args.sum);
        });
    }

    #[test]
    fn ties_of_the_normalized_value_go_up() {
        // C·x − S = ±128, V = 2^44: R_σ = 2^22, h = 3, t = R(±2^29, 30).
        let args = LayerNormArgs {
            rows: 1,
            channels: 2,
            epsilon: (1 << 44) - 2 * (64 * 64 + 64 * 64),
            gains: &[1; 2],
            offsets: &[0; 2],
            sum: SumArgs { shift: 0, zero_point: 0, clamp: FULL },
        };
        for_backends(1, |kernels, _| {
            let (mut expected, mut output) = ([9; 2], [9; 2]);
            Portable.layer_norm(&args, Codes::I16(&[64, -64]), CodesMut::I16(&mut expected));
            kernels.layer_norm(&args, Codes::I16(&[64, -64]), CodesMut::I16(&mut output));
            assert_eq!((output, expected), ([1, 0], [1, 0]));
        });
    }
}
