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
