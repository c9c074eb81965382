//! What the actuators are told.

use super::Real;
use serde::{Deserialize, Serialize};

/// One command to the vehicle.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub struct Controls {
    /// −1 (full left) to 1 (full right).
    pub steer: Real,
    /// 0 to 1; the published controllers stay below 0.75.
    pub throttle: Real,
    /// 0 to 1.
    pub brake: Real,
}

impl Controls {
    /// Nothing pressed, straight ahead.
    pub const ZERO: Self = Self { steer: Real::ZERO, throttle: Real::ZERO, brake: Real::ZERO };

    /// The safe state: full brake, no throttle.
    ///
    /// The wheels stay where they were, since a vehicle that brakes in a bend must keep to the bend.
    pub const fn stop(steer: Real) -> Self {
        Self { steer, throttle: Real::ZERO, brake: Real::ONE }
    }

    /// The three outputs of CILRS, logistic values in Q15: `steer = 2·s₀ − 1`, `throttle = 0.75·s₁`, `brake = s₂`.
    pub fn from_logistic([steer, throttle, brake]: [i16; 3]) -> Self {
        const MAX_THROTTLE: Real = Real::lit("0.75");
        let unit = |code: i16| fixed::types::I17F15::from_bits(code.max(0).into());
        let [steer, throttle, brake] = [steer, throttle, brake].map(|code| Real::from(unit(code)));
        Self {
            steer: steer.saturating_add(steer).saturating_sub(Real::ONE),
            throttle: throttle.saturating_mul(MAX_THROTTLE),
            brake,
        }
    }

    /// Throttle or brake, not both: a brake below 0.05 is none, and so is one that is weaker than the throttle.
    #[must_use]
    pub fn exclusive(self) -> Self {
        const FAINT: Real = Real::lit("0.05");
        let brake = if self.brake < FAINT || self.throttle > self.brake { Real::ZERO } else { self.brake };
        Self { brake, ..self }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn pedals(throttle: f64, brake: f64) -> Controls {
        Controls { throttle: Real::from_num(throttle), brake: Real::from_num(brake), ..Controls::ZERO }
    }

    #[test]
    fn a_faint_or_weaker_brake_is_none() {
        assert_eq!(pedals(0.0, 0.049).exclusive(), pedals(0.0, 0.0));
        assert_eq!(pedals(0.3, 0.25).exclusive(), pedals(0.3, 0.0));
        assert_eq!(
            pedals(0.25, 0.25).exclusive(),
            pedals(0.25, 0.25),
            "an equal brake stays, and so does the throttle"
        );
        assert_eq!(pedals(0.0, 1.0).exclusive(), pedals(0.0, 1.0));
    }

    #[test]
    fn logistic_values_become_controls() {
        let half = Controls { steer: Real::ZERO, ..pedals(0.375, 0.5) };
        assert_eq!(Controls::from_logistic([1 << 14; 3]), half);
        assert_eq!(Controls::from_logistic([0; 3]), Controls { steer: -Real::ONE, ..Controls::ZERO });
        assert_eq!(Controls::from_logistic([i16::MIN; 3]), Controls { steer: -Real::ONE, ..Controls::ZERO });
        let most = Controls::from_logistic([i16::MAX; 3]);
        assert!(most.steer < Real::ONE && most.throttle < Real::lit("0.75") && most.brake < Real::ONE);
    }
}
