//! LiDAR points to a bird's-eye-view histogram: two channels (below and above a height) of counts 0..=5.
//!
//! Rows are lateral: 256 bins from 32 m on the right to 33 m on the left, 65/256 m each. Columns are longitudinal: 256
//! bins from 32 m ahead (column 0) to the sensor (column 255), 0.125 m each. Bins are half-open, the last one of each
//! axis is closed, and points outside are left out. All edges are exact in f64, so a point on an edge has one bin.
//!
//! A network with a smaller or larger input sees the same area in larger or smaller bins. Numbers of bins are powers of
//! two, which keeps the edges exact.

use super::ByteMap;
use firmware::tensor::Shape;

/// The published networks' histogram.
pub const SHAPE: Shape = Shape::map(256, 256, 2);
/// Height of the sensor that the networks were trained with, m above ground.
pub const SENSOR_HEIGHT_M: f64 = 2.5;
/// Counts saturate here.
pub const MAX_COUNT: u8 = 5;

/// Most bins of an axis.
const MAX_BINS: u16 = 1024;
const LATERAL_M: f64 = 65.0;
const LONGITUDINAL_M: f64 = 32.0;

/// How the raw coordinates of a LiDAR file lie.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum LidarAxes {
    /// x left, y forward, z up (the simulator's sensor, turned by −90°).
    Carla,
    /// x forward, y left, z up.
    Velodyne,
}

/// A point `[left, forward, up]`, m, relative to a sensor [`SENSOR_HEIGHT_M`] above ground.
pub type Point = [f64; 3];

impl LidarAxes {
    /// Brings a raw point of a sensor `height_m` above ground into the trained frame; heights above ground are kept.
    pub fn to_trained_frame(self, raw: [f32; 3], height_m: f64) -> Point {
        let [x, y, z] = raw.map(f64::from);
        let up = z + height_m - SENSOR_HEIGHT_M;
        match self {
            Self::Carla => [x, y, up],
            Self::Velodyne => [y, x, up],
        }
    }
}

/// From −32 m on; the longitudinal axis counts `−forward`.
struct Axis {
    bins: usize,
    width: f64,
}

impl Axis {
    const START: f64 = -32.0;

    fn new(length: f64, bins: u16) -> Self {
        Self { bins: bins.into(), width: length / f64::from(bins) }
    }

    fn edge(&self, index: usize) -> f64 {
        Self::START + index as f64 * self.width
    }

    /// The bin with `edge(i) <= value < edge(i + 1)`; the last bin also takes its upper edge.
    fn bin(&self, value: f64) -> Option<usize> {
        if !(self.edge(0)..=self.edge(self.bins)).contains(&value) {
            return None;
        }
        // The quotient may round across an edge; the edges themselves decide.
        let guess = (((value - Self::START) / self.width) as usize).min(self.bins - 1);
        if value < self.edge(guess) {
            Some(guess - 1)
        } else if value >= self.edge(guess + 1) {
            Some((guess + 1).min(self.bins - 1))
        } else {
            Some(guess)
        }
    }
}

/// Whether there is a histogram of this shape: two channels, powers of two up to 1024 as numbers of bins.
pub fn is_possible(shape: Shape) -> bool {
    let fits = |bins: u16| bins.is_power_of_two() && bins <= MAX_BINS;
    shape.channels == 2 && fits(shape.height) && fits(shape.width)
}

/// Histogram of the finite points, and how many points were not finite.
///
/// Channel 0 counts points up to `split_height_m`, channel 1 those above.
///
/// # Panics
/// The shape is not one that [`is_possible`] accepts.
pub fn histogram(points: impl IntoIterator<Item = Point>, split_height_m: f64, shape: Shape) -> (ByteMap, usize) {
    assert!(is_possible(shape), "no histogram has the shape {shape:?}");
    let (lateral, longitudinal) = (Axis::new(LATERAL_M, shape.height), Axis::new(LONGITUDINAL_M, shape.width));
    let mut data = vec![0_u8; shape.elements() as usize];
    let mut dropped = 0;
    for [left, forward, up] in points {
        if ![left, forward, up].iter().all(|v| v.is_finite()) {
            dropped += 1;
            continue;
        }
        if let (Some(row), Some(column)) = (lateral.bin(left), longitudinal.bin(-forward)) {
            let channel = usize::from(up > split_height_m);
            let count = &mut data[(row * longitudinal.bins + column) * 2 + channel];
            *count = MAX_COUNT.min(*count + 1);
        }
    }
    (ByteMap { shape, data }, dropped)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn cells(points: &[Point], split: f64) -> Vec<(usize, usize, usize, u8)> {
        let (map, _) = histogram(points.iter().copied(), split, SHAPE);
        let position = |i: usize| (i / 2 / 256, i / 2 % 256, i % 2);
        let found = map.data.iter().enumerate().filter(|(_, count)| **count > 0);
        found.map(|(i, &count)| (position(i).0, position(i).1, position(i).2, count)).collect()
    }

    #[test]
    fn edges_belong_to_the_bin_above_and_the_last_bin_is_closed() {
        // (left, forward) → (row, column)
        let cases = [
            ([-32.0, 32.0], Some((0, 0))),
            ([(-32.0_f64).next_up(), 32.0], Some((0, 0))),
            ([(-32.0_f64).next_down(), 32.0], None),
            ([33.0, 0.0], Some((255, 255))),
            ([33.0_f64.next_up(), 0.0], None),
            ([0.0, 0.0], Some((126, 255))),
            ([0.0, -f64::MIN_POSITIVE], None),
            ([0.0, 0.125], Some((126, 255))),
            ([0.0, 0.125_f64.next_up()], Some((126, 254))),
            ([0.0, 32.0_f64.next_up()], None),
            ([-32.0 + 65.0 / 256.0, 32.0], Some((1, 0))),
            ([(-32.0 + 65.0 / 256.0_f64).next_down(), 32.0], Some((0, 0))),
        ];
        for ([left, forward], expected) in cases {
            let expected: Vec<_> = expected.map(|(row, column)| (row, column, 0, 1)).into_iter().collect();
            assert_eq!(cells(&[[left, forward, -2.0]], -2.0), expected, "left {left:e}, forward {forward:e}");
        }
    }

    #[test]
    fn every_edge_and_its_lower_neighbor_fall_into_the_right_bin() {
        let axes = [32, 128, 256, 1024].map(|bins| [Axis::new(LATERAL_M, bins), Axis::new(LONGITUDINAL_M, bins)]);
        for axis in axes.iter().flatten() {
            for i in 1..axis.bins {
                assert_eq!(axis.bin(axis.edge(i)), Some(i));
                assert_eq!(axis.bin(axis.edge(i).next_down()), Some(i - 1));
            }
        }
    }

    #[test]
    fn half_as_many_bins_hold_the_counts_of_two_by_two() {
        let points = (0..4).map(|i| [-32.0 + f64::from(i % 2) * 65.0 / 256.0, 0.1 + f64::from(i / 2) * 0.125, 0.0]);
        let (map, _) = histogram(points, -2.0, Shape::map(128, 128, 2));
        let expected = |i| if i == 127 * 2 + 1 { 4 } else { 0 };
        assert_eq!(map.data, (0..128 * 128 * 2).map(expected).collect::<Vec<_>>());
        for (height, width, channels) in [(96, 128, 2), (128, 2048, 2), (0, 128, 2), (128, 128, 1)] {
            assert!(!is_possible(Shape::map(height, width, channels)), "{height}×{width}×{channels}");
        }
    }

    #[test]
    fn height_splits_the_channels_and_counts_saturate() {
        assert_eq!(cells(&[[0.0, 1.0, -2.0], [0.0, 1.0, -1.999]], -2.0), [(126, 248, 0, 1), (126, 248, 1, 1)]);
        assert_eq!(cells(&[[0.0, 1.0, -2.0], [0.0, 1.0, -1.999]], 2.0), [(126, 248, 0, 2)]);
        assert_eq!(cells(&[[0.0, 1.0, 0.0]; 9], -2.0), [(126, 248, 1, MAX_COUNT)]);
    }

    #[test]
    fn points_that_are_not_finite_are_dropped_and_counted() {
        let points = [[f64::NAN, 1.0, 0.0], [0.0, f64::INFINITY, 0.0], [0.0, 1.0, f64::NEG_INFINITY], [0.0, 1.0, 0.0]];
        let (map, dropped) = histogram(points, -2.0, SHAPE);
        assert_eq!(dropped, 3);
        assert_eq!(map.data.iter().map(|&c| u32::from(c)).sum::<u32>(), 1);
    }

    #[test]
    fn axes_and_sensor_height_are_converted() {
        assert_eq!(LidarAxes::Carla.to_trained_frame([1.0, 2.0, 3.0], 2.5), [1.0, 2.0, 3.0]);
        assert_eq!(LidarAxes::Velodyne.to_trained_frame([1.0, 2.0, 3.0], 1.5), [2.0, 1.0, 2.0]);
    }
}
