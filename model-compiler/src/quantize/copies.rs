//! Storage across operators that move codes: who must be stored like whom, and who may be.

use super::types::{Role, Stored};
use crate::calibrate::Statistics;
use crate::ir::{Graph, Node, Op, ValueId};
use std::collections::HashMap;

/// Whether an operator gives codes of its operand as they are, a border apart.
pub(super) fn is_copy(op: &Op) -> bool {
    matches!(op, Op::MaxPool(_) | Op::Slice(_) | Op::Pad(_))
}

/// Readers of each value; a graph output counts as one more.
pub(super) fn use_counts(graph: &Graph) -> Vec<u32> {
    let mut counts = vec![0; graph.values.len()];
    for id in graph.nodes.iter().flat_map(|n| &n.inputs).chain(&graph.outputs) {
        counts[id.0 as usize] += 1;
    }
    counts
}

/// Gives each copy the storage of its operand. Before that:
/// * an operand that only a concatenation reads gets the storage of the whole: its codes are moved, not rescaled
/// * an operand that only a clip reads gets the storage of what the clip leaves: its step will carry the bounds; what
///   that step reads keeps storage of its own, for it is not within the bounds
pub(super) fn share_storage(graph: &Graph, roles: &[Role], types: &mut [Stored]) {
    let uses = use_counts(graph);
    let mut joined = vec![false; types.len()];
    let mut clipped = vec![false; types.len()];
    for node in graph.nodes.iter().rev() {
        let result = node.output.0 as usize;
        for id in &node.inputs {
            let operand = id.0 as usize;
            let ordinary = matches!(roles[operand], Role::Narrow | Role::Skip | Role::Vector);
            if !ordinary || uses[operand] != 1 {
                continue;
            }
            match &node.op {
                Op::Clip(_) if graph.producer(*id).is_some_and(|p| has_bounds(&p.op)) => clipped[operand] = true,
                Op::Concat(_) if !clipped[result] => joined[operand] = true,
                op if is_copy(op) && joined[result] => joined[operand] = true,
                _ => continue,
            }
            types[operand] = types[result];
        }
    }
    for node in graph.nodes.iter().filter(|node| is_copy(&node.op)) {
        types[node.output.0 as usize] = types[node.inputs[0].0 as usize];
    }
}

/// Whether the step of an operator bounds its output.
fn has_bounds(op: &Op) -> bool {
    let is_fixed =
        matches!(op, Op::Input(_) | Op::Softmax | Op::Sigmoid | Op::SpatialSoftmax { .. } | Op::WaypointDecoder(_));
    !is_copy(op) && !is_fixed
}

/// The values whose storage must also hold the border of a pad behind them, each with the padded value.
pub(super) fn borders(graph: &Graph, statistics: &Statistics) -> HashMap<ValueId, ValueId> {
    let mut borders = HashMap::new();
    for node in &graph.nodes {
        let Op::Pad(pad) = &node.op else { continue };
        let source = source(graph, node);
        let seen = statistics.of(source);
        let border = f64::from(pad.value);
        if border < seen.min.min(0.0) || border > seen.max.max(0.0) {
            borders.insert(source, node.output);
        }
    }
    borders
}

/// The value that a chain of copies begins with.
fn source(graph: &Graph, copy: &Node) -> ValueId {
    match graph.producer(copy.inputs[0]) {
        Some(producer) if is_copy(&producer.op) => source(graph, producer),
        _ => copy.inputs[0],
    }
}
