//! From waypoints and speed to controls: the published agents' controller in fixed point.

use super::Real;
use super::controls::Controls;
use super::pid::{Gains, Pid};
use super::pose::Point;
use super::trigonometry::{atan2, hypot};

/// Constants of the controller.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Tuning {
    /// Of the steering angle, whose unit is a quarter turn.
    pub turn: Gains,
    /// Of the speed, m/s.
    pub speed: Gains,
    /// Upper end of the throttle.
    pub max_throttle: Real,
    /// The most by which the vehicle may be too slow in the eyes of the speed controller, m/s.
    pub max_speed_error: Real,
    /// Wanted speeds below it, m/s, brake.
    pub brake_speed: Real,
    /// Speeds above this multiple of the wanted one brake.
    pub brake_ratio: Real,
    /// Speed below which the angle counts as 0, m/s: a standing vehicle's waypoints point anywhere.
    pub standstill: Option<Real>,
}

impl Tuning {
    /// AIM, Late Fusion, Geometric Fusion and LBC.
    pub const BASELINES: Self = Self {
        turn: Gains { proportional: Real::lit("1.25"), integral: Real::lit("0.75"), derivative: Real::lit("0.3") },
        speed: Gains { proportional: Real::lit("5"), integral: Real::lit("0.5"), derivative: Real::lit("1") },
        max_throttle: Real::lit("0.75"),
        max_speed_error: Real::lit("0.25"),
        brake_speed: Real::lit("0.4"),
        brake_ratio: Real::lit("1.1"),
        standstill: None,
    };
    /// TransFuser: it keeps rolling at a walk, and does not wind up its steering at a stop.
    pub const TRANSFUSER: Self =
        Self { brake_speed: Real::lit("0.1"), standstill: Some(Real::lit("0.01")), ..Self::BASELINES };
}

/// One controller with the memory of its last errors.
///
/// With w₁, w₂ the first two waypoints (half a second apart; the others say nothing to the controller) and v the speed:
/// * wanted speed `d = 2·|w₁ − w₂|`
/// * `brake = d < brake_speed or v > brake_ratio·d`
/// * angle from the mean of w₁ and w₂, `1 − 2/π·atan2(forward, right)`, in [−1, 3]: 0 ahead, 1 to the right, 2 behind;
///   straight to the left it jumps from −1 to 3, so that a point behind on the left steers to the right. Where the mean
///   is the vehicle itself, which gives no direction, it is 1: full right
/// * `steer = clamp(PID(angle), −1, 1)`
/// * `throttle = clamp(PID(clamp(d − v, 0, max_speed_error)), 0, max_throttle)`, 0 while braking
///
/// Both PIDs see every step, also while braking. Points are plain values with the front ahead: no step can turn them
/// around again.
#[derive(Clone, Debug)]
pub struct Controller {
    tuning: Tuning,
    turn: Pid,
    speed: Pid,
}

impl Controller {
    /// Starts from a fresh state.
    pub fn new(tuning: Tuning) -> Self {
        Self { tuning, turn: Pid::new(tuning.turn), speed: Pid::new(tuning.speed) }
    }

    /// Returns to the fresh state.
    pub fn reset(&mut self) {
        self.turn.reset();
        self.speed.reset();
    }

    /// One step: the first two waypoints in meters, the speed in m/s.
    pub fn step(&mut self, [first, second]: [Point; 2], speed: Real) -> Controls {
        let Tuning { max_throttle, max_speed_error, brake_speed, brake_ratio, standstill, .. } = self.tuning;
        let stride = hypot(first.right.saturating_sub(second.right), first.forward.saturating_sub(second.forward));
        let wanted = stride.saturating_add(stride);
        // The ratio v/d, without the division: at d = 0 the first condition holds.
        let brake = wanted < brake_speed || speed > wanted.saturating_mul(brake_ratio);

        let angle = if standstill.is_some_and(|limit| speed < limit) {
            Real::ZERO
        } else {
            let [right, forward] =
                [first.right.saturating_add(second.right), first.forward.saturating_add(second.forward)];
            Real::ONE.saturating_sub(atan2(forward, right).saturating_mul(Real::FRAC_2_PI))
        };
        let steer = self.turn.step(angle).clamp(-Real::ONE, Real::ONE);

        let error = wanted.saturating_sub(speed).max(Real::ZERO).min(max_speed_error);
        let throttle = self.speed.step(error).max(Real::ZERO).min(max_throttle);
        if brake {
            Controls { steer, throttle: Real::ZERO, brake: Real::ONE }
        } else {
            Controls { steer, throttle, brake: Real::ZERO }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn point(right: f64, forward: f64) -> Point {
        Point { right: Real::from_num(right), forward: Real::from_num(forward) }
    }

    /// Of a fresh controller; the second waypoint is as far behind the first as the first behind the vehicle.
    fn first_step(tuning: Tuning, right: f64, forward: f64, speed: f64) -> Controls {
        let points = [point(right, forward), point(2.0 * right, 2.0 * forward)];
        Controller::new(tuning).step(points, Real::from_num(speed))
    }

    fn close(found: Real, expected: f64) -> bool {
        (found.to_num::<f64>() - expected).abs() < 1e-6
    }

    #[test]
    fn straight_ahead_and_too_slow_is_full_throttle() {
        let controls = first_step(Tuning::BASELINES, 0.0, 2.0, 1.0);
        assert!(close(controls.steer, 0.0), "{controls:?}");
        assert_eq!((controls.throttle, controls.brake), (Real::lit("0.75"), Real::ZERO));
    }

    #[test]
    fn the_first_step_is_the_sum_of_the_three_gains() {
        // A tenth of a quarter turn to the right: 1.25 + 0.75/40 + 0.3 times the angle.
        let (sine, cosine) = (core::f64::consts::FRAC_PI_2 * 0.1).sin_cos();
        let controls = first_step(Tuning::BASELINES, 2.0 * sine, 2.0 * cosine, 3.98);
        assert!(close(controls.steer, 0.1 * (1.25 + 0.75 / 40.0 + 0.3)), "{controls:?}");
        assert!(close(controls.throttle, 0.02 * (5.0 + 0.5 / 40.0 + 1.0)), "{controls:?}");
    }

    #[test]
    fn waypoints_at_rest_brake_at_every_speed() {
        for speed in [-1.0, 0.0, 0.5, 30.0] {
            let controls = Controller::new(Tuning::TRANSFUSER).step([point(0.0, 1.0); 2], Real::from_num(speed));
            assert_eq!((controls.throttle, controls.brake), (Real::ZERO, Real::ONE), "{speed} m/s");
        }
    }

    #[test]
    fn more_than_a_tenth_too_fast_brakes() {
        for (speed, brake) in [(4.399, Real::ZERO), (4.401, Real::ONE)] {
            assert_eq!(first_step(Tuning::BASELINES, 0.0, 2.0, speed).brake, brake, "{speed} m/s");
        }
    }

    #[test]
    fn brake_speeds_differ() {
        // 0.2 m/s: TransFuser rolls, the baselines stop.
        assert_eq!(first_step(Tuning::TRANSFUSER, 0.0, 0.1, 0.1).brake, Real::ZERO);
        assert_eq!(first_step(Tuning::BASELINES, 0.0, 0.1, 0.1).brake, Real::ONE);
    }

    #[test]
    fn only_transfuser_keeps_its_steering_straight_at_a_stop() {
        assert_eq!(first_step(Tuning::TRANSFUSER, 1.0, 1.0, 0.009).steer, Real::ZERO);
        assert_ne!(first_step(Tuning::TRANSFUSER, 1.0, 1.0, 0.011).steer, Real::ZERO);
        assert_ne!(first_step(Tuning::BASELINES, 1.0, 1.0, 0.0).steer, Real::ZERO);
    }

    #[test]
    fn bounds_the_wrong_way_round_do_not_panic() {
        let tuning = Tuning { max_throttle: -Real::ONE, max_speed_error: -Real::ONE, ..Tuning::BASELINES };
        assert_eq!(first_step(tuning, 0.0, 2.0, 1.0).throttle, -Real::ONE, "the upper bound wins");
    }

    #[test]
    fn a_plan_that_is_driven_on_steers_to_the_same_side() {
        let mut controller = Controller::new(Tuning::TRANSFUSER);
        let points = [point(0.1, 1.0), point(0.2, 2.0)];
        for step in 0..100 {
            let controls = controller.step(points, Real::from_num(2));
            assert!(controls.steer > Real::ZERO && controls.steer < Real::from_num(0.2), "step {step}: {controls:?}");
        }
    }
}
