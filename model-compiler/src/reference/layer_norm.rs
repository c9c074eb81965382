//! LayerNorm over the channels of a range of rows.

use crate::ir::LayerNorm;

/// `(x − mean)/√(variance + ε)·γ + β`, biased variance, statistics in f64.
pub(super) fn layer_norm(norm: &LayerNorm, tokens: &[f32]) -> Vec<f32> {
    let channels = norm.weight.len();
    let rows = usize::from(norm.grid.0) * usize::from(norm.grid.1);
    let mut out = tokens[usize::from(norm.first_row) * channels..][..rows * channels].to_vec();
    for row in out.chunks_exact_mut(channels) {
        let count = channels as f64;
        let mean = row.iter().map(|&x| f64::from(x)).sum::<f64>() / count;
        let variance = row.iter().map(|&x| (f64::from(x) - mean).powi(2)).sum::<f64>() / count;
        let gain = 1.0 / (variance + f64::from(norm.epsilon)).sqrt();
        for ((x, weight), bias) in row.iter_mut().zip(norm.weight.iter()).zip(norm.bias.iter()) {
            *x = ((f64::from(*x) - mean) * gain) as f32 * weight + bias;
        }
    }
    out
}

#[cfg(test)]
mod tests {
    use super::super::testing::{assert_close, values};
    use super::*;
    use std::sync::Arc;

    fn norm(weight: Vec<f32>, bias: Vec<f32>, epsilon: f32, first_row: u16, grid: (u16, u16)) -> LayerNorm {
        LayerNorm { weight: Arc::new(weight), bias: Arc::new(bias), epsilon, first_row, grid }
    }

    #[test]
    fn reads_only_its_rows() {
        // Row 1: mean 4, variance 9 (+ 7 = 16). Row 2: constant.
        let op = norm(vec![2.0, 1.0], vec![0.0, 10.0], 7.0, 1, (1, 2));
        assert_eq!(layer_norm(&op, &[f32::NAN, 0.0, 1.0, 7.0, 5.0, 5.0, f32::NAN, 0.0]), [-1.5, 10.75, 0.0, 10.0]);
    }

    #[test]
    fn statistics_survive_a_large_offset() {
        let epsilon = 1e-5_f32;
        for seed in 0..20 {
            let channels = 8 + seed as usize;
            let x: Vec<f32> = values(seed, channels).iter().map(|v| v + 1000.0).collect();
            let (weight, bias) = (values(seed + 100, channels), values(seed + 200, channels));
            let mean = x.iter().map(|&v| f64::from(v)).sum::<f64>() / channels as f64;
            // The other form of the variance, E[x²] − mean², centered at 1000 where f64 is exact enough.
            let square = x.iter().map(|&v| (f64::from(v) - 1000.0).powi(2)).sum::<f64>() / channels as f64;
            let variance = square - (mean - 1000.0).powi(2);
            let normal = |v: f32| (f64::from(v) - mean) / (variance + f64::from(epsilon)).sqrt();
            let expected: Vec<f64> =
                (0..channels).map(|c| normal(x[c]) * f64::from(weight[c]) + f64::from(bias[c])).collect();
            assert_close(&layer_norm(&norm(weight, bias, epsilon, 0, (1, 1)), &x), &expected, 1e-6);
        }
    }
}
