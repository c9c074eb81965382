//! Sine, cosine, arctangent and length in fixed point. Every function is total and gives the same bits everywhere.

use super::Real;
use crate::fixed_point::{isqrt, saturate_i32, saturate_i64};
use fixed::types::{I0F64, I2F30};
use micromath::F32Ext;

/// `1 / 2π`.
const TURNS_PER_RADIAN: I0F64 = I0F64::lit("0.159154943091895335768883763372514362");

/// `1 / (2k·(2k + 1))`: factors from one term of the series of sin(x)/x to the next, in x².
const SINE: [I2F30; 5] =
    reciprocals(["0.1666666666667", "0.05", "0.0238095238095", "0.0138888888889", "0.0090909090909"]);
/// `1 / ((2k − 1)·2k)`: the same of cos(x).
const COSINE: [I2F30; 5] =
    reciprocals(["0.5", "0.0833333333333", "0.0333333333333", "0.0178571428571", "0.0111111111111"]);

const fn reciprocals([a, b, c, d, e]: [&str; 5]) -> [I2F30; 5] {
    [I2F30::lit(a), I2F30::lit(b), I2F30::lit(c), I2F30::lit(d), I2F30::lit(e)]
}

/// Sine and cosine of an angle in radians, within 2⁻²⁷ (over a turn 2^−27.5).
///
/// The angle is reduced by one exact product with 1/2π (64 fraction bits), so the largest one that the type holds,
/// 2³¹ rad, costs an error of 2⁻³¹ rad.
pub fn sin_cos(radians: Real) -> (Real, Real) {
    let (sine, cosine) = unit_vector(radians);
    (sine.into(), cosine.into())
}

/// The angle of the vector (x, y) against the x axis, counted toward y: in [−π, π], within 2⁻²⁵ rad; 0 for no vector.
///
/// A first guess in f32 is off by at most 0.003 rad. The vector is turned back by the guess; what is left of its angle
/// is so small that it equals its tangent. Negative y mirror positive ones.
pub fn atan2(y: Real, x: Real) -> Real {
    let largest = y.unsigned_abs().max(x.unsigned_abs()).to_bits();
    if largest == 0 {
        return Real::ZERO;
    }
    // One power of two for both, so that the larger one has all its digits in 30 bits.
    let digits = u64::BITS.saturating_sub(largest.leading_zeros());
    let scaled = |v: Real| {
        let bits = v.to_bits().wrapping_shr(digits.saturating_sub(30)).wrapping_shl(30u32.saturating_sub(digits));
        I2F30::from_bits(saturate_i32(bits))
    };
    let below = y < Real::ZERO;
    let (y, x) = (scaled(y.saturating_abs()), scaled(x));
    let guess = F32Ext::atan2(y.to_num::<f32>(), x.to_num::<f32>());
    let guess = Real::checked_from_num(guess).unwrap_or(Real::ZERO);
    let (sine, cosine) = unit_vector(guess);
    let across = y.saturating_mul(cosine).saturating_sub(x.saturating_mul(sine));
    let along = x.saturating_mul(cosine).saturating_add(y.saturating_mul(sine));
    let rest = across.checked_div(along).unwrap_or(I2F30::ZERO);
    let angle = guess.saturating_add(rest.into()).clamp(Real::ZERO, Real::PI);
    if below { angle.saturating_neg() } else { angle }
}

/// `√(a² + b²)`, at most 2⁻²⁸ of it or one bit too small; the largest value where it exceeds the type.
pub fn hypot(a: Real, b: Real) -> Real {
    let (a, b) = (a.unsigned_abs().to_bits(), b.unsigned_abs().to_bits());
    let shift = 33u32.saturating_sub((a | b).leading_zeros());
    let square = |v: u64| v.wrapping_shr(shift).saturating_mul(v.wrapping_shr(shift));
    let root = isqrt(square(a).saturating_add(square(b)));
    Real::from_bits(saturate_i64(root.saturating_mul(1u64.wrapping_shl(shift))))
}

/// Sine and cosine: reduction to an eighth of a turn on either side of the nearest axis, then the series.
pub(crate) fn unit_vector(radians: Real) -> (I2F30, I2F30) {
    let turns = radians.wide_mul(TURNS_PER_RADIAN);
    // Whole turns fall off at the top: two integer bits count quarters from −2 to 1.
    let quarters = I2F30::wrapping_from_num(turns.wrapping_mul_int(4));
    let axis = quarters.wrapping_round();
    let x = quarters.wrapping_sub(axis).saturating_mul(I2F30::FRAC_PI_2);
    let square = x.saturating_mul(x);
    let (sine, cosine) = (x.saturating_mul(nested(square, SINE)), nested(square, COSINE));
    match axis.wrapping_to_num::<i8>() {
        0 => (sine, cosine),
        1 => (cosine, sine.saturating_neg()),
        -1 => (cosine.saturating_neg(), sine),
        _ => (sine.saturating_neg(), cosine.saturating_neg()),
    }
}

/// `1 − c₁·y·(1 − c₂·y·(1 − …))`.
fn nested(y: I2F30, factors: [I2F30; 5]) -> I2F30 {
    let next =
        |inner: I2F30, &factor: &I2F30| I2F30::ONE.saturating_sub(y.saturating_mul(factor).saturating_mul(inner));
    factors.iter().rev().fold(I2F30::ONE, next)
}

#[cfg(test)]
#[allow(clippy::arithmetic_side_effects, reason = "tests run with overflow checks")]
mod tests {
    extern crate std;
    use super::*;
    use crate::image::known_answer::Generator;
    use std::f64::consts::{FRAC_PI_2, PI};
    use std::println;

    /// 2⁻²⁰, what the layer asks for.
    const TOLERANCE: f64 = 1.0 / (1 << 20) as f64;

    fn real(value: f64) -> Real {
        Real::from_num(value)
    }

    /// Error of both functions at one angle, as the type holds it.
    fn sin_cos_error(angle: Real) -> f64 {
        let (sine, cosine) = sin_cos(angle);
        let exact = angle.to_num::<f64>().sin_cos();
        (sine.to_num::<f64>() - exact.0).abs().max((cosine.to_num::<f64>() - exact.1).abs())
    }

    fn atan2_error(y: Real, x: Real) -> f64 {
        (atan2(y, x).to_num::<f64>() - y.to_num::<f64>().atan2(x.to_num::<f64>())).abs()
    }

    #[test]
    fn sine_and_cosine_meet_the_functions_over_a_dense_sweep() {
        let dense = (-800_000..=800_000).map(|k| real(f64::from(k) * 1e-5));
        let worst = dense.map(sin_cos_error).fold(0.0, f64::max);
        println!("largest error of sine and cosine: 2^{:.2}", worst.log2());
        assert!(worst.log2() <= -27.5, "{worst:e}");
    }

    #[test]
    fn large_angles_are_reduced_exactly() {
        let mut generator = Generator::new(1);
        let ends = [Real::MAX, Real::MIN, Real::MIN + Real::DELTA];
        let drawn = (0..200_000).map(|_| Real::from_bits((generator.draw() >> (generator.draw() % 40)).cast_signed()));
        // An angle of more than 2^20 rad has less than 32 fraction bits in f64; then the type's last bits are zero.
        let held = drawn.chain(ends).map(|angle| real(angle.to_num::<f64>().clamp(-2_147_483_647.5, 2_147_483_647.0)));
        let worst = held.map(sin_cos_error).fold(0.0, f64::max);
        assert!(worst <= TOLERANCE, "{worst:e}");
    }

    #[test]
    fn multiples_of_a_quarter_turn_are_the_axes() {
        let axes = [(0, 1), (1, 0), (0, -1), (-1, 0)];
        for (k, expected) in (-400_i32..400).zip(axes.into_iter().cycle()) {
            let (sine, cosine) = sin_cos(real(f64::from(k) * FRAC_PI_2));
            let near = |found: Real, axis: i32| (found - Real::from_num(axis)).abs() <= real(TOLERANCE);
            assert!(near(sine, expected.0) && near(cosine, expected.1), "{k} quarters: {sine}, {cosine}");
        }
        assert_eq!(sin_cos(Real::ZERO), (Real::ZERO, Real::ONE));
    }

    #[test]
    fn arctangent_meets_the_function_over_a_dense_sweep() {
        let mut worst: f64 = 0.0;
        for k in -400_000..=400_000 {
            let angle = f64::from(k) * PI / 400_000.0;
            for radius in [0.002, 0.7, 3.0, 45.0, 2e4] {
                worst = worst.max(atan2_error(real(radius * angle.sin()), real(radius * angle.cos())));
            }
        }
        println!("largest error of the arctangent: 2^{:.1}", worst.log2());
        assert!(worst <= TOLERANCE / 32.0, "{worst:e}");
    }

    #[test]
    fn arctangent_is_total() {
        let values = [Real::MIN, -Real::MAX, -Real::ONE, -Real::DELTA, Real::ZERO, Real::DELTA, Real::ONE, Real::MAX];
        for y in values {
            for x in values {
                if (x, y) != (Real::ZERO, Real::ZERO) {
                    assert!(atan2_error(y, x) <= TOLERANCE, "atan2({y}, {x}) = {}", atan2(y, x));
                }
            }
        }
        assert_eq!(atan2(Real::ZERO, Real::ZERO), Real::ZERO);
    }

    #[test]
    fn length_is_rounded_down_and_saturates() {
        assert_eq!(hypot(real(3.0), real(-4.0)), real(5.0));
        assert_eq!(hypot(Real::ZERO, Real::DELTA), Real::DELTA);
        assert_eq!(hypot(Real::MIN, Real::MIN), Real::MAX);
        let mut generator = Generator::new(2);
        for _ in 0..100_000 {
            let shift = generator.draw() % 63;
            let mut draw = || Real::from_bits((generator.draw() >> shift).cast_signed());
            let (a, b) = (draw(), draw());
            let exact = a.to_num::<f64>().hypot(b.to_num::<f64>()).min(Real::MAX.to_num());
            let bound = Real::DELTA.to_num::<f64>().max(exact * 2.0_f64.powi(-28));
            assert!((hypot(a, b).to_num::<f64>() - exact).abs() <= bound, "hypot({a}, {b})");
        }
    }
}
