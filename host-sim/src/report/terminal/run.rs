//! What networks give for frames, as text.

use super::table;
use crate::controls::{ControlPrediction, Controls};
use crate::report::{classes, controls};
use crate::run::{FrameResult, Output, RunReport};

/// Waypoints, controls, points or classes of every frame.
pub fn run(report: &RunReport) -> String {
    let head = format!("{} (sha256 {}…)", report.model.name, &report.model.sha256[..16]);
    let given: Vec<_> = report.frames.iter().filter_map(given).collect();
    if !given.is_empty() {
        return format!("{head}, controls as the network gives them\n\n{}", controls::run(&given));
    }
    let driven: Vec<_> = report.frames.iter().filter_map(Driven::of).collect();
    if driven.is_empty() {
        return format!("{head}\n\n{}", classes::run(report));
    }
    let points = report.frames.iter().any(|frame| matches!(frame.output, Output::Points { .. }));
    let (axes, unit) = match points {
        true => (["x", "y"], "points from −1 (left, top) to 1 (right, bottom)"),
        false => (["right", "forward"], "waypoints in meters"),
    };
    let controlled = driven.iter().any(|frame| frame.controls.is_some());
    let source = if controlled { ", controls of a controller in its fresh state" } else { "" };
    format!("{head}, {unit}{source}\n\n{}\n", places(&driven, axes, controlled))
}

fn given(frame: &FrameResult) -> Option<(&str, &ControlPrediction)> {
    match &frame.output {
        Output::Controls(prediction) => Some((&frame.name, prediction)),
        Output::Waypoints { .. } | Output::Points { .. } | Output::Class(_) => None,
    }
}

/// A frame with places to drive to.
struct Driven<'r> {
    name: &'r str,
    places: &'r [[f64; 2]],
    controls: Option<Controls>,
}

impl<'r> Driven<'r> {
    fn of(frame: &'r FrameResult) -> Option<Self> {
        match &frame.output {
            Output::Waypoints { waypoints: places, controls } | Output::Points { points: places, controls } => {
                Some(Self { name: &frame.name, places, controls: *controls })
            }
            Output::Controls(_) | Output::Class(_) => None,
        }
    }
}

/// A line per frame: its places, and how to drive there if that is known of any frame.
fn places(frames: &[Driven<'_>], axes: [&str; 2], controlled: bool) -> String {
    let longest = frames.iter().map(|frame| frame.places.len()).max().unwrap_or(0);
    let places = (1..=longest).flat_map(|k| axes.map(|axis| format!("{axis} {k}")));
    let controls = if controlled { &["steer", "throttle", "brake"][..] } else { &[] };
    let header = ["frame".to_owned()].into_iter().chain(places).chain(controls.iter().map(|&name| name.into()));
    let row = |frame: &Driven<'_>| {
        let number = |value: &f64| format!("{value:.3}");
        let controls = match &frame.controls {
            _ if !controlled => vec![],
            Some(Controls { steer, throttle, brake }) => [steer, throttle, brake].map(number).to_vec(),
            None => vec!["–".to_owned(); 3],
        };
        let places = frame.places.iter().flatten().map(number);
        [frame.name.to_owned()].into_iter().chain(places).chain(controls).collect()
    };
    table(header.collect(), &[0], frames.iter().map(row))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::run::ModelInfo;

    #[test]
    fn waypoints_stand_in_columns() {
        let model = ModelInfo { name: "mini".into(), sha256: "ab".repeat(32) };
        let frame = |name: &str, x: f64| {
            let waypoints = vec![[x, 2.0], [-x, 14.25]];
            FrameResult { name: name.into(), output: Output::Waypoints { waypoints, controls: None } }
        };
        let text = run(&RunReport::new(model, vec![frame("a", 0.5), frame("long name", -10.0)]));
        let lines: Vec<&str> = text.lines().skip(2).collect();
        assert_eq!(
            lines[0].split_whitespace().collect::<Vec<_>>().join(" "),
            "frame right 1 forward 1 right 2 forward 2"
        );
        assert!(lines[1].ends_with("14.250") && lines[2].ends_with("14.250"));
        assert_eq!(lines[1].len(), lines[2].len(), "{text}");
        assert!(text.starts_with("mini (sha256 abababababababab…)"));
    }

    #[test]
    fn controls_stand_behind_the_waypoints_that_they_follow() {
        let model = ModelInfo { name: "mini".into(), sha256: "ab".repeat(32) };
        let frame = |name: &str, controls| {
            let output = Output::Waypoints { waypoints: vec![[0.5, 2.0]], controls };
            FrameResult { name: name.into(), output }
        };
        let controls = Some(Controls { steer: -0.25, throttle: 0.75, brake: 0.0 });
        let text = run(&RunReport::new(model, vec![frame("a", controls), frame("b", None)]));
        let words: Vec<Vec<&str>> = text.lines().map(|line| line.split_whitespace().collect()).collect();
        assert!(text.contains("in meters, controls of a controller in its fresh state"), "{text}");
        assert_eq!(words[2], ["frame", "right", "1", "forward", "1", "steer", "throttle", "brake"]);
        assert_eq!(words[3], ["a", "0.500", "2.000", "-0.250", "0.750", "0.000"]);
        assert_eq!(words[4], ["b", "0.500", "2.000", "–", "–", "–"]);
    }

    #[test]
    fn points_stand_in_columns() {
        let model = ModelInfo { name: "mini".into(), sha256: "ab".repeat(32) };
        let output = Output::Points { points: vec![[-0.5, 1.0], [0.25, 0.0]], controls: None };
        let text = run(&RunReport::new(model, vec![FrameResult { name: "a".into(), output }]));
        assert!(text.starts_with("mini (sha256 abababababababab…), points from −1 (left, top)"), "{text}");
        let words: Vec<Vec<&str>> = text.lines().skip(2).map(|line| line.split_whitespace().collect()).collect();
        assert_eq!(words[0], ["frame", "x", "1", "y", "1", "x", "2", "y", "2"]);
        assert_eq!(words[1], ["a", "-0.500", "1.000", "0.250", "0.000"]);
    }
}
