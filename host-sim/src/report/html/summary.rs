//! What ran, whether it passed, and the figures to remember.

use crate::report::VerifyReport;
use crate::report::controls::{DIGITS, titled};
use crate::report::figures::{bytes, decibels, figure};
use maud::{Markup, html};

pub(super) fn section(report: &VerifyReport) -> Markup {
    let summary = &report.summary;
    let mirrored = |name: &str| name.ends_with("(mirrored)");
    let mirror_images = report.frames.iter().filter(|frame| mirrored(&frame.name)).count();
    html! {
        header {
            p.kicker { "Verification of a model image" }
            h1 { (report.model.name) " " span.for { "for " (report.target) } }
            p.meta {
                "image sha256 " code title=(report.model.sha256) { (report.model.sha256.get(..16).unwrap_or("")) "…" }
                " · " (summary.steps) " steps · " (report.frames.len()) " frames"
                @if mirror_images > 0 { ", " (mirror_images) " of them mirror images" }
            }
            (verdict(report))
            @if report.untrained {
                p.notice { b { "Untrained network." } " Its weights are random numbers: what it computes means nothing, "
                    "only how exactly it is computed." }
            }
            (overlap(report))
            (dropped_points(report))
        }
        dl.figures {
            @for (name, value, note) in figures(report) {
                div { dt { (name) } dd { (value) @if !note.is_empty() { span.note { (note) } } } }
            }
        }
    }
}

fn verdict(report: &VerifyReport) -> Markup {
    let missed = report.gates.iter().filter(|gate| !gate.met).count();
    html! {
        div.verdict.failed[!report.passed] role="status" {
            strong { @if report.passed { "✓ Passed" } @else { "✗ Failed" } }
            span {
                @if report.bytes_equal {
                    "The engine wrote the f64 model's bytes in every step of every frame. "
                } @else {
                    "The engine's bytes differ from the f64 model's. "
                }
                @match (report.gates.len(), missed) {
                    (0, _) => "No gate was set.",
                    (gates, 0) => { (format!("All {gates} gates are met.")) },
                    (gates, missed) => { (format!("{missed} of {gates} gates are missed.")) },
                }
            }
            @if let Some(failure) = &report.failure {
                span.cause { (failure.location) ": " (failure.message) }
            }
        }
    }
}

/// Said loudly: figures on calibration frames flatter.
fn overlap(report: &VerifyReport) -> Markup {
    let known = &report.calibration_frames;
    html! {
        @if !known.is_empty() {
            p.notice {
                b { (known.len()) " of " (report.frames.len()) " frames are also calibration frames" }
                ", so figures against f32 flatter: " (known.join(", "))
            }
        }
    }
}

fn dropped_points(report: &VerifyReport) -> Markup {
    html! {
        @for frame in report.frames.iter().filter(|frame| frame.dropped_points > 0) {
            p.notice { "Frame " (frame.name) ": " (frame.dropped_points) " LiDAR points are not finite and were left out." }
        }
    }
}

/// Name, value and explanation of each key figure.
fn figures(report: &VerifyReport) -> Vec<(&'static str, String, String)> {
    let summary = &report.summary;
    let named = |name: &Option<String>| name.clone().unwrap_or_default();
    let mut figures = Vec::new();
    if summary.worst_sqnr_db.is_some() {
        figures.push(("Worst step", decibels(summary.worst_sqnr_db), named(&summary.worst_step)));
    }
    if summary.vector_sqnr_db.is_some() {
        figures.push(("Pooled vector", decibels(summary.vector_sqnr_db), named(&summary.vector_step)));
    }
    if summary.output_sqnr_db.is_some() {
        figures.push(("First output", decibels(summary.output_sqnr_db), named(&summary.output_step)));
    }
    if let Some(last) = summary.waypoint_error_mm.last() {
        let means: Vec<String> = summary.waypoint_error_mm.iter().map(|e| figure(Some(e.mean), 0)).collect();
        let note = format!("mean of waypoints 1 to {}; the last is {:.0} mm off at most", means.len(), last.max);
        figures.push(("Waypoint error", format!("{} mm", means.join(", ")), note));
    }
    if !summary.control_error.is_empty() {
        let means: Vec<String> = summary.control_error.iter().map(|e| figure(Some(e.mean), DIGITS)).collect();
        let names: Vec<String> = summary.control_error.iter().map(|e| titled(&e.name)).collect();
        figures.push(("Control error", means.join(", "), format!("mean of {}", names.join("; "))));
    }
    if let Some(last) = summary.point_error_px.last() {
        let means: Vec<String> = summary.point_error_px.iter().map(|e| figure(Some(e.mean), 2)).collect();
        let note = format!("mean of points 1 to {}; the last is {:.2} px off at most", means.len(), last.max);
        figures.push(("Point error", format!("{} px", means.join(", ")), note));
    }
    let arena = format!("bound {}: {}", bytes(summary.arena_bound_bytes), summary.arena_status.words());
    figures.push(("Arena", bytes(summary.arena_bytes), arena));
    figures.push(("Flash", bytes(summary.flash_bytes), String::new()));
    figures
}
