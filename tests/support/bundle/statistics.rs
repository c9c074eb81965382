//! Batch-norm statistics of a network on given frames, as training would have left them.

use model_compiler::ir::{Graph, Node, Op, Shape};
use model_compiler::reference::evaluate;
use std::sync::Arc;

/// Per channel.
#[derive(Clone, Debug)]
pub struct Statistics {
    pub mean: Vec<f32>,
    pub variance: Vec<f32>,
}

/// Mean and variance at the input of every batch norm, by its name. `inputs` are raw, per frame in the graph's order.
///
/// One pass in topological order: each batch norm is evaluated with what was just measured, so that later ones see
/// activations like those of a trained network.
pub fn measure(graph: &Graph, inputs: Vec<Vec<Vec<f32>>>) -> Vec<(String, Statistics)> {
    let mut raw: Vec<_> = inputs.into_iter().map(Vec::into_iter).collect();
    // By frame, then by value.
    let mut values: Vec<Vec<Vec<f32>>> = vec![vec![Vec::new(); graph.values.len()]; raw.len()];
    let mut measured = Vec::new();
    for (position, node) in graph.nodes.iter().enumerate() {
        let mut op = node.op.clone();
        if let Op::BatchNorm(norm) = &mut op {
            let input = node.inputs[0].0 as usize;
            let frames: Vec<&[f32]> = values.iter().map(|frame| frame[input].as_slice()).collect();
            let statistics = of_channels(&frames, norm.mean.len());
            norm.mean = Arc::new(statistics.mean.clone());
            norm.variance = Arc::new(statistics.variance.clone());
            measured.push((node.name.clone(), statistics));
        }
        let shape = graph.value(node.output).shape;
        for (frame, raw) in values.iter_mut().zip(&mut raw) {
            let output = match op {
                Op::Input(_) => evaluate(&op, &[shape], &[&raw.next().expect("an input of the graph")], shape),
                _ => apply(graph, node, &op, frame),
            };
            frame[node.output.0 as usize] = output;
            drop_unused(graph, position, frame);
        }
    }
    measured
}

fn apply(graph: &Graph, node: &Node, op: &Op, frame: &[Vec<f32>]) -> Vec<f32> {
    let shapes: Vec<Shape> = node.inputs.iter().map(|&id| graph.value(id).shape).collect();
    let operands: Vec<&[f32]> = node.inputs.iter().map(|id| frame[id.0 as usize].as_slice()).collect();
    evaluate(op, &shapes, &operands, graph.value(node.output).shape)
}

fn drop_unused(graph: &Graph, position: usize, frame: &mut [Vec<f32>]) {
    for id in &graph.nodes[position].inputs {
        if !graph.nodes[position + 1..].iter().any(|later| later.inputs.contains(id)) {
            frame[id.0 as usize] = Vec::new();
        }
    }
}

fn of_channels(frames: &[&[f32]], channels: usize) -> Statistics {
    let count = frames.iter().map(|frame| frame.len() / channels).sum::<usize>() as f64;
    let sum = |term: &dyn Fn(usize, f64) -> f64| -> Vec<f64> {
        let mut sums = vec![0.0; channels];
        for position in frames.iter().flat_map(|frame| frame.chunks_exact(channels)) {
            position.iter().enumerate().for_each(|(c, &x)| sums[c] += term(c, f64::from(x)));
        }
        sums.iter().map(|s| s / count).collect()
    };
    let mean = sum(&|_, x| x);
    let variance = sum(&|c, x| (x - mean[c]) * (x - mean[c]));
    let single = |values: &[f64]| values.iter().map(|&v| v as f32).collect();
    Statistics { mean: single(&mean), variance: single(&variance) }
}
