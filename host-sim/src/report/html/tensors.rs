//! A card for every step's tensor: its distribution, and the ranges of its channels.

use super::{channels, histogram};
use crate::report::StepReport;
use crate::report::figures::{decibels, figure, shape, value};
use maud::{Markup, html};

pub(super) fn section(steps: &[StepReport]) -> Markup {
    let shown = || steps.iter().filter_map(|step| Some((step, step.histogram.as_ref()?)));
    if shown().next().is_none() {
        return html! {};
    }
    let about = html! {
        "Distribution of every step's values: the " b { "filled area" } " is the f32 network, the " b { "line" } " the "
        "engine's integers, the " b { "dashed lines" } " the least and greatest value that a code can hold. Counts are "
        "logarithmic. What lies beyond a dashed line is clipped. Below it, for a weighted step, the range of each output "
        "channel, narrowest first: a channel much narrower than the widest uses few of the codes. The counts are in "
        code { "report.json" } "."
    };
    let content = html! {
        div #tensor-list {
            @for (step, counts) in shown() {
                details.tensor {
                    summary { span.number { (step.position) } " " (step.step) " " span.note { (step.op) " " (step.element) } }
                    div.card {
                        (histogram::plot(step, counts))
                        (facts(step))
                        @if let Some(ranges) = &step.channels { (channels::plot(step, ranges)) }
                    }
                }
            }
        }
    };
    super::section("tensors", "Values of every tensor", &about, &content)
}

fn facts(step: &StepReport) -> Markup {
    let saturated = step.saturation_ppm.map(|ppm| format!("{} ppm", figure(Some(ppm), 0)));
    html! {
        dl.facts {
            dt { "tensor" } dd { (step.tensor) }
            dt { "shape" } dd { (shape(step.shape)) " " (step.element) }
            dt { "codes hold" } dd { (value(step.clip[0])) " … " (value(step.clip[1])) }
            dt { "scale" } dd { (value(step.scale)) ", zero point " (step.zero_point) }
            dt { "saturated" } dd { (saturated.unwrap_or("cannot".to_owned())) }
            dt { "SQNR" } dd { "alone " (decibels(step.local_sqnr_db)) ", accumulated " (decibels(step.sqnr_db)) }
        }
    }
}
