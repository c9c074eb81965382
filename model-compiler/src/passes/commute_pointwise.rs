//! A 1×1 convolution or linear layer changes places with the average pool behind it or the bilinear enlargement in
//! front of it, so that it runs on the smaller map.
//!
//! Both are means whose weights sum to one, the same for every channel: what a layer of one position makes of a mean is
//! the mean of what it makes, its bias included. Exact in real arithmetic.

use super::rewrite::{exchange, own_producer};
use crate::ir::{Clip, Graph, Op, Shape, Weights};
use firmware::program::Window;

/// Taps of an enlargement.
const BILINEAR_TAPS: u64 = 4;

pub(super) fn run(graph: &mut Graph) {
    for reader in 0..graph.nodes.len() {
        let Some(producer) = own_producer(graph, reader) else { continue };
        if [producer, reader].iter().any(|node| graph.nodes[*node].inputs.len() != 1) {
            continue;
        }
        let (front, behind) = (&graph.nodes[producer], &graph.nodes[reader]);
        let shapes = [front.inputs[0], front.output, behind.output].map(|id| graph.value(id).shape);
        if let Some(between) = exchanged(&front.op, &behind.op, shapes) {
            exchange(graph, producer, reader, between);
        }
    }
}

/// The shape between two operators after they changed places, if that is cheaper; `shapes` are those before, between
/// and behind them now. What counts are products, and values that are averaged.
fn exchanged(front: &Op, behind: &Op, [input, between, output]: [Shape; 3]) -> Option<Shape> {
    let (now, then, shape) = match (pointwise(front), behind) {
        (Some(weights), Op::AveragePool(window)) => {
            let taps = u64::from(window.kernel_h) * u64::from(window.kernel_w);
            let shape = Shape { channels: input.channels, ..output };
            let now = products(weights, between) + taps * output.elements();
            (now, taps * shape.elements() + products(weights, output), shape)
        }
        _ => {
            let (Op::ResizeBilinear { .. }, Some(weights)) = (front, pointwise(behind)) else { return None };
            let shape = Shape { channels: output.channels, ..input };
            let now = BILINEAR_TAPS * between.elements() + products(weights, output);
            (now, products(weights, shape) + BILINEAR_TAPS * output.elements(), shape)
        }
    };
    (then < now).then_some(shape)
}

/// The weights of an operator whose result at each position depends, without bounds, on the same position alone.
fn pointwise(op: &Op) -> Option<&Weights> {
    match op {
        Op::Conv2d(conv) => {
            let window = Window { dilation_h: 1, dilation_w: 1, ..conv.window };
            let alone = window == Window::square(1, 1, 0) && conv.normalization.is_none();
            (alone && conv.clip == Clip::NONE).then_some(&*conv.weights)
        }
        Op::Linear(linear) => (linear.clip == Clip::NONE).then_some(&*linear.weights),
        _ => None,
    }
}

/// Multiply-accumulates over a map of this size.
fn products(weights: &Weights, map: Shape) -> u64 {
    u64::from(map.positions()) * weights.shape.iter().product::<usize>() as u64
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::ir::verify::verify;
    use crate::ir::{Conv2d, Linear, ValueId};
    use crate::passes::fixture::{conv, image};
    use crate::reference;
    use std::sync::Arc;

    const POOL: Op = Op::AveragePool(Window::square(2, 2, 0));
    const ENLARGE: Op = Op::ResizeBilinear { factor: (2, 2) };

    fn with_bias(graph: &mut Graph, input: ValueId, outputs: usize) -> ValueId {
        let value = conv(graph, "conv", input, outputs);
        let Some(Op::Conv2d(conv)) = graph.nodes.last_mut().map(|node| &mut node.op) else { unreachable!() };
        conv.bias = Some(Arc::new((0..outputs).map(|i| 100.0 * i as f32 - 50.0).collect()));
        value
    }

    fn operators(graph: &Graph) -> Vec<(String, &'static str)> {
        graph.nodes.iter().skip(1).map(|n| (n.name.clone(), n.op.name())).collect()
    }

    fn named<const N: usize>(operators: [(&str, &'static str); N]) -> [(String, &'static str); N] {
        operators.map(|(name, operator)| (name.to_owned(), operator))
    }

    /// Runs the pass; the results stay, up to the rounding of f32.
    fn assert_equivalent(graph: &mut Graph) {
        let input = vec![(0..48).map(|i| (i * 37 % 101) as f32 - 30.0).collect()];
        let before = reference::run(graph, &input, |_, _| ()).unwrap();
        run(graph);
        assert_eq!(verify(graph), Ok(()));
        let after = reference::run(graph, &input, |_, _| ()).unwrap();
        for (found, expected) in after.concat().iter().zip(before.concat()) {
            assert!((found - expected).abs() <= 1e-5 * expected.abs().max(100.0), "{found}, expected {expected}");
        }
    }

    #[test]
    fn convolution_moves_behind_a_pool_and_in_front_of_an_enlargement() {
        let (mut graph, rgb) = image();
        let x = with_bias(&mut graph, rgb, 5);
        let pooled = graph.push("pool", POOL, &[x]).unwrap();
        graph.outputs.push(pooled);
        let macs = graph.macs();
        assert_equivalent(&mut graph);
        assert_eq!(operators(&graph), named([("conv.input", "average_pool"), ("pool", "conv2d")]));
        assert_eq!(graph.macs() * 4, macs);

        let (mut graph, rgb) = image();
        let enlarged = graph.push("up", ENLARGE, &[rgb]).unwrap();
        let x = with_bias(&mut graph, enlarged, 5);
        graph.outputs.push(x);
        let macs = graph.macs();
        assert_equivalent(&mut graph);
        assert_eq!(operators(&graph), named([("up.input", "conv2d"), ("conv", "resize_bilinear")]));
        assert_eq!(graph.macs() * 4, macs);
    }

    #[test]
    fn a_linear_layer_moves_like_a_convolution() {
        let (mut graph, rgb) = image();
        let enlarged = graph.push("up", ENLARGE, &[rgb]).unwrap();
        let weights = Arc::new(Weights { shape: vec![2, 3], data: vec![1.0, -2.0, 3.0, 0.5, 4.0, -1.0] });
        let linear = Linear { weights, bias: Some(Arc::new(vec![7.0, -9.0])), clip: Clip::NONE };
        let x = graph.push("linear", Op::Linear(linear), &[enlarged]).unwrap();
        let x = graph.push("pool", Op::AveragePool(Window::square(4, 4, 0)), &[x]).unwrap();
        graph.outputs.push(x);
        assert_equivalent(&mut graph);
        let expected = [("up.input", "linear"), ("linear", "resize_bilinear"), ("pool", "average_pool")];
        assert_eq!(operators(&graph), named(expected));
    }

    #[test]
    fn it_stays_where_it_would_cost_as_much_or_more() {
        let (mut graph, rgb) = image();
        let x = with_bias(&mut graph, rgb, 3);
        let same = graph.push("pool", Op::AveragePool(Window::square(1, 1, 0)), &[x]).unwrap();
        let x = graph.push("up", Op::ResizeBilinear { factor: (1, 1) }, &[same]).unwrap();
        let x = conv(&mut graph, "last", x, 3);
        graph.outputs.push(x);
        // Already on the smaller map: in front of an enlargement, behind a pool.
        let pooled = graph.push("small", POOL, &[rgb]).unwrap();
        let x = conv(&mut graph, "small.conv", pooled, 4);
        let x = graph.push("small.up", ENLARGE, &[x]).unwrap();
        graph.outputs.push(x);
        let before = operators(&graph);
        run(&mut graph);
        assert_eq!(operators(&graph), before);
    }

    #[test]
    fn it_stays_where_the_map_between_has_another_reader_or_the_operators_do_more() {
        type Change = fn(&mut Graph, ValueId);
        let changes: [Change; 5] = [
            |graph, between| graph.outputs.push(between),
            |graph, between| _ = graph.push("other", Op::GlobalPool, &[between]).unwrap(),
            |graph, _| edit(graph, |conv| conv.clip = Clip::RELU),
            |graph, _| edit(graph, |conv| conv.window.stride_h = 2),
            |graph, _| edit(graph, |conv| conv.window.pad_left = 1),
        ];
        for (number, change) in changes.iter().enumerate() {
            let (mut graph, rgb) = image();
            let between = with_bias(&mut graph, rgb, 5);
            change(&mut graph, between);
            let input = graph.value(rgb).shape;
            if let Ok(shape) = graph.nodes[1].op.output_shape(&[input]) {
                graph.values[between.0 as usize].shape = shape;
            }
            let pooled = graph.push("pool", Op::AveragePool(Window::square(2, 2, 0)), &[between]).unwrap();
            graph.outputs.push(pooled);
            run(&mut graph);
            assert_eq!(graph.nodes[1].op.name(), "conv2d", "change {number}");
        }
    }

    fn edit(graph: &mut Graph, change: impl Fn(&mut Conv2d)) {
        if let Op::Conv2d(conv) = &mut graph.nodes[1].op {
            change(conv);
        }
    }

    #[test]
    fn an_enlargement_that_adds_stays_in_front() {
        let (mut graph, rgb) = image();
        let small = graph.push("small", POOL, &[rgb]).unwrap();
        let sum = graph.push("up", ENLARGE, &[small, rgb]).unwrap();
        let x = with_bias(&mut graph, sum, 2);
        graph.outputs.push(x);
        run(&mut graph);
        assert_eq!(operators(&graph)[1..], named([("up", "resize_bilinear"), ("conv", "conv2d")]));
    }
}
