//! Softmax over all pixels of each channel, and the pixel that it expects.

use crate::ir::Shape;

/// `[map]` to `[column, row]` per channel, in f64 inside.
pub(super) fn spatial_softmax(temperature: f32, shape: Shape, map: &[f32]) -> Vec<f32> {
    let (width, channels) = (usize::from(shape.width), usize::from(shape.channels));
    let point = |channel: usize| {
        let logits = || map.iter().skip(channel).step_by(channels);
        let peak = f64::from(logits().copied().fold(f32::NEG_INFINITY, f32::max));
        let [mut total, mut across, mut down] = [0.0; 3];
        for (pixel, &logit) in logits().enumerate() {
            let power = ((f64::from(logit) - peak) / f64::from(temperature)).exp();
            total += power;
            across += power * (pixel % width) as f64;
            down += power * (pixel / width) as f64;
        }
        [(across / total) as f32, (down / total) as f32]
    };
    (0..channels).flat_map(point).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn even_logits_expect_the_middle_and_a_peak_its_pixel() {
        let shape = Shape::map(3, 5, 2);
        let mut map = vec![1.0; 30];
        assert_eq!(spatial_softmax(5.0, shape, &map), [2.0, 1.0, 2.0, 1.0]);
        map[2 * (5 + 4) + 1] = 1e6;
        assert_eq!(spatial_softmax(5.0, shape, &map), [2.0, 1.0, 4.0, 1.0]);
    }

    #[test]
    fn temperature_divides_the_logits() {
        let map = [0.0, 3.0_f32.ln()];
        assert!((spatial_softmax(1.0, Shape::map(1, 2, 1), &map)[0] - 0.75).abs() < 1e-6);
        let root = 3.0_f32.sqrt();
        assert!((spatial_softmax(2.0, Shape::map(2, 1, 1), &map)[1] - root / (1.0 + root)).abs() < 1e-6);
    }
}
