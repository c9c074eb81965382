//! Noise along the network: of every step alone, and what has added up.

use super::plot::{Axis, LEFT, RIGHT, WIDTH, line, px};
use super::{data, table};
use crate::report::StepReport;
use crate::report::figures::{decibels, figure};
use maud::{Markup, html};

const HEIGHT: f64 = 420.0;
const TOP: f64 = 34.0;
const BOTTOM: f64 = HEIGHT - 34.0;
/// Steps that are named.
const WORST: usize = 10;
/// Width of a character of a stage's name.
const CHARACTER: f64 = 6.2;

pub(super) fn section(steps: &[StepReport]) -> Markup {
    if steps.iter().all(|step| step.sqnr_db.is_none()) {
        return html! {};
    }
    let about = html! {
        "Signal to quantization noise of every step, in the order of execution; higher is better. The "
        b { "line" } " is what has added up until here, against the f32 network. The " b { "marks" } " are the noise of "
        "each step alone: its integers against its operator in f32 on the same integers. Numbers are the ten steps with "
        "the most noise of their own. Steps without a mark add none."
    };
    let content = html! {
        (plot(steps))
        (legend())
        div.columns {
            div { h3 { "Most noise of their own" } (worst(steps, |step| step.local_sqnr_db)) }
            div { h3 { "Lowest accumulated" } (worst(steps, |step| step.sqnr_db)) }
        }
        (data("Every point as a table", &points(steps)))
    };
    super::section("sqnr", "Precision along the network", &about, &content)
}

/// The lowest ones, lowest first.
fn lowest(steps: &[StepReport], figure: impl Fn(&StepReport) -> Option<f64>) -> Vec<(&StepReport, f64)> {
    let mut ranked: Vec<_> = steps.iter().filter_map(|step| Some((step, figure(step)?))).collect();
    ranked.retain(|(_, db)| *db < f64::INFINITY || db.is_nan());
    let rank = |db: f64| if db.is_nan() { f64::NEG_INFINITY } else { db };
    ranked.sort_by(|a, b| rank(a.1).total_cmp(&rank(b.1)));
    ranked.truncate(WORST);
    ranked
}

fn worst(steps: &[StepReport], figure: impl Fn(&StepReport) -> Option<f64>) -> Markup {
    let row = |(number, (step, db)): (usize, (&StepReport, f64))| {
        vec![(number + 1).to_string(), step.step.clone(), step.op.clone().into_owned(), decibels(Some(db))]
    };
    let rows: Vec<_> = lowest(steps, figure).into_iter().enumerate().map(row).collect();
    table(&["", "step", "operator", "SQNR"], 3, &rows)
}

fn plot(steps: &[StepReport]) -> Markup {
    let finite = |db: Option<f64>| db.filter(|db| db.is_finite());
    let all = steps.iter().flat_map(|step| [finite(step.local_sqnr_db), finite(step.sqnr_db)]).flatten();
    let (low, high) = all.fold((0.0_f64, 10.0_f64), |(low, high), db| (low.min(db), high.max(db)));
    let y = Axis::new([low, (high / 10.0).ceil() * 10.0], [BOTTOM, TOP]);
    let x = Axis::new([-0.5, steps.len() as f64 - 0.5], [LEFT, RIGHT]);
    let at = |step: &StepReport| x.at(step.position as f64);
    let accumulated = steps.iter().map(|step| finite(step.sqnr_db).map(|db| (at(step), y.at(db))));
    let spoken = "SQNR of every step, alone and accumulated; the same figures are in the table below";
    html! {
        figure.plot {
            svg viewBox={ "0 0 " (WIDTH) " " (HEIGHT) } role="img" aria-label=(spoken) {
                (symbols())
                (stages(steps, &x))
                (y.grid(&y.ticks(8.0), |db| format!("{db:.0}")))
                text x="4" y=(px(TOP - 8.0)) { "dB" }
                (x.labels(&x.ticks(10.0), HEIGHT - 16.0, |step| format!("{step:.0}")))
                text.mid x=(px((LEFT + RIGHT) / 2.0)) y=(px(HEIGHT - 2.0)) { "step" }
                path.accumulated d=(line(accumulated)) {}
                @for step in steps {
                    g {
                        title { (hover(step)) }
                        @if let Some(db) = finite(step.sqnr_db) {
                            circle.accumulated cx=(px(at(step))) cy=(px(y.at(db))) r="2" {}
                        }
                        @if let Some(db) = finite(step.local_sqnr_db) {
                            use href={ "#" (symbol(&step.op)) } x=(px(at(step))) y=(px(y.at(db))) {}
                        }
                    }
                }
                @for (number, (step, db)) in lowest(steps, |step| finite(step.local_sqnr_db)).into_iter().enumerate() {
                    text.rank x=(px(at(step))) y=(px(y.at(db) + 16.0)) { (number + 1) }
                }
            }
        }
    }
}

fn hover(step: &StepReport) -> String {
    format!(
        "{} {} ({}, {}): alone {}, accumulated {}",
        step.position,
        step.step,
        step.op,
        step.element,
        decibels(step.local_sqnr_db),
        decibels(step.sqnr_db)
    )
}

/// Runs of steps of one stage, every other one shaded; named where there is room, and in the hover text.
fn stages(steps: &[StepReport], x: &Axis) -> Markup {
    let runs: Vec<&[StepReport]> = steps.chunk_by(|a, b| a.stage() == b.stage()).collect();
    html! {
        @for (number, run) in runs.iter().enumerate() {
            @let first = x.at(run[0].position as f64 - 0.5);
            @let width = x.at(run[run.len() - 1].position as f64 + 0.5) - first;
            @let name = run[0].stage();
            @let short = name.rsplit('.').next().unwrap_or(name);
            g.stage {
                title { (name) }
                rect.odd[number % 2 == 1] x=(px(first)) y=(px(TOP)) width=(px(width)) height=(px(BOTTOM - TOP)) {}
                @if short.len() as f64 * CHARACTER < width {
                    text.mid x=(px(first + width / 2.0)) y=(px(TOP - 8.0)) { (short) }
                }
            }
        }
    }
}

/// Shape of an operator's mark.
fn symbol(op: &str) -> &'static str {
    match op {
        "conv2d" | "depthwise_conv2d" => "m-conv",
        "linear" => "m-linear",
        "layer_norm" => "m-norm",
        "attention" => "m-attention",
        _ => "m-other",
    }
}

const SYMBOLS: [(&str, &str, &str); 5] = [
    ("m-conv", "convolution", "M-3.5,0a3.5,3.5 0 1 0 7,0a3.5,3.5 0 1 0 -7,0z"),
    ("m-linear", "linear", "M-3,-3h6v6h-6z"),
    ("m-norm", "layer norm", "M0,-4.5L4.5,0L0,4.5L-4.5,0z"),
    ("m-attention", "attention", "M0,-4L4,3.5H-4z"),
    ("m-other", "other", "M-3.5,-3.5L3.5,3.5M3.5,-3.5L-3.5,3.5"),
];

fn symbols() -> Markup {
    html! {
        defs { @for (id, _, path) in SYMBOLS { path.mark id=(id) d=(path) {} } }
    }
}

fn legend() -> Markup {
    html! {
        p.legend {
            span { svg viewBox="-12 -6 24 12" width="24" height="12" aria-hidden="true" {
                path.accumulated d="M-12,0H12" {} circle.accumulated cx="0" cy="0" r="2" {} } " accumulated" }
            @for (_, name, path) in SYMBOLS {
                span { svg viewBox="-6 -6 12 12" width="12" height="12" aria-hidden="true" { path.mark d=(path) {} }
                    " " (name) " alone" }
            }
        }
    }
}

fn points(steps: &[StepReport]) -> Markup {
    let row = |step: &StepReport| {
        vec![
            step.step.clone(),
            step.op.clone().into_owned(),
            step.stage().to_owned(),
            step.position.to_string(),
            figure(step.local_sqnr_db, 1),
            figure(step.sqnr_db, 1),
        ]
    };
    let rows: Vec<_> = steps.iter().map(row).collect();
    table(&["step", "operator", "stage", "position", "alone dB", "accumulated dB"], 3, &rows)
}
