//! What the fusing passes share: merging a node into the only reader of its result.

use crate::ir::{Graph, Node, Op, ValueId};

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
