//! What a network that gives controls says, for people.

use super::figures::figure;
use super::terminal::table;
use crate::ablation::Row;
use crate::controls::{ControlError, ControlPrediction};
use std::fmt::Write;

/// Digits of a control.
pub(super) const DIGITS: usize = 4;

/// The controls of every frame.
pub(super) fn run(frames: &[(&str, &ControlPrediction)]) -> String {
    let header = ["frame".to_owned()].into_iter().chain(ControlPrediction::NAMES.map(titled)).collect();
    let row = |(name, prediction): &(&str, &ControlPrediction)| {
        let values = prediction.values().map(|(_, value)| figure(Some(value), DIGITS));
        [(*name).to_owned()].into_iter().chain(values).collect()
    };
    format!("{}\n", table(header, &[0], frames.iter().map(row)))
}

/// A line per control of a verification.
pub(super) fn verify(errors: &[ControlError]) -> String {
    let mut text = String::new();
    for ControlError { name, mean, max } in errors {
        let _ = writeln!(text, "{:<22} {mean:.DIGITS$} off on average, {max:.DIGITS$} at most", titled(name));
    }
    text
}

/// One line per variant of the quantizer.
pub(super) fn ablation(rows: &[Row]) -> String {
    let names: Vec<&str> = rows.iter().take(1).flat_map(|row| &row.fidelity.controls).map(|e| &*e.name).collect();
    let column = |what: &str| names.iter().map(|name| format!("{what} {}", titled(name))).collect::<Vec<_>>();
    let header = [vec!["variant".to_owned(), "vector dB".to_owned()], column("mean"), column("worst")].concat();
    let line = |row: &Row| {
        let errors = &row.fidelity.controls;
        let figures = errors.iter().map(|e| e.mean).chain(errors.iter().map(|e| e.max));
        let figures = figures.map(|error| figure(Some(error), DIGITS));
        [row.variant.to_owned(), figure(row.fidelity.vector_sqnr_db.into(), 2)].into_iter().chain(figures).collect()
    };
    format!("{}\n", table(header, &[0], rows.iter().map(line)))
}

/// The name of a value with its unit.
pub(super) fn titled(name: &str) -> String {
    match name {
        "predicted_speed" => "speed, m/s".to_owned(),
        control => control.to_owned(),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::ablation::Fidelity;
    use crate::controls::ControlComparison;
    use crate::controls::tests::prediction;

    fn words(text: &str) -> Vec<String> {
        text.lines().map(|line| line.split_whitespace().collect::<Vec<_>>().join(" ")).collect()
    }

    fn errors() -> Vec<ControlError> {
        let mut comparison = ControlComparison::default();
        comparison.add(&prediction(0.5), &prediction(0.25));
        comparison.add(&prediction(0.5), &prediction(0.5));
        comparison.summary()
    }

    #[test]
    fn frames_stand_below_each_other() {
        let found = words(&run(&[("a", &prediction(-0.25))]));
        assert_eq!(found[..2], ["frame steer throttle brake speed, m/s", "a −0.2500 0.3750 0.5000 4.0000"]);
    }

    #[test]
    fn errors_have_their_names() {
        assert_eq!(words(&verify(&errors()))[0], "steer 0.1250 off on average, 0.2500 at most");
        let fidelity = Fidelity {
            vector_sqnr_db: 30.0,
            mean_mm: vec![],
            worst_mm: vec![],
            controls: errors(),
            points: None,
            classes: None,
        };
        let found = words(&ablation(&[Row { variant: "8-bit maps", fidelity }]));
        assert!(found[0].starts_with("variant vector dB mean steer mean throttle"), "{found:?}");
        assert!(found[1].starts_with("8-bit maps 30.00 0.1250 0.0000"), "{found:?}");
    }
}
