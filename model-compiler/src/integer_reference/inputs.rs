//! Codes of the inputs from raw values.

use super::arithmetic::saturate_i16;
use crate::ir::InputKind;

/// Codes of one input from raw values (numerics, "Inputs").
///
/// Raw units: an image holds 0..=255, a BEV histogram counts 0..=5, cells are numbered from 0, the velocity is in m/s
/// and the goal in m. Images become `u8 − 128`, counts and cells stay as they are (all saturate, and a fraction rounds
/// to the nearest integer, ties up, though none is expected); velocity becomes i16 Q8, the goal i32 Q16, both by
/// `floor(2^k·x + ½)`, saturated.
pub fn encode_input(kind: InputKind, raw: &[f64]) -> Vec<f64> {
    let round = |x: f64| (x + 0.5).floor();
    let code = |&x: &f64| match kind {
        InputKind::Image => round(x).clamp(0.0, 255.0) - 128.0,
        InputKind::Bev => round(x).clamp(0.0, 5.0),
        InputKind::Velocity => saturate_i16(round(256.0 * x)),
        InputKind::Goal => round(65536.0 * x).clamp(-2147483648.0, 2147483647.0),
        InputKind::BevPoints | InputKind::CameraPoints => round(x).clamp(0.0, 127.0),
    };
    raw.iter().map(code).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn raw_values_become_codes() {
        assert_eq!(encode_input(InputKind::Image, &[0.0, 128.0, 255.0]), [-128.0, 0.0, 127.0]);
        assert_eq!(encode_input(InputKind::Bev, &[0.0, 3.0, 5.0]), [0.0, 3.0, 5.0]);
        assert_eq!(encode_input(InputKind::BevPoints, &[0.0, 7.0, 200.0, -1.0]), [0.0, 7.0, 127.0, 0.0]);
        let speeds = [0.0, 1.0 / 512.0, -1.0 / 512.0, 5.3, 127.999, 128.0, -200.0];
        let codes = [0.0, 1.0, 0.0, 1357.0, 32767.0, 32767.0, -32768.0];
        assert_eq!(encode_input(InputKind::Velocity, &speeds), codes);
        let goals = [0.5, -1.0 / 131072.0, 1.0 / 131072.0, -12.25, 40000.0, -40000.0];
        let codes = [32768.0, 0.0, 1.0, -802816.0, 2147483647.0, -2147483648.0];
        assert_eq!(encode_input(InputKind::Goal, &goals), codes);
    }
}
