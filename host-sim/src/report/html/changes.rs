//! What changed against an earlier report.

use super::{data, table};
use crate::diff::{Diff, FigureChange, MENTIONED_DB, StepChange};
use crate::report::figures::{figure, signed};
use maud::{Markup, html};

/// Changed steps that are shown without unfolding.
const SHOWN: usize = 12;

pub(super) fn section(diff: &Diff) -> Markup {
    let changed: Vec<&StepChange> = diff.changed().collect();
    let about = html! {
        "From image " code { (diff.before.sha256.get(..16).unwrap_or("")) "…" } " to "
        code { (diff.after.sha256.get(..16).unwrap_or("")) "…" } "; steps are matched by name. "
        (changed.len()) " of " (diff.steps.len()) " steps changed by " (MENTIONED_DB) " dB or more, the greatest loss "
        "first. "
        @if !diff.same_frames { b { "The two reports are about different frames." } }
    };
    let content = html! {
        div.columns {
            div { h3 { "Steps" } (steps(changed.iter().copied().take(SHOWN))) }
            div { h3 { "The whole" } (figures(&diff.figures)) }
        }
        (strangers(&diff.only_before, "Only in the earlier report"))
        (strangers(&diff.only_after, "Only in this report"))
        (data("Every step as a table", &steps(diff.steps.iter())))
    };
    super::section("changes", "Against the earlier report", &about, &content)
}

fn steps<'a>(steps: impl Iterator<Item = &'a StepChange>) -> Markup {
    let row = |step: &StepChange| {
        vec![
            step.step.clone(),
            signed(step.change_db, 1),
            figure(step.before_db, 1),
            figure(step.after_db, 1),
            signed(step.local_change_db, 1),
        ]
    };
    let rows: Vec<_> = steps.map(row).collect();
    table(&["step", "change dB", "before", "after", "alone"], 1, &rows)
}

fn figures(figures: &[FigureChange]) -> Markup {
    let row = |change: &FigureChange| {
        let digits = if change.unit == "B" { 0 } else { 1 };
        let difference = change.before.zip(change.after).map(|(before, after)| after - before);
        vec![
            format!("{}, {}", change.figure, change.unit),
            signed(difference, digits),
            figure(change.before, digits),
            figure(change.after, digits),
        ]
    };
    let rows: Vec<_> = figures.iter().map(row).collect();
    table(&["figure", "change", "before", "after"], 1, &rows)
}

fn strangers(steps: &[String], title: &str) -> Markup {
    html! { @if !steps.is_empty() { p { b { (title) ": " } (steps.join(", ")) } } }
}
