//! The clip (ReLU) after a convolution, linear layer or addition into that operator.

use super::rewrite::merge_into_reader;
use crate::ir::{BranchLinear, Conv2d, Graph, Linear, Op};

pub(super) fn run(graph: &mut Graph) {
    merge_into_reader(graph, |producer, reader, _| {
        let Op::Clip(next) = reader.op else { return None };
        let mut op = producer.op.clone();
        match &mut op {
            Op::Conv2d(Conv2d { clip, .. })
            | Op::Linear(Linear { clip, .. })
            | Op::BranchLinear(BranchLinear { clip, .. })
            | Op::Add { clip }
            | Op::Clip(clip) => *clip = clip.then(next),
            _ => return None,
        }
        Some((op, producer.inputs.clone()))
    });
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::ir::Clip;
    use crate::passes::fixture::{conv, image};

    #[test]
    fn operator_takes_the_relu_and_its_name() {
        let (mut graph, rgb) = image();
        let a = conv(&mut graph, "a", rgb, 3);
        let a = graph.push("a.relu", Op::Clip(Clip::RELU), &[a]).unwrap();
        let sum = graph.push("sum", Op::Add { clip: Clip::NONE }, &[a, rgb]).unwrap();
        let sum = graph.push("sum.relu", Op::Clip(Clip::RELU), &[sum]).unwrap();
        let free = graph.push("rgb.relu", Op::Clip(Clip::RELU), &[rgb]).unwrap();
        graph.outputs.extend([sum, free]);
        run(&mut graph);
        let names: Vec<_> = graph.nodes.iter().map(|n| n.name.as_str()).collect();
        assert_eq!(names, ["rgb", "a.relu", "sum.relu", "rgb.relu"]);
        assert!(matches!(&graph.nodes[1].op, Op::Conv2d(c) if c.clip == Clip::RELU));
        assert!(matches!(graph.nodes[2].op, Op::Add { clip: Clip::RELU }));
        assert!(matches!(graph.nodes[3].op, Op::Clip(Clip::RELU)));
    }
}
