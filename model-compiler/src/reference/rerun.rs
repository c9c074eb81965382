//! Running again only what depends on one changed value.

use super::{Activations, evaluate, operand};
use crate::error::Result;
use crate::ir::{Graph, Node, Op, Shape, ValueId};

/// A value that is not what the network computes, and who gets to see it.
#[derive(Clone, Debug)]
pub struct Change<'a> {
    /// The value.
    pub value: ValueId,
    /// Names of the nodes that read the changed elements; all others read the kept ones.
    pub readers: Vec<&'a str>,
}

impl Change<'_> {
    /// Positions in [`Graph::nodes`] of what has to run again for `target`, in order.
    pub fn dependents(&self, graph: &Graph, target: ValueId) -> Vec<usize> {
        let mut needed = vec![false; graph.values.len()];
        needed[target.0 as usize] = true;
        for node in graph.nodes.iter().rev().filter(|node| node.output != self.value) {
            if needed[node.output.0 as usize] {
                node.inputs.iter().for_each(|id| needed[id.0 as usize] = true);
            }
        }
        let mut changed = vec![false; graph.values.len()];
        let mut dependents = Vec::new();
        for (position, node) in graph.nodes.iter().enumerate() {
            let reads = |id: &ValueId| changed[id.0 as usize] || self.is_seen(node, *id);
            if needed[node.output.0 as usize] && node.inputs.iter().any(reads) {
                changed[node.output.0 as usize] = true;
                dependents.push(position);
            }
        }
        dependents
    }

    fn is_seen(&self, node: &Node, id: ValueId) -> bool {
        id == self.value && self.readers.contains(&node.name.as_str())
    }
}

/// The value `target` where `elements` stand in the place of the changed value; `kept` holds every value of the
/// unchanged network.
///
/// # Errors
/// A value that is read was not kept.
///
/// # Panics
/// `elements` does not have the length of the changed value.
pub fn rerun(
    graph: &Graph,
    kept: &Activations,
    change: &Change<'_>,
    elements: &[f32],
    target: ValueId,
) -> Result<Vec<f32>> {
    assert_eq!(elements.len() as u64, graph.value(change.value).shape.elements(), "a change keeps the shape");
    if change.value == target {
        return Ok(elements.to_vec());
    }
    let dependents = change.dependents(graph, target);
    let mut last_use = vec![0; graph.values.len()];
    for &position in &dependents {
        graph.nodes[position].inputs.iter().for_each(|id| last_use[id.0 as usize] = position);
    }
    let mut fresh: Vec<Option<Vec<f32>>> = vec![None; graph.values.len()];
    for position in dependents {
        let node = &graph.nodes[position];
        let shapes: Vec<Shape> = node.inputs.iter().map(|&id| graph.value(id).shape).collect();
        let read = |&id: &ValueId| match &fresh[id.0 as usize] {
            _ if change.is_seen(node, id) => Ok(elements),
            Some(values) => Ok(values.as_slice()),
            None => operand(graph, kept, id, &node.name),
        };
        let operands: Vec<&[f32]> = node.inputs.iter().map(read).collect::<Result<_>>()?;
        let output = evaluate(&node.op, &shapes, &operands, graph.value(node.output).shape);
        debug_assert!(!matches!(node.op, Op::Input(_)), "an input depends on nothing");
        fresh[node.output.0 as usize] = Some(output);
        for id in node.inputs.iter().filter(|id| last_use[id.0 as usize] == position) {
            fresh[id.0 as usize] = None;
        }
    }
    match fresh[target.0 as usize].take() {
        Some(values) => Ok(values),
        None => Ok(operand(graph, kept, target, "the measured value")?.to_vec()),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::ir::Clip;
    use crate::ir::InputKind;
    use crate::reference::run_all;

    /// `x → relu a; a + a → b; a + b → c; b + b → unused`.
    fn graph() -> (Graph, [ValueId; 3]) {
        let mut graph = Graph::default();
        let x = graph.push_input("x", InputKind::Goal, Shape::vector(2));
        let a = graph.push("a", Op::Clip(Clip::RELU), &[x]).unwrap();
        let b = graph.push("b", Op::Add { clip: Clip::NONE }, &[a, a]).unwrap();
        let c = graph.push("c", Op::Add { clip: Clip::NONE }, &[a, b]).unwrap();
        graph.push("unused", Op::Add { clip: Clip::NONE }, &[b, b]).unwrap();
        graph.outputs = vec![c];
        (graph, [a, b, c])
    }

    #[test]
    fn a_change_reaches_the_target_through_its_readers_only() {
        let (graph, [a, b, c]) = graph();
        let kept = run_all(&graph, &[vec![1.0, 2.0]]).unwrap();
        assert_eq!(kept.get(c).unwrap(), [3.0, 6.0]);
        let run = |value, readers: &[&str], elements: &[f32]| {
            let change = Change { value, readers: readers.to_vec() };
            rerun(&graph, &kept, &change, elements, c).unwrap()
        };
        assert_eq!(run(a, &["b", "c"], &[10.0, 2.0]), [30.0, 6.0]);
        assert_eq!(run(a, &["c"], &[10.0, 2.0]), [12.0, 6.0]);
        assert_eq!(run(a, &["b"], &[10.0, 2.0]), [21.0, 6.0]);
        assert_eq!(run(b, &["c", "unused"], &[0.0, 0.0]), [1.0, 2.0]);
        assert_eq!(run(a, &[], &[10.0, 2.0]), [3.0, 6.0], "nobody sees it");
        assert_eq!(run(c, &[], &[7.0, 8.0]), [7.0, 8.0], "the target itself");
    }

    #[test]
    fn what_the_target_does_not_need_does_not_run() {
        let (graph, [a, b, c]) = graph();
        let change = Change { value: b, readers: vec!["c", "unused"] };
        assert_eq!(change.dependents(&graph, c), [3]);
        assert_eq!(Change { value: a, readers: vec!["b", "c"] }.dependents(&graph, c), [2, 3]);
    }

    #[test]
    fn the_unchanged_elements_give_the_same_bits() {
        let (graph, [a, _, c]) = graph();
        let kept = run_all(&graph, &[vec![0.1, 0.7]]).unwrap();
        let change = Change { value: a, readers: vec!["b", "c"] };
        assert_eq!(rerun(&graph, &kept, &change, kept.get(a).unwrap(), c).unwrap(), kept.get(c).unwrap());
    }
}
