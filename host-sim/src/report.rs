//! What a verification found: the structure, and its forms for people ([`terminal`], [`html`]) and machines ([`json`]).
//!
//! The JSON document of `host-sim verify --json`, of `report.json` and of the demo is [`VerifyReport`], field for
//! field; `host-sim schema` prints its JSON Schema, and those of other documents by name. Rules that hold everywhere:
//!
//! * SQNR is `10·log10(Σ ref² / Σ (ref − test)²)` in dB, from sums over all frames
//! * a figure that was not measured is `null`, and so is one that is infinite: where `sqnr_db` is `null` and `cosine` is
//!   not, nothing differed at all; the same for `local_sqnr_db` with `max_error_lsb`
//! * steps stand in the order of execution; a step is known by its name, which is unique

use crate::attention::Measured;
use crate::channels::Channels;
use crate::classification::{ClassificationSummary, ClassifiedFrame};
use crate::compare::StepDifference;
use crate::controls::{ControlError, ControlPrediction, PREDICTED_SPEED};
use crate::diff::Diff;
use crate::drive::DriveReport;
use crate::gates::GateOutcome;
use crate::histogram::Histogram;
use crate::noise::NoiseShares;
use crate::points::Points;
use crate::run::{ModelInfo, Waypoints};
use memory::MemoryReport;
use model_compiler::artifact;
use model_compiler::error::{Error, Result};
use model_compiler::frames::Frame;
use model_compiler::memory_plan::PlanStatus;
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use std::borrow::Cow;
use std::path::Path;

mod classes;
mod controls;
mod figures;
pub mod html;
pub mod json;
pub mod memory;
pub mod terminal;

/// Result of a verification.
#[derive(Clone, Debug, Serialize, Deserialize, JsonSchema)]
pub struct VerifyReport {
    /// Version of this structure.
    pub schema: u32,
    /// The image.
    pub model: ModelInfo,
    /// Target that it was compiled for.
    pub target: String,
    /// The weights are random numbers: what the network does means nothing.
    #[serde(default, skip_serializing_if = "std::ops::Not::not")]
    pub untrained: bool,
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
    /// Where every buffer lies in the arena, and when.
    #[serde(default)]
    pub memory: MemoryReport,
    /// How much of the output's error comes from which tensor; `null` where it was not asked for.
    #[serde(default)]
    pub noise: Option<NoiseShares>,
    /// Frames that the model was calibrated on, too: their figures flatter.
    pub calibration_frames: Vec<String>,
    /// Every frame, in order.
    pub frames: Vec<FrameReport>,
    /// Every gate that was asked for, met or not.
    #[serde(default)]
    pub gates: Vec<GateOutcome>,
    /// What changed against an earlier report; `null` without one.
    #[serde(default)]
    pub baseline: Option<Diff>,
    /// Why it did not pass; absent where it did.
    #[serde(rename = "error", skip_serializing_if = "Option::is_none", serialize_with = "json::failure")]
    #[serde(default, skip_deserializing)]
    #[schemars(with = "json::Failure")]
    pub failure: Option<Error>,
}

/// Figures of the whole image.
#[derive(Clone, Debug, Serialize, Deserialize, JsonSchema)]
pub struct Summary {
    /// Steps of the program.
    pub steps: usize,
    /// The step with the lowest accumulated SQNR.
    pub worst_step: Option<String>,
    /// That SQNR, dB.
    pub worst_sqnr_db: Option<f64>,
    /// The last pooled vector; `null` in a network without one.
    #[serde(default)]
    pub vector_step: Option<String>,
    /// Its SQNR, dB.
    #[serde(default)]
    pub vector_sqnr_db: Option<f64>,
    /// The step that writes the first output.
    #[serde(default)]
    pub output_step: Option<String>,
    /// Its SQNR, dB.
    #[serde(default)]
    pub output_sqnr_db: Option<f64>,
    /// Distance of waypoint k from the f32 network's.
    pub waypoint_error_mm: Vec<MeanAndMax>,
    /// Of a network that gives controls: distance of each from the f32 network's.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub control_error: Vec<ControlError>,
    /// Distance of point k from the f32 network's, pixels.
    #[serde(default)]
    pub point_error_px: Vec<MeanAndMax>,
    /// Size of the arena in all memory regions together, bytes.
    pub arena_bytes: u64,
    /// Its lower bound, bytes.
    pub arena_bound_bytes: u64,
    /// What is known about the difference.
    #[schemars(with = "String", extend("enum" = ["optimal", "optimal_bound_not_reachable", "node_limit"]))]
    pub arena_status: PlanStatus,
    /// Size of the image, bytes.
    pub flash_bytes: u64,
    /// Of a classifier: how often it is right, and how near to the f32 network.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub accuracy: Option<ClassificationSummary>,
}

/// Mean and maximum over the frames.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
pub struct MeanAndMax {
    /// Mean.
    pub mean: f64,
    /// Maximum.
    pub max: f64,
}

/// Figures of one step.
#[derive(Clone, Debug, Serialize, Deserialize, JsonSchema)]
pub struct StepReport {
    /// Position in the program.
    pub position: usize,
    /// Step.
    pub step: String,
    /// Operator.
    pub op: Cow<'static, str>,
    /// Tensor that it writes.
    pub tensor: String,
    /// Height, width, channels.
    pub shape: [u16; 3],
    /// `i8`, `i16` or `i32`.
    #[serde(rename = "type")]
    pub element: Cow<'static, str>,
    /// Scale.
    pub scale: f64,
    /// Zero point.
    pub zero_point: i32,
    /// Lowest and highest real value that the step can write: its clamp bounds, or the range of the type.
    #[serde(default)]
    pub clip: [f64; 2],
    /// Noise of this step alone, dB: against its operator in f32 on the same integers.
    pub local_sqnr_db: Option<f64>,
    /// Noise up to here, dB: against the f32 network.
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
    /// Distribution of the values in f32 and in integers.
    #[serde(default)]
    pub histogram: Option<Histogram>,
    /// Ranges per output channel; `null` where the step has no weights per channel.
    #[serde(default)]
    pub channels: Option<Channels>,
}

/// One frame.
#[derive(Clone, Debug, Serialize, Deserialize, JsonSchema)]
pub struct FrameReport {
    /// Name.
    pub name: String,
    /// First 16 digits of its digest.
    pub digest: String,
    /// Was also a calibration frame.
    pub calibration: bool,
    /// LiDAR points that were not finite.
    pub dropped_points: usize,
    /// The step with the lowest accumulated SQNR on this frame.
    #[serde(default)]
    pub worst_step: Option<String>,
    /// That SQNR, dB.
    #[serde(default)]
    pub worst_sqnr_db: Option<f64>,
    /// SQNR of the last pooled vector on this frame, dB.
    #[serde(default)]
    pub vector_sqnr_db: Option<f64>,
    /// SQNR of the first output on this frame, dB.
    #[serde(default)]
    pub output_sqnr_db: Option<f64>,
    /// Of the engine.
    pub waypoints: Option<Waypoints>,
    /// Of the f32 network.
    pub reference_waypoints: Option<Waypoints>,
    /// What a network that gives controls says.
    #[serde(flatten)]
    pub control: Option<ControlPrediction>,
    /// The same of the f32 network.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub reference_control: Option<ControlPrediction>,
    /// Of the engine, −1..1.
    #[serde(default)]
    pub points: Option<Points>,
    /// Of the f32 network.
    #[serde(default)]
    pub reference_points: Option<Points>,
    /// What a classifier says.
    #[serde(flatten)]
    pub classes: Option<ClassifiedFrame>,
    /// Distance of both, per waypoint, mm; empty where one is missing.
    #[serde(default)]
    pub waypoint_error_mm: Vec<f64>,
    /// Distance of both, per point, pixels; empty where one is missing.
    #[serde(default)]
    pub point_error_px: Vec<f64>,
}

impl StepReport {
    /// Part of the network that a step belongs to: its name up to the first part that is numbered (`layer2`,
    /// `transformer1`), else the module that holds it.
    pub fn stage(&self) -> &str {
        let name = self.step.as_str();
        let numbered = |part: &str| {
            part.ends_with(|c: char| c.is_ascii_digit()) && part.starts_with(|c: char| c.is_ascii_alphabetic())
        };
        let mut end = 0;
        for part in name.split('.') {
            end += part.len();
            if numbered(part) {
                return &name[..end];
            }
            end += 1;
        }
        name.rsplit_once('.').map_or(name, |(module, _)| module)
    }
}

impl FrameReport {
    /// How far the controls are from those of the f32 network, by name; empty where one is missing.
    pub fn control_errors(&self) -> Vec<(&'static str, f64)> {
        let Some((found, expected)) = self.control.as_ref().zip(self.reference_control.as_ref()) else { return vec![] };
        found.values().zip(expected.values()).map(|((name, f), (_, e))| (name, (f - e).abs())).collect()
    }

    /// How bad the frame is, for sorting: the largest error of a waypoint, control or point, else the noise of the
    /// output.
    pub fn badness(&self) -> f64 {
        let controls = self.control_errors().into_iter().filter(|(name, _)| *name != PREDICTED_SPEED);
        let places = self.waypoint_error_mm.iter().chain(&self.point_error_px).copied();
        let largest = places.chain(controls.map(|(_, error)| error)).reduce(f64::max);
        largest.or(self.output_sqnr_db.map(|db| -db)).unwrap_or(f64::NEG_INFINITY)
    }
}

/// Writes `report.html` and `report.json` to a folder, which is made where it does not exist.
///
/// # Errors
/// The folder cannot be written; then neither file is there without the other.
pub fn write(folder: &Path, report: &VerifyReport, frames: &[Frame]) -> Result<()> {
    std::fs::create_dir_all(folder).map_err(|e| Error::io(folder, &e))?;
    let page = html::page(report, frames);
    let document = json::bytes(&json::verify(report));
    artifact::write_files(&[(&folder.join("report.html"), page.as_bytes()), (&folder.join("report.json"), &document)])
}

/// Writes `drive.html` and `drive.json` to a folder, which is made where it does not exist.
///
/// # Errors
/// The folder or a file cannot be written; then neither is.
pub fn write_drive(folder: &Path, report: &DriveReport) -> Result<()> {
    std::fs::create_dir_all(folder).map_err(|e| Error::io(folder, &e))?;
    let page = html::drive_page(report);
    let document = json::bytes(&json::drive(report));
    artifact::write_files(&[(&folder.join("drive.html"), page.as_bytes()), (&folder.join("drive.json"), &document)])
}

/// Writes `attention.html` and `attention.json` to a folder, which is made where it does not exist.
///
/// # Errors
/// The folder cannot be written; then neither file is there without the other.
pub fn write_attention(folder: &Path, measured: &Measured) -> Result<()> {
    std::fs::create_dir_all(folder).map_err(|e| Error::io(folder, &e))?;
    let page = html::attention_page(&measured.report, &measured.frames);
    let document = json::bytes(&json::attention(&measured.report));
    artifact::write_files(&[
        (&folder.join("attention.html"), page.as_bytes()),
        (&folder.join("attention.json"), &document),
    ])
}

/// The step with the lowest accumulated SQNR; one that is not a number is lowest of all.
pub fn worst(steps: &[StepReport]) -> Option<&StepReport> {
    let figure = |step: &&StepReport| step.sqnr_db.is_some();
    let rank = |step: &StepReport| step.sqnr_db.filter(|db| !db.is_nan()).unwrap_or(f64::NEG_INFINITY);
    steps.iter().filter(figure).min_by(|a, b| rank(a).total_cmp(&rank(b)))
}

impl VerifyReport {
    /// Decides whether the verification passed: bytes first, then the gates in order.
    pub fn check(&mut self, gates: Vec<GateOutcome>) {
        self.failure = match &self.first_difference {
            Some(difference) => Some(difference.into()),
            None => crate::gates::failure(&gates),
        };
        self.gates = gates;
        self.passed = self.failure.is_none();
    }
}

#[cfg(test)]
pub(crate) mod tests {
    use super::*;
    use crate::controls::tests::prediction;

    pub(crate) fn step(position: usize, sqnr_db: Option<f64>) -> StepReport {
        StepReport {
            position,
            step: format!("conv{position}"),
            op: "conv2d".into(),
            tensor: "t".into(),
            shape: [64, 64, 64],
            element: "i8".into(),
            scale: 0.05,
            zero_point: -128,
            clip: [0.0, 12.75],
            local_sqnr_db: Some(40.0),
            sqnr_db,
            cosine: Some(0.999),
            max_error_lsb: Some(0.51),
            saturation_ppm: None,
            headroom_bits: 3,
            bytes: 262_144,
            bytes_equal: true,
            histogram: Some(Histogram { first: 0.0, width: 0.2, float: vec![9, 100, 1], codes: vec![10, 100, 0] }),
            channels: Some(Channels { weight_scale: vec![0.1, 0.2], min: vec![0.0, 0.0], max: vec![1.0, 12.75] }),
        }
    }

    pub(crate) fn report() -> VerifyReport {
        VerifyReport {
            schema: 1,
            model: ModelInfo { name: "mini".into(), sha256: "ab".repeat(32) },
            target: "portable".into(),
            untrained: false,
            passed: true,
            bytes_equal: true,
            first_difference: None,
            summary: Summary {
                steps: 2,
                worst_step: Some("conv1".into()),
                worst_sqnr_db: Some(21.5),
                vector_step: Some("conv0".into()),
                vector_sqnr_db: Some(30.0),
                output_step: Some("conv1".into()),
                output_sqnr_db: Some(21.5),
                waypoint_error_mm: vec![MeanAndMax { mean: 1.25, max: 2.5 }],
                control_error: vec![],
                point_error_px: vec![],
                arena_bytes: 2048,
                arena_bound_bytes: 2048,
                arena_status: PlanStatus::Optimal,
                flash_bytes: 4096,
                accuracy: None,
            },
            steps: vec![step(0, Some(30.0)), step(1, Some(21.5))],
            memory: memory::tests::memory(),
            noise: None,
            calibration_frames: vec!["a".into()],
            frames: vec![FrameReport {
                name: "a".into(),
                digest: "0123456789abcdef".into(),
                calibration: true,
                dropped_points: 0,
                worst_step: Some("conv1".into()),
                worst_sqnr_db: Some(21.5),
                vector_sqnr_db: Some(30.0),
                output_sqnr_db: Some(21.5),
                waypoints: Some(vec![[0.0, 1.0]]),
                reference_waypoints: Some(vec![[0.0, 1.001]]),
                control: None,
                reference_control: None,
                points: None,
                reference_points: None,
                classes: None,
                waypoint_error_mm: vec![1.0],
                point_error_px: vec![],
            }],
            gates: vec![],
            baseline: None,
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
    fn the_predicted_speed_makes_no_frame_bad() {
        let mut frame = report().frames.remove(0);
        frame.waypoint_error_mm.clear();
        frame.control = Some(prediction(0.5));
        frame.reference_control = Some(ControlPrediction { predicted_speed: Some(9.0), ..prediction(0.25) });
        assert!(frame.control_errors().contains(&(PREDICTED_SPEED, 5.0)));
        assert_eq!(frame.badness(), 0.25);
    }

    #[test]
    fn steps_belong_to_numbered_parts_or_to_their_module() {
        let stage = |name: &str| StepReport { step: name.into(), ..step(0, None) }.stage().to_owned();
        assert_eq!(stage("encoder.features.layer2.0.relu"), "encoder.features.layer2");
        assert_eq!(stage("encoder.features.relu"), "encoder.features");
        assert_eq!((stage("join.1"), stage("waypoints")), ("join".into(), "waypoints".into()));
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
        report.check(vec![]);
        assert!(report.failure.unwrap().message.contains("found 1, expected 2"));
    }
}
