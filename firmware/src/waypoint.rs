//! Waypoints as a controller reads them: meters in fixed point, forward positive.

use fixed::types::I16F16;
use heapless::Vec;
use serde::{Deserialize, Serialize};

/// Most waypoints of one output; the published networks give 4.
pub const MAX_WAYPOINTS: usize = 16;

/// Bits of the scale, `2^-16`, that tells waypoints from other pairs of words, such as points of an image.
pub(crate) const SCALE_BITS: u32 = (1.0_f32 / 65536.0).to_bits();

/// Where to be, half a second after the waypoint before (the first: half a second from now), in the vehicle's frame.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct Waypoint {
    /// Meters to the right.
    pub right: I16F16,
    /// Meters ahead. The network's own y axis points backward; it is turned here, once.
    pub forward: I16F16,
}

/// Reads an output of `waypoints × 2` Q16 meters, little-endian. `None` where the length is no whole number of
/// waypoints, or there are more than [`MAX_WAYPOINTS`].
pub fn read(output: &[u8]) -> Option<Vec<Waypoint, MAX_WAYPOINTS>> {
    let (pairs, rest) = output.as_chunks::<8>();
    if !rest.is_empty() {
        return None;
    }
    let mut waypoints = Vec::new();
    for &[a, b, c, d, e, f, g, h] in pairs {
        let right = I16F16::from_le_bytes([a, b, c, d]);
        let forward = I16F16::from_le_bytes([e, f, g, h]).saturating_neg();
        waypoints.push(Waypoint { right, forward }).ok()?;
    }
    Some(waypoints)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn bytes(codes: &[i32]) -> std::vec::Vec<u8> {
        codes.iter().flat_map(|code| code.to_le_bytes()).collect()
    }

    extern crate std;

    #[test]
    fn forward_is_positive_and_in_meters() {
        let waypoints = read(&bytes(&[65536, -3 * 65536, -32768, 16384])).unwrap();
        assert_eq!(waypoints.len(), 2);
        assert_eq!((waypoints[0].right, waypoints[0].forward), (I16F16::ONE, I16F16::from_num(3)));
        assert_eq!((waypoints[1].right, waypoints[1].forward), (I16F16::from_num(-0.5), I16F16::from_num(-0.25)));
    }

    #[test]
    fn farthest_backward_saturates_instead_of_wrapping() {
        assert_eq!(read(&bytes(&[0, i32::MIN])).unwrap()[0].forward, I16F16::MAX);
    }

    #[test]
    fn other_outputs_are_refused() {
        assert_eq!(read(&[0; 12]), None);
        assert_eq!(read(&[0; 8 * (MAX_WAYPOINTS + 1)]), None);
        assert_eq!(read(&[]).unwrap().len(), 0);
    }
}
