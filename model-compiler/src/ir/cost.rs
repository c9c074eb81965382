//! What a network holds and costs: constants, parameters, multiply-accumulates.

use super::{Graph, Node, Op, Weights};
use std::collections::HashSet;

/// A constant of an operator.
#[derive(Clone, Copy, Debug)]
pub struct Constant<'a> {
    /// Its role, as messages name it.
    pub what: &'static str,
    /// Dimensions, outermost first; absent for a vector.
    pub shape: Option<&'a [usize]>,
    /// Row-major elements.
    pub data: &'a [f32],
    /// Whether training adjusts it (batch-norm statistics are measured, input normalization is given).
    pub trained: bool,
}

fn matrix<'a>(what: &'static str, weights: &'a Weights) -> Constant<'a> {
    Constant { what, shape: Some(&weights.shape), data: &weights.data, trained: true }
}

fn vector<'a>(what: &'static str, data: &'a [f32]) -> Constant<'a> {
    Constant { what, shape: None, data, trained: true }
}

fn statistic<'a>(what: &'static str, data: &'a [f32]) -> Constant<'a> {
    Constant { what, shape: None, data, trained: false }
}

impl Op {
    /// All constants of the operator.
    pub fn constants(&self) -> Vec<Constant<'_>> {
        match self {
            Self::Normalize(n) => vec![statistic("mean", &n.mean), statistic("standard deviation", &n.std)],
            Self::Conv2d(conv) => {
                let mut all = vec![matrix("weights", &conv.weights)];
                all.extend(conv.bias.iter().map(|b| vector("bias", b)));
                if let Some(n) = &conv.normalization {
                    all.extend([statistic("mean", &n.mean), statistic("standard deviation", &n.std)]);
                }
                all
            }
            Self::BatchNorm(bn) => vec![
                vector("weight", &bn.weight),
                vector("bias", &bn.bias),
                statistic("mean", &bn.mean),
                statistic("variance", &bn.variance),
            ],
            Self::Linear(linear) => {
                let mut all = vec![matrix("weights", &linear.weights)];
                all.extend(linear.bias.iter().map(|b| vector("bias", b)));
                all
            }
            Self::BranchLinear(layer) => {
                let mut all = vec![matrix("weights", &layer.weights)];
                all.extend(layer.bias.iter().map(|b| vector("bias", b)));
                all
            }
            Self::Tokens(tokens) => {
                let mut all = vec![
                    vector("velocity weights", &tokens.velocity_weights),
                    vector("velocity bias", &tokens.velocity_bias),
                ];
                all.extend(tokens.position.iter().map(|p| matrix("positional embedding", p)));
                all
            }
            Self::LayerNorm(norm) => vec![vector("weight", &norm.weight), vector("bias", &norm.bias)],
            Self::WaypointDecoder(d) => vec![
                matrix("input weights", &d.input_weights),
                matrix("hidden weights", &d.hidden_weights),
                vector("input bias", &d.input_bias),
                vector("hidden bias", &d.hidden_bias),
                matrix("output weights", &d.output_weights),
                vector("output bias", &d.output_bias),
            ],
            Self::Input(_)
            | Self::Clip(_)
            | Self::Add { .. }
            | Self::MaxPool(_)
            | Self::AveragePool(_)
            | Self::GlobalPool
            | Self::ResizeBilinear { .. }
            | Self::Attention { .. }
            | Self::Slice(_)
            | Self::Pad(_)
            | Self::Concat(_)
            | Self::Softmax
            | Self::GatherSum
            | Self::Sigmoid
            | Self::SpatialSoftmax { .. } => Vec::new(),
        }
    }
}

impl Graph {
    /// Trained values. A constant that several nodes share counts once.
    pub fn parameters(&self) -> u64 {
        let mut seen = HashSet::new();
        let constants = self.nodes.iter().flat_map(|n| n.op.constants());
        constants
            .filter(|c| c.trained && !c.data.is_empty() && seen.insert(c.data.as_ptr()))
            .map(|c| c.data.len() as u64)
            .sum()
    }

    /// Multiply-accumulates of one inference: convolutions, linear layers, attention products, recurrent steps.
    /// Pooling, resizing, norms and other element-wise work does not count.
    pub fn macs(&self) -> u64 {
        self.nodes.iter().map(|n| self.node_macs(n)).sum()
    }

    /// Multiply-accumulates of one node.
    pub fn node_macs(&self, node: &Node) -> u64 {
        let output = self.value(node.output).shape;
        let per_channel = |weights: &Weights| weights.shape[1..].iter().product::<usize>() as u64;
        match &node.op {
            Op::Conv2d(conv) => output.elements() * per_channel(&conv.weights),
            Op::Linear(linear) => output.elements() * per_channel(&linear.weights),
            // One branch alone is computed.
            Op::BranchLinear(layer) => output.elements() * layer.weights.shape[2] as u64,
            Op::Tokens(_) => u64::from(output.channels),
            Op::Attention { .. } => 2 * output.elements() * u64::from(output.positions()),
            Op::WaypointDecoder(d) => {
                let weights = [&d.input_weights, &d.hidden_weights, &d.output_weights];
                u64::from(d.steps) * weights.iter().map(|w| w.shape.iter().product::<usize>() as u64).sum::<u64>()
            }
            _ => 0,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::ir::{Clip, InputKind, LayerNorm, Linear, Shape};
    use std::sync::Arc;

    #[test]
    fn shared_constants_count_once() {
        let mut graph = Graph::default();
        let x = graph.push_input("x", InputKind::Velocity, Shape::tokens(6, 4));
        let (weight, bias) = (Arc::new(vec![1.0; 4]), Arc::new(vec![0.0; 4]));
        for (name, first_row) in [("a", 0), ("b", 3)] {
            let (weight, bias) = (weight.clone(), bias.clone());
            let norm = LayerNorm { weight, bias, epsilon: 1e-5, first_row, grid: (3, 1) };
            graph.push(name, Op::LayerNorm(norm), &[x]).unwrap();
        }
        assert_eq!(graph.parameters(), 8);
        assert_eq!(graph.macs(), 0);
    }

    #[test]
    fn linear_layer_and_attention_costs() {
        let mut graph = Graph::default();
        let x = graph.push_input("x", InputKind::Velocity, Shape::tokens(6, 4));
        let weights = Arc::new(Weights { shape: vec![8, 4], data: vec![0.0; 32] });
        let linear = Linear { weights, bias: Some(Arc::new(vec![0.0; 8])), clip: Clip::NONE };
        let y = graph.push("y", Op::Linear(linear), &[x]).unwrap();
        graph.push("z", Op::Attention { heads: 2 }, &[y, y, y]).unwrap();
        assert_eq!(graph.node_macs(&graph.nodes[1]), 6 * 8 * 4);
        assert_eq!(graph.node_macs(&graph.nodes[2]), 2 * 6 * 6 * 8);
        assert_eq!(graph.parameters(), 40);
    }
}
