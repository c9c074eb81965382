//! Batch norm that no neighbor takes, as a 1×1 convolution per channel.

use crate::ir::{BatchNorm, Clip, Conv2d, Graph, Op, Weights};
use firmware::program::Window;
use std::sync::Arc;

pub(super) fn run(graph: &mut Graph) {
    for node in &mut graph.nodes {
        if let Op::BatchNorm(norm) = &node.op {
            let (scale, shift) = scale_and_shift(norm);
            let narrow = |values: Vec<f64>| values.into_iter().map(|v| v as f32).collect();
            node.op = Op::Conv2d(per_channel(narrow(scale), Some(Arc::new(narrow(shift)))));
        }
    }
}

/// `γ/√(variance + ε)` and `β − mean·γ/√(variance + ε)`.
pub(super) fn scale_and_shift(norm: &BatchNorm) -> (Vec<f64>, Vec<f64>) {
    let scale = |c: usize| {
        let deviation = (f64::from(norm.variance[c]) + f64::from(norm.epsilon)).sqrt();
        f64::from(norm.weight[c]) / deviation
    };
    let scales: Vec<f64> = (0..norm.weight.len()).map(scale).collect();
    let shift = |(c, scale): (usize, &f64)| f64::from(norm.bias[c]) - f64::from(norm.mean[c]) * scale;
    let shifts = scales.iter().enumerate().map(shift).collect();
    (scales, shifts)
}

/// A convolution that multiplies each channel by its weight.
pub(super) fn per_channel(weights: Vec<f32>, bias: Option<Arc<Vec<f32>>>) -> Conv2d {
    let channels = weights.len();
    Conv2d {
        weights: Arc::new(Weights { shape: vec![channels, 1, 1, 1], data: weights }),
        bias,
        window: Window::square(1, 1, 0),
        groups: channels as u16,
        normalization: None,
        clip: Clip::NONE,
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::ir::verify::verify;
    use crate::passes::fixture::image;
    use crate::reference;

    #[test]
    fn convolution_per_channel_equals_the_norm() {
        let (mut graph, rgb) = image();
        let norm = BatchNorm {
            weight: Arc::new(vec![3.0, -1.0, 0.0]),
            bias: Arc::new(vec![0.5, -1.0, 2.0]),
            mean: Arc::new(vec![2.0, 0.0, 1.0]),
            variance: Arc::new(vec![4.0, 0.25, 1.0]),
            epsilon: 0.0,
        };
        let y = graph.push("bn", Op::BatchNorm(norm), &[rgb]).unwrap();
        graph.outputs.push(y);
        let input = vec![(0..48).map(|v| v as f32).collect()];
        let before = reference::run(&graph, &input, |_, _| ()).unwrap();
        run(&mut graph);
        assert_eq!(verify(&graph), Ok(()));
        assert_eq!(graph.producer(y).unwrap().op.name(), "conv2d");
        assert_eq!(reference::run(&graph, &input, |_, _| ()).unwrap(), before);
    }
}
