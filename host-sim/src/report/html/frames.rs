//! Figures per frame, the worst first.

use super::table;
use crate::report::FrameReport;
use crate::report::controls::DIGITS;
use crate::report::figures::figure;
use maud::{Markup, html};

/// Frames in the table.
const SHOWN: usize = 200;

pub(super) fn section(frames: &[FrameReport]) -> Markup {
    if frames.iter().all(|frame| frame.worst_sqnr_db.is_none()) {
        return html! {};
    }
    let mut sorted: Vec<&FrameReport> = frames.iter().collect();
    sorted.sort_by(|a, b| b.badness().total_cmp(&a.badness()));
    let row = |frame: &&FrameReport| {
        let waypoints = frame.waypoint_error_mm.iter().map(|&mm| figure(Some(mm), 0));
        let controls = frame.control_errors().into_iter().map(|(_, error)| figure(Some(error), DIGITS));
        let points = frame.point_error_px.iter().map(|&pixels| figure(Some(pixels), 2));
        let errors: Vec<String> = waypoints.chain(controls).chain(points).collect();
        vec![
            frame.name.clone(),
            if frame.calibration { "yes" } else { "no" }.to_owned(),
            frame.worst_step.clone().unwrap_or_default(),
            figure(frame.worst_sqnr_db, 1),
            figure(frame.vector_sqnr_db, 1),
            figure(frame.output_sqnr_db, 1),
            errors.join(", "),
        ]
    };
    let rows: Vec<_> = sorted.iter().take(SHOWN).map(row).collect();
    let any = |has: fn(&FrameReport) -> bool| frames.iter().any(has);
    let error = if any(|frame| frame.control.is_some()) {
        "error of steer, throttle, brake, speed"
    } else if any(|frame| frame.points.is_some()) {
        "point error, px"
    } else {
        "waypoint error, mm"
    };
    let header = ["frame", "calibration", "worst step", "its dB", "pooled vector, dB", "first output, dB", error];
    let about = html! {
        "Figures of every frame by itself, the worst first."
        @if sorted.len() > SHOWN { " Shown are " (SHOWN) " of " (sorted.len()) " frames." }
    };
    super::section("frames", "Frames", &about, &table(&header, 3, &rows))
}
