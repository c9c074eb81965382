//! The scalar rules in f64: rounding shift, saturation, bit length, square root, quotient, and the exactness watch.

use crate::error::{Error, ErrorCode, Result};
use firmware::program::Clamp;

/// All integers of smaller magnitude are f64 values, and sums and products that stay below it are exact.
const EXACT_LIMIT: f64 = 9_007_199_254_740_992.0;

/// Remembers whether any watched intermediate left the range where f64 is exact.
///
/// A rounded result is never smaller than 2^53, so looking at results is enough.
#[derive(Default)]
pub(super) struct Exactness {
    lost: bool,
}

impl Exactness {
    /// Watches one intermediate and hands it on.
    #[inline]
    pub(super) fn watch(&mut self, value: f64) -> f64 {
        self.lost |= value.abs() >= EXACT_LIMIT || value.is_nan();
        value
    }

    /// # Errors
    /// [`ErrorCode::Numeric`] where an intermediate was not exact.
    pub(super) fn finish(self) -> Result<()> {
        if !self.lost {
            return Ok(());
        }
        let message = "an intermediate reaches 2^53, where f64 is no longer exact";
        Err(Error::new(ErrorCode::Numeric, "", message).with_help("quantize the model again: its bounds are wrong"))
    }
}

/// `2^exponent` for −1022..=1023.
pub(super) fn power_of_two(exponent: i32) -> f64 {
    f64::from_bits(((1023 + exponent) as u64) << 52)
}

/// `R(v, n) = floor((v + 2^(n−1)) / 2^n)`, `R(v, 0) = v`.
#[derive(Clone, Copy)]
pub(super) struct RoundingShift {
    half: f64,
    factor: f64,
}

impl RoundingShift {
    pub(super) fn new(shift: u32) -> Self {
        let half = if shift == 0 { 0.0 } else { power_of_two(shift as i32 - 1) };
        Self { half, factor: power_of_two(-(shift as i32)) }
    }

    #[inline]
    pub(super) fn round(self, value: f64, exact: &mut Exactness) -> f64 {
        exact.watch(value);
        (exact.watch(value + self.half) * self.factor).floor()
    }
}

/// `y = clamp(z_o + R(v, n))`: from a sum of products to an output code.
#[derive(Clone, Copy)]
pub(super) struct Requantizer {
    shift: RoundingShift,
    output: Saturation,
}

impl Requantizer {
    pub(super) fn new(shift: u8, zero_point: i16, clamp: Clamp) -> Self {
        Self { shift: RoundingShift::new(u32::from(shift)), output: Saturation::new(zero_point, clamp) }
    }

    #[inline]
    pub(super) fn code(&self, sum: f64, exact: &mut Exactness) -> f64 {
        self.code_plus(sum, 0.0, exact)
    }

    /// `clamp(z_o + R(v, n) + p)` with a term in output codes.
    #[inline]
    pub(super) fn code_plus(&self, sum: f64, addend: f64, exact: &mut Exactness) -> f64 {
        self.output.code(self.shift.round(sum, exact) + addend)
    }
}

/// `clamp(z_o + v)`.
#[derive(Clone, Copy)]
pub(super) struct Saturation {
    pub(super) zero_point: f64,
    min: f64,
    max: f64,
}

impl Saturation {
    pub(super) fn new(zero_point: i16, clamp: Clamp) -> Self {
        Self { zero_point: f64::from(zero_point), min: f64::from(clamp.min), max: f64::from(clamp.max) }
    }

    #[inline]
    pub(super) fn code(&self, value: f64) -> f64 {
        self.limit(self.zero_point + value)
    }

    /// The bounds alone.
    #[inline]
    pub(super) fn limit(&self, code: f64) -> f64 {
        code.max(self.min).min(self.max)
    }
}

/// Saturation to the range of i16.
pub(super) fn saturate_i16(value: f64) -> f64 {
    value.clamp(-32768.0, 32767.0)
}

/// Binary digits of |value|, an integer below 2^53; 0 for 0.
pub(super) fn bits(value: f64) -> u32 {
    if value == 0.0 {
        return 0;
    }
    let exponent = (value.to_bits() >> 52) & 0x7ff;
    exponent as u32 - 1022
}

/// `floor(√value)`, exact for integers below 2^52.
pub(super) fn isqrt(value: f64) -> f64 {
    value.sqrt().floor()
}

/// `floor(a / b)`, exact for integers 0 ≤ a < 2^53, b ≥ 1.
pub(super) fn quotient(a: f64, b: f64) -> f64 {
    (a / b).floor()
}

/// Any integer type to f64; exact up to 32 bits, and watched by the caller beyond.
pub(super) fn to_f64<T: Copy + Into<f64>>(values: &[T]) -> Vec<f64> {
    values.iter().map(|&v| v.into()).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::integer_reference::testing::{Random, clamp, rounding_shift};

    fn round(value: f64, shift: u32) -> f64 {
        let mut exact = Exactness::default();
        let result = RoundingShift::new(shift).round(value, &mut exact);
        exact.finish().unwrap();
        result
    }

    #[test]
    fn ties_round_up_on_both_sides_of_zero() {
        for (value, shift, expected) in [
            (5.0, 0, 5.0),
            (1.0, 1, 1.0),
            (-1.0, 1, 0.0),
            (-3.0, 1, -1.0),
            (3.0, 1, 2.0),
            (6.0, 2, 2.0),
            (-6.0, 2, -1.0),
            (-7.0, 2, -2.0),
            (-5.0, 2, -1.0),
        ] {
            assert_eq!(round(value, shift), expected, "R({value}, {shift})");
        }
    }

    #[test]
    fn rounding_shift_equals_wide_integers() {
        let seed = 0x51f7;
        let mut random = Random(seed);
        for _ in 0..200_000 {
            let width = random.below(53) as u32;
            let value = (random.below(1 << width) as i64) * if random.below(2) == 0 { 1 } else { -1 };
            let shift = random.below(53) as u32;
            assert_eq!(
                round(value as f64, shift) as i128,
                rounding_shift(i128::from(value), shift),
                "R({value}, {shift}), seed {seed:#x}"
            );
        }
    }

    #[test]
    fn exactness_ends_at_two_to_the_53() {
        let lost = |value: f64| {
            let mut exact = Exactness::default();
            exact.watch(value);
            exact.finish().is_err()
        };
        assert!(!lost(EXACT_LIMIT - 1.0) && !lost(1.0 - EXACT_LIMIT));
        assert!(lost(EXACT_LIMIT) && lost(-EXACT_LIMIT) && lost(f64::NAN));
    }

    #[test]
    fn codes_saturate_after_the_zero_point() {
        let mut exact = Exactness::default();
        let relu = Requantizer::new(1, -128, clamp(-128, 127));
        assert_eq!(relu.code(-7.0, &mut exact), -128.0);
        assert_eq!(relu.code(3.0, &mut exact), -126.0);
        assert_eq!(relu.code(1e6, &mut exact), 127.0);
        let stream = Requantizer::new(0, 0, clamp(-32768, 32767));
        assert_eq!(stream.code_plus(32767.0, 1.0, &mut exact), 32767.0);
        assert_eq!(stream.code_plus(-32768.0, -1.0, &mut exact), -32768.0);
    }

    #[test]
    fn bit_lengths() {
        for (value, expected) in [(0.0, 0), (1.0, 1), (-1.0, 1), (2.0, 2), (255.0, 8), (256.0, 9), (-32768.0, 16)] {
            assert_eq!(bits(value), expected, "bits({value})");
        }
        assert_eq!(bits(EXACT_LIMIT - 1.0), 53);
    }

    #[test]
    fn square_root_is_exact_around_squares() {
        let seed = 0x15947;
        let mut random = Random(seed);
        let check = |value: u64| assert_eq!(isqrt(value as f64), value.isqrt() as f64, "isqrt({value})");
        for root in (1..1000).chain(67_108_000..67_108_864) {
            (root * root - 1..=root * root + 1).for_each(check);
        }
        (0..100_000).for_each(|_| check(random.below(1 << 52)));
    }

    #[test]
    fn quotient_is_exact() {
        let seed = 0xd1f;
        let mut random = Random(seed);
        for _ in 0..200_000 {
            let width = 1 + random.below(26);
            let b = 1 + random.below(1 << width);
            let a = random.below(1 << 53);
            // The neighbors of multiples are where a rounded quotient could cross an integer.
            for a in [a, a / b * b, (a / b * b).saturating_sub(1)] {
                assert_eq!(quotient(a as f64, b as f64), (a / b) as f64, "{a} / {b}, seed {seed:#x}");
            }
        }
    }
}
