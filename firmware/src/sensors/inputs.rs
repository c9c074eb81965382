//! Speed, goal and command to the codes of their inputs: to the nearest, ties up, saturating.

use super::{NotFinite, float::round_scaled};
use crate::fixed_point::{saturate_i16, saturate_i32};
use core::fmt;

/// Forward speed in m/s, as the bits of an `f32`, to i16 Q8: `sat16(floor(256·x + ½))`, within ±128 m/s.
///
/// # Errors
/// The speed is not finite.
pub fn velocity(bits: u32) -> Result<i16, NotFinite> {
    Ok(saturate_i16(round_scaled(bits, 8)?))
}

/// Goal `[right, forward-negative]` in m, as the bits of two `f32`, to i32 Q16: `floor(65536·x + ½)`, saturating at
/// ±32768 m.
///
/// # Errors
/// A coordinate is not finite.
pub fn goal(bits: [u32; 2]) -> Result<[i32; 2], NotFinite> {
    let [right, y] = bits;
    Ok([saturate_i32(round_scaled(right, 16)?), saturate_i32(round_scaled(y, 16)?)])
}

/// No navigation command has this number.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub struct UnknownCommand {
    /// The number given.
    pub found: u8,
}

impl fmt::Display for UnknownCommand {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "navigation command {}, expected 1..=6", self.found)
    }
}

impl core::error::Error for UnknownCommand {}

/// Navigation command 1 left, 2 right, 3 straight, 4 follow the lane, 5 change left, 6 change right: its own number as
/// i8.
///
/// # Errors
/// Any other number.
pub fn command(number: u8) -> Result<i8, UnknownCommand> {
    match number {
        1..=6 => Ok(number.cast_signed()),
        found => Err(UnknownCommand { found }),
    }
}

#[cfg(test)]
mod tests {
    extern crate std;
    use super::*;

    #[test]
    fn velocity_rounds_to_the_nearest_and_saturates() {
        let codes = [
            (0.0, 0),
            (1.0, 256),
            (-3.5, -896),
            (1.0 / 512.0, 1),
            (-1.0 / 512.0, 0),
            (127.996_09, 32767),
            (128.0, 32767),
            (1e30, 32767),
            (-128.0, -32768),
            (f32::MIN, -32768),
        ];
        for (speed, code) in codes {
            assert_eq!(velocity(f32::to_bits(speed)), Ok(code), "{speed} m/s");
        }
        assert_eq!(velocity(f32::NAN.to_bits()), Err(NotFinite));
    }

    #[test]
    fn goal_rounds_to_the_nearest_and_saturates() {
        let codes = |right: f32, y: f32| goal([right.to_bits(), y.to_bits()]);
        assert_eq!(codes(0.5, -20.0), Ok([32768, -1_310_720]));
        assert_eq!(codes(1.0 / 131_072.0, -1.0 / 131_072.0), Ok([1, 0]));
        assert_eq!(codes(32768.0, -32768.0), Ok([i32::MAX, i32::MIN]));
        assert_eq!(codes(1e30, -1e30), Ok([i32::MAX, i32::MIN]));
        assert_eq!(codes(0.0, f32::INFINITY), Err(NotFinite));
        assert_eq!(codes(f32::NAN, 0.0), Err(NotFinite));
    }

    #[test]
    fn six_commands_are_known() {
        let known: std::vec::Vec<_> = (0..=u8::MAX).filter_map(|number| command(number).ok()).collect();
        assert_eq!(known, [1, 2, 3, 4, 5, 6]);
        assert_eq!(command(0).unwrap_err().found, 0);
    }
}
