//! Batch norm into the weights and bias of the convolution or linear layer behind it.

use super::lower_batch_norm::scale_and_shift;
use super::rewrite::merge_into_reader;
use crate::ir::{BatchNorm, Conv2d, Graph, Linear, Op, Weights};
use std::sync::Arc;

/// Exact only without padding: padding is zero behind the norm, which no value before it stands for.
pub(super) fn run(graph: &mut Graph) {
    merge_into_reader(graph, |producer, reader, operand| {
        let Op::BatchNorm(norm) = &producer.op else { return None };
        if operand != 0 {
            return None;
        }
        let op = match &reader.op {
            Op::Conv2d(conv) if is_unpadded(conv) && conv.normalization.is_none() => {
                let inputs_per_group = norm.weight.len() / usize::from(conv.groups);
                let outputs_per_group = conv.weights.shape[0] / usize::from(conv.groups);
                let first = |o: usize| o / outputs_per_group * inputs_per_group;
                let (weights, bias) = fold(norm, &conv.weights, conv.bias.as_ref(), first);
                Op::Conv2d(Conv2d { weights, bias, ..conv.clone() })
            }
            Op::Linear(linear) => {
                let (weights, bias) = fold(norm, &linear.weights, linear.bias.as_ref(), |_| 0);
                Op::Linear(Linear { weights, bias, ..linear.clone() })
            }
            _ => return None,
        };
        let mut inputs = reader.inputs.clone();
        inputs[0] = producer.inputs[0];
        Some((op, inputs))
    });
}

fn is_unpadded(conv: &Conv2d) -> bool {
    let w = &conv.window;
    [w.pad_top, w.pad_bottom, w.pad_left, w.pad_right] == [0; 4]
}

type Folded = (Arc<Weights>, Option<Arc<Vec<f32>>>);

/// In `f64`, rounded once to `f32`; `first` is the channel that the first weight of an output multiplies.
fn fold(norm: &BatchNorm, weights: &Weights, bias: Option<&Arc<Vec<f32>>>, first: impl Fn(usize) -> usize) -> Folded {
    let (scale, shift) = scale_and_shift(norm);
    let inputs = weights.shape.last().copied().unwrap_or(1);
    let outputs = weights.shape[0];
    let mut data = Vec::with_capacity(weights.data.len());
    let mut new_bias = Vec::with_capacity(outputs);
    for (o, row) in weights.data.chunks_exact(weights.data.len() / outputs).enumerate() {
        let channel = |i: usize| first(o) + i % inputs;
        data.extend(row.iter().enumerate().map(|(i, &w)| (f64::from(w) * scale[channel(i)]) as f32));
        let shifts: f64 = row.iter().enumerate().map(|(i, &w)| f64::from(w) * shift[channel(i)]).sum();
        new_bias.push((bias.map_or(0.0, |b| f64::from(b[o])) + shifts) as f32);
    }
    (Arc::new(Weights { shape: weights.shape.clone(), data }), Some(Arc::new(new_bias)))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::ir::verify::verify;
    use crate::ir::{Clip, ValueId};
    use crate::passes::fixture::image;
    use crate::reference;
    use firmware::program::Window;

    fn norm(graph: &mut Graph, input: ValueId) -> ValueId {
        let norm = BatchNorm {
            weight: Arc::new(vec![3.0, -1.0, 2.0]),
            bias: Arc::new(vec![0.5, -1.0, 2.0]),
            mean: Arc::new(vec![2.0, 0.0, 1.0]),
            variance: Arc::new(vec![4.0, 0.25, 1.0]),
            epsilon: 0.0,
        };
        graph.push("bn", Op::BatchNorm(norm), &[input]).unwrap()
    }

    fn conv(groups: u16, window: Window) -> Op {
        let taps = usize::from(window.kernel_h) * usize::from(window.kernel_w);
        let shape = vec![6, window.kernel_h.into(), window.kernel_w.into(), 3 / usize::from(groups)];
        let data = (0..6 * taps * 3 / usize::from(groups)).map(|v| v as f32 - 5.0).collect();
        let weights = Arc::new(Weights { shape, data });
        Op::Conv2d(Conv2d { weights, bias: None, window, groups, normalization: None, clip: Clip::NONE })
    }

    #[test]
    fn convolutions_and_linear_layers_take_the_norm_before_them() {
        let weights = Arc::new(Weights { shape: vec![2, 3], data: vec![1.0, -2.0, 3.0, 4.0, 5.0, -6.0] });
        let linear = Op::Linear(Linear { weights, bias: Some(Arc::new(vec![1.0, 2.0])), clip: Clip::RELU });
        for op in [conv(1, Window::square(2, 1, 0)), conv(3, Window::square(2, 2, 0)), linear] {
            let (mut graph, rgb) = image();
            let x = norm(&mut graph, rgb);
            let y = graph.push("y", op, &[x]).unwrap();
            graph.outputs.push(y);
            let input = vec![(0..48).map(|v| v as f32).collect()];
            let before = reference::run(&graph, &input, |_, _| ()).unwrap();
            run(&mut graph);
            assert_eq!(verify(&graph), Ok(()));
            assert_eq!(graph.nodes.len(), 2);
            assert_eq!(reference::run(&graph, &input, |_, _| ()).unwrap(), before);
        }
    }

    #[test]
    fn padding_and_residuals_keep_the_norm() {
        let (mut graph, rgb) = image();
        let x = norm(&mut graph, rgb);
        let y = graph.push("y", conv(1, Window::square(3, 1, 1)), &[x]).unwrap();
        graph.outputs.push(y);
        run(&mut graph);
        assert_eq!(graph.nodes.len(), 3);
        let (mut graph, rgb) = image();
        let x = norm(&mut graph, rgb);
        let weights = Arc::new(Weights { shape: vec![3, 3], data: vec![1.0; 9] });
        let linear = Op::Linear(Linear { weights, bias: None, clip: Clip::NONE });
        let y = graph.push("y", linear, &[rgb, x]).unwrap();
        graph.outputs.push(y);
        run(&mut graph);
        assert_eq!(graph.nodes.len(), 3);
    }
}
