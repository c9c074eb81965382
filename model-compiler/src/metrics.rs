//! How far a quantized result is from the f32 reference.
//!
//! Sums are f64 in the order of the elements, so a figure is the same on every machine.

/// `10·log10(Σ ref² / Σ (ref − test)²)` in dB.
///
/// Equal signals give +∞ (also two zero or two empty ones), a zero reference with any error −∞; not-a-number anywhere
/// gives not-a-number.
///
/// # Panics
/// The lengths differ.
pub fn sqnr_db(reference: &[f32], test: &[f32]) -> f64 {
    let signal: f64 = reference.iter().map(|&r| f64::from(r).powi(2)).sum();
    let noise: f64 = pairs(reference, test).map(|(r, t)| (r - t).powi(2)).sum();
    if noise == 0.0 && !signal.is_nan() { f64::INFINITY } else { 10.0 * (signal / noise).log10() }
}

/// `Σ ref·test / √(Σ ref² · Σ test²)`, in [-1, 1]; blind to gain, so it stands beside [`sqnr_db`], not in its place.
///
/// Two zero (or empty) signals are equal: 1. One zero signal beside another has no direction: 0.
///
/// # Panics
/// The lengths differ.
pub fn cosine(reference: &[f32], test: &[f32]) -> f64 {
    let (mut product, mut reference_power, mut test_power) = (0.0, 0.0, 0.0);
    for (r, t) in pairs(reference, test) {
        product += r * t;
        reference_power += r * r;
        test_power += t * t;
    }
    match (reference_power == 0.0, test_power == 0.0) {
        (true, true) => 1.0,
        (true, false) | (false, true) => 0.0,
        // Rounding may lead out of the interval by an ulp.
        (false, false) => (product / (reference_power.sqrt() * test_power.sqrt())).clamp(-1.0, 1.0),
    }
}

/// Largest `|ref − test|`; 0 for empty signals, not-a-number where an element is.
///
/// # Panics
/// The lengths differ.
pub fn max_abs_error(reference: &[f32], test: &[f32]) -> f64 {
    pairs(reference, test)
        .map(|(r, t)| (r - t).abs())
        .fold(0.0, |worst, e| if e > worst || e.is_nan() { e } else { worst })
}

fn pairs(reference: &[f32], test: &[f32]) -> impl Iterator<Item = (f64, f64)> {
    assert_eq!(reference.len(), test.len(), "signals of different lengths cannot be compared");
    reference.iter().zip(test).map(|(&r, &t)| (f64::from(r), f64::from(t)))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn sqnr_counts_decibels() {
        // Signal 100, noise 1; then a hundredth of the noise.
        assert!((sqnr_db(&[6.0, 8.0], &[6.0, 7.0]) - 20.0).abs() < 1e-12);
        assert!((sqnr_db(&[6.0, 8.0], &[6.0, 7.9]) - 40.0).abs() < 1e-5);
        assert_eq!(sqnr_db(&[1.0, -1.0], &[2.0, 0.0]), 0.0);
    }

    #[test]
    fn sqnr_of_equal_and_of_zero_signals() {
        assert_eq!(sqnr_db(&[1.0, 2.0], &[1.0, 2.0]), f64::INFINITY);
        assert_eq!(sqnr_db(&[0.0], &[0.0]), f64::INFINITY);
        assert_eq!(sqnr_db(&[], &[]), f64::INFINITY);
        assert_eq!(sqnr_db(&[0.0], &[1.0]), f64::NEG_INFINITY);
        assert_eq!(sqnr_db(&[3.0], &[0.0]), 0.0);
    }

    #[test]
    fn cosine_sees_direction_only() {
        assert!((cosine(&[3.0, 4.0], &[30.0, 40.0]) - 1.0).abs() < 1e-15);
        assert!((cosine(&[3.0, 4.0], &[-3.0, -4.0]) + 1.0).abs() < 1e-15);
        assert_eq!(cosine(&[1.0, 0.0], &[0.0, 5.0]), 0.0);
        assert!((cosine(&[1.0, 0.0], &[1.0, 1.0]) - 0.5_f64.sqrt()).abs() < 1e-15);
        assert!(cosine(&[0.1; 7], &[0.3; 7]) <= 1.0);
    }

    #[test]
    fn cosine_of_zero_signals() {
        assert_eq!(cosine(&[0.0, 0.0], &[0.0, 0.0]), 1.0);
        assert_eq!(cosine(&[], &[]), 1.0);
        assert_eq!(cosine(&[0.0, 0.0], &[1.0, 0.0]), 0.0);
        assert_eq!(cosine(&[1.0, 0.0], &[0.0, 0.0]), 0.0);
    }

    #[test]
    fn max_abs_error_finds_the_worst() {
        assert_eq!(max_abs_error(&[1.0, -2.0, 3.0], &[1.5, -5.0, 3.25]), 3.0);
        assert_eq!(max_abs_error(&[], &[]), 0.0);
    }

    #[test]
    fn not_a_number_is_never_hidden() {
        for (r, t) in [([f32::NAN, 1.0], [1.0, 1.0]), ([1.0, 1.0], [f32::NAN, 1.0]), ([f32::NAN, 1.0], [f32::NAN, 1.0])]
        {
            assert!(sqnr_db(&r, &t).is_nan());
            assert!(cosine(&r, &t).is_nan());
            assert!(max_abs_error(&r, &[t[0], 9.0]).is_nan());
        }
    }

    #[test]
    #[should_panic(expected = "different lengths")]
    fn lengths_must_agree() {
        sqnr_db(&[1.0], &[1.0, 2.0]);
    }
}
