//! How far integers are from real values: sums of powers over any number of frames, read as decibels at the end.

/// Sums over pairs of a reference value and a tested one.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct ErrorSums {
    reference_power: f64,
    test_power: f64,
    error_power: f64,
    dot: f64,
    largest_error: f64,
}

impl ErrorSums {
    /// Adds the elements of one tensor of one frame.
    ///
    /// # Panics
    /// The lengths differ.
    pub fn add(&mut self, reference: &[f32], test: &[f32]) {
        assert_eq!(reference.len(), test.len(), "a tensor and its reference have the same shape");
        for (&r, &t) in reference.iter().zip(test) {
            let (r, t) = (f64::from(r), f64::from(t));
            let error = t - r;
            self.reference_power += r * r;
            self.test_power += t * t;
            self.error_power += error * error;
            self.dot += r * t;
            if error.abs() > self.largest_error || error.is_nan() {
                self.largest_error = error.abs();
            }
        }
    }

    /// Adds the sums over other pairs.
    pub fn merge(&mut self, other: &Self) {
        self.reference_power += other.reference_power;
        self.test_power += other.test_power;
        self.error_power += other.error_power;
        self.dot += other.dot;
        if other.largest_error > self.largest_error || other.largest_error.is_nan() {
            self.largest_error = other.largest_error;
        }
    }

    /// `Σ (ref − test)²`.
    pub fn error_power(&self) -> f64 {
        self.error_power
    }

    /// `10·log10(Σ ref² / Σ (ref − test)²)`; infinite where nothing differs, not a number where a value is none.
    pub fn sqnr_db(&self) -> f64 {
        if self.error_power == 0.0 { f64::INFINITY } else { 10.0 * (self.reference_power / self.error_power).log10() }
    }

    /// Cosine of the angle between all reference and all tested values; 1 where both are zero, 0 where only one is.
    pub fn cosine(&self) -> f64 {
        if self.reference_power == 0.0 && self.test_power == 0.0 {
            return 1.0;
        }
        let norms = (self.reference_power * self.test_power).sqrt();
        if norms == 0.0 { 0.0 } else { (self.dot / norms).clamp(-1.0, 1.0) }
    }

    /// The largest difference of a pair, in units of the values.
    pub fn largest_error(&self) -> f64 {
        self.largest_error
    }
}

/// Mean and maximum of a length that is measured once per frame.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Spread {
    sum: f64,
    count: u32,
    max: f64,
}

impl Spread {
    /// Adds a measurement.
    pub fn add(&mut self, value: f64) {
        self.sum += value;
        self.count += 1;
        self.max = self.max.max(value);
    }

    /// Mean; 0 where nothing was measured.
    pub fn mean(&self) -> f64 {
        self.sum / f64::from(self.count.max(1))
    }

    /// Largest measurement.
    pub fn max(&self) -> f64 {
        self.max
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn sqnr_is_taken_from_powers_over_all_frames() {
        let mut sums = ErrorSums::default();
        sums.add(&[3.0, 4.0], &[3.0, 4.5]);
        assert!((sums.sqnr_db() - 20.0).abs() < 1e-12);
        // A second frame without error adds 75 to the power: 100 / 0.25, not the mean of 20 dB and infinity.
        sums.add(&[5.0, 5.0, 5.0], &[5.0, 5.0, 5.0]);
        assert!((sums.sqnr_db() - 10.0 * 400_f64.log10()).abs() < 1e-12);
        assert_eq!(sums.largest_error(), 0.5);
    }

    #[test]
    fn equal_values_are_infinitely_good_and_a_lost_signal_is_zero_decibels() {
        let mut equal = ErrorSums::default();
        equal.add(&[1.0, -2.0], &[1.0, -2.0]);
        assert_eq!((equal.sqnr_db(), equal.cosine()), (f64::INFINITY, 1.0));
        let mut lost = ErrorSums::default();
        lost.add(&[1.0, -2.0], &[0.0, 0.0]);
        assert_eq!((lost.sqnr_db(), lost.cosine()), (0.0, 0.0));
        let mut invented = ErrorSums::default();
        invented.add(&[0.0], &[1.0]);
        assert_eq!(invented.sqnr_db(), f64::NEG_INFINITY);
    }

    #[test]
    fn not_a_number_is_never_hidden() {
        let mut sums = ErrorSums::default();
        sums.add(&[1.0, f32::NAN, 1.0], &[1.0, 1.0, 5.0]);
        assert!(sums.sqnr_db().is_nan() && sums.cosine().is_nan() && sums.largest_error().is_nan());
    }

    #[test]
    fn cosine_is_blind_to_gain_but_not_to_direction() {
        let mut gain = ErrorSums::default();
        gain.add(&[1.0, 2.0], &[2.0, 4.0]);
        assert!((gain.cosine() - 1.0).abs() < 1e-15);
        let mut turned = ErrorSums::default();
        turned.add(&[1.0, 0.0], &[0.0, 1.0]);
        assert_eq!(turned.cosine(), 0.0);
    }

    #[test]
    fn merged_sums_are_those_over_all_pairs() {
        let (mut first, mut second, mut both) = (ErrorSums::default(), ErrorSums::default(), ErrorSums::default());
        first.add(&[1.0, 2.0], &[1.5, 2.0]);
        second.add(&[-4.0], &[-4.25]);
        both.add(&[1.0, 2.0, -4.0], &[1.5, 2.0, -4.25]);
        first.merge(&second);
        assert_eq!(first, both);
        let mut broken = ErrorSums::default();
        broken.add(&[1.0], &[f32::NAN]);
        first.merge(&broken);
        assert!(first.largest_error().is_nan() && first.error_power().is_nan());
    }

    #[test]
    fn spread_has_mean_and_maximum() {
        let mut spread = Spread::default();
        [1.0, 2.0, 6.0].into_iter().for_each(|v| spread.add(v));
        assert_eq!((spread.mean(), spread.max()), (3.0, 6.0));
        assert_eq!(Spread::default().mean(), 0.0);
    }
}
