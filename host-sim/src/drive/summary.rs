//! What a drive comes down to: how far the integers are from f32 where both drive.

use super::{Decision, DriveStep};
use schemars::JsonSchema;
use serde::Serialize;

/// Figures of a whole drive.
#[derive(Clone, Debug, Default, PartialEq, Serialize, JsonSchema)]
pub struct Summary {
    /// Steps of the log.
    pub steps: usize,
    /// Steps in which the controls are the controller's.
    pub driven: usize,
    /// Steps in the safe state.
    pub safe: usize,
    /// Against the f32 network, over the steps that both drive; `null` without it, or where there is none.
    pub difference: Option<Difference>,
}

/// How far two drives are apart.
#[derive(Clone, Debug, Default, PartialEq, Serialize, JsonSchema)]
pub struct Difference {
    /// Steps that both drive.
    pub steps: usize,
    /// Mean of |steer − steer|.
    pub mean_steer: f64,
    /// Largest of them.
    pub max_steer: f64,
    /// Mean of |throttle − throttle|.
    pub mean_throttle: f64,
    /// Largest of them.
    pub max_throttle: f64,
    /// Steps in which both brake or neither does (more than half of the way), percent.
    pub brake_agreement_percent: f64,
    /// Mean distance of the waypoints, m; `null` for a network without waypoints.
    pub mean_waypoint_distance_m: Option<f64>,
    /// Largest mean distance of a step, m.
    pub max_waypoint_distance_m: Option<f64>,
}

impl Summary {
    /// Sums up.
    pub fn of(steps: &[DriveStep]) -> Self {
        let safe = |step: &&DriveStep| step.int8.status_code > 1;
        Self {
            steps: steps.len(),
            driven: steps.iter().filter(|step| step.int8.is_driving()).count(),
            safe: steps.iter().filter(safe).count(),
            difference: Difference::of(steps),
        }
    }
}

impl Difference {
    fn of(steps: &[DriveStep]) -> Option<Self> {
        let both = |step: &&DriveStep| step.int8.is_driving() && step.float.as_ref().is_some_and(Decision::is_driving);
        let pairs: Vec<(&DriveStep, &Decision)> =
            steps.iter().filter(both).filter_map(|step| Some((step, step.float.as_ref()?))).collect();
        if pairs.is_empty() {
            return None;
        }
        let spread = |figure: &dyn Fn(&Decision) -> f64| {
            let differences = pairs.iter().map(|(step, float)| (figure(&step.int8) - figure(float)).abs());
            mean_and_max(differences).unwrap_or_default()
        };
        let (mean_steer, max_steer) = spread(&|decision| decision.steer);
        let (mean_throttle, max_throttle) = spread(&|decision| decision.throttle);
        let agree = pairs.iter().filter(|(step, float)| (step.int8.brake > 0.5) == (float.brake > 0.5)).count();
        let distances = mean_and_max(pairs.iter().filter_map(|(step, _)| step.waypoint_distance_m)).unzip();
        Some(Self {
            steps: pairs.len(),
            mean_steer,
            max_steer,
            mean_throttle,
            max_throttle,
            brake_agreement_percent: 100.0 * agree as f64 / pairs.len() as f64,
            mean_waypoint_distance_m: distances.0,
            max_waypoint_distance_m: distances.1,
        })
    }
}

/// `None` of no values.
fn mean_and_max(values: impl Iterator<Item = f64>) -> Option<(f64, f64)> {
    let (count, sum, max) = values.fold((0_u32, 0.0, 0.0_f64), |(n, sum, max), v| (n + 1, sum + v, max.max(v)));
    (count > 0).then(|| (sum / f64::from(count), max))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn decision(status_code: u8, steer: f64, throttle: f64, brake: f64) -> Decision {
        Decision { status: String::new(), status_code, steer, throttle, brake, waypoints: None }
    }

    fn step(int8: Decision, float: Option<Decision>, waypoint_distance_m: Option<f64>) -> DriveStep {
        DriveStep {
            name: String::new(),
            time_s: 0.0,
            speed_mps: None,
            goal_m: None,
            command: None,
            int8,
            float,
            waypoint_distance_m,
        }
    }

    #[test]
    fn differences_are_over_the_steps_that_both_drive() {
        let steps = [
            step(decision(1, 0.0, 0.0, 0.0), Some(decision(1, 0.0, 0.0, 0.0)), None),
            step(decision(0, 0.25, 0.5, 0.0), Some(decision(0, 0.0, 0.25, 0.0)), Some(0.5)),
            step(decision(0, -0.5, 0.0, 1.0), Some(decision(0, 0.25, 0.25, 0.0)), Some(0.25)),
            step(decision(0x10, 0.9, 0.0, 1.0), Some(decision(0, 0.0, 0.0, 0.0)), None),
            step(decision(2, 0.9, 0.0, 1.0), Some(decision(0, 0.0, 0.0, 0.0)), None),
        ];
        let Summary { steps, driven, safe, difference } = Summary::of(&steps);
        assert_eq!((steps, driven, safe), (5, 2, 2));
        assert_eq!(
            difference,
            Some(Difference {
                steps: 2,
                mean_steer: 0.5,
                max_steer: 0.75,
                mean_throttle: 0.25,
                max_throttle: 0.25,
                brake_agreement_percent: 50.0,
                mean_waypoint_distance_m: Some(0.375),
                max_waypoint_distance_m: Some(0.5),
            })
        );
    }

    #[test]
    fn one_network_alone_has_no_difference() {
        let steps = [step(decision(0, 0.25, 0.5, 0.0), None, None)];
        assert_eq!(Summary::of(&steps), Summary { steps: 1, driven: 1, safe: 0, difference: None });
    }
}
