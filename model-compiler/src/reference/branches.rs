//! A run for every command: what does not depend on it is computed once.

use super::{evaluate, run};
use crate::error::Result;
use crate::ir::{Graph, InputKind, Op, Shape, ValueId};
use std::collections::HashMap;

/// The branches of a graph, and which values depend on the one that is selected.
#[derive(Clone, Debug)]
pub struct Branches {
    count: usize,
    /// Per value.
    depends: Vec<bool>,
}

impl Branches {
    /// The branches of a graph; one where it has none.
    pub fn of(graph: &Graph) -> Self {
        let mut depends = vec![false; graph.values.len()];
        let mut count = 1;
        for node in &graph.nodes {
            let is_command = matches!(node.op, Op::Input(InputKind::Command));
            depends[node.output.0 as usize] = is_command || node.inputs.iter().any(|id| depends[id.0 as usize]);
            if let Op::BranchLinear(layer) = &node.op {
                count = count.max(layer.branches());
            }
        }
        Self { count, depends }
    }

    /// How many forms a value has: one, or one per branch.
    pub fn forms(&self, id: ValueId) -> usize {
        if self.depends[id.0 as usize] { self.count } else { 1 }
    }
}

/// Runs a graph as [`run`], but under every command instead of the given one. `observe` sees every node's output, in
/// order: once with branch 0, or, where it depends on the command, once for every branch.
///
/// # Errors
/// See [`run`].
pub fn run_branches(
    graph: &Graph,
    branches: &Branches,
    inputs: &[Vec<f32>],
    mut observe: impl FnMut(ValueId, usize, &[f32]),
) -> Result<()> {
    let depends = |id: ValueId| branches.depends[id.0 as usize];
    let dependents: Vec<_> = graph.nodes.iter().filter(|node| depends(node.output)).collect();
    let mut values: HashMap<ValueId, Vec<f32>> = HashMap::new();
    run(graph, inputs, |node, data| {
        if depends(node.output) {
            return;
        }
        if dependents.iter().any(|dependent| dependent.inputs.contains(&node.output)) {
            values.insert(node.output, data.to_vec());
        }
        observe(node.output, 0, data);
    })?;
    for branch in 0..branches.count {
        for node in &dependents {
            let output_shape = graph.value(node.output).shape;
            let data = if let Op::Input(_) = node.op {
                vec![(branch + 1) as f32]
            } else {
                let shapes: Vec<Shape> = node.inputs.iter().map(|&id| graph.value(id).shape).collect();
                let operands: Vec<&[f32]> = node.inputs.iter().map(|id| values[id].as_slice()).collect();
                evaluate(&node.op, &shapes, &operands, output_shape)
            };
            observe(node.output, branch, &data);
            values.insert(node.output, data);
        }
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::ir::{BranchLinear, Clip, Weights};
    use std::sync::Arc;

    #[test]
    fn every_branch_is_seen_and_the_trunk_once() {
        let mut graph = Graph::default();
        let x = graph.push_input("x", InputKind::Velocity, Shape::vector(1));
        let trunk = graph.push("trunk", Op::Clip(Clip::RELU), &[x]).unwrap();
        let command = graph.push_input("command", InputKind::Command, Shape::vector(1));
        let layer = |data: &[f32]| {
            let weights = Arc::new(Weights { shape: vec![data.len(), 1, 1], data: data.to_vec() });
            Op::BranchLinear(BranchLinear { weights, bias: None, clip: Clip::NONE })
        };
        let first = graph.push("first", layer(&[1.0, 10.0, 100.0]), &[trunk, command]).unwrap();
        let second = graph.push("second", layer(&[2.0, 3.0]), &[first, command]).unwrap();
        graph.outputs = vec![second];
        let branches = Branches::of(&graph);
        assert_eq!([x, trunk, command, second].map(|id| branches.forms(id)), [1, 1, 3, 3]);
        let mut seen = Vec::new();
        run_branches(&graph, &branches, &[vec![5.0], vec![2.0]], |id, branch, data| {
            seen.push((graph.value(id).name.as_str(), branch, data[0]));
        })
        .unwrap();
        let expected = [
            ("x", 0, 5.0),
            ("trunk", 0, 5.0),
            ("command", 0, 1.0),
            ("first", 0, 5.0),
            ("second", 0, 10.0),
            ("command", 1, 2.0),
            ("first", 1, 50.0),
            ("second", 1, 150.0),
            ("command", 2, 3.0),
            ("first", 2, 500.0),
            ("second", 2, 1500.0),
        ];
        assert_eq!(seen, expected, "the second layer's last branch serves the third command");
    }
}
