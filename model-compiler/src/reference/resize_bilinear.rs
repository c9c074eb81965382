//! Enlargement by a whole factor with half-pixel centers (`align_corners = False`).

use super::elementwise::finish;
use crate::ir::{Clip, Shape};

/// Two neighbors along one axis and the weight of the second.
#[derive(Clone, Copy)]
struct Blend {
    first: usize,
    second: usize,
    weight: f32,
}

/// `[map]` or `[map, residual]`.
pub(super) fn resize_bilinear(factor: (u16, u16), shape: Shape, inputs: &[&[f32]], output: Shape) -> Vec<f32> {
    let map = inputs[0];
    let (width, channels) = (usize::from(shape.width), usize::from(shape.channels));
    let pixel = |y: usize, x: usize| &map[(y * width + x) * channels..][..channels];
    let (rows, columns) = (axis(shape.height, factor.0), axis(shape.width, factor.1));
    let mut out = Vec::with_capacity(output.elements() as usize);
    for y in &rows {
        for x in &columns {
            let (top_left, top_right) = (pixel(y.first, x.first), pixel(y.first, x.second));
            let (bottom_left, bottom_right) = (pixel(y.second, x.first), pixel(y.second, x.second));
            out.extend((0..channels).map(|c| {
                let top = mix(top_left[c], top_right[c], x.weight);
                let bottom = mix(bottom_left[c], bottom_right[c], x.weight);
                mix(top, bottom, y.weight)
            }));
        }
    }
    finish(&mut out, None, inputs.get(1).copied(), Clip::NONE);
    out
}

fn mix(a: f32, b: f32, weight: f32) -> f32 {
    (1.0 - weight) * a + weight * b
}

/// `src = max((d + ½)/factor − ½, 0)` for every output coordinate d.
fn axis(size: u16, factor: u16) -> Vec<Blend> {
    let last = usize::from(size) - 1;
    let blend = |d: usize| {
        let source = ((d as f64 + 0.5) / f64::from(factor) - 0.5).max(0.0);
        let first = (source.floor() as usize).min(last);
        Blend { first, second: (first + 1).min(last), weight: (source - first as f64) as f32 }
    };
    (0..usize::from(size) * usize::from(factor)).map(blend).collect()
}

#[cfg(test)]
mod tests {
    use super::super::testing::assert_close;
    use super::*;

    /// `torch.nn.functional.interpolate(x, scale_factor=…, mode="bilinear", align_corners=False)` of `[[1, 2], [3,
    /// 4]]`.
    #[test]
    fn meets_hand_values_of_the_framework() {
        let map = [1.0, 2.0, 3.0, 4.0];
        let resize = |f: (u16, u16)| resize_bilinear(f, Shape::map(2, 2, 1), &[&map], Shape::map(2 * f.0, 2 * f.1, 1));
        assert_eq!(
            resize((2, 2)),
            [1.0, 1.25, 1.75, 2.0, 1.5, 1.75, 2.25, 2.5, 2.5, 2.75, 3.25, 3.5, 3.0, 3.25, 3.75, 4.0]
        );
        let fourfold = [1.0, 1.0, 1.125, 1.375, 1.625, 1.875, 2.0, 2.0];
        assert_eq!(resize((1, 4)), fourfold.iter().copied().chain(fourfold.map(|v| v + 2.0)).collect::<Vec<_>>());
        assert_eq!(resize((1, 1)), map);
        assert_close(&resize((3, 1))[..6], &[1.0, 2.0, 1.0, 2.0, 5.0 / 3.0, 8.0 / 3.0], 1e-6);
    }

    #[test]
    fn channels_stay_apart_and_the_residual_is_added() {
        let out =
            resize_bilinear((1, 2), Shape::map(1, 2, 2), &[&[0.0, 8.0, 4.0, 0.0], &[100.0; 8]], Shape::map(1, 4, 2));
        assert_eq!(out, [100.0, 108.0, 101.0, 106.0, 103.0, 102.0, 104.0, 100.0]);
    }

    #[test]
    fn a_single_pixel_fills_the_map() {
        assert_eq!(resize_bilinear((2, 3), Shape::map(1, 1, 1), &[&[7.0]], Shape::map(2, 3, 1)), [7.0; 6]);
    }
}
