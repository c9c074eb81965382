//! What a classifier says, for people.

use super::figures::figure;
use super::terminal::table;
use crate::ablation::Row;
use crate::classification::{Accuracy, Classification, ClassificationSummary};
use crate::run::{Output, RunReport};
use std::fmt::Write;

/// More frames than this are only summed up.
const LONGEST_TABLE: usize = 20;

/// The class of every frame, where they are few, and how often it is right.
pub(super) fn run(report: &RunReport) -> String {
    let class = |class: usize| match report.class_names.get(&class) {
        Some(name) => format!("{class} {name}"),
        None => class.to_string(),
    };
    let row = |(name, seen): (&String, &Classification)| {
        let logit = seen.logits.get(seen.top1).map_or(f64::NAN, |&logit| logit);
        let label = seen.label.map(class).unwrap_or_default();
        let right = seen.is_right().map(|right| if right { "yes" } else { "NO" }).unwrap_or_default();
        let others = seen.top5.iter().flatten().skip(1).map(|&c| class(c)).collect::<Vec<_>>().join(", ");
        vec![name.clone(), class(seen.top1), format!("{logit:.3}"), label, right.to_owned(), others]
    };
    let seen = report.frames.iter().filter_map(|frame| match &frame.output {
        Output::Class(seen) => Some((&frame.name, seen)),
        Output::Waypoints { .. } | Output::Controls(_) | Output::Points { .. } => None,
    });
    let mut text = String::new();
    if report.frames.len() <= LONGEST_TABLE {
        let header = ["frame", "class", "logit", "label", "right", "then"].map(str::to_owned).to_vec();
        let _ = writeln!(text, "{}\n", table(header, &[0, 1, 3, 4, 5], seen.map(row)));
    }
    let _ = match &report.accuracy {
        Some(accuracy) => write!(text, "{}", self::accuracy("", accuracy)),
        None => writeln!(text, "{} frames without labels", report.frames.len()),
    };
    text
}

/// A line per figure of a classifier's verification.
pub(super) fn verify(found: &ClassificationSummary) -> String {
    let mut text = String::new();
    if let Some(db) = found.logits_sqnr_db {
        let _ = writeln!(text, "logits                 {} dB SQNR against f32", figure(Some(db), 2));
    }
    for (network, accuracy) in [("int8", &found.int8), ("f32", &found.float)] {
        text += &accuracy.as_ref().map(|accuracy| self::accuracy(network, accuracy)).unwrap_or_default();
    }
    if let Some(agreement) = &found.agreement {
        let share = share(agreement.share, agreement.interval);
        let _ = writeln!(text, "same class             {share} of {} frames", agreement.frames);
    }
    if let (Some(int8), Some(float)) = (found.only_int8_right, found.only_f32_right) {
        let _ = writeln!(text, "only one is right      int8 on {int8} frames, f32 on {float}");
    }
    text
}

/// One line per variant of the quantizer.
pub(super) fn ablation(rows: &[Row]) -> String {
    let header = ["variant", "vector dB", "logits dB", "same class %", "top-1 %"].map(str::to_owned).to_vec();
    let line = |row: &Row| {
        let found = row.fidelity.classes.as_ref();
        let percent = |share: Option<f64>| figure(share.map(|share| 100.0 * share), 2);
        vec![
            row.variant.to_owned(),
            figure(Some(row.fidelity.vector_sqnr_db), 2),
            figure(found.and_then(|f| f.logits_sqnr_db), 2),
            percent(found.and_then(|f| Some(f.agreement.as_ref()?.share))),
            percent(found.and_then(|f| Some(f.int8.as_ref()?.top1))),
        ]
    };
    let float = rows.first().and_then(|row| row.fidelity.classes.as_ref()?.float.as_ref());
    let below = float.map(|float| self::accuracy("f32", float)).unwrap_or_default();
    format!("{}\n{below}", table(header, &[0], rows.iter().map(line)))
}

fn accuracy(network: &str, accuracy: &Accuracy) -> String {
    let share = share(accuracy.top1, accuracy.interval);
    let top5 = accuracy.top5.map(|top5| format!(", top-5 {:.2} %", 100.0 * top5)).unwrap_or_default();
    let name = format!("top-1 {network}");
    format!("{:<22} {share} of {} frames{top5}\n", name.trim_end(), accuracy.frames)
}

fn share(value: f64, [low, high]: [f64; 2]) -> String {
    format!("{:.2} % (95 % interval {:.2} to {:.2} %)", 100.0 * value, 100.0 * low, 100.0 * high)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::classification::Comparison;
    use crate::run::{FrameResult, ModelInfo};
    use model_compiler::frames::{Frame, Label};

    fn report(frames: usize, label: Option<u16>) -> RunReport {
        let label = label.map(|class| Label { class, name: String::new() });
        let frame = Frame { name: "a.png".into(), label, ..Frame::default() };
        let logits = vec![0.0, 1.0, 2.0, 9.25, 4.0, 5.0];
        let output = Output::Class(Classification::new(logits, &frame));
        let result = FrameResult { name: frame.name, output };
        let model = ModelInfo { name: "mini".into(), sha256: "ab".repeat(32) };
        let mut report = RunReport::new(model, vec![result; frames]);
        report.class_names.insert(3, "cat".into());
        report
    }

    #[test]
    fn few_frames_are_listed_and_many_are_summed_up() {
        let text = run(&report(1, Some(5)));
        let row = text.lines().nth(1).unwrap().split_whitespace().collect::<Vec<_>>().join(" ");
        assert_eq!(row, "a.png 3 cat 9.250 5 NO 5, 4, 2, 1");
        assert!(
            text.contains("top-1                  0.00 % (95 % interval 0.00 to 79.35 %) of 1 frames, top-5 100.00 %")
        );
        let text = run(&report(21, Some(3)));
        assert!(text.starts_with("top-1                  100.00 %") && !text.contains("a.png"), "{text}");
        assert!(run(&report(2, None)).ends_with("2 frames without labels\n"));
    }

    #[test]
    fn a_verification_compares_both_networks() {
        let mut comparison = Comparison::default();
        let label = Some(Label { class: 0, name: String::new() });
        let frame = Frame { label, ..Frame::default() };
        comparison.add(&frame, &[3.0, 4.5], Some(&[4.0, 3.0]));
        let text = verify(&comparison.summary().unwrap());
        for line in [
            "logits                 8.86 dB SQNR",
            "top-1 int8             0.00 %",
            "top-1 f32              100.00 %",
            "same class             0.00 %",
            "only one is right      int8 on 0 frames, f32 on 1",
        ] {
            assert!(text.contains(line), "{line:?} in\n{text}");
        }
    }
}
