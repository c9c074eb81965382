//! `Concat` of maps or vectors, or of constants.

use crate::error::Result;
use crate::import::checkpoint::TensorData;
use crate::import::onnx::activation::{Activation, Value, extents};
use crate::import::onnx::node::Node;
use crate::import::onnx::tensor::Tensor;
use crate::import::onnx::translate::Translator;
use crate::ir::{Axis, Op};

pub(super) fn concat(t: &mut Translator<'_>, node: &Node<'_>) -> Result<Value> {
    let parts = (0..node.inputs.len()).map(|i| t.value(node, i)).collect::<Result<Vec<Value>>>()?;
    let Some(first) = parts.first() else { return Err(node.malformed("found no operands")) };
    if !node.has("axis") {
        return Err(node.malformed("found no axis"));
    }
    let axis = node.axis(node.int("axis", 0)?, first.dims().len())?;
    let fits = |part: &&Value| {
        let (a, b) = (part.dims(), first.dims());
        a.len() == b.len() && a.iter().zip(b).enumerate().all(|(i, (a, b))| i == axis || a == b)
    };
    if let Some(other) = parts.iter().find(|part| !fits(part)) {
        let (found, expected) = (other.described(), first.described());
        return Err(
            node.malformed(format!("found operands {expected} and {found}, expected equal extents but axis {axis}"))
        );
    }
    let mut constants = Vec::new();
    let mut activations = Vec::new();
    for part in parts {
        match part {
            Value::Constant(tensor) => constants.push(tensor),
            Value::Activation(activation) => activations.push(activation),
        }
    }
    match (constants.is_empty(), activations.is_empty()) {
        (false, true) => constant(t, node, axis, &constants),
        (true, false) => activation(t, node, axis, &activations),
        _ => Err(node.unsupported("found constants among operands that are computed from the image")),
    }
}

fn activation(t: &mut Translator<'_>, node: &Node<'_>, axis: usize, parts: &[Activation]) -> Result<Value> {
    if let [alone] = parts {
        return Ok(Value::Activation(alone.clone()));
    }
    let map_axis = parts[0].map_axes().and_then(|axes| axes[axis]);
    let all_axes = parts.iter().all(|part| part.map_axes().is_some());
    let (Some(map_axis), true) = (map_axis, all_axes) else {
        let found = parts[0].described();
        return Err(node.unsupported(format!("joins {found}, … along axis {axis}, expected maps or vectors")));
    };
    let joined = if parts[0].is_map() { Activation::map } else { Activation::vector };
    let ids: Vec<_> = parts.iter().map(|part| part.id).collect();
    let op = Op::Concat([Axis::Height, Axis::Width, Axis::Channels][map_axis]);
    let (id, shape) = t.push(node, op, &ids)?;
    Ok(Value::Activation(joined(id, shape)))
}

fn constant(t: &mut Translator<'_>, node: &Node<'_>, axis: usize, parts: &[Tensor]) -> Result<Value> {
    let count = parts.iter().fold(0usize, |sum, part| sum.saturating_add(part.len()));
    t.charge(count)?;
    let mut dims = parts[0].dims.clone();
    dims[axis] = parts.iter().fold(0, |sum: usize, part| sum.saturating_add(part.dims[axis]));
    let outer = if count == 0 { 0 } else { dims[..axis].iter().product() };
    let run = |part: &Tensor, o: usize| o * (part.len() / outer)..(o + 1) * (part.len() / outer);
    let mut floats = Vec::new();
    let mut integers = Vec::new();
    for (o, part) in (0..outer).flat_map(|o| parts.iter().map(move |part| (o, part))) {
        match &*part.data {
            TensorData::Float(values) => floats.extend_from_slice(&values[run(part, o)]),
            TensorData::Integer(values) => integers.extend_from_slice(&values[run(part, o)]),
        }
    }
    let data = match (floats.len() == count, integers.len() == count) {
        (true, _) => TensorData::Float(floats),
        (_, true) => TensorData::Integer(integers),
        _ => return Err(node.malformed(format!("joins floating and integer constants {}", extents(&dims)))),
    };
    Ok(Value::Constant(Tensor::new(dims, data)))
}
