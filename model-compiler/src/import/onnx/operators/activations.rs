//! Operators that keep every extent: `Relu`, `Clip`, `Identity`, `Dropout`.

use crate::error::Result;
use crate::import::checkpoint::TensorData;
use crate::import::onnx::activation::{Activation, Value};
use crate::import::onnx::node::Node;
use crate::import::onnx::translate::Translator;
use crate::ir::{Clip, Op};

pub(super) fn relu(t: &mut Translator<'_>, node: &Node<'_>) -> Result<Value> {
    push(t, node, Clip::RELU)
}

/// Bounds are attributes to operator set 10, then operands; an absent one does not bound. Where they are in the wrong
/// order, the result is the upper one.
pub(super) fn clip(t: &mut Translator<'_>, node: &Node<'_>) -> Result<Value> {
    let (min, max) = if node.opset < 11 {
        (node.float("min", f32::MIN)?, node.float("max", f32::MAX)?)
    } else {
        (scalar(t, node, 1)?.unwrap_or(f32::MIN), scalar(t, node, 2)?.unwrap_or(f32::MAX))
    };
    if min.is_nan() || max.is_nan() {
        return Err(node.malformed(format!("found bounds {min} and {max}, expected numbers")));
    }
    let unbounded = Clip {
        min: if min == f32::MIN { f32::NEG_INFINITY } else { min },
        max: if max == f32::MAX { f32::INFINITY } else { max },
    };
    push(t, node, Clip { min: unbounded.min.min(unbounded.max), ..unbounded })
}

pub(super) fn identity(t: &mut Translator<'_>, node: &Node<'_>) -> Result<Value> {
    t.value(node, 0)
}

/// Nothing at inference.
pub(super) fn dropout(t: &mut Translator<'_>, node: &Node<'_>) -> Result<Value> {
    if node.opset >= 12 && t.integers(node, 2)?.is_some_and(|mode| mode != [0]) {
        return Err(node
            .unsupported("training_mode is true")
            .with_help("export the model for inference (model.eval())"));
    }
    t.value(node, 0)
}

fn push(t: &mut Translator<'_>, node: &Node<'_>, clip: Clip) -> Result<Value> {
    let x = t.activation(node, 0)?;
    let (id, _) = t.push(node, Op::Clip(clip), &[x.id])?;
    Ok(Value::Activation(Activation { id, ..x }))
}

/// A single floating value; not necessarily finite.
pub(super) fn scalar(t: &mut Translator<'_>, node: &Node<'_>, index: usize) -> Result<Option<f32>> {
    let Some(tensor) = t.constant(node, index)? else { return Ok(None) };
    match &*tensor.data {
        TensorData::Float(values) if values.len() == 1 => Ok(Some(values[0])),
        _ => {
            let (kind, count, name) = (tensor.kind(), tensor.len(), node.input(index));
            Err(node.malformed(format!("operand {name}: found {count} {kind} elements, expected one floating value")))
        }
    }
}
