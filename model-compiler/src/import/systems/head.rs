//! From the feature vector to waypoints: the join layers, then a GRU.

use super::builder::Builder;
use super::detect::{indexed_count, most_common};
use crate::error::Result;
use crate::import::NamedTensors;
use crate::ir::{Clip, InputKind, Op, Shape, ValueId, WaypointDecoder};

/// Waypoints to emit; no tensor tells it.
const STEPS: u16 = 4;

/// Widths of the join layers as published, for a checkpoint without any.
const JOIN_WIDTHS: [usize; 3] = [256, 128, 64];

/// Ends the graph. `gru_inputs` is the system's published GRU input width, expected where the tensor has neither 2
/// (waypoint and goal added) nor 4 (concatenated).
pub(super) fn waypoints(b: &mut Builder<'_>, features: ValueId, gru_inputs: usize) -> Result<()> {
    let goal = b.graph.push_input("goal", InputKind::Goal, Shape::vector(2));
    let hidden_state = join(b, features)?;
    let hidden = usize::from(b.graph.value(hidden_state).shape.channels);
    let inputs = match b.tensors.get("decoder.weight_ih").map(|w| &w.shape[..]) {
        Some(&[_, width @ (2 | 4)]) => width,
        _ => gru_inputs,
    };
    let decoder = WaypointDecoder {
        input_weights: b.weights("decoder.weight_ih", &[3 * hidden, inputs]),
        hidden_weights: b.weights("decoder.weight_hh", &[3 * hidden, hidden]),
        input_bias: b.vector("decoder.bias_ih", &[3 * hidden]),
        hidden_bias: b.vector("decoder.bias_hh", &[3 * hidden]),
        output_weights: b.weights("output.weight", &[2, hidden]),
        output_bias: b.vector("output.bias", &[2]),
        steps: STEPS,
    };
    let waypoints = b.push("waypoints", Op::WaypointDecoder(decoder), &[hidden_state, goal])?;
    b.graph.outputs.push(waypoints);
    Ok(())
}

/// Linear layers `join.0`, `join.2`, …, each followed by a ReLU.
fn join(b: &mut Builder<'_>, features: ValueId) -> Result<ValueId> {
    let mut x = features;
    for (layer, width) in join_widths(&b.tensors).into_iter().enumerate() {
        x = b.linear(&format!("join.{}", 2 * layer), x, width)?;
        x = b.push(format!("join.{}", 2 * layer + 1), Op::Clip(Clip::RELU), &[x])?;
    }
    Ok(x)
}

/// Outputs of each join layer. The layer's own two tensors vote, and those that read its result.
fn join_widths(tensors: &NamedTensors) -> Vec<usize> {
    let layers = indexed_count(tensors, "join.").div_ceil(2);
    if layers == 0 {
        return JOIN_WIDTHS.to_vec();
    }
    let dimension = |name: &str, axis: usize| tensors.get(name)?.shape.get(axis).copied();
    let width = |layer: usize| {
        let module = format!("join.{}", 2 * layer);
        let own = [dimension(&format!("{module}.weight"), 0), dimension(&format!("{module}.bias"), 0)];
        let readers = if layer + 1 < layers {
            [dimension(&format!("join.{}.weight", 2 * layer + 2), 1), None]
        } else {
            [dimension("decoder.weight_hh", 1), dimension("output.weight", 1)]
        };
        most_common(own.into_iter().chain(readers).flatten()).unwrap_or(JOIN_WIDTHS[2])
    };
    (0..layers).map(width).collect()
}
