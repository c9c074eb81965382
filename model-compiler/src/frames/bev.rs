//! LiDAR points to a bird's-eye-view histogram: two channels (below and above a height) of counts 0..=5.
//!
//! Rows are lateral: 256 bins from 32 m on the right to 33 m on the left, 65/256 m each. Columns are longitudinal: 256
//! bins from 32 m ahead (column 0) to the sensor (column 255), 0.125 m each. Bins are half-open, the last one of each
//! axis is closed, and points outside are left out. All edges are exact in f64, so a point on an edge has one bin.

use super::ByteMap;
use firmware::tensor::Shape;

/// The only shape that the rule yields.
pub const SHAPE: Shape = Shape::map(BINS as u16, BINS as u16, 2);
/// Height of the sensor that the networks were trained with, m above ground.
pub const SENSOR_HEIGHT_M: f64 = 2.5;
/// Counts saturate here.
pub const MAX_COUNT: u8 = 5;

const BINS: usize = 256;
const LATERAL: Axis = Axis { start: -32.0, width: 65.0 / 256.0 };
/// Over `−forward`.
const LONGITUDINAL: Axis = Axis { start: -32.0, width: 0.125 };

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

struct Axis {
    start: f64,
    width: f64,
}

impl Axis {
    fn edge(&self, index: usize) -> f64 {
        self.start + index as f64 * self.width
    }

    /// The bin with `edge(i) <= value < edge(i + 1)`; the last bin also takes its upper edge.
    fn bin(&self, value: f64) -> Option<usize> {
        if !(self.edge(0)..=self.edge(BINS)).contains(&value) {
            return None;
        }
        // The quotient may round across an edge; the edges themselves decide.
        let guess = (((value - self.start) / self.width) as usize).min(BINS - 1);
        if value < self.edge(guess) {
            Some(guess - 1)
        } else if value >= self.edge(guess + 1) {
            Some((guess + 1).min(BINS - 1))
        } else {
            Some(guess)
        }
    }
}

/// Histogram of the finite points, and how many points were not finite.
///
/// Channel 0 counts points up to `split_height_m`, channel 1 those above.
pub fn histogram(points: impl IntoIterator<Item = Point>, split_height_m: f64) -> (ByteMap, usize) {
    let mut data = vec![0_u8; BINS * BINS * 2];
    let mut dropped = 0;
    for [left, forward, up] in points {
        if ![left, forward, up].iter().all(|v| v.is_finite()) {
            dropped += 1;
            continue;
        }
        if let (Some(row), Some(column)) = (LATERAL.bin(left), LONGITUDINAL.bin(-forward)) {
            let channel = usize::from(up > split_height_m);
            let count = &mut data[(row * BINS + column) * 2 + channel];
            *count = MAX_COUNT.min(*count + 1);
        }
    }
    (ByteMap { shape: SHAPE, data }, dropped)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn cells(points: &[Point], split: f64) -> Vec<(usize, usize, usize, u8)> {
        let (map, _) = histogram(points.iter().copied(), split);
        let position = |i: usize| (i / 2 / BINS, i / 2 % BINS, i % 2);
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
        for axis in [&LATERAL, &LONGITUDINAL] {
            for i in 1..BINS {
                assert_eq!(axis.bin(axis.edge(i)), Some(i));
                assert_eq!(axis.bin(axis.edge(i).next_down()), Some(i - 1));
            }
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
        let (map, dropped) = histogram(points, -2.0);
        assert_eq!(dropped, 3);
        assert_eq!(map.data.iter().map(|&c| u32::from(c)).sum::<u32>(), 1);
    }

    #[test]
    fn axes_and_sensor_height_are_converted() {
        assert_eq!(LidarAxes::Carla.to_trained_frame([1.0, 2.0, 3.0], 2.5), [1.0, 2.0, 3.0]);
        assert_eq!(LidarAxes::Velodyne.to_trained_frame([1.0, 2.0, 3.0], 1.5), [2.0, 1.0, 2.0]);
    }
}
