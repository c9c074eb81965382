//! Distribution of a tensor: f32 against integers, with the lines where codes end.

use super::plot::px;
use crate::histogram::Histogram;
use crate::report::StepReport;
use crate::report::figures::value;
use maud::{Markup, html};

/// Ten units per bin: with whole coordinates, paths are short.
const WIDTH: f64 = 640.0;
const HEIGHT: f64 = 180.0;
const TOP: f64 = 14.0;
const BOTTOM: f64 = HEIGHT - 20.0;

/// The plot; counts are logarithmic.
pub(super) fn plot(step: &StepReport, histogram: &Histogram) -> Markup {
    let bins = histogram.codes.len().max(1);
    let most = histogram.float.iter().chain(&histogram.codes).copied().max().unwrap_or(0).max(1);
    let decades = (most as f64).log10().max(1.0);
    let height = |count: u64| match count {
        0 => BOTTOM,
        // A single value stays visible.
        count => (BOTTOM - (BOTTOM - TOP) * (0.03 + 0.97 * (count as f64).log10() / decades)).round(),
    };
    let end = histogram.first + histogram.width * bins as f64;
    let x = |value: f64| WIDTH * (value - histogram.first) / (end - histogram.first);
    let inside = |value: &&f64| (histogram.first..=end).contains(*value);
    html! {
        svg.histogram viewBox={ "0 0 " (WIDTH) " " (HEIGHT) } role="img"
            aria-label={ "Distribution of " (step.tensor) " in f32 and in integers" } {
            @if !histogram.float.is_empty() { path.float d=(outline(&histogram.float, height, true)) {} }
            path.codes d=(outline(&histogram.codes, height, false)) {}
            path.axis d={ "M0," (px(BOTTOM)) "H" (WIDTH) } {}
            @for clip in step.clip.iter().filter(inside) {
                path.clip d={ "M" (px(x(*clip))) "," (px(TOP - 8.0)) "V" (px(BOTTOM)) } {}
            }
            text x="0" y=(px(HEIGHT - 5.0)) { (value(histogram.first)) }
            @if histogram.first < 0.0 && x(0.0) > 70.0 && x(0.0) < WIDTH - 70.0 {
                text.mid x=(px(x(0.0))) y=(px(HEIGHT - 5.0)) { "0" }
            }
            text.end x=(WIDTH) y=(px(HEIGHT - 5.0)) { (value(end)) }
        }
    }
}

/// Steps over the bins: relative moves are short. `closed` goes down to the axis, to be filled.
fn outline(counts: &[u64], height: impl Fn(u64) -> f64, closed: bool) -> String {
    let width = WIDTH / counts.len().max(1) as f64;
    let mut path = format!("M0,{}", if closed { px(BOTTOM) } else { px(height(counts[0])) });
    let mut last = None;
    for (bin, &count) in counts.iter().enumerate() {
        let y = px(height(count));
        if last.as_ref() != Some(&y) {
            if bin > 0 {
                path += &format!("H{}", px(width * bin as f64));
            }
            path += &format!("V{y}");
            last = Some(y);
        }
    }
    path += &format!("H{}", px(WIDTH));
    if closed {
        path += &format!("V{}z", px(BOTTOM));
    }
    path
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn equal_bins_share_a_line() {
        let path = outline(&[0, 7, 7, 0], |count| BOTTOM - count as f64, false);
        assert_eq!(path, "M0,160V160H160V153H480V160H640");
    }
}
