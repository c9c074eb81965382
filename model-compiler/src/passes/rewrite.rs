//! What the passes share: merging a node into the only reader of its result, or the two changing places.

use crate::ir::{Graph, Node, Op, Shape, ValueId};

/// Readers of each value; a graph output counts as one more.
fn use_counts(graph: &Graph) -> Vec<u32> {
    let mut counts = vec![0; graph.values.len()];
    for id in graph.nodes.iter().flat_map(|n| &n.inputs).chain(&graph.outputs) {
        counts[id.0 as usize] += 1;
    }
    counts
}

/// Merges nodes into their only reader where `rule(producer, reader, operand)` gives the merged operator and operands;
/// `operand` is the reader's operand that the producer computes. The result stands at the reader's place, under its
/// name. Chains merge link by link.
pub(super) fn merge_into_reader(graph: &mut Graph, rule: impl Fn(&Node, &Node, usize) -> Option<(Op, Vec<ValueId>)>) {
    let uses = use_counts(graph);
    let mut producer = vec![None; graph.values.len()];
    let mut merged = vec![false; graph.nodes.len()];
    for reader in 0..graph.nodes.len() {
        let found = graph.nodes[reader].inputs.iter().enumerate().find_map(|(operand, id)| {
            let index: usize = producer[id.0 as usize].filter(|_| uses[id.0 as usize] == 1)?;
            Some((index, rule(&graph.nodes[index], &graph.nodes[reader], operand)?))
        });
        if let Some((index, (op, inputs))) = found {
            merged[index] = true;
            graph.nodes[reader].op = op;
            graph.nodes[reader].inputs = inputs;
        }
        producer[graph.nodes[reader].output.0 as usize] = Some(reader);
    }
    let mut merged = merged.into_iter();
    graph.nodes.retain(|_| merged.next() != Some(true));
}

/// Position of the node that computes the first operand of `reader`, where nothing else reads its result.
pub(super) fn own_producer(graph: &Graph, reader: usize) -> Option<usize> {
    let value = *graph.nodes[reader].inputs.first()?;
    let reads = graph.nodes.iter().flat_map(|n| &n.inputs).chain(&graph.outputs).filter(|id| **id == value);
    let producer = graph.nodes.iter().position(|n| n.output == value)?;
    (reads.count() == 1).then_some(producer)
}

/// A node and its [`own_producer`], with one operand each, change places. The value between them gets the shape
/// `between` and, since it is no longer what its name said, `.input` behind its name.
pub(super) fn exchange(graph: &mut Graph, producer: usize, reader: usize, between: Shape) {
    let value = &mut graph.values[graph.nodes[producer].output.0 as usize];
    value.shape = between;
    value.name.push_str(".input");
    graph.nodes[producer].name.push_str(".input");
    let op = graph.nodes[reader].op.clone();
    graph.nodes[reader].op = std::mem::replace(&mut graph.nodes[producer].op, op);
}
