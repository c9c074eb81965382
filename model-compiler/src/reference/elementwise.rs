//! Operators that treat each element alone, and the common end of the weighted ones.

use crate::ir::{BatchNorm, Clip, Normalization};

/// `(x − mean)/std` per channel.
pub(super) fn normalize(n: &Normalization, x: &[f32]) -> Vec<f32> {
    let mut out = x.to_vec();
    for position in out.chunks_exact_mut(n.mean.len()) {
        for ((x, mean), std) in position.iter_mut().zip(&n.mean).zip(&n.std) {
            *x = (*x - mean) / std;
        }
    }
    out
}

/// `(x − mean)·γ/√(variance + ε) + β` per channel.
pub(super) fn batch_norm(bn: &BatchNorm, x: &[f32]) -> Vec<f32> {
    let gain = |(&weight, &variance): (&f32, &f32)| {
        (f64::from(weight) / (f64::from(variance) + f64::from(bn.epsilon)).sqrt()) as f32
    };
    let gains: Vec<f32> = bn.weight.iter().zip(bn.variance.iter()).map(gain).collect();
    let mut out = x.to_vec();
    for position in out.chunks_exact_mut(gains.len()) {
        for (c, x) in position.iter_mut().enumerate() {
            *x = (*x - bn.mean[c]) * gains[c] + bn.bias[c];
        }
    }
    out
}

/// In place: bias per channel (the slice's length is the number of channels), then the residual, then the bounds.
pub(super) fn finish(out: &mut [f32], bias: Option<&[f32]>, residual: Option<&[f32]>, bounds: Clip) {
    if let Some(bias) = bias {
        for position in out.chunks_exact_mut(bias.len()) {
            for (x, b) in position.iter_mut().zip(bias) {
                *x += b;
            }
        }
    }
    if let Some(residual) = residual {
        for (x, r) in out.iter_mut().zip(residual) {
            *x += r;
        }
    }
    clip(out, bounds);
}

/// Moves values to the nearest bound; not-a-number stays, so that a broken network shows.
pub(super) fn clip(out: &mut [f32], bounds: Clip) {
    if bounds == Clip::NONE {
        return;
    }
    for x in out {
        if *x < bounds.min {
            *x = bounds.min;
        } else if *x > bounds.max {
            *x = bounds.max;
        }
    }
}

/// `exp(x − max) / Σ exp(x − max)` over the channels of each position, in f64 inside.
pub(super) fn softmax(x: &[f32], channels: usize) -> Vec<f32> {
    let mut out = Vec::with_capacity(x.len());
    for position in x.chunks_exact(channels) {
        let peak = position.iter().copied().fold(f32::NEG_INFINITY, f32::max);
        let powers: Vec<f64> = position.iter().map(|x| (f64::from(*x) - f64::from(peak)).exp()).collect();
        let sum: f64 = powers.iter().sum();
        out.extend(powers.iter().map(|p| (p / sum) as f32));
    }
    out
}

/// `1 / (1 + exp(−x))`; f64 inside.
pub(super) fn sigmoid(x: &[f32]) -> Vec<f32> {
    x.iter().map(|&x| (1.0 / (1.0 + (-f64::from(x)).exp())) as f32).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::sync::Arc;

    #[test]
    fn normalize_is_per_channel() {
        let n = Normalization { mean: vec![1.0, -2.0], std: vec![2.0, 0.5] };
        assert_eq!(normalize(&n, &[1.0, -2.0, 5.0, 0.0]), [0.0, 0.0, 2.0, 4.0]);
    }

    #[test]
    fn batch_norm_meets_its_formula() {
        let bn = BatchNorm {
            weight: Arc::new(vec![3.0, -1.0]),
            bias: Arc::new(vec![0.5, 0.25]),
            mean: Arc::new(vec![1.0, 2.0]),
            variance: Arc::new(vec![3.75, 0.0]),
            epsilon: 0.25,
        };
        // √(3.75 + 0.25) = 2, √0.25 = 0.5
        assert_eq!(batch_norm(&bn, &[5.0, 3.0, 1.0, 2.0]), [6.5, -1.75, 0.5, 0.25]);
    }

    #[test]
    fn finish_adds_bias_then_residual_then_clips() {
        let mut out = [1.0, 1.0, -5.0, 1.0];
        finish(&mut out, Some(&[1.0, -2.0]), Some(&[-3.0, 3.0, 10.0, 0.5]), Clip::RELU);
        assert_eq!(out, [0.0, 2.0, 6.0, 0.0]);
        finish(&mut out, None, Some(&[-1.0; 4]), Clip::NONE);
        assert_eq!(out, [-1.0, 1.0, 5.0, -1.0]);
    }

    #[test]
    fn softmax_sums_to_one_and_keeps_ratios() {
        let out = softmax(&[0.0, f32::ln(3.0), 1000.0, 1000.0], 2);
        let expected = [0.25, 0.75, 0.5, 0.5];
        assert!(out.iter().zip(expected).all(|(o, e)| (o - e).abs() < 1e-6), "{out:?}");
    }

    #[test]
    fn sigmoid_has_its_known_values() {
        let out = sigmoid(&[0.0, f32::ln(3.0), -f32::ln(3.0), 1000.0, -1000.0]);
        let expected = [0.5, 0.75, 0.25, 1.0, 0.0];
        assert!(out.iter().zip(expected).all(|(o, e)| (o - e).abs() < 1e-6), "{out:?}");
    }

    #[test]
    fn clips_compose() {
        let six = Clip { min: 0.0, max: 6.0 };
        assert_eq!(Clip::RELU.then(six), six);
        assert_eq!(six.then(Clip { min: 7.0, max: 9.0 }), Clip { min: 7.0, max: 7.0 });
        let mut out = [-1.0, 3.0, 8.0];
        clip(&mut out, six);
        assert_eq!(out, [0.0, 3.0, 6.0]);
    }

    #[test]
    fn clip_keeps_not_a_number() {
        let mut out = [f32::NAN, -1.0, 2.0];
        clip(&mut out, Clip::RELU);
        assert!(out[0].is_nan());
        assert_eq!(out[1..], [0.0, 2.0]);
    }
}
