//! Portable LayerNorm.

use super::codes::{Code, value};
use crate::fault::{self, Fault};
use crate::fixed_point::{bits, divide, finish, isqrt, round_shift, saturate_i64};
use crate::kernels::LayerNormArgs;
use crate::tensor::{Codes, CodesMut, index};

/// Per row: `S = Σx; V = C·Σx² − S² + E; h = max(0, (52 − bits(V)) >> 1); σ = isqrt(V << 2h); R_σ = floor(2^47/σ);`
/// `t_i = R((C·x_i − S)·R_σ, 33 − h)` (Q14); `y_i = clamp(z_o + R(t_i·G_i + B_i, n))`.
///
/// `input` and `output`: i8 or i16, `rows × C`. Preconditions: C ≤ 1024, `1 ≤ V < 2^52`, `|G| < 2^24`, `|B| < 2^51`,
/// n ≤ 40.
pub fn layer_norm(args: &LayerNormArgs<'_>, input: Codes<'_>, output: CodesMut<'_>) {
    match (input, output) {
        (Codes::I8(input), CodesMut::I8(output)) => run(args, input, output),
        (Codes::I8(input), CodesMut::I16(output)) => run(args, input, output),
        (Codes::I16(input), CodesMut::I8(output)) => run(args, input, output),
        (Codes::I16(input), CodesMut::I16(output)) => run(args, input, output),
    }
}

fn run<I: Code, O: Code>(args: &LayerNormArgs<'_>, input: &[I], output: &mut [O]) {
    let channels = usize::from(args.channels);
    if channels == 0 {
        return;
    }
    let rows = input.chunks_exact(channels).zip(output.chunks_exact_mut(channels));
    for (row, codes) in rows.take(index(args.rows)) {
        let statistics = Statistics::of(args, row);
        let constants = args.gains.iter().zip(args.offsets);
        for ((code, x), (gain, offset)) in codes.iter_mut().zip(row).zip(constants) {
            let sum = statistics.normalize(value(*x)).wrapping_mul(i64::from(*gain)).wrapping_add(*offset);
            *code = O::from_code(finish(sum, args.sum.shift, i64::from(args.sum.zero_point), args.sum.clamp));
        }
    }
}

/// What a row is normalized with.
struct Statistics {
    /// C.
    channels: i64,
    /// S.
    sum: i64,
    /// `R_σ`.
    reciprocal: i64,
    /// `33 − h`.
    shift: u32,
}

impl Statistics {
    fn of<I: Code>(args: &LayerNormArgs<'_>, row: &[I]) -> Self {
        let channels = i64::from(args.channels);
        let values = || row.iter().map(|x| value(*x));
        let sum: i64 = values().sum();
        let squares: i64 = values().map(|x| x * x).sum();
        let epsilon = if fault::active(Fault::LayerNormEpsilon) { 0 } else { args.epsilon };
        let variance = (channels * squares).wrapping_sub(sum.wrapping_mul(sum)).wrapping_add(epsilon).max(1);
        let headroom = 52u32.saturating_sub(bits(variance)) >> 1;
        let sigma = isqrt(variance.unsigned_abs() << (2 * headroom));
        Self { channels, sum, reciprocal: saturate_i64(divide(1 << 47, sigma)), shift: 33 - headroom.min(33) }
    }

    /// `t = R((C·x − S)·R_σ, 33 − h)`, Q14.
    #[inline]
    fn normalize(&self, x: i64) -> i64 {
        round_shift((self.channels * x - self.sum).wrapping_mul(self.reciprocal), self.shift)
    }
}

#[cfg(test)]
mod tests {
    extern crate std;
    use super::super::oracle::{Buffer, clamp, for_seeds, round};
    use super::*;
    use crate::kernels::SumArgs;
    use crate::program::Clamp;
    use std::vec::Vec;

    fn expected(args: &LayerNormArgs<'_>, input: &Buffer) -> Vec<i128> {
        let channels = usize::from(args.channels);
        let mut codes = Vec::new();
        for row in 0..args.rows as usize {
            let x: Vec<i128> = (0..channels).map(|c| input.get(row * channels + c)).collect();
            let s: i128 = x.iter().sum();
            let v = channels as i128 * x.iter().map(|x| x * x).sum::<i128>() - s * s + i128::from(args.epsilon);
            assert!((1..1 << 52).contains(&v));
            let h = ((52 - (v.ilog2() as i32 + 1)) >> 1).max(0) as u32;
            let sigma = (v << (2 * h)).isqrt();
            let reciprocal = (1i128 << 47) / sigma;
            for (channel, x) in x.iter().enumerate() {
                let t = round((channels as i128 * x - s) * reciprocal, 33 - h);
                let sum = t * i128::from(args.gains[channel]) + i128::from(args.offsets[channel]);
                codes.push(clamp(i128::from(args.sum.zero_point) + round(sum, args.sum.shift), args.sum.clamp));
            }
        }
        codes
    }

    #[test]
    fn equals_the_formula() {
        for_seeds(300, |rng| {
            let channels = [1, 2, 7, 64, rng.range(1, 200), 1024][rng.range(0, 5) as usize] as u16;
            let rows = rng.range(1, 4) as u32;
            let (from, to) = (rng.element_type(), rng.element_type());
            let count = rows as usize * usize::from(channels);
            let input = match rng.next() % 3 {
                0 => Buffer::I16(rng.values(count, -3, 3)),
                1 => Buffer::I16(std::vec![rng.range(-32768, 32767) as i16; count]),
                _ => rng.buffer(from, count),
            };
            let shift = rng.range(20, 30);
            let gains: Vec<i32> = rng.values(usize::from(channels), -(1 << (shift - 6)), 1 << (shift - 6));
            let offsets: Vec<i64> = rng.values(usize::from(channels), -(1 << (shift + 7)), 1 << (shift + 7));
            let args = LayerNormArgs {
                rows,
                channels,
                epsilon: [1, 5, rng.range(1, 1 << 30)][rng.range(0, 2) as usize],
                gains: &gains,
                offsets: &offsets,
                sum: SumArgs { shift: shift as u32, zero_point: rng.zero_point(to), clamp: rng.clamp(to) },
            };
            let mut output = rng.buffer(to, count);
            layer_norm(&args, input.codes(), output.codes_mut());
            output.assert_equals(&expected(&args, &input), &std::format!("{rows} x {channels}"));
        });
    }

    #[test]
    fn a_unit_row_is_normalized_to_unit_variance() {
        let input: Vec<i16> = (0..64).map(|i| if i % 2 == 0 { 1000 } else { -1000 }).collect();
        let args = LayerNormArgs {
            rows: 1,
            channels: 64,
            epsilon: 1,
            gains: &[1 << 20; 64],
            offsets: &[0; 64],
            sum: SumArgs { shift: 24, zero_point: 0, clamp: Clamp { min: i16::MIN, max: i16::MAX } },
        };
        let mut output = [0; 64];
        layer_norm(&args, Codes::I16(&input), CodesMut::I16(&mut output));
        // Q14 · 2^20 / 2^24 = Q10.
        assert!(output.iter().enumerate().all(|(i, y)| *y == if i % 2 == 0 { 1024 } else { -1024 }), "{output:?}");
    }

    #[test]
    fn hostile_constants_and_lengths_do_not_panic() {
        let sum = SumArgs { shift: 255, zero_point: i16::MIN, clamp: Clamp { min: 1, max: -1 } };
        for epsilon in [i64::MIN, -1, 0, i64::MAX] {
            for (rows, channels) in [(1, 8), (2, 4), (u32::MAX, 1), (1, 0), (0, u16::MAX)] {
                let args =
                    LayerNormArgs { rows, channels, epsilon, gains: &[i32::MIN; 8], offsets: &[i64::MIN; 8], sum };
                layer_norm(&args, Codes::I16(&[i16::MIN; 8]), CodesMut::I16(&mut [0; 8]));
                layer_norm(&args, Codes::I8(&[127; 7]), CodesMut::I8(&mut [0; 8]));
            }
        }
        let args = LayerNormArgs { rows: 1, channels: u16::MAX, epsilon: i64::MAX, gains: &[], offsets: &[], sum };
        let row = std::vec![i16::MIN; 65535];
        layer_norm(&args, Codes::I16(&row), CodesMut::I8(&mut std::vec![0; 65535]));
    }
}
