//! Parts of small graphs for the passes' tests.

use crate::ir::{BatchNorm, Clip, Conv2d, Graph, InputKind, Op, Shape, ValueId, Weights};
use firmware::program::Window;
use std::sync::Arc;

/// A graph with one input `rgb` of 4×4×3.
pub(super) fn image() -> (Graph, ValueId) {
    let mut graph = Graph::default();
    let rgb = graph.push_input("rgb", InputKind::Image, Shape::map(4, 4, 3));
    (graph, rgb)
}

/// A 1×1 convolution without bias; weights 1, 2, 3, ….
pub(super) fn conv(graph: &mut Graph, name: &str, input: ValueId, outputs: usize) -> ValueId {
    let channels = usize::from(graph.value(input).shape.channels);
    let data = (1..=outputs * channels).map(|v| v as f32).collect();
    let weights = Arc::new(Weights { shape: vec![outputs, 1, 1, channels], data });
    let window = Window::square(1, 1, 0);
    let op = Conv2d { weights, bias: None, window, groups: 1, normalization: None, clip: Clip::NONE };
    graph.push(name, Op::Conv2d(op), &[input]).unwrap()
}

/// A batch norm that changes nothing but for ε.
pub(super) fn batch_norm(graph: &mut Graph, name: &str, input: ValueId) -> ValueId {
    let channels = usize::from(graph.value(input).shape.channels);
    let constant = |value| Arc::new(vec![value; channels]);
    let op = BatchNorm {
        weight: constant(1.0),
        bias: constant(0.0),
        mean: constant(0.0),
        variance: constant(1.0),
        epsilon: 1e-5,
    };
    graph.push(name, Op::BatchNorm(op), &[input]).unwrap()
}
