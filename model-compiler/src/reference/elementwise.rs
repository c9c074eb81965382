//! Operators that treat each element alone, and the common end of the weighted ones.

use crate::ir::{BatchNorm, Normalization};

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

/// In place: bias per channel (the slice's length is the number of channels), then the residual, then ReLU.
pub(super) fn finish(out: &mut [f32], bias: Option<&[f32]>, residual: Option<&[f32]>, with_relu: bool) {
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
    if with_relu {
        relu(out);
    }
}

/// Zero where negative; not-a-number stays, so that a broken network shows.
pub(super) fn relu(out: &mut [f32]) {
    for x in out {
        if *x < 0.0 {
            *x = 0.0;
        }
    }
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
        finish(&mut out, Some(&[1.0, -2.0]), Some(&[-3.0, 3.0, 10.0, 0.5]), true);
        assert_eq!(out, [0.0, 2.0, 6.0, 0.0]);
        finish(&mut out, None, Some(&[-1.0; 4]), false);
        assert_eq!(out, [-1.0, 1.0, 5.0, -1.0]);
    }

    #[test]
    fn relu_keeps_not_a_number() {
        let mut out = [f32::NAN, -1.0, 2.0];
        relu(&mut out);
        assert!(out[0].is_nan());
        assert_eq!(out[1..], [0.0, 2.0]);
    }
}
