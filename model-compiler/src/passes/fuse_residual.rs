//! The addition after a convolution, linear layer or enlargement into that operator.

use super::rewrite::merge_into_reader;
use crate::ir::{Clip, Graph, Op};

/// The first operand of the addition that only the addition reads is the one that takes the other as its residual; in
/// a basic block with a projection shortcut this is the main path, and the projection stays a plain convolution.
/// `weighted` says whether convolutions and linear layers take part.
pub(super) fn run(graph: &mut Graph, weighted: bool) {
    merge_into_reader(graph, |producer, reader, operand| {
        let Op::Add { clip } = reader.op else { return None };
        if producer.inputs.len() != 1 {
            return None;
        }
        let mut op = producer.op.clone();
        match &mut op {
            Op::Conv2d(conv) if weighted && conv.clip == Clip::NONE => conv.clip = clip,
            Op::Linear(linear) if weighted && linear.clip == Clip::NONE => linear.clip = clip,
            Op::ResizeBilinear { .. } if clip == Clip::NONE => {}
            _ => return None,
        }
        Some((op, vec![producer.inputs[0], reader.inputs[1 - operand]]))
    });
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::ir::verify::verify;
    use crate::passes::fixture::{conv, image};

    #[test]
    fn projection_shortcut_becomes_the_residual_of_the_main_path() {
        let (mut graph, rgb) = image();
        let main = conv(&mut graph, "conv2", rgb, 4);
        let shortcut = conv(&mut graph, "downsample", rgb, 4);
        let sum = graph.push("add", Op::Add { clip: Clip::NONE }, &[main, shortcut]).unwrap();
        graph.outputs.push(sum);
        run(&mut graph, true);
        assert_eq!(verify(&graph), Ok(()));
        assert_eq!(graph.nodes.iter().map(|n| n.name.as_str()).collect::<Vec<_>>(), ["rgb", "downsample", "add"]);
        let fused = graph.producer(sum).unwrap();
        assert_eq!(fused.inputs, [rgb, shortcut]);
        assert_eq!(fused.op.name(), "conv2d");
    }

    #[test]
    fn second_operand_is_fused_where_the_first_has_other_readers() {
        let (mut graph, rgb) = image();
        let skip = conv(&mut graph, "conv1", rgb, 4);
        let branch = conv(&mut graph, "conv2", skip, 4);
        let sum = graph.push("add", Op::Add { clip: Clip::RELU }, &[skip, branch]).unwrap();
        graph.outputs.push(sum);
        run(&mut graph, true);
        assert_eq!(verify(&graph), Ok(()));
        let fused = graph.producer(sum).unwrap();
        assert_eq!(fused.inputs, [skip, skip]);
        assert!(matches!(&fused.op, Op::Conv2d(c) if c.clip == Clip::RELU));
    }

    #[test]
    fn switched_off_only_enlargements_take_a_residual() {
        let (mut graph, rgb) = image();
        let a = conv(&mut graph, "a", rgb, 4);
        let b = conv(&mut graph, "b", rgb, 4);
        let sum = graph.push("add", Op::Add { clip: Clip::NONE }, &[a, b]).unwrap();
        let up = graph.push("up", Op::ResizeBilinear { factor: (1, 1) }, &[rgb]).unwrap();
        let up = graph.push("up.add", Op::Add { clip: Clip::NONE }, &[up, rgb]).unwrap();
        graph.outputs.extend([sum, up]);
        run(&mut graph, false);
        assert_eq!(verify(&graph), Ok(()));
        assert_eq!(graph.producer(sum).unwrap().op.name(), "add");
        assert_eq!(graph.producer(up).unwrap().op.name(), "resize_bilinear");
    }

    #[test]
    fn doubling_is_not_a_residual() {
        let (mut graph, rgb) = image();
        let a = conv(&mut graph, "a", rgb, 4);
        let sum = graph.push("add", Op::Add { clip: Clip::NONE }, &[a, a]).unwrap();
        graph.outputs.push(sum);
        run(&mut graph, true);
        assert_eq!(graph.producer(sum).unwrap().inputs, [a, a]);
    }
}
