//! A 1×1 convolution changes places with the average pool behind it or the bilinear enlargement in front of it, so that
//! it runs on the smaller map.
//!
//! Both are means whose weights sum to one, the same for every channel: what a convolution of one position makes of a
//! mean is the mean of what it makes, its bias included. Exact in real arithmetic.

use super::rewrite::{exchange, own_producer};
use crate::ir::{Clip, Conv2d, Graph, Op, Shape};
use firmware::program::Window;

/// Taps of an enlargement.
const BILINEAR_TAPS: u64 = 4;

pub(super) fn run(graph: &mut Graph) {
    for reader in 0..graph.nodes.len() {
        let Some(producer) = own_producer(graph, reader) else { continue };
        if [producer, reader].iter().any(|node| graph.nodes[*node].inputs.len() != 1) {
            continue;
        }
        let shape = |node: usize, operand: usize| graph.value(graph.nodes[node].inputs[operand]).shape;
        let (input, between) = (shape(producer, 0), shape(reader, 0));
        let output = graph.value(graph.nodes[reader].output).shape;
        let exchanged = match (&graph.nodes[producer].op, &graph.nodes[reader].op) {
            (Op::Conv2d(conv), Op::AveragePool(window)) if is_pointwise(conv) => {
                let taps = u64::from(window.kernel_h) * u64::from(window.kernel_w);
                let now = products(conv, between) + taps * output.elements();
                let then = Shape { channels: input.channels, ..output };
                (products(conv, output) + taps * then.elements() < now).then_some(then)
            }
            (Op::ResizeBilinear { .. }, Op::Conv2d(conv)) if is_pointwise(conv) => {
                let now = BILINEAR_TAPS * between.elements() + products(conv, output);
                let then = Shape { channels: output.channels, ..input };
                (products(conv, then) + BILINEAR_TAPS * output.elements() < now).then_some(then)
            }
            _ => None,
        };
        if let Some(between) = exchanged {
            exchange(graph, producer, reader, between);
        }
    }
}

/// Whether each position of the result depends, without bounds, on the same position alone.
fn is_pointwise(conv: &Conv2d) -> bool {
    let window = Window { dilation_h: 1, dilation_w: 1, ..conv.window };
    window == Window::square(1, 1, 0) && conv.clip == Clip::NONE && conv.normalization.is_none()
}

/// Multiply-accumulates of a convolution that gives a map of this size.
fn products(conv: &Conv2d, output: Shape) -> u64 {
    let [_, per_output @ ..] = &conv.weights.shape[..] else { return 0 };
    u64::from(output.positions()) * conv.weights.shape[0] as u64 * per_output.iter().product::<usize>() as u64
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::ir::ValueId;
    use crate::ir::verify::verify;
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
            if let Some(shape) = graph.nodes[1].op.output_shape(&[input]).ok() {
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
