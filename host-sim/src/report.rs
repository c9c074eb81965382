//! What a verification found: the structure, and its forms for people ([`terminal`]) and machines ([`json`]).

use crate::classification::{ClassificationSummary, ClassifiedFrame};
use crate::compare::StepDifference;
use crate::run::{ModelInfo, Waypoints};
use model_compiler::error::{Error, ErrorCode};
use model_compiler::memory_plan::PlanStatus;
use serde::Serialize;

mod classes;
pub mod json;
pub mod terminal;

/// Result of a verification. In JSON a figure that is infinite (no error at all) or was not measured is `null`.
#[derive(Clone, Debug, Serialize)]
pub struct VerifyReport {
    /// Version of this structure.
    pub schema: u32,
    /// The image.
    pub model: ModelInfo,
    /// Target that it was compiled for.
    pub target: String,
    /// Bytes are equal and all gates are met.
    pub passed: bool,
    /// The engine wrote the f64 model's bytes in every step of every frame.
    pub bytes_equal: bool,
    /// Where not.
    pub first_difference: Option<StepDifference>,
    /// The figures of the whole.
    pub summary: Summary,
    /// Every step, in the order of execution; sums over all frames.
    pub steps: Vec<StepReport>,
    /// Frames that the model was calibrated on, too: their figures flatter.
    pub calibration_frames: Vec<String>,
    /// Every frame, in order.
    pub frames: Vec<FrameReport>,
    /// Why it did not pass; in JSON beside the report, as `error`.
    #[serde(skip)]
    pub failure: Option<Error>,
}

/// Figures of the whole image.
#[derive(Clone, Debug, Serialize)]
pub struct Summary {
    /// Steps of the program.
    pub steps: usize,
    /// The step with the lowest accumulated SQNR.
    pub worst_step: Option<String>,
    /// That SQNR, dB.
    pub worst_sqnr_db: Option<f64>,
    /// Distance of waypoint k from the f32 network's.
    pub waypoint_error_mm: Vec<WaypointError>,
    /// Size of the arena.
    pub arena_bytes: u64,
    /// Its lower bound.
    pub arena_bound_bytes: u64,
    /// What is known about the difference.
    #[serde(serialize_with = "json::plan_status")]
    pub arena_status: PlanStatus,
    /// Size of the image.
    pub flash_bytes: u64,
    /// Of a classifier: how often it is right, and how near to the f32 network.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub accuracy: Option<ClassificationSummary>,
}

/// Mean and maximum over the frames, mm.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct WaypointError {
    /// Mean.
    pub mean: f64,
    /// Maximum.
    pub max: f64,
}

/// Figures of one step.
#[derive(Clone, Debug, Serialize)]
pub struct StepReport {
    /// Position in the program.
    pub position: usize,
    /// Step.
    pub step: String,
    /// Operator.
    pub op: &'static str,
    /// Tensor that it writes.
    pub tensor: String,
    /// Height, width, channels.
    pub shape: [u16; 3],
    /// `i8`, `i16` or `i32`.
    #[serde(rename = "type")]
    pub element: &'static str,
    /// Scale.
    pub scale: f64,
    /// Zero point.
    pub zero_point: i32,
    /// Noise of this step alone: against its operator in f32 on the same integers.
    pub local_sqnr_db: Option<f64>,
    /// Noise up to here: against the f32 network.
    pub sqnr_db: Option<f64>,
    /// Cosine against the f32 network.
    pub cosine: Option<f64>,
    /// Largest error of this step alone, in units of the scale.
    pub max_error_lsb: Option<f64>,
    /// Codes at a clamp bound that is no ReLU's, per million.
    pub saturation_ppm: Option<f64>,
    /// Spare bits of the tightest intermediate.
    pub headroom_bits: u8,
    /// Bytes of the output.
    pub bytes: u64,
    /// The engine's bytes are the f64 model's.
    pub bytes_equal: bool,
}

/// One frame.
#[derive(Clone, Debug, Serialize)]
pub struct FrameReport {
    /// Name.
    pub name: String,
    /// First 16 digits of its digest.
    pub digest: String,
    /// Was also a calibration frame.
    pub calibration: bool,
    /// LiDAR points that were not finite.
    pub dropped_points: usize,
    /// Of the engine.
    pub waypoints: Option<Waypoints>,
    /// Of the f32 network.
    pub reference_waypoints: Option<Waypoints>,
    /// What a classifier says.
    #[serde(flatten)]
    pub classes: Option<ClassifiedFrame>,
}

/// The step with the lowest accumulated SQNR; one that is not a number is lowest of all.
pub fn worst(steps: &[StepReport]) -> Option<&StepReport> {
    let figure = |step: &&StepReport| step.sqnr_db.is_some();
    let rank = |step: &StepReport| step.sqnr_db.filter(|db| !db.is_nan()).unwrap_or(f64::NEG_INFINITY);
    steps.iter().filter(figure).min_by(|a, b| rank(a).total_cmp(&rank(b)))
}

impl VerifyReport {
    /// Decides whether the verification passed: bytes first, then the gate on the worst step's SQNR, if there is one.
    pub fn check(&mut self, min_sqnr_db: Option<f64>) {
        self.failure = match &self.first_difference {
            Some(difference) => Some(difference.into()),
            None => min_sqnr_db.and_then(|gate| self.missed_gate(gate)),
        };
        self.passed = self.failure.is_none();
    }

    fn missed_gate(&self, min_sqnr_db: f64) -> Option<Error> {
        let step = worst(&self.steps)?;
        let found = step.sqnr_db?;
        // Not-a-number misses every gate.
        if found >= min_sqnr_db {
            return None;
        }
        let message = format!("SQNR is {found:.2} dB, the gate asks for {min_sqnr_db} dB");
        Some(Error::new(ErrorCode::Check, format!("step {} {}", step.position, step.step), message))
    }
}

#[cfg(test)]
pub(crate) mod tests {
    use super::*;

    pub(crate) fn step(position: usize, sqnr_db: Option<f64>) -> StepReport {
        StepReport {
            position,
            step: format!("conv{position}"),
            op: "conv2d",
            tensor: "t".into(),
            shape: [64, 64, 64],
            element: "i8",
            scale: 0.05,
            zero_point: -128,
            local_sqnr_db: Some(40.0),
            sqnr_db,
            cosine: Some(0.999),
            max_error_lsb: Some(0.51),
            saturation_ppm: None,
            headroom_bits: 3,
            bytes: 262_144,
            bytes_equal: true,
        }
    }

    pub(crate) fn report() -> VerifyReport {
        VerifyReport {
            schema: 1,
            model: ModelInfo { name: "mini".into(), sha256: "ab".repeat(32) },
            target: "portable".into(),
            passed: true,
            bytes_equal: true,
            first_difference: None,
            summary: Summary {
                steps: 2,
                worst_step: Some("conv1".into()),
                worst_sqnr_db: Some(21.5),
                waypoint_error_mm: vec![WaypointError { mean: 1.25, max: 2.5 }],
                arena_bytes: 2048,
                arena_bound_bytes: 2048,
                arena_status: PlanStatus::Optimal,
                flash_bytes: 4096,
                accuracy: None,
            },
            steps: vec![step(0, Some(30.0)), step(1, Some(21.5))],
            calibration_frames: vec!["a".into()],
            frames: vec![FrameReport {
                name: "a".into(),
                digest: "0123456789abcdef".into(),
                calibration: true,
                dropped_points: 0,
                waypoints: Some(vec![[0.0, 1.0]]),
                reference_waypoints: Some(vec![[0.0, 1.001]]),
                classes: None,
            }],
            failure: None,
        }
    }

    #[test]
    fn the_worst_step_has_the_lowest_figure_and_not_a_number_is_lower_still() {
        let steps = [step(0, Some(30.0)), step(1, None), step(2, Some(f64::INFINITY)), step(3, Some(12.0))];
        assert_eq!(worst(&steps).unwrap().position, 3);
        assert_eq!(worst(&[step(0, Some(3.0)), step(1, Some(f64::NAN))]).unwrap().position, 1);
        assert!(worst(&[step(0, None)]).is_none());
    }

    #[test]
    fn the_gate_names_the_worst_step() {
        let mut report = report();
        report.check(Some(21.5));
        assert!(report.passed);
        report.check(Some(25.0));
        let failure = report.failure.clone().unwrap();
        assert_eq!(failure.to_string(), "step 1 conv1: SQNR is 21.50 dB, the gate asks for 25 dB");
        assert_eq!((report.passed, failure.code.exit_status()), (false, 1));
    }

    #[test]
    fn unequal_bytes_come_before_any_gate() {
        let mut report = report();
        report.first_difference = Some(StepDifference {
            frame: "a".into(),
            position: 0,
            step: "conv0".into(),
            tensor: "t".into(),
            index: 0,
            at: [0; 3],
            found: Some(1),
            expected: Some(2),
            differing: 1,
            elements: 4,
        });
        report.check(None);
        assert!(report.failure.unwrap().message.contains("found 1, expected 2"));
    }
}
