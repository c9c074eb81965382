//! The machine-readable forms: one JSON document per command.

use super::VerifyReport;
use crate::ablation::Row;
use crate::bench::figures::BenchReport;
use crate::run::RunReport;
use model_compiler::error::Error;
use model_compiler::memory_plan::PlanStatus;
use serde::{Serialize, Serializer};
use serde_json::{Value, json};

/// Document of a run.
pub fn run(report: &RunReport) -> Value {
    to_value(report)
}

/// Document of a verification; one that did not pass also has an `error`.
pub fn verify(report: &VerifyReport) -> Value {
    let mut document = to_value(report);
    if let Some(failure) = &report.failure {
        document["error"] = error(failure)["error"].take();
    }
    document
}

/// Document of an ablation.
pub fn ablation(rows: &[Row]) -> Value {
    json!({"schema": 1, "variants": to_value(&rows)})
}

/// Document of a measurement.
pub fn bench(report: &BenchReport) -> Value {
    to_value(report)
}

/// `{"error": {"code", "message", "where"}}`.
pub fn error(error: &Error) -> Value {
    let message = match error.help.as_str() {
        "" => error.message.clone(),
        help => format!("{}; help: {help}", error.message),
    };
    json!({"error": {"code": error.code.name(), "message": message, "where": error.location}})
}

/// Name of a plan's proof status.
pub(super) fn plan_status<S: Serializer>(status: &PlanStatus, serializer: S) -> Result<S::Ok, S::Error> {
    serializer.serialize_str(match status {
        PlanStatus::Optimal => "optimal",
        PlanStatus::OptimalBoundNotReachable => "optimal_bound_not_reachable",
        PlanStatus::NodeLimit => "node_limit",
    })
}

fn to_value(report: &impl Serialize) -> Value {
    serde_json::to_value(report).expect("reports have string keys only")
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::classification::Classification;
    use crate::run::{FrameResult, ModelInfo, Output};
    use model_compiler::error::ErrorCode;
    use model_compiler::frames::{Frame, Label};

    #[test]
    fn run_has_the_documented_shape() {
        let model = ModelInfo { name: "mini".into(), sha256: "00".into() };
        let output = Output::Waypoints { waypoints: vec![[0.5, 2.0]] };
        let document = run(&RunReport::new(model, vec![FrameResult { name: "a".into(), output }]));
        let expected = json!({
            "schema": 1,
            "model": {"name": "mini", "sha256": "00"},
            "frames": [{"name": "a", "waypoints": [[0.5, 2.0]]}],
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
        report.check(Some(25.0));
        let document = verify(&report);
        assert_eq!(document["passed"], false);
        assert_eq!(document["error"]["code"], "check");
        assert_eq!(document["error"]["where"], "step 1 conv1");
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
