//! `Pad` with a constant.

use super::activations::scalar;
use crate::error::Result;
use crate::import::onnx::activation::{Activation, Value};
use crate::import::onnx::node::Node;
use crate::import::onnx::translate::Translator;
use crate::ir::{Op, Pad};

/// `pads` and `value` are attributes to operator set 10, then operands; `axes` came with 18.
pub(super) fn pad(t: &mut Translator<'_>, node: &Node<'_>) -> Result<Value> {
    let mode = node.text("mode", "constant")?;
    if mode != "constant" {
        return Err(node.unsupported(format!("mode {mode:?}, expected constant")));
    }
    let x = t.activation(node, 0)?;
    let Some(map_axes) = x.map_axes() else {
        return Err(node.unsupported(format!("pads {}, expected a map or a vector", x.described())));
    };
    let (pads, value) = if node.opset < 11 {
        (node.ints("pads")?.map(<[i64]>::to_vec), node.float("value", 0.0)?)
    } else {
        (t.integers(node, 1)?, scalar(t, node, 2)?.unwrap_or(0.0))
    };
    let pads = pads.ok_or_else(|| node.malformed("found no pads"))?;
    let axes = t.integers(node, 3)?.unwrap_or_else(|| (0..map_axes.len() as i64).collect());
    if pads.len() != 2 * axes.len() {
        return Err(node.malformed(format!("found {} pads, expected two for each of {} axes", pads.len(), axes.len())));
    }
    let mut pad = Pad { before: [0; 3], after: [0; 3], value };
    for (i, &axis) in axes.iter().enumerate() {
        for (side, count) in [(&mut pad.before, pads[i]), (&mut pad.after, pads[i + axes.len()])] {
            match (map_axes[node.axis(axis, map_axes.len())?], u16::try_from(count)) {
                (_, Ok(0)) => {}
                (Some(axis), Ok(count)) => side[axis] = count,
                (None, _) => return Err(node.unsupported("pads the batch")),
                (_, Err(_)) => return Err(node.unsupported(format!("pads {count}, expected 0 to 65535"))),
            }
        }
    }
    if pad.before == [0; 3] && pad.after == [0; 3] {
        return Ok(Value::Activation(x));
    }
    let is_vector = !x.is_map();
    let (id, shape) = t.push(node, Op::Pad(pad), &[x.id])?;
    let padded = if is_vector && shape.positions() == 1 { Activation::vector } else { Activation::map };
    Ok(Value::Activation(padded(id, shape)))
}
