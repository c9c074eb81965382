//! The forms for people: tables with a line per frame or step, and a short summary.

use super::figures::{figure, signed};
use super::{FrameReport, StepReport, VerifyReport, classes, controls};
use crate::ablation::Row;
use crate::diff::{Diff, FigureChange, MENTIONED_DB, StepChange};
use crate::gates::GateOutcome;
use crate::run::{ModelInfo, Waypoints};
use comfy_table::{CellAlignment, ContentArrangement, Table, presets};
use std::fmt::Write;

mod attention;
mod bench;
mod drive;
mod footprint;
mod hil;
mod run;
mod score;

pub use attention::attention;
pub use bench::bench;
pub use drive::drive;
pub use footprint::footprint;
pub use hil::{hil, update};
pub use run::run;
pub use score::score;

/// Changed steps that a terminal shows.
const MAX_CHANGES: usize = 20;

/// The steps and the summary of a verification.
pub fn verify(report: &VerifyReport) -> String {
    let mut text = format!("{} for {}, {} frames\n\n", report.model.name, report.target, report.frames.len());
    let header = [
        "", "step", "op", "shape", "type", "scale", "local dB", "SQNR dB", "cosine", "max LSB", "clip ppm", "headroom",
        "bytes", "equal",
    ];
    let rows = report.steps.iter().map(step_row);
    let _ = writeln!(text, "{}\n", table(header.map(str::to_owned).to_vec(), &[1, 2, 3, 4], rows));
    text += &summary(report);
    text += &gates(&report.gates);
    if let Some(baseline) = &report.baseline {
        let _ = write!(text, "\nagainst the baseline: {}", diff(baseline));
    }
    text
}

/// Waypoints of the engine and, below, of the f32 network; frame by frame.
pub fn waypoints(frames: &[FrameReport]) -> String {
    let longest = frames.iter().flat_map(|f| &f.waypoints).map(Vec::len).max().unwrap_or(0);
    let columns = (1..=longest).flat_map(|k| [format!("right {k}"), format!("forward {k}")]);
    let header = ["frame", "network"].map(str::to_owned).into_iter().chain(columns).collect();
    let row = |frame: &str, network: &str, waypoints: &Waypoints| {
        let meters = waypoints.iter().flatten().map(|meters| format!("{meters:.3}"));
        [frame, network].map(str::to_owned).into_iter().chain(meters).collect()
    };
    let rows = frames.iter().flat_map(|frame| {
        let engine = frame.waypoints.iter().map(|w| row(&frame.name, "int8", w));
        engine.chain(frame.reference_waypoints.iter().map(|w| row("", "f32", w)))
    });
    table(header, &[0, 1], rows)
}

/// One line per variant of the quantizer.
pub fn ablation(rows: &[Row]) -> String {
    if rows.iter().any(|row| row.fidelity.classes.is_some()) {
        return classes::ablation(rows);
    }
    if rows.iter().any(|row| !row.fidelity.controls.is_empty()) {
        return controls::ablation(rows);
    }
    let points = rows.iter().any(|row| row.fidelity.points.is_some());
    let (vector, unit, digits) = if points { ("logits dB", "px", 2) } else { ("vector dB", "mm", 0) };
    let errors = |row: &Row| match &row.fidelity.points {
        Some(points) => [points.mean_px.clone(), points.worst_px.clone()],
        None => [row.fidelity.mean_mm.clone(), row.fidelity.worst_mm.clone()],
    };
    let count = rows.first().map_or(0, |row| errors(row)[0].len());
    let numbered = |what: &str| (1..=count).map(|k| format!("{what} {unit} {k}")).collect::<Vec<_>>();
    let header = [vec!["variant".to_owned(), vector.to_owned()], numbered("mean"), numbered("worst")].concat();
    let line = |row: &Row| {
        let errors = errors(row).concat().into_iter().map(|error| format!("{error:.digits$}"));
        [row.variant.to_owned(), figure(row.fidelity.vector_sqnr_db.into(), 2)].into_iter().chain(errors).collect()
    };
    format!("{}\n", table(header, &[0], rows.iter().map(line)))
}

fn step_row(step: &StepReport) -> Vec<String> {
    let [height, width, channels] = step.shape;
    vec![
        step.position.to_string(),
        step.step.clone(),
        step.op.clone().into_owned(),
        format!("{height}×{width}×{channels}"),
        step.element.clone().into_owned(),
        format!("{:.3e}", step.scale),
        figure(step.local_sqnr_db, 1),
        figure(step.sqnr_db, 1),
        figure(step.cosine, 5),
        figure(step.max_error_lsb, 2),
        figure(step.saturation_ppm, 0),
        step.headroom_bits.to_string(),
        step.bytes.to_string(),
        if step.bytes_equal { "yes" } else { "NO" }.to_owned(),
    ]
}

/// The figures of the whole, a line each.
pub fn summary(report: &VerifyReport) -> String {
    let mut text = String::new();
    let s = &report.summary;
    let bytes = if report.bytes_equal { "equal in every step of every frame" } else { "UNEQUAL" };
    let _ = writeln!(text, "engine and f64 model   {bytes} ({} steps, {} frames)", s.steps, report.frames.len());
    if let (Some(step), Some(db)) = (&s.worst_step, s.worst_sqnr_db) {
        let _ = writeln!(text, "worst step             {step}: {db:.1} dB");
    }
    if let Some(db) = s.vector_sqnr_db {
        let _ = writeln!(text, "pooled vector          {} dB", figure(Some(db), 1));
    }
    for (k, error) in s.waypoint_error_mm.iter().enumerate() {
        let _ = writeln!(
            text,
            "waypoint {}             {:.1} mm off on average, {:.1} mm at most",
            k + 1,
            error.mean,
            error.max
        );
    }
    text += &controls::verify(&s.control_error);
    for (k, error) in s.point_error_px.iter().enumerate() {
        let _ = writeln!(
            text,
            "point {}                {:.2} px off on average, {:.2} px at most",
            k + 1,
            error.mean,
            error.max
        );
    }
    text += &s.accuracy.as_ref().map(classes::verify).unwrap_or_default();
    let _ = writeln!(
        text,
        "arena                  {} B, lower bound {} B: {}",
        s.arena_bytes,
        s.arena_bound_bytes,
        s.arena_status.words()
    );
    for region in &report.memory.regions {
        let of = region.capacity_bytes.map(|capacity| format!(" of {capacity} B")).unwrap_or_default();
        let (bytes, bound, share) = (region.bytes, region.bound_bytes, 100.0 * region.traffic_share);
        let figures = format!("{bytes} B{of}, lower bound {bound} B: {}", region.status.words());
        let _ = writeln!(text, "  in {:<19} {figures}; {share:.1} % of the traffic", region.name);
    }
    let _ = writeln!(text, "flash                  {} B", s.flash_bytes);
    text
}

/// Steps, sizes and figures that changed.
pub fn diff(diff: &Diff) -> String {
    let short = |model: &ModelInfo| format!("{} ({})", model.name, model.sha256.get(..12).unwrap_or(&model.sha256));
    let mut text = format!("from {} to {}\n", short(&diff.before), short(&diff.after));
    if !diff.same_frames {
        text += "the two reports are about different frames\n";
    }
    let header = ["figure", "before", "after", "change", ""].map(str::to_owned).to_vec();
    let digits = |unit: &str| match unit {
        "B" => 0,
        "" => controls::DIGITS,
        "px" => 2,
        _ => 1,
    };
    let row = |change: &FigureChange| {
        let digits = digits(&change.unit);
        let difference = change.before.zip(change.after).map(|(before, after)| after - before);
        vec![
            change.figure.clone(),
            figure(change.before, digits),
            figure(change.after, digits),
            signed(difference, digits),
            change.unit.clone(),
        ]
    };
    let _ = writeln!(text, "\n{}\n", table(header, &[0, 4], diff.figures.iter().map(row)));
    let changed: Vec<&StepChange> = diff.changed().collect();
    let _ = writeln!(text, "{} of {} steps changed by {MENTIONED_DB} dB or more", changed.len(), diff.steps.len());
    let header = ["change dB", "before", "after", "step"].map(str::to_owned).to_vec();
    let row = |step: &&StepChange| {
        vec![signed(step.change_db, 1), figure(step.before_db, 1), figure(step.after_db, 1), step.step.clone()]
    };
    if !changed.is_empty() {
        let _ = writeln!(text, "{}", table(header, &[3], changed.iter().take(MAX_CHANGES).map(row)));
    }
    if changed.len() > MAX_CHANGES {
        let _ = writeln!(text, "and {} more", changed.len() - MAX_CHANGES);
    }
    for (steps, which) in [(&diff.only_before, "earlier"), (&diff.only_after, "later")] {
        if !steps.is_empty() {
            let _ = writeln!(text, "only in the {which} report: {}", steps.join(", "));
        }
    }
    text
}

/// Gates with what they met, a line each.
pub fn gates(gates: &[GateOutcome]) -> String {
    let line = |gate: &GateOutcome| {
        let place = gate.place.as_ref().map(|place| format!(" ({place})")).unwrap_or_default();
        format!("gate {} {}{place}: {}\n", gate.gate, if gate.met { "met" } else { "MISSED" }, gate.words())
    };
    gates.iter().map(line).collect()
}

/// A table whose columns are aligned right, except those of words.
pub(super) fn table(header: Vec<String>, words: &[usize], rows: impl Iterator<Item = Vec<String>>) -> String {
    let mut table = Table::new();
    table.load_style(presets::NOTHING).set_content_arrangement(ContentArrangement::Disabled);
    table.set_header(header);
    table.add_rows(rows);
    for (index, column) in table.column_iter_mut().enumerate() {
        column.set_cell_alignment(if words.contains(&index) { CellAlignment::Left } else { CellAlignment::Right });
    }
    table.trim_fmt()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn errors_of_points_are_in_pixels() {
        let mut report = super::super::tests::report();
        report.summary.point_error_px = vec![super::super::MeanAndMax { mean: 0.25, max: 1.5 }];
        assert!(summary(&report).contains("point 1                0.25 px off on average, 1.50 px at most"));
    }

    #[test]
    fn a_verification_shows_steps_and_summary() {
        let text = verify(&super::super::tests::report());
        for expected in [
            "local dB",
            "conv1",
            "64×64×64",
            "21.5",
            "waypoint 1",
            "1.2 mm off on average, 2.5 mm",
            "lower bound 2048 B: optimal",
        ] {
            assert!(text.contains(expected), "{expected} in\n{text}");
        }
        assert!(text.contains("equal in every step"), "{text}");
    }

    #[test]
    fn both_networks_stand_below_each_other() {
        let text = waypoints(&super::super::tests::report().frames);
        let words: Vec<Vec<&str>> = text.lines().map(|line| line.split_whitespace().collect()).collect();
        assert_eq!(words[0], ["frame", "network", "right", "1", "forward", "1"]);
        assert_eq!(words[1..], [vec!["a", "int8", "0.000", "1.000"], vec!["f32", "0.000", "1.001"]]);
    }

    #[test]
    fn a_comparison_shows_losses_first_and_strangers_last() {
        let text = diff(&crate::diff::tests::diff());
        let lines: Vec<&str> = text.lines().map(str::trim).collect();
        let loss = lines.iter().position(|line| line.starts_with("−1.3") && line.ends_with("conv0"));
        let gain = lines.iter().position(|line| line.starts_with("+1.5") && line.ends_with("conv1"));
        assert!(loss.unwrap() < gain.unwrap(), "{text}");
        assert!(text.contains("+512") && text.contains("only in the earlier report: conv5"), "{text}");
    }
}
