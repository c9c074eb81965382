//! Motion of the vehicle between the capture of a point and now.

use super::Point;
use crate::drive::Real;
use crate::drive::trigonometry::unit_vector;
use crate::fixed_point::{round_shift, saturate_i32};
use core::fmt;
use fixed::types::I16F16;

/// Fraction bits of sines and cosines.
const UNIT_BITS: u32 = 30;
const UNIT: i32 = 1 << UNIT_BITS;
/// Largest deviation of `cos² + sin²` from 1, in Q60: 2^-26. Sine and cosine of the drive layer lie within
/// 2^-27.5 of the real ones, which makes at most 2√2·2^-27.5.
const MAX_DEVIATION: u64 = 1 << 34;

/// Cosine and sine of a compass reading (0 north, clockwise), Q30.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Heading {
    cos: i32,
    sin: i32,
}

/// Cosine and sine do not belong to one angle: their squares do not sum to 1 within 2^-26.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub struct NoRotation {
    /// Cosine given, Q30.
    pub cos: i32,
    /// Sine given, Q30.
    pub sin: i32,
}

impl fmt::Display for NoRotation {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "cosine {} and sine {} (Q30) are not of one angle", self.cos, self.sin)
    }
}

impl core::error::Error for NoRotation {}

impl Heading {
    /// Facing north.
    pub const NORTH: Self = Self { cos: UNIT, sin: 0 };

    /// Of a compass reading in radians, 0 north and clockwise, as the drive layer takes it.
    pub fn from_compass(radians: Real) -> Self {
        let (sine, cosine) = unit_vector(radians);
        Self { cos: cosine.to_bits(), sin: sine.to_bits() }
    }

    /// Cosine and sine in Q30, of a sensor that gives those.
    ///
    /// # Errors
    /// Their squares do not sum to 1 within 2^-26.
    pub const fn new(cos: i32, sin: i32) -> Result<Self, NoRotation> {
        // Each square is at most 2^62.
        let square = (cos as i64).wrapping_mul(cos as i64).wrapping_add((sin as i64).wrapping_mul(sin as i64));
        match square.wrapping_sub(1 << (2 * UNIT_BITS)).unsigned_abs() <= MAX_DEVIATION {
            true => Ok(Self { cos, sin }),
            false => Err(NoRotation { cos, sin }),
        }
    }
}

/// Where a vehicle is and where it faces.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Pose {
    /// Meters to the north of any fixed origin.
    pub north: I16F16,
    /// Meters to the east of it.
    pub east: I16F16,
    /// Compass.
    pub heading: Heading,
}

/// Brings a point of the frame of its capture into the current one: `p' = R·p + t` on the ground plane, z unchanged.
///
/// With Δ = capture's compass − current compass and d = capture's position − current position:
/// `left' = left·cos Δ − forward·sin Δ + t_left`, `forward' = left·sin Δ + forward·cos Δ + t_forward`, where t is d
/// seen by the current frame. This is `M₂⁻¹·M₁·p` of the published data preparation in its axes (right, backward);
/// there it was written for points whose x grows to the right. Networks of one LiDAR frame are trained without motion.
///
/// No motion is exact, and keeps the odd codes of [`Point`]. Otherwise a coordinate lies within 2^-14 m (61 µm) of the
/// real one for points and motions of up to 128 m; results saturate at ±32768 m.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Motion {
    cos: i32,
    sin: i32,
    left: i32,
    forward: i32,
}

impl Motion {
    /// The vehicle has not moved.
    pub const NONE: Self = Self { cos: UNIT, sin: 0, left: 0, forward: 0 };

    /// The motion from the pose at the capture to the current one. Equal poses give [`Self::NONE`].
    pub fn between(capture: &Pose, current: &Pose) -> Self {
        let (from, to) = (capture.heading, current.heading);
        let (cos, sin) = match from == to {
            // Rounded sines and cosines do not give exactly 1.
            true => (UNIT, 0),
            false => (
                sum_of_products([from.cos, from.sin], [to.cos, to.sin]),
                sum_of_products([from.sin, from.cos], [to.cos, to.sin.saturating_neg()]),
            ),
        };
        let north = capture.north.saturating_sub(current.north).to_bits();
        let east = capture.east.saturating_sub(current.east).to_bits();
        Self {
            cos,
            sin,
            left: sum_of_products([north, east], [to.sin, to.cos.saturating_neg()]),
            forward: sum_of_products([north, east], [to.cos, to.sin]),
        }
    }

    /// The point in the current frame.
    pub fn apply(&self, point: Point) -> Point {
        let [x, y] = [point.left.to_bits(), point.forward.to_bits()];
        let left = sum_of_products([x, y], [self.cos, self.sin.saturating_neg()]).saturating_add(self.left);
        let forward = sum_of_products([x, y], [self.sin, self.cos]).saturating_add(self.forward);
        Point { left: I16F16::from_bits(left), forward: I16F16::from_bits(forward), up: point.up }
    }
}

/// `R(a₀·b₀ + a₁·b₁, 30)`: below 2^62 in magnitude before the shift, since no b
/// exceeds 2^30 by more than rounding.
fn sum_of_products(a: [i32; 2], b: [i32; 2]) -> i32 {
    let [first, second] = [0, 1].map(|i| {
        let pair = a.get(i).zip(b.get(i));
        pair.map_or(0, |(&a, &b)| i64::from(a).wrapping_mul(i64::from(b)))
    });
    saturate_i32(round_shift(first.wrapping_add(second), UNIT_BITS))
}

#[cfg(test)]
mod tests {
    extern crate std;
    use super::*;
    use crate::image::known_answer::Generator;
    use proptest::prelude::*;

    fn heading(angle: f64) -> Heading {
        let [cos, sin] = [angle.cos(), angle.sin()].map(|v| (v * f64::from(UNIT)).round() as i32);
        Heading::new(cos, sin).unwrap()
    }

    fn pose([north, east, compass]: [f64; 3]) -> Pose {
        Pose { north: I16F16::from_num(north), east: I16F16::from_num(east), heading: heading(compass) }
    }

    /// `M₂⁻¹·M₁·p` with `M(r, t)` of rotation rows `[cos r, sin r], [−sin r, cos r]`, `r = π/2 − compass`, `t = −pos`.
    fn published(first: [f64; 3], second: [f64; 3], [x, y]: [f64; 2]) -> [f64; 2] {
        let angle = |pose: [f64; 3]| core::f64::consts::FRAC_PI_2 - pose[2];
        let (sin, cos) = angle(first).sin_cos();
        let world = [cos * x + sin * y - first[0], -sin * x + cos * y - first[1]];
        let moved = [world[0] + second[0], world[1] + second[1]];
        let (sin, cos) = angle(second).sin_cos();
        [cos * moved[0] - sin * moved[1], sin * moved[0] + cos * moved[1]]
    }

    #[test]
    fn a_vehicle_that_drives_and_turns() {
        let ahead = Point { left: I16F16::ZERO, forward: I16F16::from_num(10), up: I16F16::ONE };
        let at_origin = Pose { north: I16F16::ZERO, east: I16F16::ZERO, heading: Heading::NORTH };
        let driven = Motion::between(&at_origin, &Pose { north: I16F16::from_num(4), ..at_origin });
        assert_eq!(driven.apply(ahead), Point { forward: I16F16::from_num(6), ..ahead });
        let facing_east = Pose { heading: Heading::new(0, UNIT).unwrap(), ..at_origin };
        let on_the_left = Point { left: I16F16::from_num(10), forward: I16F16::ZERO, ..ahead };
        assert_eq!(Motion::between(&at_origin, &facing_east).apply(ahead), on_the_left);
    }

    #[test]
    fn every_compass_gives_a_heading() {
        let seed = 3;
        let mut generator = Generator::new(seed);
        let mut worst = 0;
        for _ in 0..100_000 {
            let compass = Real::from_bits((generator.draw() >> (generator.draw() % 34)).cast_signed());
            let Heading { cos, sin } = Heading::from_compass(compass);
            assert_eq!(Heading::new(cos, sin), Ok(Heading { cos, sin }), "seed {seed}, {compass} rad");
            let [cos, sin] = [cos, sin].map(i64::from);
            worst = worst.max((cos * cos + sin * sin - (1 << (2 * UNIT_BITS))).unsigned_abs());
        }
        std::println!("largest deviation of cos² + sin² from 1: 2^{:.1}", (worst as f64).log2() - 60.0);
        assert_eq!(Heading::from_compass(Real::ZERO), Heading::NORTH);
    }

    #[test]
    fn numbers_that_are_no_cosine_and_sine_are_refused() {
        for (cos, sin) in [(0, 0), (UNIT, UNIT), (i32::MIN, i32::MIN), (i32::MAX, 0), (UNIT - 9, 0)] {
            assert_eq!(Heading::new(cos, sin), Err(NoRotation { cos, sin }));
        }
        assert_eq!(Heading::new(UNIT, 0), Ok(Heading::NORTH));
        assert!(Heading::new(UNIT - 8, 0).is_ok());
    }

    proptest! {
        #[test]
        fn no_motion_is_exact(codes: [i32; 3], compass in 0.0..7.0, north in -3e4..3e4, east in -3e4..3e4) {
            let [left, forward, up] = codes.map(I16F16::from_bits);
            let point = Point { left, forward, up };
            let pose = pose([north, east, compass]);
            prop_assert_eq!(Motion::between(&pose, &pose), Motion::NONE);
            prop_assert_eq!(Motion::NONE.apply(point), point);
        }

        #[test]
        fn points_move_as_published(
            first in [-60.0..60.0, -60.0..60.0, -7.0..7.0_f64],
            second in [-60.0..60.0, -60.0..60.0, -7.0..7.0_f64],
            left in -128.0..128.0_f64,
            forward in -128.0..128.0_f64,
        ) {
            let bits = [left as f32, forward as f32, 0.0].map(f32::to_bits);
            let point = super::super::Mounting::TRAINED.place(bits).unwrap();
            let moved = Motion::between(&pose(first), &pose(second)).apply(point);
            // The published axes: x to the right, y backward.
            let [x, y] = published(first, second, [-left, -forward]);
            let error = |found: I16F16, expected: f64| (found.to_num::<f64>() - expected).abs();
            // The f32 of the input may be 2^-18 m off.
            let tolerance = f64::exp2(-14.0) + f64::exp2(-17.0);
            prop_assert!(error(moved.left, -x) < tolerance, "left {} against {}", moved.left, -x);
            prop_assert!(error(moved.forward, -y) < tolerance, "forward {} against {}", moved.forward, -y);
        }

        #[test]
        fn extreme_motions_give_points(codes: [i32; 7], compass in [-7.0..7.0_f64, -7.0..7.0]) {
            let [a, b, c, d, left, forward, up] = codes.map(I16F16::from_bits);
            let capture = Pose { north: a, east: b, heading: heading(compass[0]) };
            let current = Pose { north: c, east: d, heading: heading(compass[1]) };
            Motion::between(&capture, &current).apply(Point { left, forward, up });
        }
    }
}
