//! The ReLU after a convolution, linear layer or addition into that operator.

use super::rewrite::merge_into_reader;
use crate::ir::{Graph, Op};

pub(super) fn run(graph: &mut Graph) {
    merge_into_reader(graph, |producer, reader, _| {
        let Op::Relu = reader.op else { return None };
        let mut op = producer.op.clone();
        match &mut op {
            Op::Conv2d(conv) => conv.relu = true,
            Op::Linear(linear) => linear.relu = true,
            Op::Add { relu } => *relu = true,
            _ => return None,
        }
        Some((op, producer.inputs.clone()))
    });
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::passes::fixture::{conv, image};

    #[test]
    fn operator_takes_the_relu_and_its_name() {
        let (mut graph, rgb) = image();
        let a = conv(&mut graph, "a", rgb, 3);
        let a = graph.push("a.relu", Op::Relu, &[a]).unwrap();
        let sum = graph.push("sum", Op::Add { relu: false }, &[a, rgb]).unwrap();
        let sum = graph.push("sum.relu", Op::Relu, &[sum]).unwrap();
        let free = graph.push("rgb.relu", Op::Relu, &[rgb]).unwrap();
        graph.outputs.extend([sum, free]);
        run(&mut graph);
        let names: Vec<_> = graph.nodes.iter().map(|n| n.name.as_str()).collect();
        assert_eq!(names, ["rgb", "a.relu", "sum.relu", "rgb.relu"]);
        assert!(matches!(&graph.nodes[1].op, Op::Conv2d(c) if c.relu));
        assert!(matches!(graph.nodes[2].op, Op::Add { relu: true }));
        assert!(matches!(graph.nodes[3].op, Op::Relu));
    }
}
