//! Controls over time, int8 beside f32.

use super::plot::{Axis, LEFT, RIGHT, WIDTH, line, px};
use super::{data, table};
use crate::drive::{Decision, DriveReport, DriveStep};
use crate::report::figures::figure;
use maud::{Markup, html};

const HEIGHT: f64 = 190.0;
const TOP: f64 = 16.0;
const BOTTOM: f64 = HEIGHT - 34.0;

/// What is drawn of a step.
type Value = fn(&Decision) -> f64;

pub(super) fn summary(report: &DriveReport) -> Markup {
    let counts = &report.summary;
    let mut figures = vec![
        ("Steps", counts.steps.to_string(), "20 per second".to_owned()),
        ("Driven", counts.driven.to_string(), format!("{} in the safe state", counts.safe)),
    ];
    if let Some(difference) = &counts.difference {
        let most = |value: f64| format!("at most {}", figure(Some(value), 4));
        figures.push(("Steer apart, mean", figure(Some(difference.mean_steer), 4), most(difference.max_steer)));
        figures.push((
            "Throttle apart, mean",
            figure(Some(difference.mean_throttle), 4),
            most(difference.max_throttle),
        ));
        let agreement = format!("{} %", figure(Some(difference.brake_agreement_percent), 1));
        figures.push(("Brakes agree", agreement, format!("in {} steps that both drive", difference.steps)));
        if let (Some(mean), Some(max)) = (difference.mean_waypoint_distance_m, difference.max_waypoint_distance_m) {
            let millimeters = |meters: f64| format!("{} mm", figure(Some(1000.0 * meters), 0));
            figures.push((
                "Waypoints apart, mean",
                millimeters(mean),
                format!("at most {} in a step", millimeters(max)),
            ));
        }
    }
    html! {
        header {
            p.kicker { "A recorded sequence, driven" }
            h1 { (report.model.name) }
            p.meta {
                "image sha256 " code title=(report.model.sha256) { (report.model.sha256.get(..16).unwrap_or("")) "…" }
                @if let Some(reference) = &report.reference { " · beside the f32 network " (reference.name) }
            }
        }
        dl.figures {
            @for (name, value, note) in figures {
                div { dt { (name) } dd { (value) span.note { (note) } } }
            }
        }
    }
}

pub(super) fn controls(report: &DriveReport) -> Markup {
    let compared = report.reference.is_some();
    let about = html! {
        "What the actuators are told in every step: the integers (" b { "solid line" } ")"
        @if compared { " and the f32 network (" b { "dashed line" } "), each with a controller of its own" }
        ". Shaded steps are in the safe state or fill buffers. The loop is open: the recording goes its way."
    };
    let plots: [(&str, Value, [f64; 2]); 3] = [
        ("Steer", |d| d.steer, [-1.0, 1.0]),
        ("Throttle", |d| d.throttle, [0.0, 1.0]),
        ("Brake", |d| d.brake, [0.0, 1.0]),
    ];
    let content = html! {
        @for (name, value, range) in plots {
            h3 { (name) @if name == "Steer" { span.note { "right is up" } } }
            (plot(name, &report.steps, value, range))
        }
        (data("Every step as a table", &steps(report)))
    };
    super::section("controls", "Controls", &about, &content)
}

fn plot(name: &str, steps: &[DriveStep], value: Value, range: [f64; 2]) -> Markup {
    let end = steps.last().map_or(0.0, |step| step.time_s);
    let (x, y) = (Axis::new([0.0, end], [LEFT, RIGHT]), Axis::new(range, [BOTTOM, TOP]));
    let track = |of: fn(&DriveStep) -> Option<&Decision>| {
        line(steps.iter().map(|step| of(step).map(|decision| (x.at(step.time_s), y.at(value(decision))))))
    };
    let width = (RIGHT - LEFT) / steps.len().max(1) as f64;
    html! {
        figure.plot {
            svg viewBox={ "0 0 " (WIDTH) " " (HEIGHT) } role="img" aria-label={ (name) " over time" } {
                @for step in steps.iter().filter(|step| !step.int8.is_driving()) {
                    rect.safe x=(px(x.at(step.time_s))) y=(px(TOP)) width=(px(width)) height=(px(BOTTOM - TOP)) {
                        title { (step.name) ": " (step.int8.status) }
                    }
                }
                (y.grid(&y.ticks(4.0), |value| figure(Some(value), 1)))
                (x.labels(&x.ticks(10.0), HEIGHT - 16.0, |seconds| figure(Some(seconds), 1)))
                text.mid x=(px((LEFT + RIGHT) / 2.0)) y=(px(HEIGHT - 2.0)) { "s" }
                @if steps.iter().any(|step| step.float.is_some()) {
                    path.reference d=(track(|step| step.float.as_ref())) {}
                }
                path.engine d=(track(|step| Some(&step.int8))) {}
            }
        }
    }
}

fn steps(report: &DriveReport) -> Markup {
    let compared = report.reference.is_some();
    let mut header = vec!["step", "status", "time, s", "speed, m/s", "steer", "throttle", "brake"];
    if compared {
        header.extend(["f32: steer", "throttle", "brake", "waypoints apart, mm"]);
    }
    let values: [Value; 3] = [|d| d.steer, |d| d.throttle, |d| d.brake];
    let controls = |decision: Option<&Decision>| values.map(|value| figure(decision.map(value), 3));
    let row = |step: &DriveStep| {
        let mut row = vec![step.name.clone(), step.int8.status.clone()];
        row.extend([figure(Some(step.time_s), 2), figure(step.speed_mps, 2)]);
        row.extend(controls(Some(&step.int8)));
        if compared {
            row.extend(controls(step.float.as_ref()));
            row.push(figure(step.waypoint_distance_m.map(|meters| 1000.0 * meters), 0));
        }
        row
    };
    table(&header, 2, &report.steps.iter().map(row).collect::<Vec<_>>())
}
