//! `Softmax` over the channels.

use crate::error::Result;
use crate::import::onnx::activation::{Activation, Value};
use crate::import::onnx::node::Node;
use crate::import::onnx::translate::Translator;
use crate::ir::Op;

/// To operator set 12 over everything from the axis on (1 by default), then along one axis (the last by default).
pub(super) fn softmax(t: &mut Translator<'_>, node: &Node<'_>) -> Result<Value> {
    let x = t.activation(node, 0)?;
    let rank = x.dims.len();
    let is_flattening = node.opset < 13;
    let axis = node.axis(node.int("axis", if is_flattening { 1 } else { -1 })?, rank)?;
    let axes = if is_flattening { axis..rank } else { axis..axis + 1 };
    let is_long = |axis: &usize| x.dims[*axis] > 1;
    let is_over_channels = if x.shape.positions() == 1 {
        // A vector in whatever extents: all its elements, wherever they lie.
        (0..rank).filter(is_long).all(|axis| axes.contains(&axis)) && x.shape.channels > 1
    } else {
        x.is_map() && axes == (1..2)
    };
    if !is_over_channels {
        let found = x.described();
        return Err(node.unsupported(format!("softmax over axes {axes:?} of {found}, expected over the channels")));
    }
    let (id, _) = t.push(node, Op::Softmax, &[x.id])?;
    Ok(Value::Activation(Activation { id, ..x }))
}
