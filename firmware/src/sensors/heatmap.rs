//! The goal as a picture: the tenth channel of LBC's map.
//!
//! A bell of 11×11 pixels around the goal, cropped at the borders, 0 elsewhere. The trained network saw the goal in
//! pixels of a *map* of 256×256 (5.5 pixels per meter, the vehicle at the middle of the lower edge), drawn onto the
//! camera image of 256×144 and clamped to it; it is not where the goal appears in the camera.

use super::InputSize;
use crate::tensor::Shape;

/// LBC's map: three views and this channel.
pub const MAP: Shape = Shape::map(144, 256, 10);
/// The channel of the heatmap.
pub const CHANNEL: u16 = 9;

/// Pixels on each side of the goal.
const RADIUS: u16 = 5;
/// A quarter of the bell, from its corner to its center: `floor(255·(e − e⁻¹)/(1 − e⁻¹) + ½)` of
/// `e = exp(−(dx² + dy²)/50)`.
const KERNEL: [[u8; 6]; 6] = [
    [0, 29, 56, 77, 91, 96],
    [29, 64, 96, 122, 139, 145],
    [56, 96, 133, 163, 182, 189],
    [77, 122, 163, 195, 217, 224],
    [91, 139, 182, 217, 239, 247],
    [96, 145, 189, 224, 247, 255],
];
/// The code of 0.
const ZERO: i8 = -128;

/// Draws the heatmap of a goal `[right, forward-negative]` (Q16 m, as [`super::inputs::goal`] gives it) into channel 9
/// of LBC's map; the other channels stay.
///
/// # Errors
/// The input does not have the size of [`MAP`].
pub fn draw(goal: [i32; 2], input: &mut [i8]) -> Result<(), InputSize> {
    InputSize::check(input.len(), MAP.elements())?;
    let [column, row] = center(goal);
    let rows = input.chunks_exact_mut(usize::from(MAP.width).wrapping_mul(usize::from(MAP.channels)));
    for (codes, y) in rows.zip(0_u16..) {
        let bell = mirrored(y, row).and_then(|dy| KERNEL.get(usize::from(dy)));
        let pixels = codes.iter_mut().skip(usize::from(CHANNEL)).step_by(usize::from(MAP.channels));
        for (code, x) in pixels.zip(0_u16..) {
            let level = bell.and_then(|bell| bell.get(usize::from(mirrored(x, column)?)));
            *code = level.map_or(ZERO, |level| (level ^ 0x80).cast_signed());
        }
    }
    Ok(())
}

/// Column and row of the goal: `round(5.5·[right, y] + [128, 256])`, ties to even, clipped to 0..=256 and clamped to
/// the image.
fn center([right, y]: [i32; 2]) -> [u16; 2] {
    let pixel = |meters: i32, origin: i64, size: u16| {
        // 11 half pixels per meter: Q17 pixels.
        let position = i64::from(meters).wrapping_mul(11).wrapping_add(origin << 17).clamp(0, 256 << 17);
        let (whole, fraction) = (position >> 17, position & 0x1_FFFF);
        let is_up = fraction > 1 << 16 || (fraction == 1 << 16 && whole & 1 == 1);
        let last = size.saturating_sub(1);
        u16::try_from(whole.wrapping_add(is_up.into())).map_or(last, |pixel| pixel.min(last))
    };
    [pixel(right, 128, MAP.width), pixel(y, 256, MAP.height)]
}

/// Distance from the bell's nearer edge; `None` outside of the bell.
fn mirrored(position: u16, center: u16) -> Option<u16> {
    RADIUS.checked_sub(position.abs_diff(center))
}

#[cfg(test)]
mod tests {
    extern crate std;
    use super::*;
    use proptest::prelude::*;
    use std::{vec, vec::Vec};

    fn meters([right, y]: [f64; 2]) -> [i32; 2] {
        [right, y].map(|v| (v * 65536.0).round() as i32)
    }

    /// Levels of the heatmap, row by row.
    fn heatmap(goal: [i32; 2]) -> Vec<u8> {
        let mut input = vec![7; MAP.elements() as usize];
        draw(goal, &mut input).unwrap();
        let (channel, others): (Vec<_>, Vec<_>) = input.iter().enumerate().partition(|(i, _)| i % 10 == 9);
        assert!(others.iter().all(|(_, code)| **code == 7), "other channels stay");
        channel.into_iter().map(|(_, code)| (i16::from(*code) + 128) as u8).collect()
    }

    /// The whole kernel, pasted by its definition in f64.
    fn oracle([right, y]: [f64; 2]) -> Vec<u8> {
        let [x, y] = [right * 5.5 + 128.0, y * 5.5 + 256.0].map(|v| v.clamp(0.0, 256.0).round_ties_even() as i32);
        let (x, y) = (x.min(255), y.min(143));
        let bell = |i: i32| {
            let (dx, dy) = (i % 256 - x, i / 256 - y);
            if dx.abs() > 5 || dy.abs() > 5 {
                return 0;
            }
            let least = f64::exp(-1.0);
            let value = (f64::from(-(dx * dx + dy * dy)) / 50.0).exp();
            (255.0 * (value - least) / (1.0 - least)).round() as u8
        };
        (0..256 * 144).map(bell).collect()
    }

    #[test]
    fn a_goal_ahead_is_a_bell_above_the_middle_of_the_lower_edge() {
        let found = heatmap(meters([0.0, -40.0]));
        let at = |x: usize, y: usize| found[y * 256 + x];
        assert_eq!([at(128, 36), at(127, 36), at(123, 36), at(122, 36), at(123, 31)], [255, 247, 96, 0, 0]);
        assert_eq!(found.iter().filter(|level| **level > 0).count(), 117);
    }

    #[test]
    fn goals_at_every_border_are_cropped() {
        for goal in [[0.0, 0.0], [-50.0, -30.0], [50.0, -30.0], [0.0, -60.0], [1e4, 1e4], [-1e4, -1e4], [23.3, -20.6]] {
            assert_eq!(heatmap(meters(goal)), oracle(goal), "{goal:?}");
        }
    }

    #[test]
    fn halves_round_to_even() {
        // 5.5 pixels per meter: 1 m is 5.5 pixels, 3 m are 16.5.
        assert_eq!(center(meters([1.0, -30.0])), [134, 91]);
        assert_eq!(center(meters([3.0, -29.0])), [144, 96]);
        assert_eq!(center([i32::MAX, i32::MIN]), [255, 0]);
        assert_eq!(center([i32::MIN, i32::MAX]), [0, 143]);
    }

    #[test]
    fn another_size_is_refused() {
        assert_eq!(draw([0, 0], &mut [0; 10]), Err(InputSize { found: 10, expected: 368_640 }));
    }

    proptest! {
        #![proptest_config(ProptestConfig::with_cases(200))]

        #[test]
        fn every_goal_gives_the_heatmap_of_its_definition(right in -4_000_000..4_000_000, y in -4_000_000..1_000_000) {
            let goal: [i32; 2] = [right, y];
            prop_assert_eq!(heatmap(goal), oracle(goal.map(|code| f64::from(code) / 65536.0)));
        }
    }
}
