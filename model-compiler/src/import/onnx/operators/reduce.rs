//! `ReduceMean` over rows and columns.

use crate::error::Result;
use crate::import::onnx::activation::{Activation, Value};
use crate::import::onnx::node::Node;
use crate::import::onnx::translate::Translator;
use crate::ir::Op;

/// Axes are an attribute to operator set 17, then an operand. Everything behind the channels is averaged, or nothing.
pub(super) fn reduce_mean(t: &mut Translator<'_>, node: &Node<'_>) -> Result<Value> {
    let x = t.activation(node, 0)?;
    let axes = if node.opset < 18 { node.ints("axes")?.map(<[i64]>::to_vec) } else { t.integers(node, 1)? };
    let axes = axes.unwrap_or_default();
    if axes.is_empty() && node.int("noop_with_empty_axes", 0)? != 0 {
        return Ok(Value::Activation(x));
    }
    let mut axes = axes.iter().map(|&axis| node.axis(axis, x.dims.len())).collect::<Result<Vec<usize>>>()?;
    axes.sort_unstable();
    axes.dedup();
    let behind: Vec<usize> = (2..x.dims.len()).collect();
    if axes != behind || axes.is_empty() || !x.has_channels_second() {
        let found = x.described();
        return Err(
            node.unsupported(format!("averages the axes {axes:?} of {found}, expected rows and columns (2, 3)"))
        );
    }
    let (id, shape) = t.push(node, Op::GlobalPool, &[x.id])?;
    let mut dims = vec![1, usize::from(shape.channels)];
    if node.int("keepdims", 1)? != 0 {
        dims.resize(x.dims.len(), 1);
    }
    Ok(Value::Activation(Activation { dims, ..Activation::vector(id, shape) }))
}
