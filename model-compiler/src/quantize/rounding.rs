//! Weights to integers so that their errors cancel on the inputs that the layer will see.
//!
//! With `e = w − s·q` the error of one output varies by `eᵀ·C·e`, C being the covariance of the inputs; its mean is the
//! bias's affair. Finding the best integers is a closest-vector problem. Babai's nearest plane is the classical
//! answer: with `C = Rᵀ·R`, R upper triangular, `|R·e|²` is settled element by element from the last to the first, each
//! taking over the errors of those behind it. (GPTQ, Frantar et al. 2022, is the same rule written for the inverse.)

use super::factors::round;
use ndarray::Array2;

/// Largest magnitude of an i8 weight.
const LARGEST: f64 = 127.0;

/// Added to the diagonal, as a share of its mean: keeps the factorization stable, and the weights near their values in
/// directions that the samples say little about.
const DAMPING: f64 = 0.01;

/// How a row of weights is rounded.
#[derive(Clone, Debug)]
pub struct Rounding {
    /// `R[k][j] / R[k][k]` for `j > k`, row by row; empty where every weight goes to its nearest integer.
    compensation: Vec<Vec<f64>>,
}

impl Rounding {
    /// Every weight to its nearest integer.
    pub fn nearest() -> Self {
        Self { compensation: Vec::new() }
    }

    /// By a covariance; to nearest where the inputs never vary.
    pub fn by(covariance: &Array2<f64>) -> Self {
        let depth = covariance.nrows();
        let damping = DAMPING * covariance.diag().iter().sum::<f64>() / depth as f64;
        if damping.is_nan() || damping <= 0.0 {
            return Self::nearest();
        }
        let mut upper: Vec<Vec<f64>> = Vec::with_capacity(depth);
        let mut rest = covariance.clone();
        for k in 0..depth {
            let pivot = (rest[[k, k]] + damping).max(damping);
            let row: Vec<f64> = (k + 1..depth).map(|j| rest[[k, j]] / pivot).collect();
            for (i, of_row) in row.iter().enumerate() {
                let scaled = of_row * pivot;
                let target = rest.row_mut(k + 1 + i);
                let target = target.into_slice().expect("rows of an owned matrix are contiguous");
                for (element, other) in target[k + 1 + i..].iter_mut().zip(&row[i..]) {
                    *element -= scaled * other;
                }
            }
            upper.push(row);
        }
        Self { compensation: upper }
    }

    /// Integers in −127..=127 for weights of this scale.
    pub fn round(&self, weights: &[f64], scale: f64) -> Vec<f64> {
        let code = |weight: f64| round(weight / scale).clamp(-LARGEST, LARGEST);
        if self.compensation.is_empty() {
            return weights.iter().copied().map(code).collect();
        }
        let mut codes = vec![0.0; weights.len()];
        let mut errors = vec![0.0; weights.len()];
        for k in (0..weights.len()).rev() {
            let behind = self.compensation[k].iter().zip(&errors[k + 1..]);
            codes[k] = code(weights[k] + behind.map(|(share, error)| share * error).sum::<f64>());
            errors[k] = weights[k] - scale * codes[k];
        }
        codes
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn noise(covariance: &Array2<f64>, weights: &[f64], codes: &[f64], scale: f64) -> f64 {
        let errors: Vec<f64> = weights.iter().zip(codes).map(|(w, q)| w - scale * q).collect();
        let product = |(i, j)| errors[i] * covariance[[i, j]] * errors[j];
        ndarray::indices(covariance.dim()).into_iter().map(product).sum()
    }

    /// Values in −0.5..0.5 that follow from a seed.
    fn random(mut state: u64) -> impl FnMut() -> f64 {
        move || {
            state = state.wrapping_mul(6364136223846793005).wrapping_add(1442695040888963407);
            (state >> 40) as f64 / f64::from(1 << 24) - 0.5
        }
    }

    /// `Σ x·xᵀ` of samples whose elements are alike.
    fn covariance(depth: usize) -> Array2<f64> {
        let mut random = random(7);
        let mut sum = Array2::zeros((depth, depth));
        for _ in 0..20 * depth {
            let common = 4.0 * random();
            let sample: Vec<f64> = (0..depth).map(|_| common + random()).collect();
            sum.indexed_iter_mut().for_each(|((i, j), s)| *s += sample[i] * sample[j]);
        }
        sum
    }

    #[test]
    fn inputs_that_do_not_vary_together_leave_nothing_to_cancel() {
        let weights = [0.3, -1.26, 0.74, 5.0, -200.0];
        let nearest = [0.0, -1.0, 1.0, 5.0, -127.0];
        let diagonal = Array2::from_diag(&ndarray::arr1(&[3.0, 1.0, 9.0, 0.0, 2.0]));
        assert_eq!(Rounding::by(&diagonal).round(&weights, 1.0), nearest);
        assert_eq!(Rounding::nearest().round(&weights, 1.0), nearest);
        assert_eq!(Rounding::by(&Array2::zeros((5, 5))).round(&weights, 1.0), nearest);
    }

    #[test]
    fn two_equal_inputs_share_their_error() {
        let together = ndarray::arr2(&[[1.0, 1.0], [1.0, 1.0]]);
        // 0.4 + 0.4: nearest gives 0 + 0; the sum is 1 at the best.
        assert_eq!(Rounding::by(&together).round(&[0.4, 0.4], 1.0), [1.0, 0.0]);
    }

    #[test]
    fn correlated_inputs_get_less_noise_than_from_nearest() {
        let covariance = covariance(24);
        let rounding = Rounding::by(&covariance);
        let (mut random, mut found, mut nearest) = (random(8), 0.0, 0.0);
        for _ in 0..10 {
            let weights: Vec<f64> = (0..24).map(|_| random()).collect();
            let scale = 0.03;
            found += noise(&covariance, &weights, &rounding.round(&weights, scale), scale);
            nearest += noise(&covariance, &weights, &Rounding::nearest().round(&weights, scale), scale);
        }
        assert!(found < 0.2 * nearest, "{found} against {nearest}");
    }
}
