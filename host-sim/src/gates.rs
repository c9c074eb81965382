//! Limits that a verification must keep, from the command line or a gate file, for continuous integration.
//!
//! ```toml
//! min_sqnr_db = 15              # every step, accumulated
//! min_output_sqnr_db = 18       # the first output
//! max_waypoint_error_mm = 120   # every waypoint of every frame
//! max_control_error = 0.02      # steer, throttle and brake of every frame, where the network gives them
//! max_point_error_px = 2        # every point of every frame
//! min_agreement_percent = 98.5  # of a classifier: frames on which int8 and f32 give one class
//! min_top1_percent = 91         # of a classifier: frames on which the class is the label
//! max_arena_bytes = 245760
//! max_flash_bytes = 2097152
//! max_loss_db = 1               # no step against the baseline
//!
//! [steps]                       # by name, * for any characters
//! "*.layer1.*" = 28
//! ```
//!
//! Every field may be absent. A figure that is not a number misses every gate.

use crate::attention::{AttentionReport, FrameAttention};
use crate::classification::ClassificationSummary;
use crate::controls::PREDICTED_SPEED;
use crate::diff::Diff;
use crate::report::{MeanAndMax, StepReport, VerifyReport, worst};
use glob::Pattern;
use model_compiler::error::{Error, ErrorCode, Result};
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use std::borrow::Cow;
use std::collections::BTreeMap;
use std::path::Path;
use toml::Spanned;

/// What is asked for.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Gates {
    /// Lowest accumulated SQNR of any step, dB.
    pub min_sqnr_db: Option<f64>,
    /// Lowest SQNR of the first output, dB.
    pub min_output_sqnr_db: Option<f64>,
    /// Largest waypoint error of any frame, mm.
    pub max_waypoint_error_mm: Option<f64>,
    /// Largest error of steer, throttle or brake of any frame.
    pub max_control_error: Option<f64>,
    /// Largest point error of any frame, pixels.
    pub max_point_error_px: Option<f64>,
    /// Fewest frames on which a classifier in int8 and in f32 gives one class, percent.
    pub min_agreement_percent: Option<f64>,
    /// Fewest frames on which the class is the label, percent.
    pub min_top1_percent: Option<f64>,
    /// Largest arena, all memory regions together.
    pub max_arena_bytes: Option<u64>,
    /// Largest image.
    pub max_flash_bytes: Option<u64>,
    /// Most that a step may lose against the baseline, dB.
    pub max_loss_db: Option<f64>,
    /// Lowest accumulated SQNR of the steps that a pattern matches, dB.
    pub steps: Vec<(Pattern, f64)>,
}

/// One gate and what it met.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
pub struct GateOutcome {
    /// The gate, as in the gate file: `min_sqnr_db`, `steps."PATTERN"`, …
    pub gate: String,
    /// Where the figure comes from: the step that is nearest to the gate, or beyond.
    pub place: Option<String>,
    /// The figure.
    pub found: Option<f64>,
    /// The limit.
    pub limit: f64,
    /// The limit is a minimum; else a maximum.
    pub at_least: bool,
    /// Unit of both; empty where they have none.
    pub unit: Cow<'static, str>,
    /// The figure keeps the limit.
    pub met: bool,
}

/// The first missed gate, and how many more there are.
pub fn failure(gates: &[GateOutcome]) -> Option<Error> {
    let mut missed = gates.iter().filter(|gate| !gate.met);
    let first = missed.next()?;
    let more = match missed.count() {
        0 => String::new(),
        1 => "; 1 more gate is missed".to_owned(),
        more => format!("; {more} more gates are missed"),
    };
    let place = first.place.as_ref().map(|place| format!(": {place}")).unwrap_or_default();
    Some(Error::new(ErrorCode::Check, format!("gate {}{place}", first.gate), format!("{}{more}", first.words())))
}

impl GateOutcome {
    fn at_least(gate: &str, place: Option<String>, found: Option<f64>, limit: f64, unit: &'static str) -> Self {
        let met = found.is_some_and(|found| found >= limit);
        Self { gate: gate.into(), place, found, limit, at_least: true, unit: unit.into(), met }
    }

    fn at_most(gate: &str, place: Option<String>, found: Option<f64>, limit: f64, unit: &'static str) -> Self {
        let met = found.is_some_and(|found| found <= limit);
        Self { gate: gate.into(), place, found, limit, at_least: false, unit: unit.into(), met }
    }

    /// `found 12.30 dB, expected at least 15 dB`.
    pub fn words(&self) -> String {
        let (digits, space) = match &*self.unit {
            "" => (4, ""),
            "B" => (0, " "),
            _ => (2, " "),
        };
        let unit = &self.unit;
        let found = match self.found {
            Some(found) if found.is_finite() => format!("{found:.digits$}{space}{unit}"),
            Some(found) if found.is_infinite() => "exact values".to_owned(),
            _ => "no figure".to_owned(),
        };
        let side = if self.at_least { "at least" } else { "at most" };
        format!("found {found}, expected {side} {}{space}{unit}", self.limit)
    }
}

/// The gate file, with the place of every value.
#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct File {
    min_sqnr_db: Option<Spanned<f64>>,
    min_output_sqnr_db: Option<Spanned<f64>>,
    max_waypoint_error_mm: Option<Spanned<f64>>,
    max_control_error: Option<Spanned<f64>>,
    max_point_error_px: Option<Spanned<f64>>,
    min_agreement_percent: Option<Spanned<f64>>,
    min_top1_percent: Option<Spanned<f64>>,
    max_arena_bytes: Option<u64>,
    max_flash_bytes: Option<u64>,
    max_loss_db: Option<Spanned<f64>>,
    #[serde(default)]
    steps: BTreeMap<Spanned<String>, Spanned<f64>>,
}

/// What a percentage must be: a share such as 0.9 would be a gate that nothing ever misses.
pub const PERCENTAGE: &str = "a percentage above 1 up to 100, such as 98.5";

/// Whether a number is a [`PERCENTAGE`].
pub fn is_percentage(value: f64) -> bool {
    value > 1.0 && value <= 100.0
}

const FIELDS: &str = "fields: min_sqnr_db, min_output_sqnr_db, max_waypoint_error_mm, max_control_error, \
                      max_point_error_px, min_agreement_percent, min_top1_percent, max_arena_bytes, max_flash_bytes, \
                      max_loss_db, [steps] with \"PATTERN\" = dB";

impl Gates {
    /// Reads a gate file.
    ///
    /// # Errors
    /// The file cannot be read, or see [`Gates::parse`].
    pub fn read(path: &Path) -> Result<Self> {
        let text = std::fs::read_to_string(path).map_err(|e| Error::io(path, &e))?;
        Self::parse(&text).map_err(|e| e.within(path.display()))
    }

    /// Gates from the text of a gate file.
    ///
    /// # Errors
    /// Not TOML, an unknown field, or a value out of range: the field and its line are named.
    pub fn parse(text: &str) -> Result<Self> {
        let file: File = toml::from_str(text)
            .map_err(|e| Error::new(ErrorCode::Malformed, "", e.to_string().trim_end()).with_help(FIELDS))?;
        let line = |offset: usize| 1 + text[..offset].matches('\n').count();
        let refuse = |offset: usize, field: &str, message: String| {
            Error::new(ErrorCode::Malformed, format!("line {}: {field}", line(offset)), message)
        };
        let checked = |field: &str, value: Spanned<f64>, allowed: fn(f64) -> bool, expected: &str| {
            let number = *value.get_ref();
            let error = || refuse(value.span().start, field, format!("found {number}, expected {expected}"));
            if allowed(number) { Ok(number) } else { Err(error()) }
        };
        let decibels = |field: &str, value: Option<Spanned<f64>>| {
            value.map(|value| checked(field, value, f64::is_finite, "decibels")).transpose()
        };
        let distance = |field: &str, value: Option<Spanned<f64>>, expected| {
            value.map(|value| checked(field, value, |v| v.is_finite() && v >= 0.0, expected)).transpose()
        };
        let share = |field: &str, value: Option<Spanned<f64>>| {
            value.map(|value| checked(field, value, is_percentage, PERCENTAGE)).transpose()
        };
        let step = |(name, value): (Spanned<String>, Spanned<f64>)| {
            let field = format!("steps.{:?}", name.get_ref());
            let pattern = Pattern::new(name.get_ref())
                .map_err(|e| refuse(name.span().start, &field, format!("this is no pattern: {}", e.msg)))?;
            Ok((pattern, checked(&field, value, f64::is_finite, "decibels")?))
        };
        Ok(Self {
            min_sqnr_db: decibels("min_sqnr_db", file.min_sqnr_db)?,
            min_output_sqnr_db: decibels("min_output_sqnr_db", file.min_output_sqnr_db)?,
            max_waypoint_error_mm: distance(
                "max_waypoint_error_mm",
                file.max_waypoint_error_mm,
                "millimeters, 0 or more",
            )?,
            max_control_error: distance("max_control_error", file.max_control_error, "an error, 0 or more")?,
            max_point_error_px: distance("max_point_error_px", file.max_point_error_px, "pixels, 0 or more")?,
            min_agreement_percent: share("min_agreement_percent", file.min_agreement_percent)?,
            min_top1_percent: share("min_top1_percent", file.min_top1_percent)?,
            max_arena_bytes: file.max_arena_bytes,
            max_flash_bytes: file.max_flash_bytes,
            max_loss_db: distance("max_loss_db", file.max_loss_db, "decibels, 0 or more")?,
            steps: file.steps.into_iter().map(step).collect::<Result<_>>()?,
        })
    }

    /// These gates, and those of `other` where these leave something open.
    #[must_use]
    pub fn or(self, other: Self) -> Self {
        Self {
            min_sqnr_db: self.min_sqnr_db.or(other.min_sqnr_db),
            min_output_sqnr_db: self.min_output_sqnr_db.or(other.min_output_sqnr_db),
            max_waypoint_error_mm: self.max_waypoint_error_mm.or(other.max_waypoint_error_mm),
            max_control_error: self.max_control_error.or(other.max_control_error),
            max_point_error_px: self.max_point_error_px.or(other.max_point_error_px),
            min_agreement_percent: self.min_agreement_percent.or(other.min_agreement_percent),
            min_top1_percent: self.min_top1_percent.or(other.min_top1_percent),
            max_arena_bytes: self.max_arena_bytes.or(other.max_arena_bytes),
            max_flash_bytes: self.max_flash_bytes.or(other.max_flash_bytes),
            max_loss_db: self.max_loss_db.or(other.max_loss_db),
            steps: [self.steps, other.steps].concat(),
        }
    }

    /// Checks what can be known before anything runs: an f32 network where figures against f32 are limited, a baseline
    /// where a loss is.
    ///
    /// # Errors
    /// One of them is missing.
    pub fn check_sources(&self, float: bool, baseline: bool) -> Result<()> {
        let against_f32 = [
            ("min_sqnr_db (--min-sqnr)", self.min_sqnr_db.is_some()),
            ("min_output_sqnr_db (--min-output-sqnr)", self.min_output_sqnr_db.is_some()),
            ("max_waypoint_error_mm", self.max_waypoint_error_mm.is_some()),
            ("max_control_error", self.max_control_error.is_some()),
            ("max_point_error_px", self.max_point_error_px.is_some()),
            ("min_agreement_percent (--min-agreement)", self.min_agreement_percent.is_some()),
            ("max_loss_db (--max-loss)", self.max_loss_db.is_some()),
            ("steps", !self.steps.is_empty()),
        ];
        if let Some((gate, _)) = against_f32.iter().find(|(_, asked)| *asked && !float) {
            let error = Error::new(ErrorCode::Usage, format!("gate {gate}"), "needs the f32 network to compare with");
            return Err(error.with_help("add --model MODEL"));
        }
        if self.max_loss_db.is_some() && !baseline {
            let error = Error::new(ErrorCode::Usage, "gate max_loss_db (--max-loss)", "needs an earlier report");
            return Err(error.with_help("add --baseline OLD/report.json"));
        }
        Ok(())
    }

    /// What every gate meets in a report.
    ///
    /// # Errors
    /// A pattern matches no step.
    pub fn outcomes(&self, report: &VerifyReport) -> Result<Vec<GateOutcome>> {
        let summary = &report.summary;
        let mut outcomes = Vec::new();
        if let Some(limit) = self.min_sqnr_db {
            outcomes.push(lowest("min_sqnr_db", &report.steps, limit));
        }
        for (pattern, limit) in &self.steps {
            let gate = format!("steps.\"{pattern}\"");
            let matching: Vec<StepReport> = report.steps.iter().filter(|s| pattern.matches(&s.step)).cloned().collect();
            if matching.is_empty() {
                let error = Error::new(ErrorCode::Usage, format!("gate {gate}"), "no step of this model matches");
                return Err(
                    error.with_help("the names are in the table of `host-sim verify`; * stands for any characters")
                );
            }
            outcomes.push(lowest(&gate, &matching, *limit));
        }
        if let Some(limit) = self.min_output_sqnr_db {
            let place = summary.output_step.as_ref().map(|step| format!("step {step}"));
            outcomes.push(GateOutcome::at_least("min_output_sqnr_db", place, summary.output_sqnr_db, limit, "dB"));
        }
        outcomes.extend(
            self.max_waypoint_error_mm
                .map(|limit| farthest("max_waypoint_error_mm", "waypoint", &summary.waypoint_error_mm, limit, "mm")),
        );
        if let Some(limit) = self.max_control_error {
            let controls = summary.control_error.iter().filter(|error| error.name != PREDICTED_SPEED);
            let largest = controls.max_by(|a, b| a.max.total_cmp(&b.max));
            let place = largest.map(|error| error.name.clone().into_owned());
            outcomes.push(GateOutcome::at_most("max_control_error", place, largest.map(|e| e.max), limit, ""));
        }
        outcomes.extend(
            self.max_point_error_px
                .map(|limit| farthest("max_point_error_px", "point", &summary.point_error_px, limit, "px")),
        );
        outcomes.extend(self.class_outcomes(summary.accuracy.as_ref())?);
        let sizes = [
            ("max_arena_bytes", summary.arena_bytes, self.max_arena_bytes),
            ("max_flash_bytes", summary.flash_bytes, self.max_flash_bytes),
        ];
        for (gate, found, limit) in sizes {
            outcomes.extend(limit.map(|limit| GateOutcome::at_most(gate, None, Some(found as f64), limit as f64, "B")));
        }
        if let (Some(limit), Some(diff)) = (self.max_loss_db, &report.baseline) {
            outcomes.push(loss(diff, limit));
        }
        Ok(outcomes)
    }
}

impl Gates {
    /// What the gates of a classifier meet.
    fn class_outcomes(&self, found: Option<&ClassificationSummary>) -> Result<Vec<GateOutcome>> {
        let agreement = found.and_then(|found| found.agreement.as_ref()).map(|agreement| agreement.share);
        let top1 = found.and_then(|found| found.int8.as_ref()).map(|accuracy| accuracy.top1);
        let gates = [
            ("min_agreement_percent", self.min_agreement_percent, agreement, "add --model MODEL"),
            ("min_top1_percent", self.min_top1_percent, top1, "label the frames: labels.csv, or tensor `label`"),
        ];
        let mut outcomes = Vec::new();
        for (gate, limit, share, help) in gates {
            let Some(limit) = limit else { continue };
            let share = share.ok_or_else(|| {
                let message = "this was not measured: it needs a classifier and what it is compared with";
                Error::new(ErrorCode::Usage, format!("gate {gate}"), message).with_help(help)
            })?;
            outcomes.push(GateOutcome::at_least(gate, None, Some(100.0 * share), limit, "%"));
        }
        Ok(outcomes)
    }
}

/// The gate on what a step may lose.
pub fn loss(diff: &Diff, limit: f64) -> GateOutcome {
    let worst = diff.steps.first();
    let place = worst.map(|step| format!("step {}", step.step));
    // Without a common step nothing was lost that could be measured.
    let found = worst.map_or(0.0, |step| step.loss_db());
    GateOutcome::at_most("max_loss_db", place, Some(found), limit, "dB")
}

/// The gate on the strongest keys of attention that integers and f32 have in common.
///
/// # Errors
/// One of the two networks is missing.
pub fn attention_agreement(report: &AttentionReport, limit: f64) -> Result<GateOutcome> {
    const GATE: &str = "min_agreement_percent";
    let agreement = report.agreement.ok_or_else(|| {
        let error = Error::new(ErrorCode::Usage, format!("gate {GATE}"), "needs the integers and the f32 network");
        error.with_help("give an image, and --model with the checkpoint that it was compiled from")
    })?;
    let keys_percent = |frame: &&FrameAttention| frame.agreement.map_or(0.0, |agreement| agreement.keys_percent);
    let worst = report.frames.iter().min_by(|a, b| keys_percent(a).total_cmp(&keys_percent(b)));
    let place = worst.map(|frame| format!("least on frame {}", frame.name));
    Ok(GateOutcome::at_least(GATE, place, Some(agreement.keys_percent), limit, "%"))
}

/// The gate on the largest error of several points; without any there is no figure, and it is missed.
fn farthest(gate: &str, what: &str, errors: &[MeanAndMax], limit: f64, unit: &'static str) -> GateOutcome {
    let largest = errors.iter().enumerate().max_by(|a, b| a.1.max.total_cmp(&b.1.max));
    let place = largest.map(|(k, _)| format!("{what} {}", k + 1));
    GateOutcome::at_most(gate, place, largest.map(|(_, error)| error.max), limit, unit)
}

fn lowest(gate: &str, steps: &[StepReport], limit: f64) -> GateOutcome {
    let worst = worst(steps);
    let place = worst.map(|step| format!("step {} {}", step.position, step.step));
    GateOutcome::at_least(gate, place, worst.and_then(|step| step.sqnr_db), limit, "dB")
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::controls::ControlError;
    use crate::report::tests::report;

    fn outcome(gates: Gates) -> GateOutcome {
        gates.outcomes(&report()).unwrap().remove(0)
    }

    #[test]
    fn the_worst_step_is_named_with_both_figures() {
        let met = outcome(Gates { min_sqnr_db: Some(21.5), ..Gates::default() });
        assert!(met.met && failure(&[met]).is_none());
        let missed = outcome(Gates { min_sqnr_db: Some(25.0), ..Gates::default() });
        let error = failure(&[missed.clone(), missed]).unwrap();
        assert_eq!(
            error.to_string(),
            "gate min_sqnr_db: step 1 conv1: found 21.50 dB, expected at least 25 dB; 1 more gate is missed"
        );
        assert_eq!(error.code.exit_status(), 1);
    }

    #[test]
    fn every_field_of_the_file_becomes_a_gate_that_can_be_missed() {
        let text = "min_sqnr_db = 22\nmin_output_sqnr_db = 22.0\nmax_waypoint_error_mm = 2\nmax_arena_bytes = 2047\n\
                    max_flash_bytes = 4095\n[steps]\n'conv*' = 22\n'conv0' = 31\n";
        let outcomes = Gates::parse(text).unwrap().outcomes(&report()).unwrap();
        let missed: Vec<&str> = outcomes.iter().filter(|o| !o.met).map(|o| o.gate.as_str()).collect();
        let expected = [
            "min_sqnr_db",
            "steps.\"conv*\"",
            "steps.\"conv0\"",
            "min_output_sqnr_db",
            "max_waypoint_error_mm",
            "max_arena_bytes",
            "max_flash_bytes",
        ];
        assert_eq!(missed, expected);
        let kept = "min_sqnr_db = 21\nmax_waypoint_error_mm = 2.5\nmax_arena_bytes = 2048\n[steps]\nconv0 = 30\n";
        assert!(Gates::parse(kept).unwrap().outcomes(&report()).unwrap().iter().all(|o| o.met));
    }

    #[test]
    fn not_a_number_misses_and_exact_values_keep_every_gate() {
        let mut report = report();
        report.steps[1].sqnr_db = Some(f64::NAN);
        let gates = Gates { min_sqnr_db: Some(-1e9), ..Gates::default() };
        let outcome = gates.outcomes(&report).unwrap().remove(0);
        assert!(!outcome.met && outcome.words().starts_with("found no figure"), "{}", outcome.words());
        report.steps[0].sqnr_db = Some(f64::INFINITY);
        let gates = Gates { steps: vec![(Pattern::new("conv0").unwrap(), 200.0)], ..Gates::default() };
        assert!(gates.outcomes(&report).unwrap()[0].met);
    }

    #[test]
    fn bad_files_name_field_and_line() {
        let cases = [
            ("min_sqnr = 3", "min_sqnr"),
            ("\nmax_arena_bytes = -1", "line 2"),
            ("max_waypoint_error_mm = -1.5", "line 1: max_waypoint_error_mm: found -1.5"),
            ("# first\nmin_sqnr_db = nan", "line 2: min_sqnr_db: found NaN"),
            ("[steps]\n'a***b' = 3", "line 2: steps.\"a***b\": this is no pattern"),
            ("[steps]\nconv = inf", "line 2: steps.\"conv\": found inf"),
            ("min_sqnr_db = 'high'", "line 1"),
        ];
        for (text, expected) in cases {
            let error = Gates::parse(text).unwrap_err();
            assert!(error.to_string().contains(expected), "{expected} not in: {error}");
            assert_eq!(error.code.exit_status(), 2);
        }
    }

    #[test]
    fn points_have_a_gate_of_their_own() {
        let mut report = report();
        let error = |max| MeanAndMax { mean: 0.5, max };
        report.summary.point_error_px = vec![error(1.0), error(2.5), error(2.0)];
        let outcome = |limit| {
            let gates = Gates::parse(&format!("max_point_error_px = {limit}")).unwrap();
            gates.outcomes(&report).unwrap().remove(0)
        };
        assert!(outcome(2.5).met);
        let missed = outcome(2.4);
        assert_eq!((missed.met, missed.place.as_deref()), (false, Some("point 2")));
        assert_eq!(missed.words(), "found 2.50 px, expected at most 2.4 px");
        report.summary.point_error_px.clear();
        let gates = Gates { max_point_error_px: Some(9.0), ..Gates::default() };
        assert!(!gates.outcomes(&report).unwrap()[0].met, "a network without points");
    }

    #[test]
    fn controls_have_no_unit_and_small_errors() {
        let mut report = report();
        let error = |name: &'static str, max| ControlError { name: name.into(), mean: 0.0, max };
        report.summary.control_error = vec![error("steer", 0.0016), error("brake", 0.001), error(PREDICTED_SPEED, 0.5)];
        let gates = Gates { max_control_error: Some(0.001), ..Gates::default() };
        let missed = failure(&gates.outcomes(&report).unwrap()).unwrap();
        assert_eq!(missed.to_string(), "gate max_control_error: steer: found 0.0016, expected at most 0.001");
        let gates = Gates { max_arena_bytes: Some(2047), ..Gates::default() };
        let missed = failure(&gates.outcomes(&report).unwrap()).unwrap();
        assert_eq!(missed.to_string(), "gate max_arena_bytes: found 2048 B, expected at most 2047 B");
    }

    #[test]
    fn a_pattern_without_a_step_is_refused() {
        let gates = Gates::parse("[steps]\n'layer9.*' = 3").unwrap();
        let error = gates.outcomes(&report()).unwrap_err();
        assert!(error.to_string().contains("layer9.*") && error.code == ErrorCode::Usage, "{error}");
    }

    #[test]
    fn the_command_line_comes_before_the_file() {
        let file = Gates::parse("min_sqnr_db = 3\nmax_loss_db = 1\n[steps]\na = 1").unwrap();
        let both = Gates { min_sqnr_db: Some(9.0), ..Gates::default() }.or(file);
        assert_eq!((both.min_sqnr_db, both.max_loss_db, both.steps.len()), (Some(9.0), Some(1.0), 1));
        assert_eq!(both.check_sources(false, true).unwrap_err().help, "add --model MODEL");
        assert!(both.check_sources(true, false).unwrap_err().help.contains("--baseline"));
        assert!(both.check_sources(true, true).is_ok());
    }
}
