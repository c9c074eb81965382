//! From points in the image to points on the ground, for the network that answers with the former (LBC).

use super::Real;
use super::pose::Point;

/// A point in the front camera's image: −1 is the left or upper edge, 1 the right or lower one.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub struct ImagePoint {
    /// To the right.
    pub x: Real,
    /// Down.
    pub y: Real,
}

/// A camera that looks straight ahead over flat ground.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct GroundCamera {
    /// Columns and rows of the image.
    pub size: [u16; 2],
    /// Focal lengths to the right and down, in pixels.
    pub focal_length: [Real; 2],
    /// Meters of the lens above the ground.
    pub height: Real,
    /// Meters that a point lies nearer to the vehicle's origin than to the lens.
    pub setback: Real,
}

impl GroundCamera {
    /// LBC's front camera, as its controller sees it: a field of view of 90°, columns 1.1 times as dense.
    pub const LBC: Self = Self {
        size: [256, 144],
        focal_length: [Real::lit("140.8"), Real::lit("128")],
        height: Real::lit("1.3"),
        setback: Real::lit("0.4"),
    };

    /// The point that a spatial softmax gives: column and row in 1/64 pixel, counted between the centers of the first
    /// and the last pixel.
    pub fn image_point(&self, [column, row]: [i32; 2]) -> ImagePoint {
        let [columns, rows] = self.size;
        let unit = |code: i32, pixels: u16| {
            let last = i64::from(pixels).saturating_sub(1).saturating_mul(32);
            Real::from(code).checked_div_int(last).unwrap_or(Real::ZERO).saturating_sub(Real::ONE)
        };
        ImagePoint { x: unit(column, columns), y: unit(row, rows) }
    }

    /// The ground that a point shows: with u, v its pixels right of and below the image's center,
    /// `depth = fy·height/v`, `right = u·depth/fx`, `forward = depth − setback`.
    ///
    /// `None` at and above the horizon, where no ground is. (The original divides all the same and steers by a point
    /// behind the vehicle.)
    pub fn ground(&self, point: ImagePoint) -> Option<Point> {
        let [half_width, half_height] = self.size.map(|pixels| Real::from(pixels).saturating_mul(HALF));
        let [fx, fy] = self.focal_length;
        let below = point.y.saturating_mul(half_height);
        if below <= Real::ZERO {
            return None;
        }
        let depth = fy.saturating_mul(self.height).saturating_div(below);
        let right = point.x.saturating_mul(half_width).saturating_mul(depth).checked_div(fx)?;
        Some(Point { right, forward: depth.saturating_sub(self.setback) })
    }
}

const HALF: Real = Real::lit("0.5");

#[cfg(test)]
#[allow(clippy::unwrap_used, clippy::arithmetic_side_effects, reason = "what is missing fails the test")]
mod tests {
    use super::*;

    #[test]
    fn ground_is_the_pinhole_formula() {
        for column in (0..=255).step_by(5) {
            for row in 0..144 {
                let point = GroundCamera::LBC.image_point([column * 64 + 13, row * 64 + 7]);
                let [x, y] = [f64::from(column * 64 + 13) / 64.0, f64::from(row * 64 + 7) / 64.0];
                let [u, v] = [x / 255.0 * 256.0 - 128.0, y / 143.0 * 144.0 - 72.0];
                let Some(found) = GroundCamera::LBC.ground(point) else {
                    assert!(v <= 0.0, "{column}, {row}");
                    continue;
                };
                let depth = 128.0 * 1.3 / v;
                let close = |found: Real, exact: f64| (found.to_num::<f64>() - exact).abs() <= 1e-6 * depth * depth;
                assert!(close(found.forward, depth - 0.4), "{column}, {row}: {found:?}");
                assert!(close(found.right, u * depth / 140.8), "{column}, {row}: {found:?}");
            }
        }
    }

    #[test]
    fn no_ground_at_the_horizon_or_above() {
        for y in [Real::ZERO, -Real::DELTA, -Real::ONE, Real::MIN] {
            assert_eq!(GroundCamera::LBC.ground(ImagePoint { x: Real::ZERO, y }), None);
        }
        let far = GroundCamera::LBC.ground(ImagePoint { x: Real::MAX, y: Real::DELTA }).unwrap();
        assert_eq!(far.right, Real::MAX.saturating_div(GroundCamera::LBC.focal_length[0]));
        let flat = GroundCamera { size: [1, 0], focal_length: [Real::ZERO; 2], ..GroundCamera::LBC };
        assert_eq!(flat.image_point([5, 5]), ImagePoint { x: -Real::ONE, y: Real::from(5) / -32 - Real::ONE });
        assert_eq!(flat.ground(ImagePoint { x: Real::ONE, y: Real::ONE }), None);
    }
}
