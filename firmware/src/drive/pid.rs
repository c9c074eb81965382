//! The PID controller of the published agents.

use super::Real;
use heapless::Deque;

/// Errors that the integral part looks back on.
pub const WINDOW: usize = 40;

/// Factors of the three parts.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Gains {
    /// Of the error.
    pub proportional: Real,
    /// Of the mean error of the window.
    pub integral: Real,
    /// Of the change since the step before.
    pub derivative: Real,
}

/// `u = Kp·e + Ki·mean(e over the window) + Kd·(e − e before)`.
///
/// The window starts full of zeros, the mean is not scaled by time, and nothing bounds the integral but the window:
/// so the networks' controllers were tuned.
#[derive(Clone, Debug)]
pub struct Pid {
    gains: Gains,
    /// The errors so far, the zeros before them left out.
    errors: Deque<Real, WINDOW>,
}

impl Pid {
    /// Starts from no error.
    pub const fn new(gains: Gains) -> Self {
        Self { gains, errors: Deque::new() }
    }

    /// Forgets all errors.
    pub fn reset(&mut self) {
        self.errors.clear();
    }

    /// Takes the error of this step and gives the controlled value, unclamped (it saturates at the type's ends).
    pub fn step(&mut self, error: Real) -> Real {
        let before = self.errors.back().copied().unwrap_or(Real::ZERO);
        if self.errors.is_full() {
            self.errors.pop_front();
        }
        // There is room.
        let _ = self.errors.push_back(error);
        let sum = self.errors.iter().fold(Real::ZERO, |sum, &e| sum.saturating_add(e));
        let mean = sum.checked_div_int(WINDOW as i64).unwrap_or(Real::ZERO);
        let Gains { proportional, integral, derivative } = self.gains;
        let proportional = proportional.saturating_mul(error);
        let integral = integral.saturating_mul(mean);
        let derivative = derivative.saturating_mul(error.saturating_sub(before));
        proportional.saturating_add(integral).saturating_add(derivative)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const GAINS: Gains = Gains { proportional: Real::ONE, integral: Real::ZERO, derivative: Real::ZERO };
    const INTEGRAL: Gains = Gains { proportional: Real::ZERO, integral: Real::ONE, ..GAINS };
    const DERIVATIVE: Gains = Gains { proportional: Real::ZERO, derivative: Real::ONE, ..GAINS };

    #[test]
    fn the_integral_is_the_mean_of_forty_errors() {
        let mut pid = Pid::new(INTEGRAL);
        for step in 1..=100 {
            assert_eq!(pid.step(Real::from(40)), Real::from(step.min(40)), "step {step}");
        }
        for step in 1..=40 {
            assert_eq!(pid.step(Real::ZERO), Real::from(40 - step), "step {step}");
        }
    }

    #[test]
    fn the_derivative_is_the_last_change_and_starts_from_zero() {
        let mut pid = Pid::new(DERIVATIVE);
        assert_eq!([3, 5, 5, -1].map(|e| pid.step(Real::from(e))), [3, 2, 0, -6].map(Real::from));
    }

    #[test]
    fn a_reset_forgets() {
        let gains = Gains { derivative: Real::ONE, integral: Real::ONE, ..GAINS };
        let (mut used, mut fresh) = (Pid::new(gains), Pid::new(gains));
        used.step(Real::MAX);
        used.step(Real::MIN);
        used.reset();
        assert_eq!(used.step(Real::ONE), fresh.step(Real::ONE));
    }
}
