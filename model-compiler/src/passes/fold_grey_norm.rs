//! Batch norm of grey levels into the padded convolution that reads it, as its normalization.

use super::lower_batch_norm::scale_and_shift;
use super::rewrite::merge_into_reader;
use crate::ir::{BatchNorm, Conv2d, Graph, InputKind, Normalization, Op, ValueId, Weights};
use std::collections::HashSet;
use std::sync::Arc;

/// Only where every mean is a grey level: it is what padding stands for (half a level off at most, as any input).
/// Where one is not, and where a channel's γ is zero, the norm stays and becomes a step of its own, whose padding is
/// exact.
pub(super) fn run(graph: &mut Graph) {
    let grey = grey_values(graph);
    merge_into_reader(graph, |producer, reader, operand| {
        let (Op::BatchNorm(norm), Op::Conv2d(conv)) = (&producer.op, &reader.op) else { return None };
        if operand != 0 || conv.normalization.is_some() || !grey.contains(&producer.inputs[0]) {
            return None;
        }
        let (normalization, signs) = normalization(norm)?;
        let (inputs_per_group, outputs) = (*conv.weights.shape.last()?, conv.weights.shape[0]);
        let outputs_per_group = outputs / usize::from(conv.groups);
        let signed = |(o, row): (usize, &[f32])| {
            let first = o / outputs_per_group * inputs_per_group;
            row.iter().enumerate().map(|(k, w)| w * signs[first + k % inputs_per_group]).collect::<Vec<_>>()
        };
        let depth = conv.weights.data.len() / outputs;
        let data = conv.weights.data.chunks_exact(depth).enumerate().flat_map(signed).collect();
        let weights = Arc::new(Weights { shape: conv.weights.shape.clone(), data });
        let mut inputs = reader.inputs.clone();
        inputs[0] = producer.inputs[0];
        Some((Op::Conv2d(Conv2d { weights, normalization: Some(Arc::new(normalization)), ..conv.clone() }), inputs))
    });
}

/// Images, and means of their pixels.
fn grey_values(graph: &Graph) -> HashSet<ValueId> {
    let mut grey = HashSet::new();
    for node in &graph.nodes {
        let is_grey = match node.op {
            Op::Input(InputKind::Image | InputKind::Views) => true,
            Op::AveragePool(_) => grey.contains(&node.inputs[0]),
            _ => false,
        };
        if is_grey {
            grey.insert(node.output);
        }
    }
    grey
}

/// `±(x − mean)/std` per channel; `None` where padding has no grey level.
fn normalization(norm: &BatchNorm) -> Option<(Normalization, Vec<f32>)> {
    let (scale, shift) = scale_and_shift(norm);
    let mean: Vec<f64> = scale.iter().zip(&shift).map(|(scale, shift)| -shift / scale).collect();
    let is_level = |mean: &f64| (-0.5..255.5).contains(mean);
    let std: Vec<f32> = scale.iter().map(|scale| (1.0 / scale.abs()) as f32).collect();
    let signs = scale.iter().map(|scale| 1_f32.copysign(*scale as f32)).collect();
    let usable = mean.iter().all(is_level) && std.iter().all(|std| std.is_normal());
    usable.then(|| (Normalization { mean: mean.into_iter().map(|mean| mean as f32).collect(), std }, signs))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::ir::verify::verify;
    use crate::ir::{Clip, Shape};
    use crate::reference;
    use firmware::program::Window;

    /// `image → batch norm → padded convolution of two groups`, or with an average pool in front.
    fn graph(weight: [f32; 4], mean: [f32; 4], pooled: bool) -> Graph {
        let mut graph = Graph::default();
        let mut x = graph.push_input("views", InputKind::Views, Shape::map(6, 4, 4));
        if pooled {
            x = graph.push("pool", Op::AveragePool(Window::square(2, 2, 0)), &[x]).unwrap();
        }
        let norm = BatchNorm {
            weight: Arc::new(weight.to_vec()),
            bias: Arc::new(vec![0.5, -1.0, 0.25, 0.0]),
            mean: Arc::new(mean.to_vec()),
            variance: Arc::new(vec![4.0, 0.25, 1.0, 100.0]),
            epsilon: 0.0,
        };
        let x = graph.push("norm", Op::BatchNorm(norm), &[x]).unwrap();
        let data = (0..4 * 9 * 2).map(|v| v as f32 - 30.0).collect();
        let weights = Arc::new(Weights { shape: vec![4, 3, 3, 2], data });
        let window = Window::square(3, 1, 1);
        let conv = Conv2d { weights, bias: None, window, groups: 2, normalization: None, clip: Clip::NONE };
        let y = graph.push("conv", Op::Conv2d(conv), &[x]).unwrap();
        graph.outputs.push(y);
        graph
    }

    /// Outputs before and after the pass, and the operators that are left.
    fn folded(mut graph: Graph) -> ([Vec<f32>; 2], Vec<&'static str>) {
        let input = vec![(0..96).map(|v| (v * 37 % 256) as f32).collect()];
        let before = reference::run(&graph, &input, |_, _| ()).unwrap().remove(0);
        run(&mut graph);
        assert_eq!(verify(&graph), Ok(()));
        let after = reference::run(&graph, &input, |_, _| ()).unwrap().remove(0);
        ([before, after], graph.nodes.iter().map(|n| n.op.name()).collect())
    }

    #[test]
    fn convolution_takes_the_norm_with_its_signs() {
        for pooled in [false, true] {
            let (outputs, left) = folded(graph([2.0, -0.5, 1.0, -3.0], [100.0, 7.0, 3.0, 200.0], pooled));
            assert_eq!(left.last(), Some(&"conv2d"));
            assert_eq!(left.len(), if pooled { 3 } else { 2 });
            let worst = outputs[0].iter().zip(&outputs[1]).map(|(a, b)| (a - b).abs() / a.abs().max(1.0));
            assert!(worst.fold(0.0, f32::max) < 1e-5, "{outputs:?}");
        }
    }

    #[test]
    fn a_norm_whose_zero_is_no_grey_level_stays() {
        let good = [100.0, 7.0, 3.0, 200.0];
        for (weight, mean) in [
            ([2.0, 0.0, 1.0, 1.0], good),
            ([2.0, 1e-30, 1.0, 1.0], good),
            ([2.0, 1.0, 1.0, 1.0], [-10.0, 7.0, 3.0, 200.0]),
            ([2.0, 1.0, 1.0, 1.0], [100.0, 7.0, 3.0, 256.0]),
        ] {
            let ([before, after], left) = folded(graph(weight, mean, false));
            assert_eq!((left, before), (vec!["input", "batch_norm", "conv2d"], after), "{weight:?} {mean:?}");
        }
    }
}
