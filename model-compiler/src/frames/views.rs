//! What LBC reads: three cameras (front, left, right), and a heatmap of the target as their tenth channel.
//!
//! The heatmap marks where the target lies in a map of 5.5 pixels per meter around the vehicle at column 128, row 256,
//! clamped to the views' size. It is laid over the views as it is, though it is no projection of the target into the
//! camera: the networks were trained so.

use super::{ByteMap, RealMap};
use firmware::tensor::Shape;

/// Channels: three views and the heatmap.
pub const CHANNELS: u16 = 10;
/// Grey levels per unit of the network's own input.
pub const LEVELS: f32 = 255.0;

const PIXELS_PER_METER: f64 = 5.5;
/// Column and row of the vehicle in the map.
const VEHICLE: [f64; 2] = [128.0, 256.0];
/// Side of the map; a target outside counts as one on its border.
const MAP_SIDE: f64 = 256.0;
/// The heatmap's spot reaches so many pixels to each side.
const RADIUS: i32 = 5;

/// Joins views of one shape `H×W×3`, in the order front, left, right, and the heatmap of a goal `[right,
/// forward-negative]` in m.
pub fn join(views: &[ByteMap; 3], goal: [f64; 2]) -> RealMap {
    let Shape { height, width, .. } = views[0].shape;
    let heatmap = heatmap(goal, height, width);
    let mut data = Vec::with_capacity(heatmap.len() * usize::from(CHANNELS));
    for (pixel, heat) in heatmap.into_iter().enumerate() {
        data.extend(views.iter().flat_map(|view| &view.data[3 * pixel..3 * pixel + 3]).map(|&level| f32::from(level)));
        data.push(heat);
    }
    RealMap { shape: Shape::map(height, width, CHANNELS), data }
}

/// The heatmap of a goal `[right, forward-negative]` in m, row by row, in grey levels: `exp(−d²/50)` of the distance d
/// in pixels from the rounded target (ties to even), stretched over 0..=255, in a square of 11 pixels.
pub fn heatmap(goal: [f64; 2], height: u16, width: u16) -> Vec<f32> {
    let target = |axis: usize, size: u16| {
        let pixel = (goal[axis] * PIXELS_PER_METER + VEHICLE[axis]).clamp(0.0, MAP_SIDE);
        pixel.round_ties_even().min(f64::from(size.max(1) - 1)) as i32
    };
    let (column, row) = (target(0, width), target(1, height));
    let power = |dx: i32, dy: i32| (-f64::from(dx * dx + dy * dy) / 50.0).exp();
    let least = power(RADIUS, RADIUS);
    let heat = |x: i32, y: i32| {
        let (dx, dy) = (x - column, y - row);
        if dx.abs().max(dy.abs()) > RADIUS {
            return 0.0;
        }
        (f64::from(LEVELS) * (power(dx, dy) - least) / (1.0 - least)) as f32
    };
    (0..i32::from(height)).flat_map(|y| (0..i32::from(width)).map(move |x| heat(x, y))).collect()
}

/// The views in a mirror: left and right change places, columns are reversed, those of the heatmap too (it is that of
/// the mirrored goal, one column to the left: a map of even width has no middle column).
pub(super) fn mirrored(views: &RealMap) -> RealMap {
    let (pixel, row) = (usize::from(views.shape.channels), usize::from(views.shape.width));
    let mut data = Vec::with_capacity(views.data.len());
    for row in views.data.chunks(row * pixel) {
        for pixel in row.chunks(pixel).rev() {
            match pixel {
                [front @ .., l0, l1, l2, r0, r1, r2, heat] => {
                    data.extend_from_slice(front);
                    data.extend([r0, r1, r2, l0, l1, l2, heat]);
                }
                other => data.extend_from_slice(other),
            }
        }
    }
    RealMap { shape: views.shape, data }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Row and column of the brightest pixel.
    fn peak(heatmap: &[f32], width: usize) -> (usize, usize) {
        let at = heatmap.iter().position(|&v| v == LEVELS).expect("a peak");
        assert!(heatmap.iter().all(|v| (0.0..=LEVELS).contains(v)));
        (at / width, at % width)
    }

    #[test]
    fn the_spot_lies_at_the_target_in_the_map_and_is_clamped_to_the_views() {
        for (goal, expected) in [
            ([0.0, -30.0], (91, 128)),
            // 5.5 · 45.0 = 247.5 above the vehicle is row 8.5, which rounds to the even 8.
            ([3.0, -45.0], (8, 144)),
            ([0.5, -20.0], (143, 131)),
            ([-100.0, -60.0], (0, 0)),
            ([100.0, 60.0], (143, 255)),
        ] {
            assert_eq!(peak(&heatmap(goal, 144, 256), 256), expected, "{goal:?}");
        }
    }

    #[test]
    fn the_spot_falls_to_zero_at_its_corners_and_is_cut_at_the_border() {
        let map = heatmap([0.0, -30.0], 144, 256);
        let at = |dx: i32, dy: i32| map[((91 + dy) * 256 + 128 + dx) as usize];
        assert_eq!([at(5, 5), at(-5, 5), at(6, 0), at(0, -6)], [0.0; 4]);
        let expected = |d2: f64| (255.0 * ((-d2 / 50.0).exp() - (-1.0_f64).exp()) / (1.0 - (-1.0_f64).exp())) as f32;
        assert_eq!([at(0, 0), at(1, 0), at(0, 5), at(-3, 4)], [0.0, 1.0, 25.0, 25.0].map(expected));
        assert_eq!(map.iter().filter(|&&v| v > 0.0).count(), 117);
        let corner = heatmap([-100.0, -60.0], 144, 256);
        assert_eq!(corner.iter().filter(|&&v| v > 0.0).count(), 35);
    }

    #[test]
    fn views_stand_in_order_before_the_heatmap_and_twice_mirrored_is_the_same() {
        let view = |first: u8| ByteMap { shape: Shape::map(1, 2, 3), data: (first..first + 6).collect() };
        let joined = join(&[view(10), view(20), view(30)], [0.0, 0.0]);
        assert_eq!(joined.shape, Shape::map(1, 2, 10));
        assert_eq!(joined.data[..9], [10.0, 11.0, 12.0, 20.0, 21.0, 22.0, 30.0, 31.0, 32.0]);
        assert_eq!(joined.data[19], LEVELS, "the target is clamped to the last column");
        let turned = mirrored(&joined);
        assert_eq!(turned.data[..9], [13.0, 14.0, 15.0, 33.0, 34.0, 35.0, 23.0, 24.0, 25.0]);
        assert_eq!(turned.data[9], LEVELS);
        assert_eq!(mirrored(&turned), joined);
    }
}
