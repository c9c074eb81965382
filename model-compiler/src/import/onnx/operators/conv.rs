//! `Conv` in two dimensions.

use crate::error::Result;
use crate::import::onnx::activation::{Activation, Value};
use crate::import::onnx::node::Node;
use crate::import::onnx::translate::Translator;
use crate::import::onnx::window::{Sliding, pair, sliding};
use crate::import::systems::oihw_to_ohwi;
use crate::ir::{Clip, Conv2d, Op, Pad};

/// Weights `O×(I/groups)×kh×kw`, bias `O`.
pub(super) fn conv(t: &mut Translator<'_>, node: &Node<'_>) -> Result<Value> {
    let map = t.map(node, 0)?;
    let weights = t.weights(node, 1)?;
    let [o, i, kh, kw] = weights.dims[..] else {
        let rank = weights.dims.len();
        return Err(node.unsupported(format!("weights {}: found rank {rank}, expected 4 (2-d)", node.input(1))));
    };
    if let Some(kernel) = pair(node, "kernel_shape")?
        && kernel != [kh as i64, kw as i64]
    {
        return Err(node.malformed(format!("kernel_shape: found {kernel:?}, expected {:?} of the weights", [kh, kw])));
    }
    let groups = node.int("group", 1)?;
    let groups = u16::try_from(groups).ok().filter(|&g| g > 0);
    let groups = groups.ok_or_else(|| node.malformed("group: expected 1 to 65535"))?;
    let bias = t.vector(node, 2, o)?;
    let sliding = sliding(node, [kh, kw], map.shape)?;
    let (input, window) = match sliding.with_padding() {
        Some(window) => (map.id, window),
        None => (t.push_before(node, Op::Pad(border(&sliding, 0.0)), &[map.id])?.0, sliding.window),
    };
    let conv = Conv2d {
        weights: oihw_to_ohwi(&weights.data, [o, i, kh, kw]),
        bias,
        window,
        groups,
        normalization: None,
        clip: Clip::NONE,
    };
    let (id, shape) = t.push(node, Op::Conv2d(conv), &[input])?;
    Ok(Value::Activation(Activation::map(id, shape)))
}

/// The padding of a window as an operator of its own.
pub(super) fn border(sliding: &Sliding, value: f32) -> Pad {
    let [top, left, bottom, right] = sliding.pads;
    Pad { before: [top, left, 0], after: [bottom, right, 0], value }
}
