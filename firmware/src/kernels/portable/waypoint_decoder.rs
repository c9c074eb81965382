//! Portable GRU decoder.
use crate::kernels::WaypointDecoderArgs;

/// See [`crate::kernels::Kernels::waypoint_decoder`].
pub fn waypoint_decoder(
    _args: &WaypointDecoderArgs<'_>,
    _hidden: &[i16],
    _goal: &[i32],
    _waypoints: &mut [i32],
    _scratch: &mut [u8],
) {
}
