//! Points to a bird's-eye-view histogram: two channels (up to and above a height) of counts 0..=5.
//!
//! Rows are lateral: from 32 m on the right to 33 m on the left. Columns are longitudinal: from 32 m ahead (column 0)
//! to the sensor (last column). Numbers of bins are powers of two; the published networks have 256 × 256 bins of
//! 65/256 m × 0.125 m. Bins are half-open, the last one of each axis is closed, and points outside are left out.

use super::Point;
use crate::drive::Reading;
use crate::sensors::{InputSize, NotFinite};
use crate::tensor::{Shape, index};
use core::fmt;
use fixed::types::I16F16;

/// Most bins of an axis.
pub const MAX_BINS: u16 = 1024;
/// Counts saturate here.
pub const MAX_COUNT: i8 = 5;

/// Both axes start at −32 m; the longitudinal one counts `−forward`. Q16.
const START: u32 = 32 << 16;
const LATERAL_M: u32 = 65;
const LONGITUDINAL_M: u32 = 32;

/// Bins of both axes and the height between the channels.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Histogram {
    shape: Shape,
    split: I16F16,
}

/// No histogram has this shape: its numbers of bins are powers of two up to [`MAX_BINS`], and it has two channels.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub struct HistogramError {
    /// Shape asked for.
    pub found: Shape,
}

impl fmt::Display for HistogramError {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Shape { height, width, channels } = self.found;
        write!(f, "histogram of {height}×{width}×{channels}, expected powers of two up to {MAX_BINS} and 2 channels")
    }
}

impl core::error::Error for HistogramError {}

impl Histogram {
    /// TransFuser's: the channels part half a meter above ground.
    pub const TRANSFUSER: Self = Self { shape: Shape::map(256, 256, 2), split: I16F16::from_bits(-2 << 16) };
    /// Late Fusion's and Geometric Fusion's: the channels part 4.5 m above ground.
    pub const BASELINES: Self = Self { shape: Shape::map(256, 256, 2), split: I16F16::from_bits(2 << 16) };

    /// A histogram `lateral × longitudinal × 2`: channel 0 counts points up to `split` meters above the trained sensor,
    /// channel 1 those above. A split at a multiple of 2^-15 m is exact for points that came as `f32`.
    ///
    /// # Errors
    /// The shape is not one that a histogram has.
    pub const fn new(shape: Shape, split: I16F16) -> Result<Self, HistogramError> {
        let Shape { height, width, channels } = shape;
        let fits = height.is_power_of_two() && width.is_power_of_two() && height <= MAX_BINS && width <= MAX_BINS;
        if fits && channels == 2 { Ok(Self { shape, split }) } else { Err(HistogramError { found: shape }) }
    }

    /// Shape of the network's input.
    pub const fn shape(&self) -> Shape {
        self.shape
    }

    /// Element of the input that counts this point; `None` outside.
    ///
    /// The edges of `2^k ≤ 1024` bins lie at `65·i/2^k − 32` and `32·i/2^k − 32` m: multiples of 2^-10 m, hence even
    /// codes. A coordinate rounded to odd lies on the same side of each as the real one, so that
    /// `floor((x + 32)·2^k / length)` of its code is the real bin, and a code on the upper edge is the edge itself.
    /// (`floor(floor(c / 2^s) / 65) = floor(c / (65·2^s))` keeps the arithmetic in 32 bits.)
    fn element(&self, point: Point) -> Option<u32> {
        let Shape { height, width, .. } = self.shape;
        let row = bin(point.left.to_bits(), LATERAL_M, height)?;
        let column = bin(point.forward.to_bits().checked_neg()?, LONGITUDINAL_M, width)?;
        let cell = row.wrapping_mul(width.into()).wrapping_add(column);
        Some(cell.wrapping_mul(2) | u32::from(point.up > self.split))
    }
}

/// The bin of a Q16 coordinate on an axis from −32 m on.
fn bin(code: i32, length: u32, bins: u16) -> Option<u32> {
    // From the start of the axis; what lies before it becomes larger than any axis.
    let distance = code.cast_unsigned().wrapping_add(START);
    if distance > length << 16 {
        return None;
    }
    let shift = 16_u32.saturating_sub(bins.trailing_zeros());
    let last = u32::from(bins).saturating_sub(1);
    (distance >> shift.min(31)).checked_div(length).map(|bin| bin.min(last))
}

/// What became of the points of a sweep.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub struct Statistics {
    /// Points given; none at all tells of a dead sensor.
    pub points: u32,
    /// Points with a coordinate that is not finite; left out.
    pub not_finite: u32,
    /// Points outside the area; left out.
    pub out_of_range: u32,
    /// Points in a bin that had [`MAX_COUNT`] already.
    pub saturated: u32,
}

/// What the driver is to know of a sweep that ended in this step.
impl From<Statistics> for Reading<()> {
    fn from(Statistics { points, not_finite, .. }: Statistics) -> Self {
        match points {
            0 => Self::Missing,
            _ if points == not_finite => Self::NotANumber,
            _ => Self::now(()),
        }
    }
}

/// A histogram that grows point by point in the network's input. A frame that ends before [`Self::finish`] leaves
/// counts of the points so far.
#[derive(Clone, Copy, Debug)]
pub struct Sweep {
    histogram: Histogram,
    statistics: Statistics,
}

impl Sweep {
    /// A sweep before its first point; [`Self::start`] comes first.
    pub const fn new(histogram: Histogram) -> Self {
        let statistics = Statistics { points: 0, not_finite: 0, out_of_range: 0, saturated: 0 };
        Self { histogram, statistics }
    }

    /// Begins anew, with all counts 0.
    ///
    /// # Errors
    /// The input does not have the histogram's size.
    pub fn start(&mut self, counts: &mut [i8]) -> Result<(), InputSize> {
        InputSize::check(counts.len(), self.histogram.shape.elements())?;
        counts.fill(0);
        self.statistics = Statistics::default();
        Ok(())
    }

    /// Counts a point, or that it is none, in the input that was given to [`Self::start`].
    pub fn push(&mut self, point: Result<Point, NotFinite>, counts: &mut [i8]) {
        let Statistics { points, not_finite, out_of_range, saturated } = &mut self.statistics;
        *points = points.saturating_add(1);
        let Ok(point) = point else {
            *not_finite = not_finite.saturating_add(1);
            return;
        };
        let count = self.histogram.element(point).and_then(|element| counts.get_mut(index(element)));
        match count {
            None => *out_of_range = out_of_range.saturating_add(1),
            Some(count) if *count >= MAX_COUNT => *saturated = saturated.saturating_add(1),
            Some(count) => *count = count.saturating_add(1),
        }
    }

    /// Ends the sweep.
    pub fn finish(&mut self) -> Statistics {
        core::mem::take(&mut self.statistics)
    }
}

#[cfg(test)]
mod tests {
    extern crate std;
    use super::super::Mounting;
    use super::*;
    use std::{vec, vec::Vec};

    /// Row, column and channel of the only point.
    fn cell(histogram: Histogram, point: [f32; 3]) -> Option<(u32, u32, u32)> {
        let element = histogram.element(Mounting::TRAINED.place(point.map(f32::to_bits)).unwrap())?;
        let width = u32::from(histogram.shape.width);
        Some((element / 2 / width, element / 2 % width, element % 2))
    }

    #[test]
    fn a_sweep_without_points_is_a_missing_sensor() {
        let mut counts = vec![0; Histogram::TRANSFUSER.shape().elements() as usize];
        let mut reading = |points: &[Result<Point, NotFinite>]| {
            let mut sweep = Sweep::new(Histogram::TRANSFUSER);
            sweep.start(&mut counts).unwrap();
            points.iter().for_each(|&point| sweep.push(point, &mut counts));
            Reading::from(sweep.finish())
        };
        let far = Mounting::TRAINED.place([1e4_f32.to_bits(); 3]);
        assert_eq!(reading(&[]), Reading::Missing);
        assert_eq!(reading(&[Err(NotFinite); 3]), Reading::NotANumber);
        assert_eq!(reading(&[Err(NotFinite), far]), Reading::now(()), "an empty street is no fault");
    }

    #[test]
    fn edges_belong_to_the_bin_above_and_the_last_bin_is_closed() {
        // left, forward → row, column
        let cases = [
            ([-32.0, 32.0], Some((0, 0))),
            ([(-32.0_f32).next_up(), 32.0], Some((0, 0))),
            ([(-32.0_f32).next_down(), 32.0], None),
            ([33.0, 0.0], Some((255, 255))),
            ([33.0_f32.next_up(), 0.0], None),
            ([0.0, 0.0], Some((126, 255))),
            ([0.0, -0.0], Some((126, 255))),
            ([0.0, -f32::from_bits(1)], None),
            ([0.0, 0.125], Some((126, 255))),
            ([0.0, 0.125_f32.next_up()], Some((126, 254))),
            ([0.0, 32.0_f32.next_up()], None),
            ([-32.0 + 65.0 / 256.0, 32.0], Some((1, 0))),
            ([(-32.0 + 65.0 / 256.0_f32).next_down(), 32.0], Some((0, 0))),
            ([f32::MAX, 1.0], None),
            ([f32::MIN, 1.0], None),
            ([0.0, f32::MAX], None),
            ([0.0, f32::MIN], None),
        ];
        for ([left, forward], expected) in cases {
            let found = cell(Histogram::TRANSFUSER, [left, forward, -2.0]);
            assert_eq!(found, expected.map(|(row, column)| (row, column, 0)), "left {left:e}, forward {forward:e}");
        }
    }

    #[test]
    fn every_edge_and_its_lower_neighbor_fall_into_the_right_bin() {
        for bins in (0..=10).map(|k| 1_u16 << k) {
            let histogram = Histogram::new(Shape::map(bins, bins, 2), I16F16::ZERO).unwrap();
            for i in 1..u32::from(bins) {
                let edge = |meters: f32| i as f32 * meters / f32::from(bins) - 32.0;
                assert_eq!(cell(histogram, [edge(65.0), 1.0, 0.0]).unwrap().0, i);
                assert_eq!(cell(histogram, [edge(65.0).next_down(), 1.0, 0.0]).unwrap().0, i - 1);
                assert_eq!(cell(histogram, [0.0, -edge(32.0), 0.0]).unwrap().1, i);
                assert_eq!(cell(histogram, [0.0, -edge(32.0).next_down(), 0.0]).unwrap().1, i - 1);
            }
        }
    }

    #[test]
    fn height_splits_the_channels() {
        let channel = |histogram, up| cell(histogram, [0.0, 1.0, up]).unwrap().2;
        for (histogram, split) in [(Histogram::TRANSFUSER, -2.0_f32), (Histogram::BASELINES, 2.0)] {
            assert_eq!([split.next_down(), split, split.next_up()].map(|up| channel(histogram, up)), [0, 0, 1]);
        }
    }

    #[test]
    fn counts_saturate_and_every_point_is_accounted_for() {
        let mut input = vec![77_i8; 256 * 256 * 2];
        let mut sweep = Sweep::new(Histogram::TRANSFUSER);
        sweep.start(&mut input).unwrap();
        let place = |point: [f32; 3]| Mounting::TRAINED.place(point.map(f32::to_bits));
        for point in [[0.0, 1.0, 0.0], [0.0, -1.0, 0.0], [f32::NAN, 1.0, 0.0], [0.0, f32::INFINITY, 0.0]] {
            (0..7).for_each(|_| sweep.push(place(point), &mut input));
        }
        let statistics = sweep.finish();
        assert_eq!(statistics, Statistics { points: 28, not_finite: 14, out_of_range: 7, saturated: 2 });
        let counted: Vec<_> = input.iter().enumerate().filter(|(_, count)| **count != 0).collect();
        assert_eq!(counted, [((126 * 256 + 248) * 2 + 1, &MAX_COUNT)]);
        let mut sweep = Sweep::new(Histogram::TRANSFUSER);
        sweep.start(&mut input).unwrap();
        sweep.push(place([0.0, 2.0, 0.0]), &mut input);
        sweep.start(&mut input).unwrap();
        assert_eq!(sweep.finish(), Statistics::default());
        assert!(input.iter().all(|count| *count == 0));
    }

    #[test]
    fn other_shapes_and_sizes_are_refused() {
        for (height, width, channels) in [(96, 128, 2), (128, 2048, 2), (0, 128, 2), (128, 128, 1)] {
            let found = Shape::map(height, width, channels);
            assert_eq!(Histogram::new(found, I16F16::ZERO), Err(HistogramError { found }));
        }
        let error = Sweep::new(Histogram::TRANSFUSER).start(&mut [0; 100]).unwrap_err();
        assert_eq!(error, InputSize { found: 100, expected: 131_072 });
    }
}
