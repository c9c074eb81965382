//! Removes nodes whose results nobody reads, and values that nobody writes.

use crate::ir::{Graph, Op, ValueId};

/// Graph inputs stay: they are the network's interface.
pub(super) fn run(graph: &mut Graph) {
    let mut live = vec![false; graph.values.len()];
    for id in &graph.outputs {
        live[id.0 as usize] = true;
    }
    for node in graph.nodes.iter().rev() {
        if matches!(node.op, Op::Input(_)) || live[node.output.0 as usize] {
            live[node.output.0 as usize] = true;
            node.inputs.iter().for_each(|id| live[id.0 as usize] = true);
        }
    }
    graph.nodes.retain(|n| live[n.output.0 as usize]);
    renumber(graph, &live);
}

/// Drops dead values and closes the gaps in the numbering.
fn renumber(graph: &mut Graph, live: &[bool]) {
    let mut next = 0;
    let mut count = |&live: &bool| {
        next += u32::from(live);
        ValueId(next.wrapping_sub(1))
    };
    let new: Vec<ValueId> = live.iter().map(&mut count).collect();
    let mut keep = live.iter();
    graph.values.retain(|_| keep.next() == Some(&true));
    for node in &mut graph.nodes {
        node.output = new[node.output.0 as usize];
        node.inputs.iter_mut().for_each(|id| *id = new[id.0 as usize]);
    }
    graph.outputs.iter_mut().for_each(|id| *id = new[id.0 as usize]);
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::ir::Clip;
    use crate::ir::verify::verify;
    use crate::ir::{InputKind, Shape};
    use crate::passes::fixture::{conv, image};

    #[test]
    fn unread_chain_goes_and_unread_input_stays() {
        let (mut graph, rgb) = image();
        let dead = conv(&mut graph, "dead", rgb, 4);
        graph.push("dead.relu", Op::Clip(Clip::RELU), &[dead]).unwrap();
        graph.push_input("velocity", InputKind::Velocity, Shape::vector(1));
        let kept = conv(&mut graph, "kept", rgb, 4);
        graph.outputs.push(kept);
        run(&mut graph);
        assert_eq!(verify(&graph), Ok(()));
        assert_eq!(graph.values.iter().map(|v| v.name.as_str()).collect::<Vec<_>>(), ["rgb", "velocity", "kept"]);
        assert_eq!(graph.outputs, [ValueId(2)]);
    }
}
