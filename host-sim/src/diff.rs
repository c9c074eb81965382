//! What changed between two reports: step by step, and in size.

use crate::report::{StepReport, VerifyReport};
use crate::run::ModelInfo;
use model_compiler::error::{Error, ErrorCode, Result};
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use std::collections::HashMap;

/// A step whose figure changed by less is not mentioned to people, dB.
pub const MENTIONED_DB: f64 = 0.05;

/// Changes from an earlier report to a later one. Steps are matched by name.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
pub struct Diff {
    /// Image of the earlier report.
    pub before: ModelInfo,
    /// Image of the later report.
    pub after: ModelInfo,
    /// Both were measured on the same frames, in the same order; otherwise figures differ for that reason, too.
    pub same_frames: bool,
    /// Steps of both, the greatest loss first.
    pub steps: Vec<StepChange>,
    /// Steps of the earlier report alone.
    pub only_before: Vec<String>,
    /// Steps of the later report alone.
    pub only_after: Vec<String>,
    /// Figures of the whole that both have.
    pub figures: Vec<FigureChange>,
}

/// A step in both reports.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
pub struct StepChange {
    /// Step.
    pub step: String,
    /// Operator in the later report.
    pub op: String,
    /// Accumulated SQNR before, dB.
    pub before_db: Option<f64>,
    /// Accumulated SQNR after, dB.
    pub after_db: Option<f64>,
    /// After − before, dB; negative is a loss. `null` where it is infinite.
    pub change_db: Option<f64>,
    /// The same for the step alone.
    pub local_change_db: Option<f64>,
}

/// A figure of the whole.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
pub struct FigureChange {
    /// `arena`, `flash`, `pooled vector`, `output`, `worst step`, `waypoint K, mean`, `waypoint K, max`; for waypoint K
    /// also `steer`, `throttle`, `brake`, `predicted_speed`, `point K`.
    pub figure: String,
    /// `B`, `dB` or `mm`; empty for a control.
    pub unit: String,
    /// Before.
    pub before: Option<f64>,
    /// After.
    pub after: Option<f64>,
}

impl Diff {
    /// Compares two reports.
    ///
    /// # Errors
    /// A report has two steps of one name.
    pub fn between(before: &VerifyReport, after: &VerifyReport) -> Result<Self> {
        let (old, new) = (by_name(before)?, by_name(after)?);
        let common = after.steps.iter().filter_map(|step| Some(StepChange::of(old.get(step.step.as_str())?, step)));
        let mut steps: Vec<StepChange> = common.collect();
        steps.sort_by(|a, b| b.loss_db().total_cmp(&a.loss_db()));
        let absent = |steps: &[StepReport], other: &HashMap<&str, &StepReport>| {
            let names = steps.iter().map(|step| &step.step);
            names.filter(|name| !other.contains_key(name.as_str())).cloned().collect::<Vec<_>>()
        };
        let digests = |report: &VerifyReport| report.frames.iter().map(|f| f.digest.clone()).collect::<Vec<_>>();
        Ok(Self {
            before: before.model.clone(),
            after: after.model.clone(),
            same_frames: digests(before) == digests(after),
            steps,
            only_before: absent(&before.steps, &new),
            only_after: absent(&after.steps, &old),
            figures: figures(before, after),
        })
    }

    /// Steps whose figure changed noticeably, the greatest loss first.
    pub fn changed(&self) -> impl Iterator<Item = &StepChange> {
        self.steps.iter().filter(|step| step.loss_db().is_nan() || step.loss_db().abs() >= MENTIONED_DB)
    }
}

impl StepChange {
    fn of(before: &StepReport, after: &StepReport) -> Self {
        Self {
            step: after.step.clone(),
            op: after.op.clone().into_owned(),
            before_db: before.sqnr_db,
            after_db: after.sqnr_db,
            change_db: change(before.sqnr_db, after.sqnr_db),
            local_change_db: change(before.local_sqnr_db, after.local_sqnr_db),
        }
    }

    /// What the step lost, dB: 0 where it was not measured twice, infinite where it was exact, not a number where the
    /// later figure is none.
    pub fn loss_db(&self) -> f64 {
        change(self.before_db, self.after_db).map_or(0.0, |change| 0.0 - change)
    }
}

/// After − before; both infinite is no change.
fn change(before: Option<f64>, after: Option<f64>) -> Option<f64> {
    let (before, after) = (before?, after?);
    Some(if before == after { 0.0 } else { after - before })
}

fn by_name(report: &VerifyReport) -> Result<HashMap<&str, &StepReport>> {
    let mut steps = HashMap::new();
    for step in &report.steps {
        if steps.insert(step.step.as_str(), step).is_some() {
            let message = "two steps have this name, so steps cannot be matched";
            return Err(Error::new(ErrorCode::Malformed, format!("step {}", step.step), message));
        }
    }
    Ok(steps)
}

fn figures(before: &VerifyReport, after: &VerifyReport) -> Vec<FigureChange> {
    let (old, new) = (&before.summary, &after.summary);
    let figure = |figure: &str, unit: &str, before, after| FigureChange {
        figure: figure.to_owned(),
        unit: unit.to_owned(),
        before,
        after,
    };
    let bytes = |value: u64| Some(value as f64);
    let mut figures = vec![
        figure("arena", "B", bytes(old.arena_bytes), bytes(new.arena_bytes)),
        figure("flash", "B", bytes(old.flash_bytes), bytes(new.flash_bytes)),
        figure("worst step", "dB", old.worst_sqnr_db, new.worst_sqnr_db),
        figure("pooled vector", "dB", old.vector_sqnr_db, new.vector_sqnr_db),
        figure("output", "dB", old.output_sqnr_db, new.output_sqnr_db),
    ];
    for (k, (old, new)) in old.waypoint_error_mm.iter().zip(&new.waypoint_error_mm).enumerate() {
        figures.push(figure(&format!("waypoint {}, mean", k + 1), "mm", Some(old.mean), Some(new.mean)));
        figures.push(figure(&format!("waypoint {}, max", k + 1), "mm", Some(old.max), Some(new.max)));
    }
    for (old, new) in old.control_error.iter().zip(&new.control_error) {
        figures.push(figure(&format!("{}, mean", new.name), "", Some(old.mean), Some(new.mean)));
        figures.push(figure(&format!("{}, max", new.name), "", Some(old.max), Some(new.max)));
    }
    for (k, (old, new)) in old.point_error_px.iter().zip(&new.point_error_px).enumerate() {
        figures.push(figure(&format!("point {}, mean", k + 1), "px", Some(old.mean), Some(new.mean)));
        figures.push(figure(&format!("point {}, max", k + 1), "px", Some(old.max), Some(new.max)));
    }
    figures.retain(|figure| figure.before.is_some() && figure.after.is_some());
    figures
}

#[cfg(test)]
pub(crate) mod tests {
    use super::*;
    use crate::report::tests::{report, step};

    pub(crate) fn diff() -> Diff {
        let (before, mut after) = (report(), report());
        after.steps = vec![step(0, Some(28.7)), step(1, Some(23.0)), step(7, Some(3.0))];
        after.summary.arena_bytes += 512;
        let mut before = before;
        before.steps.push(step(5, Some(40.0)));
        Diff::between(&before, &after).unwrap()
    }

    #[test]
    fn losses_come_first_and_strangers_are_listed() {
        let diff = diff();
        let changes: Vec<(&str, f64)> = diff.steps.iter().map(|s| (s.step.as_str(), s.loss_db())).collect();
        assert_eq!(changes[0].0, "conv0");
        assert!((changes[0].1 - 1.3).abs() < 1e-9 && (changes[1].1 + 1.5).abs() < 1e-9, "{changes:?}");
        assert_eq!((diff.only_before, diff.only_after), (vec!["conv5".to_owned()], vec!["conv7".to_owned()]));
        let arena = diff.figures.iter().find(|f| f.figure == "arena").unwrap();
        assert_eq!((arena.before, arena.after), (Some(2048.0), Some(2560.0)));
        assert!(diff.same_frames);
    }

    #[test]
    fn an_exact_step_that_got_noise_is_the_greatest_loss() {
        let (mut before, mut after) = (report(), report());
        before.steps = vec![step(0, Some(f64::INFINITY)), step(1, Some(f64::INFINITY)), step(2, Some(50.0))];
        after.steps = vec![step(0, Some(f64::INFINITY)), step(1, Some(60.0)), step(2, Some(20.0))];
        let diff = Diff::between(&before, &after).unwrap();
        assert_eq!(diff.steps[0].step, "conv1");
        assert_eq!(diff.steps[0].loss_db(), f64::INFINITY);
        assert_eq!(diff.changed().count(), 2);
    }

    #[test]
    fn a_figure_that_became_none_is_a_loss() {
        let (before, mut after) = (report(), report());
        after.steps[1].sqnr_db = Some(f64::NAN);
        let diff = Diff::between(&before, &after).unwrap();
        assert_eq!(diff.steps[0].step, "conv1");
        assert!(!crate::gates::loss(&diff, 1e9).met);
    }

    #[test]
    fn two_steps_of_one_name_are_refused() {
        let mut twice = report();
        twice.steps[1].step = "conv0".into();
        assert!(Diff::between(&report(), &twice).unwrap_err().location.contains("conv0"));
    }
}
