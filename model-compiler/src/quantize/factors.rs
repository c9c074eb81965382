//! Real factors to integers: the rounding rule of the host, requantization multipliers, sums of terms.

use crate::error::{Error, ErrorCode, Result};
use firmware::program::Requant;

/// `floor(x + 1/2)`: the host's one rounding rule.
pub fn round(x: f64) -> f64 {
    (x + 0.5).floor()
}

/// Binary digits of a magnitude, `bits(0) = 0`.
pub fn bits(magnitude: f64) -> u32 {
    if magnitude < 1.0 { 0 } else { floor_log2(magnitude) as u32 + 1 }
}

/// `floor(log2 x)` of a normal positive number, exactly.
pub fn floor_log2(x: f64) -> i32 {
    ((x.to_bits() >> 52) & 0x7ff) as i32 - 1023
}

/// Rounds a positive scale up to 12 significant bits, so that last-bit differences between machines vanish.
pub fn snap(scale: f64) -> f64 {
    let unit = f64::powi(2.0, floor_log2(scale) - 11);
    (scale / unit).ceil() * unit
}

/// M in `[2^23, 2^24)` and n with `m ≈ M·2^-n`.
///
/// # Errors
/// n outside 1..=52: the scales of the operands are too far apart.
pub fn requant(m: f64) -> Result<Requant> {
    if !(m.is_finite() && m > 0.0) {
        return Err(Error::new(ErrorCode::Numeric, "", format!("factor {m} of a requantization is not positive")));
    }
    let mut n = 23 - floor_log2(m);
    let mut multiplier = round(m * f64::powi(2.0, n));
    if multiplier == f64::powi(2.0, 24) {
        multiplier /= 2.0;
        n -= 1;
    }
    if !(1..=52).contains(&n) {
        return Err(Error::new(
            ErrorCode::Numeric,
            "",
            format!("factor {m:e} needs a shift of {n} bits, expected 1..=52"),
        ));
    }
    Ok(Requant { multiplier: multiplier as i32, shift: n as u8 })
}

/// One term of a sum: real factor and bound of the integer it multiplies.
#[derive(Clone, Copy, Debug)]
pub struct Factor {
    /// Real factor, ≥ 0.
    pub m: f64,
    /// Largest magnitude of the integer.
    pub bound: f64,
}

/// A sum of terms made integer.
#[derive(Clone, Debug)]
pub struct Terms {
    /// n.
    pub shift: u8,
    /// `M_k = round(m_k·2^n)`.
    pub multipliers: Vec<i32>,
    /// Largest magnitude of the sum.
    pub bound: f64,
    /// `max |t_k|·2^-(n+1)`: rounding of the multipliers, in output LSB.
    pub rounding: f64,
}

/// The largest n ≤ `max_shift` with every `M_k < 2^31` and `Σ bound·M + |offset·2^n| < 2^52`.
///
/// # Errors
/// No n ≥ 0 satisfies the bounds.
pub fn terms(factors: &[Factor], offset: f64, max_shift: u8) -> Result<Terms> {
    for shift in (0..=max_shift).rev() {
        let unit = f64::powi(2.0, i32::from(shift));
        let scaled: Vec<f64> = factors.iter().map(|f| round(f.m * unit)).collect();
        let bound: f64 =
            scaled.iter().zip(factors).map(|(m, f)| m.abs() * f.bound).sum::<f64>() + round((offset * unit).abs());
        if scaled.iter().all(|m| m.abs() < f64::powi(2.0, 31)) && bound < f64::powi(2.0, 52) {
            let largest = factors.iter().map(|f| f.bound).fold(0.0, f64::max);
            return Ok(Terms {
                shift,
                multipliers: scaled.iter().map(|&m| m as i32).collect(),
                bound,
                rounding: largest * f64::powi(2.0, -(i32::from(shift) + 1)),
            });
        }
    }
    Err(Error::new(ErrorCode::Numeric, "", format!("no shift keeps the sum of {factors:?} below 2^52")))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn rounding_is_half_up() {
        assert_eq!([round(0.5), round(-0.5), round(1.5), round(-1.5)], [1.0, 0.0, 2.0, -1.0]);
    }

    #[test]
    fn bits_counts_binary_digits() {
        let expected = [(0.0, 0), (1.0, 1), (2.0, 2), (3.0, 2), (255.0, 8), (256.0, 9), (4_503_599_627_370_496.0, 53)];
        for (value, digits) in expected {
            assert_eq!(bits(value), digits, "{value}");
        }
    }

    #[test]
    fn snapped_scale_has_twelve_bits_and_is_not_smaller() {
        for i in 1..2000 {
            let s = 0.000_37 * f64::from(i);
            let t = snap(s);
            assert!(t >= s && t <= s * (1.0 + 1.0 / 2048.0), "{s} {t}");
            let m = t / f64::powi(2.0, floor_log2(t) - 11);
            assert_eq!(m, m.floor());
            assert_eq!(snap(t), t);
        }
    }

    #[test]
    fn requant_multiplier_is_normalized() {
        for i in -24..20 {
            for k in 0..50 {
                let m = f64::powi(2.0, i) * (1.0 + f64::from(k) / 50.0);
                let r = requant(m).unwrap();
                assert!((1 << 23..1 << 24).contains(&r.multiplier));
                let back = f64::from(r.multiplier) * f64::powi(2.0, -i32::from(r.shift));
                assert!((back / m - 1.0).abs() <= f64::powi(2.0, -24), "{m}");
            }
        }
        let almost_two = 2.0 - f64::powi(2.0, -40);
        assert_eq!(requant(almost_two).unwrap(), Requant { multiplier: 1 << 23, shift: 22 });
        assert!(requant(f64::powi(2.0, 23)).is_err());
        assert!(requant(f64::powi(2.0, -40)).is_err());
        assert!(requant(0.0).is_err());
    }

    #[test]
    fn terms_take_the_largest_shift() {
        let t = terms(&[Factor { m: 0.75, bound: 255.0 }, Factor { m: 0.5, bound: 255.0 }], 0.0, 40).unwrap();
        assert_eq!(t.shift, 31);
        assert_eq!(t.multipliers, [(0.75 * f64::powi(2.0, 31)) as i32, 1 << 30]);
        let t = terms(&[Factor { m: 0.01, bound: f64::powi(2.0, 31) }], 0.0, 40).unwrap();
        assert!(t.bound < f64::powi(2.0, 52) && t.bound >= f64::powi(2.0, 51));
    }
}
