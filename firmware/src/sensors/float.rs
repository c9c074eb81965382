//! An `f32`, given as its bits, to fixed point without float arithmetic.

use super::NotFinite;
use crate::fixed_point::saturate_i32;
use fixed::types::I16F16;

/// Magnitudes beyond this are all the same: out of every range here.
const MAX_MAGNITUDE: i64 = 1 << 61;
/// Exponent of the lowest bit of the significand of 1.0, plus the exponent's bias.
const EXPONENT_OFFSET: i64 = 150;

/// `floor(x·2^n)`, and whether that cut something off.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct Floor {
    pub value: i64,
    pub inexact: bool,
}

/// `floor(x·2^fraction_bits)` of the `f32` with these bits; magnitudes saturate at 2^61.
pub(super) fn floor_scaled(bits: u32, fraction_bits: u8) -> Result<Floor, NotFinite> {
    let exponent = (bits >> 23) & 0xFF;
    let fraction = bits & 0x7F_FFFF;
    if exponent == 0xFF {
        return Err(NotFinite);
    }
    // A subnormal has no hidden bit and the exponent of the smallest normal.
    let significand = i64::from(if exponent == 0 { fraction } else { fraction | 0x80_0000 });
    let shift = i64::from(exponent.max(1)).wrapping_sub(EXPONENT_OFFSET).wrapping_add(i64::from(fraction_bits));
    let (magnitude, inexact) = match u32::try_from(shift) {
        // 24 bits of significand: up to 37 more stay within 61.
        Ok(left) if left <= 37 => (significand.wrapping_shl(left), false),
        Ok(_) => (MAX_MAGNITUDE, false),
        Err(_) => {
            let right = u32::try_from(shift.wrapping_neg()).unwrap_or(63).min(63);
            let whole = significand.wrapping_shr(right);
            (whole, whole.wrapping_shl(right) != significand)
        }
    };
    let is_negative = bits >> 31 == 1;
    let value = if is_negative { magnitude.wrapping_neg().wrapping_sub(inexact.into()) } else { magnitude };
    Ok(Floor { value, inexact })
}

/// `floor(x·2^fraction_bits + ½)`: to the nearest, ties up.
pub(super) fn round_scaled(bits: u32, fraction_bits: u8) -> Result<i64, NotFinite> {
    // floor(y + ½) = floor((2y + 1)/2) = floor((floor(2y) + 1)/2)
    let doubled = floor_scaled(bits, fraction_bits.wrapping_add(1))?.value;
    Ok(doubled.wrapping_add(1) >> 1)
}

/// Q16 meters, rounded to odd: exact where x is a multiple of 2^-15, else the odd code between the two multiples around
/// x. Saturates at ±32768 m.
///
/// Rounding to odd keeps the order of x and of every multiple of 2^-15, on either side of it: an even code `e` stands
/// for one value only, and all values between `e` and `e + 2` have the code `e + 1`. So `<`, `≤`, `>`, `≥` of the code
/// with an even code decide as the real numbers do, and the code of −x is the negative of the code of x.
pub(super) fn odd_q16(bits: u32) -> Result<I16F16, NotFinite> {
    let Floor { value, inexact } = floor_scaled(bits, 15)?;
    let code = saturate_i32(value.wrapping_shl(1) | i64::from(inexact));
    Ok(I16F16::from_bits(code.max(-i32::MAX)))
}

#[cfg(test)]
mod tests {
    extern crate std;
    use super::*;
    use proptest::prelude::*;

    /// Magnitudes up to 2^60, beyond which f64 arithmetic and saturation part.
    fn oracle(x: f32, fraction_bits: u8) -> Floor {
        let scaled = f64::from(x) * f64::exp2(fraction_bits.into());
        Floor { value: scaled.floor() as i64, inexact: scaled.floor() != scaled }
    }

    #[test]
    fn special_values() {
        for not_finite in [f32::NAN, -f32::NAN, f32::INFINITY, f32::NEG_INFINITY] {
            assert_eq!(floor_scaled(not_finite.to_bits(), 15), Err(NotFinite));
            assert_eq!(odd_q16(not_finite.to_bits()), Err(NotFinite));
        }
        for (x, code) in [
            (0.0, 0),
            (-0.0, 0),
            (f32::MIN_POSITIVE, 1),
            (-f32::MIN_POSITIVE, -1),
            (f32::from_bits(1), 1),
            (-f32::from_bits(1), -1),
            (1.0, 65536),
            (-2.0, -131_072),
            ((-2.0_f32).next_up(), -131_071),
            (1.0 / 32768.0, 2),
            (1.5 / 32768.0, 3),
            (-1.5 / 32768.0, -3),
            (f32::MAX, i32::MAX),
            (f32::MIN, -i32::MAX),
            (32768.0, i32::MAX),
            (-32768.0, -i32::MAX),
        ] {
            assert_eq!(odd_q16(x.to_bits()).unwrap().to_bits(), code, "{x:e}");
        }
    }

    #[test]
    fn rounding_is_to_the_nearest_with_ties_up() {
        for (x, code) in [(0.5, 1), (-0.5, 0), (1.5, 2), (-1.5, -1), (0.499_999_97, 0), (-0.500_000_06, -1), (2.0, 2)] {
            assert_eq!(round_scaled(f32::to_bits(x), 0), Ok(code), "{x}");
        }
    }

    proptest! {
        #[test]
        fn floor_is_the_floor(bits: u32, fraction_bits in 0_u8..20) {
            let x = f32::from_bits(bits);
            match floor_scaled(bits, fraction_bits) {
                Err(NotFinite) => prop_assert!(!x.is_finite()),
                Ok(found) if x.abs() < 1e12 => prop_assert_eq!(found, oracle(x, fraction_bits)),
                Ok(found) => prop_assert!(x.is_finite() && found.value.abs() > 1 << 39),
            }
        }

        #[test]
        fn rounding_is_the_formula(x in -1e9_f32..1e9, fraction_bits in 0_u8..20) {
            // 24 bits times a power of two, plus one half: exact in f64.
            let expected = (f64::from(x) * f64::exp2(fraction_bits.into()) + 0.5).floor();
            prop_assert_eq!(round_scaled(x.to_bits(), fraction_bits), Ok(expected as i64));
        }

        #[test]
        fn rounding_to_odd_keeps_order_and_sign(x in -40_000.0_f32..40_000.0, steps in -3_i32..=3) {
            let code = odd_q16(x.to_bits()).unwrap().to_bits();
            prop_assert_eq!(odd_q16((-x).to_bits()).unwrap().to_bits(), -code);
            // A multiple of 2^-15 near x.
            let edge = ((f64::from(x) * 32768.0).round() as i64 + i64::from(steps)) * 2;
            let real = f64::from(x) * 65536.0;
            if real.abs() < f64::from(i32::MAX) && edge.abs() < i64::from(i32::MAX) {
                prop_assert_eq!(i64::from(code) < edge, real < edge as f64);
                prop_assert_eq!(i64::from(code) > edge, real > edge as f64);
            }
        }
    }
}
