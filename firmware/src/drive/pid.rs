//! The PID controller of the published agents.

use super::Real;
use heapless::HistoryBuf;

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
    errors: HistoryBuf<Real, WINDOW>,
}

impl Pid {
    /// Starts from no error.
    pub fn new(gains: Gains) -> Self {
        Self { gains, errors: HistoryBuf::new_with(Real::ZERO) }
    }

    /// Forgets all errors.
    pub fn reset(&mut self) {
        self.errors.clear_with(Real::ZERO);
    }

    /// Takes the error of this step and gives the controlled value, unclamped (it saturates at the type's ends).
    pub fn step(&mut self, error: Real) -> Real {
        let before = self.errors.recent().copied().unwrap_or(Real::ZERO);
        self.errors.write(error);
        // The order of a sum that does not saturate is irrelevant.
        let sum = self.errors.as_slice().iter().fold(Real::ZERO, |sum, &e| sum.saturating_add(e));
        let mean = sum.checked_div_int(WINDOW as i64).unwrap_or(Real::ZERO);
        let Gains { proportional, integral, derivative } = self.gains;
        let proportional = proportional.saturating_mul(error);
        let integral = integral.saturating_mul(mean);
        let derivative = derivative.saturating_mul(error.saturating_sub(before));
        proportional.saturating_add(integral).saturating_add(derivative)
    }
}
