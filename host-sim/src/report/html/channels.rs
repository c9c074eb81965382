//! How evenly the output channels of weighted steps use the one scale of their tensor.

use super::plot::px;
use super::table;
use crate::channels::Channels;
use crate::report::StepReport;
use crate::report::figures::{figure, value};
use maud::{Markup, html};

const WIDTH: f64 = 640.0;
const HEIGHT: f64 = 150.0;
const TOP: f64 = 6.0;
const BOTTOM: f64 = HEIGHT - 18.0;
/// Channels that a plot shows; of more, evenly spaced ones.
const SHOWN: usize = 80;
/// Steps in the table.
const WIDEST: usize = 20;

pub(super) fn section(steps: &[StepReport]) -> Markup {
    let spread = |step: &StepReport| {
        let channels = step.channels.as_ref()?;
        Some((step.clone(), channels.unused_bits()?, channels.weight_spread_bits()))
    };
    let mut spreads: Vec<_> = steps.iter().filter_map(spread).collect();
    if spreads.is_empty() {
        return html! {};
    }
    spreads.sort_by(|a, b| b.1.total_cmp(&a.1));
    let row = |(step, outputs, weights): &(StepReport, f64, Option<f64>)| {
        let channels = step.channels.as_ref();
        let mut widths = channels.map(Channels::widths).unwrap_or_default();
        widths.sort_by(f32::total_cmp);
        let width = |index: usize| widths.get(index).map_or("–".to_owned(), |&w| value(w.into()));
        vec![
            step.step.clone(),
            step.op.clone().into_owned(),
            widths.len().to_string(),
            width(0),
            width(widths.len() / 2),
            width(widths.len().saturating_sub(1)),
            figure(Some(*outputs), 1),
            figure(*weights, 1),
        ]
    };
    let rows: Vec<_> = spreads.iter().take(WIDEST).map(row).collect();
    let header = [
        "step",
        "operator",
        "channels",
        "narrowest",
        "median",
        "widest",
        "output spread, bits",
        "weight scale spread, bits",
    ];
    let about = html! {
        "All output channels of a step share one scale. Where the widest channel is 2" sup { "b" } " times as wide as "
        "the median one, half of the channels give away b bits of the type or more. Weights have a scale per channel, "
        "so their spread costs nothing. The " (rows.len()) " steps with the widest output spread of " (spreads.len()) ":"
    };
    super::section("channels", "Spread of the channels", &about, &table(&header, 2, &rows))
}

/// A bar from the lowest to the highest value per channel, narrowest first.
pub(super) fn plot(step: &StepReport, channels: &Channels) -> Markup {
    let mut order: Vec<usize> = (0..channels.min.len()).collect();
    let widths = channels.widths();
    order.sort_by(|&a, &b| widths[a].total_cmp(&widths[b]));
    let count = order.len().min(SHOWN);
    let picked: Vec<usize> = (0..count).map(|i| order[i * (order.len() - 1) / (count - 1).max(1)]).collect();
    let low = picked.iter().map(|&c| channels.min[c]).fold(0.0, f32::min);
    let high = picked.iter().map(|&c| channels.max[c]).fold(0.0, f32::max);
    let y = super::plot::Axis::new([low.into(), high.into()], [BOTTOM, TOP]);
    let pitch = WIDTH / count.max(1) as f64;
    let bar = |(index, &channel): (usize, &usize)| {
        let [min, max] = [channels.min[channel], channels.max[channel]].map(|value| y.at(value.into()).round());
        format!("M{},{}V{}", px(((index as f64 + 0.5) * pitch).round()), px(min), px(max.min(min - 1.0)))
    };
    let bars: String = picked.iter().enumerate().map(bar).collect();
    let all = channels.min.len();
    html! {
        svg.channels viewBox={ "0 0 " (WIDTH) " " (HEIGHT) } role="img"
            aria-label={ "Range of each output channel of " (step.step) } {
            path.grid d={ "M0," (px(y.at(0.0))) "H" (WIDTH) } {}
            path.bars d=(bars) stroke-width=(px((0.7 * pitch).min(10.0))) {}
            text x="0" y=(px(HEIGHT - 4.0)) {
                @if count < all { (count) " of " (all) " channels, evenly picked" } @else { (all) " channels" }
                ", from " (value(low.into())) " to " (value(high.into()))
            }
        }
    }
}
