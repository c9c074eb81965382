//! CILRS: the camera image and the speed; a command selects the branch that gives the controls.

use super::builder::Builder;
use super::detect::{common_length, indexed_count, most_common};
use super::{DEFAULT_RESOLUTION, has, resnet::ResNet};
use crate::error::Result;
use crate::import::NamedTensors;
use crate::ir::{BranchLinear, Clip, InputKind, Op, Shape, ValueId, Weights};
use std::sync::Arc;

/// As published.
const BRANCHES: usize = 6;
const HIDDEN: usize = 256;

/// Steer, throttle, brake.
const CONTROLS: usize = 3;

/// Positions of the linear layers between the ReLUs of a head.
const LAYERS: [usize; 3] = [0, 2, 4];

pub(super) fn recognize(tensors: &NamedTensors) -> bool {
    has(tensors, "encoder.features.") && has(tensors, "controller.")
}

/// Outputs: `controls`, the sigmoids of steer, throttle and brake of the selected branch, and `predicted_speed`, m/s.
pub(super) fn build(b: &mut Builder<'_>) -> Result<()> {
    let resolution = b.options.resolution.unwrap_or(DEFAULT_RESOLUTION);
    let network = ResNet::detect(&b.tensors, "encoder.features", None);
    let rgb = b.rgb("encoder", resolution)?;
    let velocity = b.graph.push_input("velocity", InputKind::Velocity, Shape::vector(1));
    let command = b.graph.push_input("command", InputKind::Command, Shape::vector(1));
    let mut map = network.stem(b, rgb, 3)?;
    for stage in 1..=4 {
        map = network.stage(b, stage, map)?;
    }
    let image = b.push("encoder", Op::GlobalPool, &[map])?;
    let features = usize::from(b.graph.value(image).shape.channels);

    let width = common_length(&b.tensors, &["controller.vel_in.0."], |_| true).unwrap_or(HIDDEN);
    let x = b.linear("controller.vel_in.0", velocity, width)?;
    let x = b.push("controller.vel_in.1", Op::Clip(Clip::RELU), &[x])?;
    let speed = b.linear("controller.vel_in.2", x, features)?;
    let embedding = b.push("controller.add", Op::Add { clip: Clip::NONE }, &[speed, image])?;

    let branches = match indexed_count(&b.tensors, "controller.branches.") {
        0 => BRANCHES,
        count => count,
    };
    let mut x = embedding;
    for (layer, outputs) in LAYERS.into_iter().zip(widths(&b.tensors, CONTROLS)) {
        let op = branch_linear(b, branches, layer, x, outputs);
        x = b.push(format!("controller.branches.{layer}"), Op::BranchLinear(op), &[x, command])?;
        if layer != LAYERS[2] {
            x = b.push(format!("controller.branches.{}", layer + 1), Op::Clip(Clip::RELU), &[x])?;
        }
    }
    let controls = b.push("controls", Op::Sigmoid, &[x])?;

    let mut x = embedding;
    for layer in LAYERS {
        let last = layer == LAYERS[2];
        let module = format!("controller.vel_out.{layer}");
        let outputs = common_length(&b.tensors, &[&format!("{module}.")], |_| true).unwrap_or(HIDDEN);
        let inputs = usize::from(b.graph.value(x).shape.channels);
        let linear = b.linear_weights(&module, inputs, if last { 1 } else { outputs });
        x = b.push(if last { "predicted_speed" } else { &module }, Op::Linear(linear), &[x])?;
        if !last {
            x = b.push(format!("controller.vel_out.{}", layer + 1), Op::Clip(Clip::RELU), &[x])?;
        }
    }
    b.graph.outputs.extend([controls, x]);
    Ok(())
}

/// Outputs of the three layers of a branch; all branches vote.
fn widths(tensors: &NamedTensors, last: usize) -> [usize; 3] {
    let voted = |layer: usize| {
        let of_layer = |name: &str| name.split('.').nth(3) == Some(&layer.to_string());
        let own = tensors.under("controller.branches.").filter(|(name, _)| of_layer(name));
        most_common(own.filter_map(|(_, tensor)| tensor.shape.first().copied())).unwrap_or(HIDDEN)
    };
    [voted(LAYERS[0]), voted(LAYERS[1]), last]
}

/// One layer of every branch, `controller.branches.BRANCH.LAYER`.
fn branch_linear(b: &mut Builder<'_>, branches: usize, layer: usize, input: ValueId, outputs: usize) -> BranchLinear {
    let inputs = usize::from(b.graph.value(input).shape.channels);
    let (mut weights, mut bias) = (Vec::new(), Vec::new());
    for branch in 0..branches {
        let module = format!("controller.branches.{branch}.{layer}");
        weights.extend_from_slice(&b.weights(&format!("{module}.weight"), &[outputs, inputs]).data);
        bias.extend_from_slice(&b.vector(&format!("{module}.bias"), &[outputs]));
    }
    let weights = Arc::new(Weights { shape: vec![branches, outputs, inputs], data: weights });
    BranchLinear { weights, bias: Some(Arc::new(bias)), clip: Clip::NONE }
}
