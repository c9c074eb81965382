//! A clip (ReLU) behind a max pool goes in front of it, where the layer before the pool can take it: the largest of
//! bounded values is the bounded largest value.

use super::rewrite::{exchange, own_producer};
use crate::ir::{Graph, Op};

pub(super) fn run(graph: &mut Graph) {
    for reader in 0..graph.nodes.len() {
        let Some((pool, layer)) = chain(graph, reader) else { continue };
        let unpooled = graph.value(graph.nodes[layer].output).shape;
        exchange(graph, pool, reader, unpooled);
    }
}

/// Max pool and layer in front of a clip, where each is read by its successor alone.
fn chain(graph: &Graph, reader: usize) -> Option<(usize, usize)> {
    if !matches!(graph.nodes[reader].op, Op::Clip(_)) {
        return None;
    }
    let pool = own_producer(graph, reader).filter(|pool| matches!(graph.nodes[*pool].op, Op::MaxPool(_)))?;
    let layer = own_producer(graph, pool)?;
    let takes_clips = matches!(graph.nodes[layer].op, Op::Conv2d(_) | Op::Linear(_) | Op::Add { .. });
    takes_clips.then_some((pool, layer))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::ir::verify::verify;
    use crate::ir::{Clip, ValueId};
    use crate::passes::fixture::{conv, image};
    use crate::reference;
    use firmware::program::Window;

    fn pooled_relu(layer: impl Fn(&mut Graph, ValueId) -> ValueId) -> Graph {
        let (mut graph, rgb) = image();
        let x = layer(&mut graph, rgb);
        let pool = graph.push("pool", Op::MaxPool(Window::square(3, 2, 1)), &[x]).unwrap();
        let relu = graph.push("relu", Op::Clip(Clip { min: 3.0, max: 700.0 }), &[pool]).unwrap();
        graph.outputs.push(relu);
        graph
    }

    #[test]
    fn a_convolution_in_front_of_the_pool_gets_the_clip() {
        let mut graph = pooled_relu(|graph, rgb| conv(graph, "conv", rgb, 4));
        let input = vec![(0..48).map(|i| (i * 37 % 101) as f32 - 30.0).collect()];
        let before = reference::run(&graph, &input, |_, _| ()).unwrap();
        run(&mut graph);
        assert_eq!(verify(&graph), Ok(()));
        assert_eq!(reference::run(&graph, &input, |_, _| ()).unwrap(), before);
        let nodes: Vec<_> = graph.nodes.iter().map(|n| (n.name.as_str(), n.op.name())).collect();
        assert_eq!(nodes, [("rgb", "input"), ("conv", "conv2d"), ("pool.input", "clip"), ("relu", "max_pool")]);
    }

    #[test]
    fn a_clip_that_nothing_would_take_stays() {
        let mut graph = pooled_relu(|_, rgb| rgb);
        run(&mut graph);
        assert_eq!(graph.nodes[2].op.name(), "clip");
        let mut graph = pooled_relu(|graph, rgb| {
            let x = conv(graph, "conv", rgb, 4);
            graph.outputs.push(x);
            x
        });
        run(&mut graph);
        assert_eq!(graph.nodes[3].op.name(), "clip");
    }
}
