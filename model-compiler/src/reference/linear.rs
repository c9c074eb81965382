//! Linear layer: the channels of each position times the weights.

use super::elementwise::finish;
use super::matmul::{Panels, ROWS_PER_TASK};
use crate::ir::{BranchLinear, Linear};
use rayon::prelude::*;

/// `[x]` or `[x, residual]`, see [`Linear`].
pub(super) fn linear(linear: &Linear, inputs: &[&[f32]]) -> Vec<f32> {
    let mut out = product(&linear.weights.data, linear.weights.shape[0], inputs[0]);
    finish(&mut out, linear.bias.as_ref().map(|b| &b[..]), inputs.get(1).copied(), linear.clip);
    out
}

/// `[x, command]`, see [`BranchLinear`].
pub(super) fn branch_linear(layer: &BranchLinear, inputs: &[&[f32]]) -> Vec<f32> {
    let (outputs, depth) = (layer.weights.shape[1], layer.weights.shape[2]);
    let branch = layer.branch(inputs[1][0]);
    let weights = &layer.weights.data[branch * outputs * depth..][..outputs * depth];
    let mut out = product(weights, outputs, inputs[0]);
    finish(&mut out, layer.bias.as_ref().map(|b| &b[branch * outputs..][..outputs]), None, layer.clip);
    out
}

/// Every position of `x` times `weights` `[outputs][depth]`.
fn product(weights: &[f32], outputs: usize, x: &[f32]) -> Vec<f32> {
    let depth = weights.len() / outputs;
    let panels = Panels::new(weights, outputs);
    let mut out = vec![0.0; x.len() / depth * outputs];
    out.par_chunks_mut(ROWS_PER_TASK * outputs)
        .zip(x.par_chunks(ROWS_PER_TASK * depth))
        .for_each(|(out, rows)| panels.multiply(rows, out, outputs, 0));
    out
}

#[cfg(test)]
mod tests {
    use super::super::testing::{assert_close, values};
    use super::*;
    use crate::ir::Clip;
    use crate::ir::Weights;
    use proptest::prelude::*;
    use std::sync::Arc;

    proptest! {
        #[test]
        fn meets_the_definition(
            rows in 1..130_usize, outputs in 1..40_usize, depth in 1..40_usize, options in any::<[bool; 3]>(),
            seed: u64,
        ) {
            let [with_bias, relu, with_residual] = options;
            let clip = if relu { Clip::RELU } else { Clip::NONE };
            let layer = Linear {
                weights: Arc::new(Weights { shape: vec![outputs, depth], data: values(seed, outputs * depth) }),
                bias: with_bias.then(|| Arc::new(values(seed ^ 1, outputs))),
                clip,
            };
            let x = values(seed ^ 2, rows * depth);
            let residual = values(seed ^ 3, rows * outputs);
            let mut expected = Vec::new();
            for r in 0..rows {
                for o in 0..outputs {
                    let product = |k: usize| f64::from(x[r * depth + k]) * f64::from(layer.weights.data[o * depth + k]);
                    let mut y: f64 = (0..depth).map(product).sum();
                    y += layer.bias.as_ref().map_or(0.0, |b| f64::from(b[o]));
                    y += if with_residual { f64::from(residual[r * outputs + o]) } else { 0.0 };
                    expected.push(if relu { y.max(0.0) } else { y });
                }
            }
            let operands: &[&[f32]] = if with_residual { &[&x, &residual] } else { &[&x] };
            assert_close(&linear(&layer, operands), &expected, 1e-4);
        }
    }

    #[test]
    fn a_command_selects_its_branch() {
        let layer = BranchLinear {
            weights: Arc::new(Weights { shape: vec![2, 2, 1], data: vec![1.0, 2.0, 3.0, 4.0] }),
            bias: Some(Arc::new(vec![0.0, 0.5, 1.0, -20.0])),
            clip: Clip::RELU,
        };
        for (command, expected) in [(0.0, [3.0, 6.5]), (1.0, [3.0, 6.5]), (2.0, [10.0, 0.0]), (9.0, [10.0, 0.0])] {
            assert_eq!(branch_linear(&layer, &[&[3.0], &[command]]), expected, "command {command}");
        }
    }
}
