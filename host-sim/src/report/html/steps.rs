//! Every figure of every step.

use super::{data, table};
use crate::report::StepReport;
use crate::report::figures::{figure, shape, value};
use maud::{Markup, html};

const HEADER: [&str; 14] = [
    "step", "op", "type", "", "shape", "scale", "alone dB", "SQNR dB", "cosine", "max LSB", "clip ppm", "headroom",
    "bytes", "equal",
];

pub(super) fn section(steps: &[StepReport]) -> Markup {
    let rows: Vec<_> = steps.iter().map(row).collect();
    let about = html! {
        "SQNR alone and accumulated as above; the largest error of the step alone in units of its scale; codes at a bound "
        "that is no ReLU's, per million; spare bits of the tightest intermediate; whether the engine's bytes are those of "
        "the f64 model. A click on a column's name sorts."
    };
    super::section("steps", "Every step", &about, &data("Table of all steps", &table(&HEADER, 3, &rows)))
}

fn row(step: &StepReport) -> Vec<String> {
    vec![
        step.step.clone(),
        step.op.clone().into_owned(),
        step.element.clone().into_owned(),
        step.position.to_string(),
        shape(step.shape),
        value(step.scale),
        figure(step.local_sqnr_db, 1),
        figure(step.sqnr_db, 1),
        figure(step.cosine, 5),
        figure(step.max_error_lsb, 2),
        figure(step.saturation_ppm, 0),
        step.headroom_bits.to_string(),
        step.bytes.to_string(),
        if step.bytes_equal { "yes" } else { "NO" }.to_owned(),
    ]
}
