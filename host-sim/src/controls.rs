//! Steer, throttle and brake: of a network that gives them itself, with how far int8 is from f32 there; of others from
//! the firmware's controller.

use crate::statistics::Spread;
use firmware::drive;
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use std::borrow::Cow;

/// Name of the output that holds the sigmoids of steer, throttle and brake.
const CONTROLS: &str = "controls";
/// Name of the output that holds the speed that the network reads off its features, m/s. It is no control: neither a
/// gate on controls nor the order of frames counts its error.
pub const PREDICTED_SPEED: &str = "predicted_speed";

/// What the actuators would be told. Of a network that gives controls itself they are its raw outputs, before the
/// agent's post-processing.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
pub struct Controls {
    /// −1 (left) to 1 (right).
    pub steer: f64,
    /// 0 to 0.75.
    pub throttle: f64,
    /// 0 to 1.
    pub brake: f64,
}

impl Controls {
    /// `steer = 2s − 1`, `throttle = 0.75·s`, `brake = s`: exact for the 16-bit codes of an image too.
    fn from_sigmoids(steer: f64, throttle: f64, brake: f64) -> Self {
        Self { steer: 2.0 * steer - 1.0, throttle: 0.75 * throttle, brake }
    }
}

impl From<drive::Controls> for Controls {
    fn from(drive::Controls { steer, throttle, brake }: drive::Controls) -> Self {
        Self { steer: steer.to_num(), throttle: throttle.to_num(), brake: brake.to_num() }
    }
}

/// What a network that gives controls says of one frame.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
pub struct ControlPrediction {
    /// How to drive.
    pub controls: Controls,
    /// How fast the scene looks, m/s.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub predicted_speed: Option<f64>,
}

impl ControlPrediction {
    /// Names of the values, in order.
    pub const NAMES: [&str; 4] = ["steer", "throttle", "brake", PREDICTED_SPEED];

    /// The values that are there, with their names.
    pub fn values(&self) -> impl Iterator<Item = (&'static str, f64)> {
        let Controls { steer, throttle, brake } = self.controls;
        let values = [Some(steer), Some(throttle), Some(brake), self.predicted_speed];
        Self::NAMES.into_iter().zip(values).filter_map(|(name, value)| Some((name, value?)))
    }
}

/// Which outputs of a network are its controls and its speed.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct ControlOutputs {
    controls: usize,
    speed: Option<usize>,
}

impl ControlOutputs {
    /// The outputs of these names; `None` for a network without controls.
    pub fn find<'a>(names: impl IntoIterator<Item = &'a str>) -> Option<Self> {
        let (mut controls, mut speed) = (None, None);
        for (index, name) in names.into_iter().enumerate() {
            match name {
                CONTROLS => controls = Some(index),
                PREDICTED_SPEED => speed = Some(index),
                _ => {}
            }
        }
        Some(Self { controls: controls?, speed })
    }

    /// Reads the real values of all outputs; `None` where the controls are not three values.
    pub fn read<T: Copy + Into<f64>>(&self, outputs: &[Vec<T>]) -> Option<ControlPrediction> {
        let [steer, throttle, brake] = outputs.get(self.controls)?.as_slice() else { return None };
        let controls = Controls::from_sigmoids((*steer).into(), (*throttle).into(), (*brake).into());
        let speed = self.speed.and_then(|index| outputs.get(index)?.first());
        Some(ControlPrediction { controls, predicted_speed: speed.map(|&speed| speed.into()) })
    }
}

/// Error of one value over the frames, in its own unit.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
pub struct ControlError {
    /// `steer`, `throttle`, `brake` or `predicted_speed`.
    pub name: Cow<'static, str>,
    /// Mean.
    pub mean: f64,
    /// Maximum.
    pub max: f64,
}

/// The errors while frames come in.
#[derive(Clone, Debug, Default)]
pub struct ControlComparison {
    errors: Vec<(&'static str, Spread)>,
}

impl ControlComparison {
    /// Adds a frame.
    pub fn add(&mut self, found: &ControlPrediction, expected: &ControlPrediction) {
        for ((name, found), (_, expected)) in found.values().zip(expected.values()) {
            let at = self.errors.iter().position(|(known, _)| *known == name).unwrap_or_else(|| {
                self.errors.push((name, Spread::default()));
                self.errors.len() - 1
            });
            self.errors[at].1.add((found - expected).abs());
        }
    }

    /// The errors so far, in the order of [`ControlPrediction::NAMES`].
    pub fn summary(&self) -> Vec<ControlError> {
        let error = |(name, spread): &(&'static str, Spread)| ControlError {
            name: (*name).into(),
            mean: spread.mean(),
            max: spread.max(),
        };
        self.errors.iter().map(error).collect()
    }
}

#[cfg(test)]
pub(crate) mod tests {
    use super::*;

    pub(crate) fn prediction(steer: f64) -> ControlPrediction {
        ControlPrediction { controls: Controls { steer, throttle: 0.375, brake: 0.5 }, predicted_speed: Some(4.0) }
    }

    #[test]
    fn codes_become_controls_without_rounding() {
        let unit = f64::exp2(-15.0);
        let outputs = ControlOutputs::find(["predicted_speed", "controls"]).unwrap();
        let found = outputs.read(&[vec![2.5], vec![0.0, 32767.0 * unit, 3.0 * unit]]).unwrap();
        assert_eq!(found.controls, Controls { steer: -1.0, throttle: 24575.25 * unit, brake: 3.0 * unit });
        assert_eq!(found.predicted_speed, Some(2.5));
    }

    #[test]
    fn other_outputs_are_no_controls() {
        assert_eq!(ControlOutputs::find(["waypoints", "predicted_speed"]), None);
        let alone = ControlOutputs::find(["controls"]).unwrap();
        assert_eq!(alone.read(&[vec![0.5_f32; 4]]), None);
        assert_eq!(alone.read(&[vec![0.5_f32; 3]]).unwrap().predicted_speed, None);
    }

    #[test]
    fn errors_are_kept_by_value() {
        let mut comparison = ControlComparison::default();
        comparison.add(&prediction(0.5), &prediction(0.25));
        comparison.add(&prediction(-0.75), &prediction(-0.75));
        let found = comparison.summary();
        assert_eq!(found.iter().map(|error| &*error.name).collect::<Vec<_>>(), ControlPrediction::NAMES);
        assert_eq!((found[0].mean, found[0].max), (0.125, 0.25));
        assert!(found[1..].iter().all(|error| error.max == 0.0));
    }
}
