//! A run on a board as text.

use super::table;
use crate::hil::report::{HilFrame, HilReport, LinkFigures, Spread, StepTimes};
use crate::hil::update::{InstalledImage, UpdateReport};
use crate::report::figures::figure;
use std::fmt::Write;

/// A line per frame and, where they were asked for, per step; the summary below.
pub fn hil(report: &HilReport) -> String {
    let HilReport { model, board, unit, .. } = report;
    let sha256 = model.sha256.get(..16).unwrap_or_default();
    let mut text = format!("{} (sha256 {sha256}…) on board {}\n\n", model.name, board.name);
    let _ = writeln!(text, "{}\n", frames(report));
    if !report.steps.is_empty() {
        let _ = writeln!(text, "{}\n", steps(&report.steps, unit.name()));
    }
    text + &summary(report)
}

/// An update in a few lines.
pub fn update(report: &UpdateReport) -> String {
    let UpdateReport { board, before, after, bytes_sent, line_s, .. } = report;
    let shown = |image: &InstalledImage| {
        let InstalledImage { model, revision, target, qmodel_sha256, bytes } = image;
        let digest = qmodel_sha256.get(..16).unwrap_or_default();
        format!("{model}, revision {revision}, for {target}, {bytes} bytes, quantized model {digest}…")
    };
    let before = before.as_ref().map_or_else(|| "no image".to_owned(), shown);
    format!(
        "{board}\n  before  {before}\n  now     {}, confirmed\n  {bytes_sent} bytes sent, {} s on the line\n",
        shown(after),
        figure(Some(*line_s), 1)
    )
}

fn frames(report: &HilReport) -> String {
    let header = ["frame", "equal", "status", "steer", "throttle", "brake", "answer", report.unit.name(), "bytes sent"];
    let header = header.map(str::to_owned).into_iter().chain([format!("s at {} baud", report.baud)]);
    let row = |frame: &HilFrame| {
        vec![
            frame.name.clone(),
            if frame.equal { "yes" } else { "NO" }.to_owned(),
            frame.status.clone(),
            figure(Some(frame.steer), 3),
            figure(Some(frame.throttle), 3),
            figure(Some(frame.brake), 3),
            answer(frame),
            frame.network.map_or("–".to_owned(), |time| time.to_string()),
            frame.bytes_sent.to_string(),
            figure(Some(frame.line_s), 2),
        ]
    };
    table(header.collect(), &[0, 1, 2, 6], report.frames.iter().map(row))
}

/// Places in the order of time, or the class.
fn answer(frame: &HilFrame) -> String {
    let digits = if frame.waypoints.is_some() { 2 } else { 1 };
    let places = frame.waypoints.as_ref().or(frame.points_px.as_ref());
    let place = |[x, y]: &[f64; 2]| format!("({}, {})", figure(Some(*x), digits), figure(Some(*y), digits));
    match (places, frame.top1) {
        (Some(places), _) => places.iter().map(place).collect::<Vec<_>>().join(" "),
        (None, Some(class)) => format!("class {class}"),
        (None, None) => "–".to_owned(),
    }
}

fn steps(steps: &[StepTimes], unit: &str) -> String {
    let header = ["step".to_owned(), "op".to_owned(), format!("mean {unit}"), "min".to_owned(), "max".to_owned()];
    let row = |step: &StepTimes| {
        let Spread { mean, min, max } = step.times;
        vec![step.position.to_string(), step.op.clone(), figure(Some(mean), 0), min.to_string(), max.to_string()]
    };
    table(header.to_vec(), &[1], steps.iter().map(row))
}

fn summary(report: &HilReport) -> String {
    let (summary, unit) = (&report.summary, report.unit.name());
    let mut text = String::new();
    let mut line = |what: &str, said: String| {
        let _ = writeln!(text, "{what:22} {said}");
    };
    line("frames", format!("{} of {} equal", summary.equal, summary.frames));
    match (summary.bytes_compared, summary.steps_compared) {
        (0, _) => line("compared", "status, controls and waypoints, bit for bit".to_owned()),
        (bytes, 0) => line("compared", format!("{bytes} B of outputs, status and controls")),
        (bytes, steps) => line("compared", format!("{bytes} B of outputs, {steps} CRCs of steps, status and controls")),
    }
    if let Some(Spread { mean, min, max }) = summary.network {
        line("network", format!("{} {unit} on average, {min} to {max}", figure(Some(mean), 0)));
    }
    line(
        "start",
        format!("{} {unit} for the image's structure, {} for its bytes", report.board.parse, report.board.check),
    );
    line("known answers met", summary.self_tests.to_string());
    if let Some(bytes) = summary.stack_bytes {
        line("deepest stack", format!("{bytes} B"));
    }
    let LinkFigures { packets, damaged, lost, repeated, overflowed, incomplete_frames, abandoned_frames } =
        summary.link;
    line("packets to the board", format!("{packets}: {damaged} damaged, {lost} lost, {repeated} repeated"));
    line(
        "line",
        format!("{overflowed} B overflowed, {incomplete_frames} frames incomplete, {abandoned_frames} abandoned"),
    );
    text
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::hil::report::{BoardInfo, SCHEMA, Summary, TimeUnit};
    use crate::run::ModelInfo;

    #[test]
    fn frames_and_steps_stand_above_their_summary() {
        let frame = |name: &str, equal, waypoints, top1| HilFrame {
            name: name.into(),
            equal,
            status: "driving".into(),
            status_code: 0,
            steer: -0.25,
            throttle: 0.75,
            brake: 0.0,
            waypoints,
            points_px: None,
            top1,
            network: top1.is_none().then_some(470_000_000),
            bytes_sent: 23040,
            line_s: 2.0,
        };
        let times = Spread::of([7, 9]).unwrap();
        let mut report = HilReport {
            schema: SCHEMA,
            model: ModelInfo { name: "mini".into(), sha256: "ab".repeat(32) },
            board: BoardInfo { name: "an386".into(), hertz: 1000, parse: 5, check: 6 },
            unit: TimeUnit::Instructions,
            baud: 115_200,
            frames: vec![frame("a", true, Some(vec![[0.5, -2.0]]), None), frame("b", false, None, Some(3))],
            steps: vec![StepTimes { position: 4, op: "conv2d".into(), times }],
            summary: Summary { frames: 2, equal: 1, bytes_compared: 32, network: Some(times), ..Summary::default() },
            difference: None,
            failure: None,
        };
        let text = hil(&report);
        let lines: Vec<String> = text.lines().map(|l| l.split_whitespace().collect::<Vec<_>>().join(" ")).collect();
        assert_eq!(lines[0], "mini (sha256 abababababababab…) on board an386");
        assert_eq!(lines[3], "a yes driving −0.250 0.750 0.000 (0.50, −2.00) 470000000 23040 2.00");
        assert_eq!(lines[4], "b NO driving −0.250 0.750 0.000 class 3 – 23040 2.00");
        assert_eq!(lines[7], "4 conv2d 8 7 9");
        for line in ["frames 1 of 2 equal", "compared 32 B of outputs, status and controls"] {
            assert!(lines.iter().any(|found| found == line), "{line} in\n{text}");
        }
        report.summary.stack_bytes = Some(4096);
        assert!(hil(&report).contains("4096 B"));
    }
}
