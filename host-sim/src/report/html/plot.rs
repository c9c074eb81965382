//! Axes and paths of the plots.

use maud::{Markup, html};

/// Width of a full-size plot, in units of its view box.
pub(super) const WIDTH: f64 = 1040.0;
/// Where its data begin and end.
pub(super) const LEFT: f64 = 62.0;
pub(super) const RIGHT: f64 = WIDTH - 12.0;

/// A linear map from values to a side of the plot.
#[derive(Clone, Copy, Debug)]
pub(super) struct Axis {
    from: f64,
    to: f64,
    start: f64,
    end: f64,
}

impl Axis {
    /// `from` lies at `start`, `to` at `end`.
    pub(super) fn new([from, to]: [f64; 2], [start, end]: [f64; 2]) -> Self {
        let to = if to > from { to } else { from + 1.0 };
        Self { from, to, start, end }
    }

    /// Place of a value; one beyond the ends is at the end.
    pub(super) fn at(&self, value: f64) -> f64 {
        let part = ((value - self.from) / (self.to - self.from)).clamp(0.0, 1.0);
        self.start + part * (self.end - self.start)
    }

    /// Round values, about `count` of them.
    pub(super) fn ticks(&self, count: f64) -> Vec<f64> {
        let raw = (self.to - self.from) / count;
        let power = 10_f64.powf(raw.log10().floor());
        let step = [1.0, 2.0, 5.0, 10.0].into_iter().map(|m| m * power).find(|step| *step >= raw).unwrap_or(raw);
        let (first, last) = ((self.from / step).ceil() as i64, (self.to / step).floor() as i64);
        (first..=last).map(|k| k as f64 * step).collect()
    }

    /// Horizontal grid lines with their values on the left.
    pub(super) fn grid(&self, ticks: &[f64], label: impl Fn(f64) -> String) -> Markup {
        html! {
            @for &tick in ticks {
                path.grid d={ "M" (px(LEFT)) "," (px(self.at(tick))) "H" (px(RIGHT)) } {}
                text.end x=(px(LEFT - 6.0)) y=(px(self.at(tick) + 4.0)) { (label(tick)) }
            }
        }
    }

    /// Values along the bottom.
    pub(super) fn labels(&self, ticks: &[f64], y: f64, label: impl Fn(f64) -> String) -> Markup {
        html! {
            @for &tick in ticks {
                text.mid x=(px(self.at(tick))) y=(px(y)) { (label(tick)) }
            }
        }
    }
}

/// A coordinate with one decimal, without a useless zero.
pub(super) fn px(value: f64) -> String {
    let text = format!("{value:.1}");
    text.strip_suffix(".0").map(str::to_owned).unwrap_or(text)
}

/// A line through points, broken where one is missing.
pub(super) fn line(points: impl IntoIterator<Item = Option<(f64, f64)>>) -> String {
    let mut path = String::new();
    let mut pen_down = false;
    for point in points {
        if let Some((x, y)) = point {
            path += &format!("{}{},{}", if pen_down { 'L' } else { 'M' }, px(x), px(y));
        }
        pen_down = point.is_some();
    }
    path
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_axis_maps_and_clamps() {
        let axis = Axis::new([0.0, 10.0], [100.0, 0.0]);
        assert_eq!((axis.at(0.0), axis.at(2.5), axis.at(99.0)), (100.0, 75.0, 0.0));
        assert_eq!(Axis::new([3.0, 3.0], [0.0, 10.0]).at(3.0), 0.0, "an empty range is widened");
    }

    #[test]
    fn ticks_are_round_and_inside() {
        assert_eq!(Axis::new([3.0, 47.0], [0.0, 1.0]).ticks(5.0), [10.0, 20.0, 30.0, 40.0]);
        assert_eq!(Axis::new([0.0, 1.0], [0.0, 1.0]).ticks(5.0).len(), 6);
    }

    #[test]
    fn lines_break_at_missing_points() {
        assert_eq!(line([Some((0.0, 1.0)), Some((2.0, 3.25)), None, Some((4.0, 4.0))]), "M0,1L2,3.2M4,4");
    }
}
