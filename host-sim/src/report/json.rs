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
    use crate::run::{FrameResult, ModelInfo};
    use model_compiler::error::ErrorCode;

    #[test]
    fn run_has_the_documented_shape() {
        let model = ModelInfo { name: "mini".into(), sha256: "00".into() };
        let frames = vec![FrameResult { name: "a".into(), waypoints: vec![[0.5, 2.0]] }];
        let document = run(&RunReport { schema: 1, model, frames });
        let expected = json!({
            "schema": 1,
            "model": {"name": "mini", "sha256": "00"},
            "frames": [{"name": "a", "waypoints": [[0.5, 2.0]]}],
        });
        assert_eq!(document, expected);
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
