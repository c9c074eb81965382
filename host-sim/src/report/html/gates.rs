//! Gates and what they met.

use super::table;
use crate::gates::GateOutcome;
use maud::{Markup, html};

pub(super) fn section(gates: &[GateOutcome]) -> Markup {
    if gates.is_empty() {
        return html! {};
    }
    let row = |gate: &GateOutcome| {
        let verdict = if gate.met { "✓ met" } else { "✗ missed" };
        vec![verdict.to_owned(), gate.gate.clone(), gate.place.clone().unwrap_or_default(), gate.words()]
    };
    let rows: Vec<_> = gates.iter().map(row).collect();
    let about =
        html! { "Limits that this report was asked to keep. A missed one fails the command with exit status 1." };
    super::section("gates", "Gates", &about, &table(&["verdict", "gate", "nearest", "figure"], 4, &rows))
}
