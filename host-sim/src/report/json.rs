//! The machine-readable forms: one JSON document per command.

use super::VerifyReport;
use crate::ablation::Row;
use crate::attention::AttentionReport;
use crate::bench::figures::BenchReport;
use crate::diff::Diff;
use crate::drive::DriveReport;
use crate::footprint::FootprintReport;
use crate::gates::GateOutcome;
use crate::hil::report::HilReport;
use crate::hil::update::UpdateReport;
use crate::metrics::{RouteLog, Score};
use crate::run::RunReport;
use model_compiler::error::{Error, ErrorCode, Result};
use schemars::JsonSchema;
use schemars::generate::SchemaSettings;
use serde::{Serialize, Serializer};
use serde_json::{Value, json};
use std::path::Path;

/// Version of the documents.
pub const SCHEMA: u32 = 1;

/// Document of a run.
pub fn run(report: &RunReport) -> Value {
    to_value(report)
}

/// Document of a verification; one that did not pass also has an `error`.
pub fn verify(report: &VerifyReport) -> Value {
    to_value(report)
}

/// Document of a comparison of two reports, with the gates on it and the `error` where one is missed.
pub fn diff(diff: &Diff, gates: &[GateOutcome], failure: Option<&Error>) -> Value {
    let mut document = to_value(diff);
    document["schema"] = SCHEMA.into();
    document["gates"] = to_value(&gates);
    if let Some(failure) = failure {
        document["error"] = error(failure)["error"].take();
    }
    document
}

/// Documents that have a JSON Schema.
#[derive(Clone, Copy, Debug, PartialEq, Eq, clap::ValueEnum)]
pub enum Document {
    /// Of a run.
    Run,
    /// Of a verification.
    Verify,
    /// Of attention statistics.
    Attention,
    /// Of scored drives.
    Score,
    /// Of a replayed log.
    Drive,
    /// Of a run on a board.
    Hil,
    /// Of an update.
    Update,
    /// Of footprints.
    Footprint,
    /// The log of a drive, which is read.
    RouteLog,
}

/// JSON Schema of a document.
pub fn schema(document: Document) -> Value {
    let written = || SchemaSettings::default().for_serialize().into_generator();
    let schema = match document {
        Document::Run => written().into_root_schema_for::<RunReport>(),
        Document::Verify => written().into_root_schema_for::<VerifyReport>(),
        Document::Attention => written().into_root_schema_for::<AttentionReport>(),
        Document::Score => written().into_root_schema_for::<Score>(),
        Document::Drive => written().into_root_schema_for::<DriveReport>(),
        Document::Hil => written().into_root_schema_for::<HilReport>(),
        Document::Update => written().into_root_schema_for::<UpdateReport>(),
        Document::Footprint => written().into_root_schema_for::<FootprintReport>(),
        Document::RouteLog => SchemaSettings::default().into_generator().into_root_schema_for::<RouteLog>(),
    };
    schema.to_value()
}

/// A document as the bytes of a file.
pub fn bytes(document: &Value) -> Vec<u8> {
    format!("{document}\n").into_bytes()
}

/// Reads the report of an earlier verification.
///
/// # Errors
/// The file cannot be read, or is no such report.
pub fn read(path: &Path) -> Result<VerifyReport> {
    let bytes = std::fs::read(path).map_err(|e| Error::io(path, &e))?;
    let malformed = |message: String| {
        Error::new(ErrorCode::Malformed, path.display().to_string(), message)
            .with_help("expected the report.json of `host-sim verify … --report DIR`")
    };
    let mut report: VerifyReport =
        serde_json::from_slice(&bytes).map_err(|e| malformed(format!("this is no report of a verification: {e}")))?;
    if report.schema != SCHEMA {
        return Err(malformed(format!("version of the report: found {}, expected {SCHEMA}", report.schema)));
    }
    report.restore_infinities();
    Ok(report)
}

impl VerifyReport {
    /// JSON has no infinity: puts it back where a figure is missing that was measured.
    fn restore_infinities(&mut self) {
        for step in &mut self.steps {
            if step.cosine.is_some() {
                step.sqnr_db.get_or_insert(f64::INFINITY);
            }
            if step.max_error_lsb.is_some() {
                step.local_sqnr_db.get_or_insert(f64::INFINITY);
            }
        }
    }
}

/// Document of an ablation.
pub fn ablation(rows: &[Row]) -> Value {
    json!({"schema": 1, "variants": to_value(&rows)})
}

/// Document of attention statistics.
pub fn attention(report: &AttentionReport) -> Value {
    to_value(report)
}

/// Document of scored drives.
pub fn score(score: &Score) -> Value {
    to_value(score)
}

/// Document of a replayed log.
pub fn drive(report: &DriveReport) -> Value {
    to_value(report)
}

/// Document of a run on a board; one with a difference also has an `error`.
pub fn hil(report: &HilReport) -> Value {
    to_value(report)
}

/// Document of an update.
pub fn update(report: &UpdateReport) -> Value {
    to_value(report)
}

/// Document of footprints.
pub fn footprint(report: &FootprintReport) -> Value {
    to_value(report)
}

/// Document of a measurement.
pub fn bench(report: &BenchReport) -> Value {
    to_value(report)
}

/// Why a command failed.
#[derive(Debug, Serialize, JsonSchema)]
pub struct Failure {
    /// Class: `check` for a failed check, else a kind of bad input.
    code: &'static str,
    /// What was found, what was expected, what to do.
    message: String,
    /// File, tensor, step or gate.
    #[serde(rename = "where")]
    location: String,
}

impl From<&Error> for Failure {
    fn from(error: &Error) -> Self {
        let message = match error.help.as_str() {
            "" => error.message.clone(),
            help => format!("{}; help: {help}", error.message),
        };
        Self { code: error.code.name(), message, location: error.location.clone() }
    }
}

/// `{"error": {"code", "message", "where"}}`.
pub fn error(error: &Error) -> Value {
    json!({"error": Failure::from(error)})
}

/// The `error` of a report.
pub(crate) fn failure<S: Serializer>(error: &Option<Error>, serializer: S) -> std::result::Result<S::Ok, S::Error> {
    error.as_ref().map(Failure::from).serialize(serializer)
}

fn to_value(report: &impl Serialize) -> Value {
    serde_json::to_value(report).expect("reports have string keys only")
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::classification::Classification;
    use crate::controls::Controls;
    use crate::run::{FrameResult, ModelInfo, Output};
    use model_compiler::error::ErrorCode;
    use model_compiler::frames::{Frame, Label};

    #[test]
    fn run_has_the_documented_shape() {
        let model = ModelInfo { name: "mini".into(), sha256: "00".into() };
        let controls = Some(Controls { steer: 0.25, throttle: 0.75, brake: 0.0 });
        let outputs = [
            Output::Waypoints { waypoints: vec![[0.5, 2.0]], controls },
            Output::Waypoints { waypoints: vec![[0.5, 2.0]], controls: None },
            Output::Points { points: vec![[0.5, -1.0]], controls },
        ];
        let frames = outputs.into_iter().map(|output| FrameResult { name: "a".into(), output });
        let document = run(&RunReport::new(model, frames.collect()));
        let controls = json!({"steer": 0.25, "throttle": 0.75, "brake": 0.0});
        let expected = json!({
            "schema": 1,
            "model": {"name": "mini", "sha256": "00"},
            "frames": [{"name": "a", "waypoints": [[0.5, 2.0]], "controls": controls},
                       {"name": "a", "waypoints": [[0.5, 2.0]]},
                       {"name": "a", "points": [[0.5, -1.0]], "controls": controls}],
        });
        assert_eq!(document, expected);
    }

    #[test]
    fn run_of_a_classifier_has_logits_classes_and_accuracy() {
        let model = || ModelInfo { name: "mini".into(), sha256: "00".into() };
        let result = |label: Option<u16>| {
            let label = label.map(|class| Label { class, name: "cat".into() });
            let frame = Frame { name: "a".into(), label, ..Frame::default() };
            FrameResult { name: "a".into(), output: Output::Class(Classification::new(vec![0.5, -2.0], &frame)) }
        };
        let document = run(&RunReport::new(model(), vec![result(Some(0)), result(None)]));
        let interval = document["accuracy"]["interval"].clone();
        let expected = json!({
            "schema": 1,
            "model": {"name": "mini", "sha256": "00"},
            "frames": [{"name": "a", "logits": [0.5, -2.0], "top1": 0, "label": 0},
                       {"name": "a", "logits": [0.5, -2.0], "top1": 0}],
            "accuracy": {"top1": 1.0, "interval": interval, "frames": 1},
        });
        assert_eq!(document, expected);
        assert_eq!(document["accuracy"]["interval"][1], 1.0);
        assert!(run(&RunReport::new(model(), vec![result(None)])).get("accuracy").is_none());
    }

    #[test]
    fn a_failed_verification_carries_report_and_error() {
        let mut report = super::super::tests::report();
        report.steps[0].sqnr_db = Some(f64::INFINITY);
        report.check(crate::gates::Gates { min_sqnr_db: Some(25.0), ..Default::default() }.outcomes(&report).unwrap());
        let document = verify(&report);
        assert_eq!(document["passed"], false);
        assert_eq!(document["error"]["code"], "check");
        assert_eq!(document["error"]["where"], "gate min_sqnr_db: step 1 conv1");
        assert_eq!(document["gates"][0]["met"], false);
        assert_eq!(document["summary"]["arena_status"], "optimal");
        assert_eq!(document["steps"][1]["type"], "i8");
        assert!(document["steps"][0]["sqnr_db"].is_null(), "infinite");
        assert_eq!(document["frames"][0]["calibration"], true);
    }

    #[test]
    fn errors_have_code_message_and_place() {
        let document = error(&Error::new(ErrorCode::Frames, "frames/a", "no image").with_help("add one"));
        let expected = json!({"error": {"code": "frames", "message": "no image; help: add one", "where": "frames/a"}});
        assert_eq!(document, expected);
    }
}
