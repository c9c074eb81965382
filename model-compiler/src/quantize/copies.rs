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

/// Gives each copy the storage of its operand. Before that, an operand that only a concatenation reads gets the storage
/// of the whole (its codes are then moved, not rescaled), and one that only a clip reads gets the storage of what the clip
/// leaves, where the step that computes it will carry the bounds.
pub(super) fn share_storage(graph: &Graph, roles: &[Role], types: &mut [Stored]) {
    let uses = use_counts(graph);
    let mut given = vec![false; types.len()];
    for node in graph.nodes.iter().rev() {
        let gives = |id: &ValueId| match node.op {
            Op::Concat(_) => true,
            Op::Clip(_) => graph.producer(*id).is_some_and(|producer| has_bounds(&producer.op)),
            _ => is_copy(&node.op) && given[node.output.0 as usize],
        };
        let free = |id: &ValueId| {
            let ordinary = matches!(roles[id.0 as usize], Role::Narrow | Role::Skip | Role::Vector);
            ordinary && uses[id.0 as usize] == 1
        };
        let takers: Vec<ValueId> = node.inputs.iter().copied().filter(|id| free(id) && gives(id)).collect();
        for id in takers {
            types[id.0 as usize] = types[node.output.0 as usize];
            given[id.0 as usize] = true;
        }
    }
    for node in graph.nodes.iter().filter(|node| is_copy(&node.op)) {
        types[node.output.0 as usize] = types[node.inputs[0].0 as usize];
    }
}

/// Whether the step of an operator bounds its output.
fn has_bounds(op: &Op) -> bool {
    !is_copy(op) && !matches!(op, Op::Input(_) | Op::Softmax | Op::WaypointDecoder(_))
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
