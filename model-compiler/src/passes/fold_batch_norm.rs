//! Batch norm into the weights and bias of the convolution before it.

use super::rewrite::merge_into_reader;
use crate::ir::{BatchNorm, Clip, Conv2d, Graph, Op, Weights};
use std::sync::Arc;

pub(super) fn run(graph: &mut Graph) {
    merge_into_reader(graph, |producer, reader, _| match (&producer.op, &reader.op) {
        (Op::Conv2d(conv), Op::BatchNorm(norm)) if conv.clip == Clip::NONE && producer.inputs.len() == 1 => {
            Some((Op::Conv2d(fold(conv, norm)), producer.inputs.clone()))
        }
        _ => None,
    });
}

/// In `f64`, rounded once to `f32`.
fn fold(conv: &Conv2d, norm: &BatchNorm) -> Conv2d {
    let factor = |o: usize| {
        let deviation = (f64::from(norm.variance[o]) + f64::from(norm.epsilon)).sqrt();
        f64::from(norm.weight[o]) / deviation
    };
    let outputs = norm.weight.len();
    let depth = conv.weights.data.len() / outputs;
    let mut data = Vec::with_capacity(conv.weights.data.len());
    let mut bias = Vec::with_capacity(outputs);
    for o in 0..outputs {
        let factor = factor(o);
        let weights = &conv.weights.data[o * depth..(o + 1) * depth];
        data.extend(weights.iter().map(|&w| (f64::from(w) * factor) as f32));
        let old = conv.bias.as_ref().map_or(0.0, |b| f64::from(b[o]));
        bias.push(((old - f64::from(norm.mean[o])) * factor + f64::from(norm.bias[o])) as f32);
    }
    let weights = Arc::new(Weights { shape: conv.weights.shape.clone(), data });
    Conv2d { weights, bias: Some(Arc::new(bias)), ..conv.clone() }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::passes::fixture::{batch_norm, conv, image};

    #[test]
    fn weights_and_bias_take_scale_and_shift() {
        let (mut graph, rgb) = image();
        let x = conv(&mut graph, "conv", rgb, 2);
        let norm = BatchNorm {
            weight: Arc::new(vec![3.0, 1.0]),
            bias: Arc::new(vec![0.5, -1.0]),
            mean: Arc::new(vec![2.0, 0.0]),
            variance: Arc::new(vec![4.0, 0.25]),
            epsilon: 0.0,
        };
        let y = graph.push("bn", Op::BatchNorm(norm), &[x]).unwrap();
        graph.outputs.push(y);
        let before = match &graph.producer(x).unwrap().op {
            Op::Conv2d(c) => c.weights.data.clone(),
            _ => unreachable!(),
        };
        run(&mut graph);
        let node = graph.producer(y).unwrap();
        assert_eq!(node.name, "bn");
        let Op::Conv2d(folded) = &node.op else { panic!("{}", node.op.name()) };
        let half = before.len() / 2;
        assert!(folded.weights.data[..half].iter().zip(&before).all(|(new, old)| *new == 1.5 * old));
        assert!(folded.weights.data[half..].iter().zip(&before[half..]).all(|(new, old)| *new == 2.0 * old));
        assert_eq!(**folded.bias.as_ref().unwrap(), [-2.5, -1.0]);
    }

    #[test]
    fn result_with_a_second_reader_is_left_alone() {
        let (mut graph, rgb) = image();
        let x = conv(&mut graph, "conv", rgb, 2);
        let y = batch_norm(&mut graph, "bn", x);
        graph.outputs.extend([x, y]);
        run(&mut graph);
        assert_eq!(graph.nodes.len(), 3);
    }
}
