//! Where the vehicle is, and where things are as it sees them.

use super::Real;
use super::trigonometry::{hypot, sin_cos};
use crate::waypoint::Waypoint;
use fixed::types::{I8F8, I16F16};
use serde::{Deserialize, Serialize};

/// A place on the map, in meters.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub struct Position {
    /// Meters to the north of the origin.
    pub north: Real,
    /// Meters to the east of the origin.
    pub east: Real,
}

impl Position {
    /// Meters between two places.
    pub fn distance(self, other: Self) -> Real {
        hypot(self.north.saturating_sub(other.north), self.east.saturating_sub(other.east))
    }
}

/// How satellite coordinates become meters: a plane that touches the earth at its origin.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct GpsPlane {
    /// Latitude of the origin, in 10⁻⁹ degrees.
    pub latitude_nanodegrees: i64,
    /// Longitude of the origin, in 10⁻⁹ degrees.
    pub longitude_nanodegrees: i64,
    /// Meters per degree of latitude.
    pub north_per_degree: Real,
    /// Meters per degree of longitude.
    pub east_per_degree: Real,
}

impl GpsPlane {
    /// The simulator CARLA from 0.9.10 on, whose maps lie around the equator.
    pub const CARLA: Self = Self {
        latitude_nanodegrees: 0,
        longitude_nanodegrees: 0,
        north_per_degree: Real::lit("111324.60662786"),
        east_per_degree: Real::lit("111319.490945"),
    };
    /// CARLA before 0.9.10, whose maps lie around 49° north, 8° east.
    pub const CARLA_0_9_9: Self = Self {
        latitude_nanodegrees: 49_000_000_000,
        longitude_nanodegrees: 8_000_000_000,
        north_per_degree: Real::lit("111324.60662786"),
        east_per_degree: Real::lit("73032.1570362"),
    };

    /// The place of a latitude and a longitude, both in 10⁻⁹ degrees (0.1 mm), rounded toward the origin. What no
    /// receiver says saturates.
    pub fn position(&self, latitude_nanodegrees: i64, longitude_nanodegrees: i64) -> Position {
        let meters = |from: i64, to: i64, per_degree: Real| {
            let product = i128::from(to).saturating_sub(from.into()).saturating_mul(per_degree.to_bits().into());
            let bits = product / 1_000_000_000;
            Real::from_bits(i64::try_from(bits).unwrap_or(if bits < 0 { i64::MIN } else { i64::MAX }))
        };
        Position {
            north: meters(self.latitude_nanodegrees, latitude_nanodegrees, self.north_per_degree),
            east: meters(self.longitude_nanodegrees, longitude_nanodegrees, self.east_per_degree),
        }
    }
}

/// A place in the vehicle's frame, in meters.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub struct Point {
    /// Meters to the right.
    pub right: Real,
    /// Meters ahead.
    pub forward: Real,
}

impl Point {
    /// `place` as seen from `own` under a heading in radians (0 is north, clockwise):
    /// `right = −sin(θ)·Δn + cos(θ)·Δe`, `forward = cos(θ)·Δn + sin(θ)·Δe`.
    pub fn seen_from(own: Position, heading: Real, place: Position) -> Self {
        let (sine, cosine) = sin_cos(heading);
        let north = place.north.saturating_sub(own.north);
        let east = place.east.saturating_sub(own.east);
        Self {
            right: cosine.saturating_mul(east).saturating_sub(sine.saturating_mul(north)),
            forward: cosine.saturating_mul(north).saturating_add(sine.saturating_mul(east)),
        }
    }

    /// The network's goal input, `floor(2^16·x + 1/2)` of `[right, −forward]`: its y axis points backward. From single
    /// precision, [`crate::sensors::inputs::goal`] gives the same codes.
    pub fn goal_codes(self) -> [I16F16; 2] {
        const HALF: Real = Real::lit("0x0.00008");
        [self.right, self.forward.saturating_neg()].map(|x| I16F16::saturating_from_num(x.saturating_add(HALF)))
    }
}

impl From<Waypoint> for Point {
    fn from(Waypoint { right, forward }: Waypoint) -> Self {
        Self { right: right.into(), forward: forward.into() }
    }
}

/// The network's velocity input, `sat16(floor(2^8·v + 1/2))` of a speed in m/s. From single precision,
/// [`crate::sensors::inputs::velocity`] gives the same code.
pub fn velocity_code(speed: Real) -> I8F8 {
    const HALF: Real = Real::lit("0x0.008");
    I8F8::saturating_from_num(speed.saturating_add(HALF))
}

#[cfg(test)]
#[allow(clippy::arithmetic_side_effects, reason = "tests run with overflow checks")]
mod tests {
    use super::*;
    use crate::sensors::inputs;
    use proptest::prelude::*;

    fn real(value: f64) -> Real {
        Real::from_num(value)
    }

    fn place(north: f64, east: f64) -> Position {
        Position { north: real(north), east: real(east) }
    }

    #[test]
    fn right_and_forward_follow_the_heading() {
        let quarter = real(core::f64::consts::FRAC_PI_2);
        for (heading, right, forward) in
            [(Real::ZERO, 3.0, 4.0), (quarter, -4.0, 3.0), (quarter * 2, -3.0, -4.0), (-quarter, 4.0, -3.0)]
        {
            // 4 m north and 3 m east of the vehicle.
            let found = Point::seen_from(place(10.0, 20.0), heading, place(14.0, 23.0));
            assert!((found.right - real(right)).abs() < real(1e-6), "{heading}: {found:?}");
            assert!((found.forward - real(forward)).abs() < real(1e-6), "{heading}: {found:?}");
        }
    }

    #[test]
    fn inputs_of_the_network_round_half_up_and_saturate() {
        let codes = |right: f64, forward: f64| Point { right: real(right), forward: real(forward) }.goal_codes();
        let lsb = 1.0 / 65536.0;
        assert_eq!(codes(2.5 * lsb, 2.5 * lsb).map(I16F16::to_bits), [3, -2], "floor(x + 1/2) of x and of −x");
        assert_eq!(codes(-2.6 * lsb, 1.0).map(I16F16::to_bits), [-3, -65536]);
        assert_eq!(codes(40_000.0, 40_000.0), [I16F16::MAX, I16F16::MIN]);
        let farthest = Point { right: Real::MAX, forward: Real::MIN };
        assert_eq!(farthest.goal_codes(), [I16F16::MAX; 2]);
        assert_eq!(
            [1.0, -1.0, 0.001953125, 200.0, -200.0].map(|v| velocity_code(real(v)).to_bits()),
            [256, -256, 1, i16::MAX, i16::MIN]
        );
    }

    proptest! {
        /// The sensors round single precision, the planner 32 fraction bits.
        #[test]
        fn codes_are_those_of_the_sensors(right in -40_000.0_f32..40_000.0, forward in -40_000.0_f32..40_000.0) {
            let point = Point { right: real(right.into()), forward: real(forward.into()) };
            let found = point.goal_codes().map(I16F16::to_bits);
            prop_assert_eq!(Ok(found), inputs::goal([right, -forward].map(f32::to_bits)));
            let speed = forward / 256.0;
            prop_assert_eq!(Ok(velocity_code(real(speed.into())).to_bits()), inputs::velocity(speed.to_bits()));
        }
    }

    #[test]
    fn satellite_coordinates_become_meters() {
        let near = |found: Real, meters: f64| assert!((found - real(meters)).abs() < real(1e-4), "{found}, {meters}");
        let found = GpsPlane::CARLA.position(-1_234_567, 900_000_001);
        near(found.north, -0.001_234_567 * 111_324.606_627_86);
        near(found.east, 0.900_000_001 * 111_319.490_945);
        let found = GpsPlane::CARLA_0_9_9.position(49_001_000_000, 7_999_000_000);
        near(found.north, 111.324_606_627_86);
        near(found.east, -73.032_157_036_2);
    }

    #[test]
    fn coordinates_that_no_receiver_says_saturate() {
        let found = GpsPlane::CARLA_0_9_9.position(i64::MAX, i64::MIN);
        assert_eq!((found.north, found.east), (Real::MAX, Real::MIN));
        assert_eq!(found.distance(Position { north: Real::MIN, east: Real::MAX }), Real::MAX);
        let seen = Point::seen_from(found, Real::MAX, Position::default());
        assert!(seen.right.abs() > Real::ONE || seen.forward.abs() > Real::ONE);
    }
}
