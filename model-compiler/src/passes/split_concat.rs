//! A concatenation of many maps as a balanced tree of pairs, and of one map as a copy: a step of the image joins two.
//!
//! In a tree over n maps an element is moved about log2(n) times; in a chain the first map would move n − 1 times.

use crate::ir::{Axis, Graph, Op, Shape, Slice, ValueId};

pub(super) fn run(graph: &mut Graph) {
    for mut node in std::mem::take(&mut graph.nodes) {
        let shapes: Vec<Shape> = node.inputs.iter().map(|&id| graph.value(id).shape).collect();
        match node.op {
            Op::Concat(_) if node.op.output_shape(&shapes).is_err() => {} // the verifier will say why
            Op::Concat(_) if shapes.len() == 1 => node.op = Op::Slice(whole(shapes[0])),
            Op::Concat(axis) if shapes.len() > 2 => {
                let (front, behind) = halves(&node.inputs);
                let pair = [(0, front), (front.len(), behind)];
                node.inputs = pair.map(|(first, half)| join(graph, &node.name, axis, first, half)).to_vec();
            }
            _ => {}
        }
        graph.nodes.push(node);
    }
}

/// A slice that takes everything.
fn whole(Shape { height, width, channels }: Shape) -> Slice {
    Slice { begin: [0; 3], end: [height, width, channels], stride: [1; 3] }
}

fn halves(operands: &[ValueId]) -> (&[ValueId], &[ValueId]) {
    operands.split_at(operands.len().div_ceil(2))
}

/// The operands number `first` and up of the concatenation `name`, as one value.
fn join(graph: &mut Graph, name: &str, axis: Axis, first: usize, operands: &[ValueId]) -> ValueId {
    if let [operand] = operands {
        return *operand;
    }
    let (front, behind) = halves(operands);
    let pair = [join(graph, name, axis, first, front), join(graph, name, axis, first + front.len(), behind)];
    let name = format!("{name}[{first}..{}]", first + operands.len());
    graph.push(name, Op::Concat(axis), &pair).expect("the whole fits together, so its parts do")
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::ir::InputKind;
    use crate::ir::verify::verify;
    use crate::reference;

    #[test]
    fn many_operands_become_pairs_and_give_the_same() {
        for (count, joins) in [(1, 0), (2, 1), (3, 2), (4, 3), (7, 6)] {
            let mut graph = Graph::default();
            let channels = |i: usize| i as u16 + 1;
            let maps: Vec<ValueId> = (0..count)
                .map(|i| graph.push_input(format!("x{i}"), InputKind::Image, Shape::map(2, 1, channels(i))))
                .collect();
            let all = graph.push("all", Op::Concat(Axis::Channels), &maps).unwrap();
            graph.outputs.push(all);
            let inputs: Vec<Vec<f32>> =
                (0..count).map(|i| (0..2 * channels(i)).map(|v| f32::from(v) + 100.0 * i as f32).collect()).collect();
            let before = reference::run(&graph, &inputs, |_, _| ()).unwrap();
            run(&mut graph);
            assert_eq!(verify(&graph), Ok(()));
            assert_eq!(reference::run(&graph, &inputs, |_, _| ()).unwrap(), before);
            let concats: Vec<_> = graph.nodes.iter().filter(|n| matches!(n.op, Op::Concat(_))).collect();
            assert_eq!(concats.len(), joins, "{count} maps");
            assert!(concats.iter().all(|n| n.inputs.len() == 2));
            assert_eq!(graph.producer(all).map(|n| n.name.as_str()), Some("all"));
        }
    }

    #[test]
    fn parts_are_named_by_their_operands() {
        let mut graph = Graph::default();
        let x = graph.push_input("x", InputKind::Image, Shape::map(2, 2, 3));
        let all = graph.push("all", Op::Concat(Axis::Height), &[x; 5]).unwrap();
        graph.outputs.push(all);
        run(&mut graph);
        let names: Vec<_> = graph.nodes.iter().map(|n| n.name.as_str()).collect();
        assert_eq!(names, ["x", "all[0..2]", "all[0..3]", "all[3..5]", "all"]);
    }
}
