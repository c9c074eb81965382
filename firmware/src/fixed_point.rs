//! The normative arithmetic: one rounding rule, requantization, table functions. Integers only.
//!
//! Everything here is total: every input gives a number, in builds with overflow checks too, because an image that
//! nobody compiled may hold any constant. Under the compiler's bounds (each function states them as its precondition)
//! nothing wraps and nothing saturates that the formula does not saturate, and every intermediate lies below 2^53.
//!
//! This is also the only file in which values are narrowed.

use crate::fault::{self, Fault};
use crate::program::{Clamp, Requant};

/// Entries of the table of [`exp2_q15`].
pub const EXP_TABLE_LEN: usize = 257;
/// Entries of the table of [`tanh_q15`] and [`sigmoid_q15`].
pub const TANH_TABLE_LEN: usize = 513;
/// Largest exponent that [`exp2_q15`] is given: 31 in Q16. Beyond it the result is 0 or 1 LSB of Q15 anyway.
pub const EXPONENT_MAX: i64 = 31 << 16;

/// The one rounding rule: `R(v, n) = floor((v + 2^(n−1)) / 2^n)` for n ≥ 1, `R(v, 0) = v`. Ties go up.
///
/// Precondition: `v + 2^(n−1) < 2^63`, n ≤ 62 (the compiler stays below 2^53 and 52).
#[inline]
pub fn round_shift(value: i64, shift: u32) -> i64 {
    let shift = shift.min(62);
    let half = (1i64 << shift) >> 1;
    let tie_down = fault::active(Fault::TieDown) || (fault::active(Fault::TieAwayFromZero) && value < 0);
    let half = if tie_down && shift > 0 { half - 1 } else { half };
    value.wrapping_add(half) >> shift
}

/// [`round_shift`] as the last rounding of an epilogue, which must be the only one.
#[inline]
fn round_last(value: i64, shift: u32) -> i64 {
    if fault::active(Fault::DoubleRounding) {
        let first = shift.saturating_sub(1);
        return round_shift(round_shift(value, first), shift - first);
    }
    round_shift(value, shift)
}

/// `RQ(acc) = R(R(acc, p)·M, n)`.
///
/// Precondition: `|R(acc, p)| < 2^28`, M in `[2^23, 2^24)`, so that the product stays below 2^52.
#[inline]
pub fn requantize(acc: i64, pre_shift: u32, requant: Requant) -> i64 {
    let product = round_shift(acc, pre_shift).wrapping_mul(i64::from(requant.multiplier));
    round_last(product, u32::from(requant.shift))
}

/// End of every epilogue: `clamp(z_o + R(sum, n))`.
///
/// `offset` is the zero point of the output, or what else is added after the rounding: the stream operand of a
/// residual, the position code of a token. Precondition: `|sum| < 2^52`.
#[inline]
pub fn finish(sum: i64, shift: u32, offset: i64, clamp: Clamp) -> i16 {
    let rounded = round_last(sum, shift);
    if fault::active(Fault::ClampOrder) {
        return saturate_i16(offset.wrapping_add(i64::from(clamp_code(rounded, clamp))));
    }
    clamp_code(rounded.wrapping_add(offset), clamp)
}

/// `min(max(value, clamp.min), clamp.max)`; with bounds the wrong way round it is the upper one.
#[inline]
#[allow(clippy::cast_possible_truncation, reason = "the value lies between, or is one of, two i16 values")]
pub fn clamp_code(value: i64, clamp: Clamp) -> i16 {
    value.max(i64::from(clamp.min)).min(i64::from(clamp.max)) as i16
}

/// The nearest `i8`.
#[inline]
#[allow(clippy::cast_possible_truncation, reason = "clamped just before")]
pub fn saturate_i8(value: i16) -> i8 {
    value.clamp(i8::MIN as i16, i8::MAX as i16) as i8
}

/// The nearest `i16` (`sat16`).
#[inline]
#[allow(clippy::cast_possible_truncation, reason = "clamped just before")]
pub fn saturate_i16(value: i64) -> i16 {
    value.clamp(i16::MIN as i64, i16::MAX as i64) as i16
}

/// The nearest `i32`.
#[inline]
#[allow(clippy::cast_possible_truncation, reason = "clamped just before")]
pub fn saturate_i32(value: i64) -> i32 {
    value.clamp(i32::MIN as i64, i32::MAX as i64) as i32
}

/// The nearest `i64`.
#[inline]
#[allow(clippy::cast_possible_wrap, reason = "clamped just before")]
pub fn saturate_i64(value: u64) -> i64 {
    value.min(i64::MAX as u64) as i64
}

/// Binary digits of `|value|`: `bits(0) = 0`, `bits(255) = 8`, `bits(−256) = 9`.
#[inline]
pub const fn bits(value: i64) -> u32 {
    u64::BITS - value.unsigned_abs().leading_zeros()
}

/// `floor(√value)`, digit by digit: 32 rounds for every value, integers only.
pub const fn isqrt(value: u64) -> u64 {
    let mut rest = value;
    let mut root = 0u64;
    let mut bit = 1u64 << 62;
    while bit != 0 {
        let trial = root | bit;
        root >>= 1;
        if rest >= trial {
            rest -= trial;
            root |= bit;
        }
        bit >>= 2;
    }
    root
}

/// `floor(numerator / denominator)`, 0 for denominator 0: 64 rounds for every pair, where the library's division takes
/// a time that depends on its operands (and has a panic path).
pub const fn divide(numerator: u64, denominator: u64) -> u64 {
    if denominator == 0 {
        return 0;
    }
    let mut quotient = 0u64;
    let mut rest = 0u64;
    let mut bit = 1u64 << 63;
    while bit != 0 {
        // `rest` before the step is below `denominator`; its carry out means that it is at least 2^64 after it.
        let carry = rest >> 63;
        rest = (rest << 1) | ((numerator & bit != 0) as u64);
        if carry != 0 || rest >= denominator {
            rest = rest.wrapping_sub(denominator);
            quotient |= bit;
        }
        bit >>= 1;
    }
    quotient
}

/// `2^(−u/2^16)` in Q15: `R((T[k]<<8) − (T[k] − T[k+1])·r, 8 + min(I, 23))` with `I = u>>16`, `k = (u>>8)&255`,
/// `r = u&255` and `T[k] = min(32767, round(2^15·2^(−k/256)))`.
///
/// Precondition: 0 ≤ u ≤ [`EXPONENT_MAX`] (other values are moved there).
#[inline]
pub fn exp2_q15(table: &[i16; EXP_TABLE_LEN], exponent: i64) -> i16 {
    saturate_i16(exp2(table, exponent, 8))
}

/// `2^(−u/2^16)` in Q23: `R((T[k]<<8) − (T[k] − T[k+1])·r, I)`; see [`exp2_q15`].
#[inline]
pub fn exp2_q23(table: &[i16; EXP_TABLE_LEN], exponent: i64) -> i64 {
    exp2(table, exponent, 0)
}

/// `2^(−u/2^16)` in Q23, rounded with the last `drop` bits left off.
#[inline]
fn exp2(table: &[i16; EXP_TABLE_LEN], exponent: i64, drop: u64) -> i64 {
    let exponent = exponent.clamp(0, EXPONENT_MAX);
    let k = low_bits(exponent >> 8, 8);
    let fraction = exponent & 255;
    let shift = (drop + (exponent >> 16).unsigned_abs()).min(31);
    let here = i64::from(table[k]);
    let next = i64::from(table[if fault::active(Fault::ExpNextEntry) { k } else { k + 1 }]);
    round_shift((here << 8) - (here - next) * fraction, u32::try_from(shift).unwrap_or(31))
}

/// `tanh(x)` in Q15 of `x` in Q12, from `T[k] = min(32767, round(2^15·tanh(k/64)))`.
///
/// `a = min(|x|, 2^15 − 1)`, `k = a>>6`, `r = a&63`, `y = ±R(T[k]·64 + (T[k+1] − T[k])·r, 6)` with the sign of x.
#[inline]
pub fn tanh_q15(table: &[i16; TANH_TABLE_LEN], x: i64) -> i16 {
    interpolate_odd::<6>(table, x)
}

/// The logistic function in Q15 of `x` in Q12: `min(32767, R(2^15 + tanh(x/2), 1))`.
///
/// tanh(x/2) comes from the same table with one more bit of fraction: `a = min(|x|, 2^16 − 1)`, `k = a>>7`,
/// `r = a&127`, shift 7.
#[inline]
pub fn sigmoid_q15(table: &[i16; TANH_TABLE_LEN], x: i64) -> i16 {
    saturate_i16(round_shift((1 << 15) + i64::from(interpolate_odd::<7>(table, x)), 1))
}

/// The odd function of which `table` holds the values at multiples of `2^BITS`, between entries linear.
#[inline]
fn interpolate_odd<const BITS: u32>(table: &[i16; TANH_TABLE_LEN], x: i64) -> i16 {
    // The sign as a mask: with a branch the time would tell of the data.
    let limit = (512 << BITS) - 1;
    let x = x.clamp(-limit, limit);
    let sign = x >> 63;
    let magnitude = (x ^ sign) - sign;
    let k = low_bits(magnitude >> BITS, 9);
    let fraction = magnitude & ((1 << BITS) - 1);
    let here = i64::from(table[k]);
    let next = i64::from(table[if fault::active(Fault::TanhNextEntry) { k } else { k + 1 }]);
    let value = round_shift((here << BITS) + (next - here) * fraction, BITS);
    saturate_i16((value ^ sign) - sign)
}

/// The lowest `count` bits (at most 16) as an index.
#[inline]
#[allow(clippy::cast_possible_truncation, clippy::cast_sign_loss, reason = "masked to at most 16 bits")]
const fn low_bits(value: i64, count: u32) -> usize {
    (value & ((1 << count) - 1)) as usize
}

#[cfg(test)]
mod tests {
    extern crate std;
    use super::*;

    const FULL: Clamp = Clamp { min: i16::MIN, max: i16::MAX };
    const I8: Clamp = Clamp { min: -128, max: 127 };

    fn exp_table() -> [i16; EXP_TABLE_LEN] {
        core::array::from_fn(|k| f64::min(32767.0, (32768.0 * f64::exp2(-(k as f64) / 256.0)).round()) as i16)
    }

    fn tanh_table() -> [i16; TANH_TABLE_LEN] {
        core::array::from_fn(|k| f64::min(32767.0, (32768.0 * (k as f64 / 64.0).tanh()).round()) as i16)
    }

    #[test]
    fn requantize_rounds_half_up() {
        for (value, shift, expected) in [
            (0, 1, 0),
            (1, 1, 1),
            (-1, 1, 0),
            (2, 1, 1),
            (3, 1, 2),
            (-3, 1, -1),
            (-2, 2, 0),
            (-6, 2, -1),
            (2, 2, 1),
            (-7, 2, -2),
            (5, 0, 5),
            (-5, 0, -5),
        ] {
            assert_eq!(round_shift(value, shift), expected, "R({value}, {shift})");
        }
        let requant = Requant { multiplier: 1 << 23, shift: 24 };
        assert_eq!(requantize(1, 0, requant), 1);
        assert_eq!(requantize(-1, 0, requant), 0);
        assert_eq!(requantize(-3, 0, requant), -1);
        assert_eq!(requantize(-3, 1, requant), 0, "R(-3, 1) = -1, R(-1/2) = 0");
    }

    #[test]
    fn round_shift_is_the_formula() {
        for shift in 0..=52u32 {
            for base in [0i64, 1, -1, 1 << 20, -(1 << 20), (1 << 52) - 1, -(1 << 52)] {
                for delta in -3i64..=3 {
                    for value in [base + delta, base + delta + ((1i64 << shift) >> 1)] {
                        let half = if shift == 0 { 0 } else { 1i128 << (shift - 1) };
                        let expected = (i128::from(value) + half).div_euclid(1i128 << shift);
                        assert_eq!(i128::from(round_shift(value, shift)), expected, "R({value}, {shift})");
                    }
                }
            }
        }
    }

    #[test]
    fn finish_clamps_after_the_offset() {
        assert_eq!(finish(300, 0, -200, I8), 100);
        assert_eq!(finish(-300, 0, -128, Clamp { min: -128, max: 127 }), -128);
        assert_eq!(finish(5, 0, -128, Clamp { min: -100, max: 127 }), -100);
        assert_eq!(finish(40_000, 0, 0, FULL), 32767);
        assert_eq!(finish(3, 1, 10, I8), 12);
    }

    #[test]
    fn saturation_keeps_the_ends() {
        assert_eq!([-129, -128, 0, 127, 128].map(saturate_i8), [-128, -128, 0, 127, 127]);
        assert_eq!([-32769, -32768, 32767, 32768, i64::MIN].map(saturate_i16), [-32768, -32768, 32767, 32767, -32768]);
        assert_eq!([i64::MAX, i64::MIN, -7].map(saturate_i32), [i32::MAX, i32::MIN, -7]);
        assert_eq!([u64::MAX, 7].map(saturate_i64), [i64::MAX, 7]);
    }

    #[test]
    fn bits_counts_binary_digits() {
        assert_eq!([0, 1, -1, 255, 256, -256, i64::MIN].map(bits), [0, 1, 1, 8, 9, 9, 64]);
    }

    #[test]
    fn isqrt_is_exact_beside_every_square() {
        let roots = (0..200_000u64).chain((0..32).flat_map(|b| (1u64 << b) - 1..=(1 << b) + 1)).chain([(1 << 32) - 1]);
        for root in roots {
            let square = root * root;
            assert_eq!(isqrt(square), root);
            assert_eq!(isqrt(square + 2 * root), root, "last before the next square");
            if square > 0 {
                assert_eq!(isqrt(square - 1), root - 1);
            }
        }
        assert_eq!(isqrt(u64::MAX), (1 << 32) - 1);
    }

    #[test]
    fn divide_is_the_floor_of_the_quotient() {
        let mut state = 1u64;
        let mut next = || {
            state = state.wrapping_mul(6364136223846793005).wrapping_add(1442695040888963407);
            state >> (state >> 58)
        };
        for _ in 0..10_000 {
            let (a, b) = (next(), next());
            assert_eq!(divide(a, b), a.checked_div(b).unwrap_or(0), "{a} / {b}");
        }
        for a in [0, 1, u64::MAX, 1 << 63, 1 << 47] {
            for b in [0, 1, 2, 3, u64::MAX, 1 << 63, (1 << 63) + 1] {
                assert_eq!(divide(a, b), a.checked_div(b).unwrap_or(0), "{a} / {b}");
            }
        }
    }

    #[test]
    fn exp2_is_the_formula_and_close_to_the_function() {
        let table = exp_table();
        for u in (0..=EXPONENT_MAX).step_by(7).chain([EXPONENT_MAX]) {
            let (i, k, r) = (u >> 16, ((u >> 8) & 255) as usize, i128::from(u & 255));
            let (t0, t1) = (i128::from(table[k]), i128::from(table[k + 1]));
            let shift = 8 + i.min(23);
            let expected = ((t0 << 8) - (t0 - t1) * r + (1 << (shift - 1))) >> shift;
            assert_eq!(i128::from(exp2_q15(&table, u)), expected, "u = {u}");
            let real = 32768.0 * f64::exp2(-(u as f64) / 65536.0);
            assert!((expected as f64 - real).abs() < 1.6, "u = {u}: {expected} against {real}");
        }
        assert_eq!(exp2_q15(&table, 0), 32767);
        assert_eq!(exp2_q15(&table, EXPONENT_MAX), 0);
    }

    #[test]
    fn exp2_of_23_bits_keeps_what_15_bits_round_away() {
        let table = exp_table();
        for u in 0..=EXPONENT_MAX {
            let (i, k, r) = ((u >> 16) as u32, ((u >> 8) & 255) as usize, u & 255);
            let (here, next) = (i128::from(table[k]), i128::from(table[k + 1]));
            let expected = ((here << 8) - (here - next) * i128::from(r) + ((1 << i) >> 1)) >> i;
            assert_eq!(i128::from(exp2_q23(&table, u)), expected, "u = {u}");
            let real = f64::exp2(23.0 - u as f64 / 65536.0);
            assert!((expected as f64 - real).abs() < 0.51 + 5e-5 * real, "u = {u}: {expected} against {real}");
        }
        assert_eq!(exp2_q23(&table, 0), 32767 << 8);
        assert_eq!(exp2_q23(&table, 22 << 16), 2);
        assert_eq!([24 << 16, EXPONENT_MAX, i64::MAX].map(|u| exp2_q23(&table, u)), [0; 3], "far pixels add nothing");
    }

    #[test]
    fn tanh_and_sigmoid_follow_the_functions() {
        let table = tanh_table();
        for x in (-70_000..=70_000i64).chain([i64::MIN, i64::MAX, 1 << 40, -(1 << 40)]) {
            let real = x as f64 / 4096.0;
            let tanh = f64::from(tanh_q15(&table, x)) / 32768.0;
            assert!((tanh - real.tanh()).abs() < 1.5e-4, "tanh({real}) = {tanh}");
            let sigmoid = f64::from(sigmoid_q15(&table, x)) / 32768.0;
            assert!((sigmoid - 1.0 / (1.0 + (-real).exp())).abs() < 4.0e-4, "sigmoid({real}) = {sigmoid}");
        }
    }

    #[test]
    fn tanh_is_odd_and_sigmoid_rounds_up_around_one_half() {
        let table = tanh_table();
        for x in 0..70_000 {
            assert_eq!(tanh_q15(&table, -x), -tanh_q15(&table, x), "x = {x}");
            let a = x.min((1 << 16) - 1);
            let (k, r) = ((a >> 7) as usize, a & 127);
            let (t0, t1) = (i64::from(table[k]), i64::from(table[k + 1]));
            let half_angle = (t0 * 128 + (t1 - t0) * r + 64) >> 7;
            assert_eq!(i64::from(sigmoid_q15(&table, x)), ((32768 + half_angle + 1) >> 1).min(32767), "x = {x}");
            assert_eq!(i64::from(sigmoid_q15(&table, -x)), (32768 - half_angle + 1) >> 1, "x = -{x}");
        }
    }

    #[test]
    fn hostile_constants_give_numbers() {
        let extremes = [i64::MIN, -1, 0, 1, i64::MAX];
        for value in extremes {
            for shift in [0, 1, 31, 52, 62, 63, 64, 255, u32::MAX] {
                round_shift(value, shift);
                for multiplier in [i32::MIN, -1, 0, i32::MAX] {
                    requantize(value, shift, Requant { multiplier, shift: 255 });
                }
                for offset in extremes {
                    finish(value, shift, offset, Clamp { min: 1, max: -1 });
                }
            }
            for entry in [i16::MIN, 0, i16::MAX] {
                let mut exp = [entry; EXP_TABLE_LEN];
                let mut tanh = [entry; TANH_TABLE_LEN];
                exp[1] = !entry;
                tanh[1] = !entry;
                for x in [value, 100, 8000] {
                    exp2_q15(&exp, x);
                    tanh_q15(&tanh, x);
                    sigmoid_q15(&tanh, x);
                }
            }
        }
        assert_eq!(clamp_code(0, Clamp { min: 1, max: -1 }), -1);
    }
}
