//! LiDAR points in the frame that the networks were trained with.

use super::{NotFinite, float::odd_q16};
use fixed::types::I16F16;
use serde::{Deserialize, Serialize};

mod histogram;
mod motion;

pub use histogram::{Histogram, HistogramError, MAX_BINS, MAX_COUNT, Statistics, Sweep};
pub use motion::{Heading, Motion, NoRotation, Pose};

/// A point in Q16 meters, relative to a sensor 2.5 m above ground.
///
/// A coordinate that came as an `f32` is rounded to odd: exact where it is a multiple of 2^-15 m, otherwise the odd
/// code within 2^-16 m. Against any multiple of 2^-15 m (every edge of a [`Histogram`] is one of 2^-10 m) it lies on
/// the same side as the `f32` itself.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Point {
    /// Meters to the left.
    pub left: I16F16,
    /// Meters ahead.
    pub forward: I16F16,
    /// Meters up.
    pub up: I16F16,
}

/// How the raw coordinates of a sensor lie.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub enum Axes {
    /// x left, y forward, z up (the simulator's sensor, turned by −90°).
    Carla,
    /// x forward, y left, z up.
    Velodyne,
}

/// Axes and height of a sensor.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Mounting {
    axes: Axes,
    /// Added to z: heights above ground are kept.
    raise: I16F16,
}

impl Mounting {
    /// The sensor that the networks were trained with: [`Axes::Carla`], 2.5 m above ground.
    pub const TRAINED: Self = Self::new(Axes::Carla, TRAINED_HEIGHT);

    /// A sensor `height` meters above ground, rounded down to a multiple of 2^-15 m (31 µm).
    pub const fn new(axes: Axes, height: I16F16) -> Self {
        let raise = height.saturating_sub(TRAINED_HEIGHT).to_bits() & !1;
        Self { axes, raise: I16F16::from_bits(raise) }
    }

    /// A raw point x, y, z in m, as the bits of three `f32`.
    ///
    /// # Errors
    /// A coordinate is not finite.
    pub fn place(&self, bits: [u32; 3]) -> Result<Point, NotFinite> {
        let [x, y, z] = bits;
        Ok(self.place_fixed([odd_q16(x)?, odd_q16(y)?, odd_q16(z)?]))
    }

    /// A raw point x, y, z in Q16 m.
    pub const fn place_fixed(&self, raw: [I16F16; 3]) -> Point {
        let [x, y, z] = raw;
        let up = z.saturating_add(self.raise);
        match self.axes {
            Axes::Carla => Point { left: x, forward: y, up },
            Axes::Velodyne => Point { left: y, forward: x, up },
        }
    }
}

/// 2.5 m.
const TRAINED_HEIGHT: I16F16 = I16F16::from_bits(5 << 15);

#[cfg(test)]
mod tests {
    use super::*;

    fn meters(value: f64) -> I16F16 {
        I16F16::from_num(value)
    }

    #[test]
    fn axes_and_sensor_height_are_converted() {
        let raw = [1.0, 2.0, 3.0].map(f32::to_bits);
        let point = |left, forward, up| Ok(Point { left: meters(left), forward: meters(forward), up: meters(up) });
        assert_eq!(Mounting::TRAINED.place(raw), point(1.0, 2.0, 3.0));
        assert_eq!(Mounting::new(Axes::Velodyne, meters(1.5)).place(raw), point(2.0, 1.0, 2.0));
        assert_eq!(Mounting::new(Axes::Carla, meters(-0.5)).place(raw), point(1.0, 2.0, 0.0));
    }

    #[test]
    fn a_height_is_rounded_down_to_an_even_code() {
        let height = I16F16::from_bits(113_379);
        assert_eq!(Mounting::new(Axes::Carla, height).raise.to_bits(), 113_378 - (5 << 15));
        assert_eq!(Mounting::new(Axes::Carla, I16F16::MIN).raise, I16F16::MIN);
    }

    #[test]
    fn any_coordinate_that_is_not_finite_refuses_the_point() {
        for at in 0..3 {
            let mut raw = [0.0_f32; 3];
            raw[at] = f32::NAN;
            assert_eq!(Mounting::TRAINED.place(raw.map(f32::to_bits)), Err(NotFinite));
        }
    }
}
