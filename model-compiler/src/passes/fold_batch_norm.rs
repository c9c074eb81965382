//! Batch norm into the weights and bias of the convolution or linear layer before it.

use super::rewrite::merge_into_reader;
use crate::ir::{BatchNorm, Clip, Conv2d, Graph, Linear, Op, Weights};
use std::sync::Arc;

pub(super) fn run(graph: &mut Graph) {
    merge_into_reader(graph, |producer, reader, _| {
        let Op::BatchNorm(norm) = &reader.op else { return None };
        if producer.inputs.len() != 1 {
            return None;
        }
        let op = match &producer.op {
            Op::Conv2d(conv) if conv.clip == Clip::NONE => {
                let (weights, bias) = fold(&conv.weights, conv.bias.as_ref(), norm);
                Op::Conv2d(Conv2d { weights, bias, ..conv.clone() })
            }
            Op::Linear(linear) if linear.clip == Clip::NONE => {
                let (weights, bias) = fold(&linear.weights, linear.bias.as_ref(), norm);
                Op::Linear(Linear { weights, bias, ..linear.clone() })
            }
            _ => return None,
        };
        Some((op, producer.inputs.clone()))
    });
}

type Folded = (Arc<Weights>, Option<Arc<Vec<f32>>>);

/// In `f64`, rounded once to `f32`.
fn fold(weights: &Weights, bias: Option<&Arc<Vec<f32>>>, norm: &BatchNorm) -> Folded {
    let factor = |o: usize| {
        let deviation = (f64::from(norm.variance[o]) + f64::from(norm.epsilon)).sqrt();
        f64::from(norm.weight[o]) / deviation
    };
    let outputs = norm.weight.len();
    let depth = weights.data.len() / outputs;
    let mut data = Vec::with_capacity(weights.data.len());
    let mut new_bias = Vec::with_capacity(outputs);
    for o in 0..outputs {
        let factor = factor(o);
        let row = &weights.data[o * depth..(o + 1) * depth];
        data.extend(row.iter().map(|&w| (f64::from(w) * factor) as f32));
        let old = bias.map_or(0.0, |b| f64::from(b[o]));
        new_bias.push(((old - f64::from(norm.mean[o])) * factor + f64::from(norm.bias[o])) as f32);
    }
    (Arc::new(Weights { shape: weights.shape.clone(), data }), Some(Arc::new(new_bias)))
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
    fn linear_layer_takes_the_norm_too() {
        let (mut graph, rgb) = image();
        let weights = Arc::new(Weights { shape: vec![2, 3], data: vec![1.0, 2.0, 3.0, 4.0, 5.0, 6.0] });
        let linear = Op::Linear(Linear { weights, bias: Some(Arc::new(vec![1.0, -1.0])), clip: Clip::NONE });
        let x = graph.push("fc", linear, &[rgb]).unwrap();
        let y = batch_norm(&mut graph, "bn", x);
        graph.outputs.push(y);
        run(&mut graph);
        let factor = f64::from(1.0 + 1e-5_f32).sqrt().recip();
        let Op::Linear(folded) = &graph.producer(y).unwrap().op else { panic!() };
        let close = |(a, b): (&f32, f64)| (f64::from(*a) - b * factor).abs() < 1e-6;
        assert!(folded.weights.data.iter().zip([1.0, 2.0, 3.0, 4.0, 5.0, 6.0]).all(close));
        assert!(folded.bias.as_ref().unwrap().iter().zip([1.0, -1.0]).all(close));
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
