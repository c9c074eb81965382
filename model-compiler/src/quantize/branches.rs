//! Linear layers that a command selects: one set of scales for what goes in and out, weights and biases of each branch
//! its own.

use super::Builder;
use super::weighted::Layer;
use crate::error::Result;
use crate::ir::{BranchLinear, Node};
use crate::qmodel::QOp;

impl Builder<'_> {
    pub(super) fn branch_linear(&mut self, node: &Node, linear: &BranchLinear) -> Result<()> {
        let (input, command) = (self.tensor(node.inputs[0]), self.tensor(node.inputs[1]));
        let layer = Layer {
            weights: &linear.weights.data,
            bias: linear.bias.as_deref().map(Vec::as_slice),
            outputs: linear.branches() * linear.weights.shape[1],
            inputs: linear.weights.shape[2],
            groups: 1,
            branches: linear.branches(),
            normalization: None,
            clip: linear.clip,
        };
        let (weights, rescale, bounds, wide) = self.weighted(node, &layer, input, None)?;
        let (output, branches) = (self.tensor(node.output), linear.branches() as u16);
        self.step(node, QOp::BranchLinear { input, command, output, branches, weights, wide, rescale }, bounds);
        Ok(())
    }
}
