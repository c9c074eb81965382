//! `MaxPool`, `AveragePool` and their global forms.

use super::conv::border;
use crate::error::Result;
use crate::import::onnx::activation::{Activation, Value};
use crate::import::onnx::node::Node;
use crate::import::onnx::translate::Translator;
use crate::import::onnx::window::{Sliding, pair, sliding};
use crate::ir::{Op, Shape};
use firmware::program::Window;

pub(super) fn max_pool(t: &mut Translator<'_>, node: &Node<'_>) -> Result<Value> {
    let map = t.map(node, 0)?;
    let sliding = windows(node, map.shape)?;
    let window = sliding.with_padding().ok_or_else(|| {
        node.unsupported(format!("padding {:?}, expected less than the kernel's reach", sliding.pads))
    })?;
    push(t, node, Op::MaxPool(window), &map)
}

/// The mean is over whole windows. Padding that counts becomes a border of zeros; where it does not count, the divisor
/// would change from window to window.
pub(super) fn average_pool(t: &mut Translator<'_>, node: &Node<'_>) -> Result<Value> {
    let mut map = t.map(node, 0)?;
    let sliding = windows(node, map.shape)?;
    let counts_padding = node.int("count_include_pad", 0)? != 0;
    if sliding.overhangs {
        return Err(node
            .unsupported("ceil_mode lets windows reach beyond the map, where the divisor changes")
            .with_help("set ceil_mode to 0, or choose a size that the stride divides"));
    }
    if sliding.is_padded() && !counts_padding {
        return Err(node
            .unsupported(format!("padding {:?} with count_include_pad 0, where the divisor changes", sliding.pads))
            .with_help("set count_include_pad to 1 (then zeros are averaged), or leave the padding out"));
    }
    if sliding.is_padded() {
        let (id, shape) = t.push_before(node, Op::Pad(border(&sliding, 0.0)), &[map.id])?;
        map = Activation::map(id, shape);
    }
    push(t, node, Op::AveragePool(sliding.window), &map)
}

pub(super) fn global_average_pool(t: &mut Translator<'_>, node: &Node<'_>) -> Result<Value> {
    let map = t.map(node, 0)?;
    push(t, node, Op::GlobalPool, &map)
}

/// A window over the whole map.
pub(super) fn global_max_pool(t: &mut Translator<'_>, node: &Node<'_>) -> Result<Value> {
    let map = t.map(node, 0)?;
    let (Ok(kernel_h), Ok(kernel_w)) = (u8::try_from(map.shape.height), u8::try_from(map.shape.width)) else {
        return Err(node.unsupported(format!("found a map {}, expected at most 255 pixels a side", map.described())));
    };
    push(t, node, Op::MaxPool(Window { kernel_h, kernel_w, ..Window::square(1, 1, 0) }), &map)
}

fn windows(node: &Node<'_>, shape: Shape) -> Result<Sliding> {
    let kernel = pair(node, "kernel_shape")?.ok_or_else(|| node.malformed("found no kernel_shape"))?;
    sliding(node, kernel.map(|size| size as usize), shape)
}

fn push(t: &mut Translator<'_>, node: &Node<'_>, op: Op, map: &Activation) -> Result<Value> {
    let (id, shape) = t.push(node, op, &[map.id])?;
    Ok(Value::Activation(Activation::map(id, shape)))
}
