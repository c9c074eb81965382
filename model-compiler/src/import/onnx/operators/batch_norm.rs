//! `BatchNormalization` at inference, and other scales and shifts per channel in its form.

use crate::error::Result;
use crate::import::onnx::activation::{Activation, Value};
use crate::import::onnx::node::Node;
use crate::import::onnx::translate::Translator;
use crate::ir::{BatchNorm, Op};
use std::sync::Arc;

pub(super) fn batch_norm(t: &mut Translator<'_>, node: &Node<'_>) -> Result<Value> {
    if node.int("training_mode", 0)? != 0 {
        return Err(node.unsupported("training_mode is 1").with_help("export the model for inference (model.eval())"));
    }
    if node.opset < 9 && node.int("spatial", 1)? == 0 {
        return Err(node.unsupported("spatial is 0: one statistic per pixel, expected one per channel"));
    }
    let x = t.activation(node, 0)?;
    let channels = usize::from(x.shape.channels);
    if !x.has_channels_second() {
        let found = x.described();
        return Err(node.unsupported(format!("operand {}: found {found}, expected 1×{channels}×…", node.input(0))));
    }
    let mut vector = |index| {
        let values = t.vector(node, index, channels)?;
        values.ok_or_else(|| node.malformed(format!("found no operand {index}")))
    };
    let norm = BatchNorm {
        weight: vector(1)?,
        bias: vector(2)?,
        mean: vector(3)?,
        variance: vector(4)?,
        epsilon: node.float("epsilon", 1e-5)?,
    };
    if let Some(at) = norm.variance.iter().position(|v| v + norm.epsilon <= 0.0 || !(v + norm.epsilon).is_finite()) {
        let message =
            format!("variance {} + ε {} at index {at}, expected more than 0", norm.variance[at], norm.epsilon);
        return Err(node.malformed(message));
    }
    push(t, node, x, norm)
}

/// `x·scale + shift` per channel: a batch norm whose statistics are 0 and 1. The passes fold it away.
pub(super) fn scale_and_shift(
    t: &mut Translator<'_>,
    node: &Node<'_>,
    x: Activation,
    scale: Vec<f32>,
    shift: Vec<f32>,
) -> Result<Value> {
    let constant = |value| Arc::new(vec![value; scale.len()]);
    let (mean, variance) = (constant(0.0), constant(1.0));
    let norm = BatchNorm { weight: Arc::new(scale), bias: Arc::new(shift), mean, variance, epsilon: 0.0 };
    push(t, node, x, norm)
}

fn push(t: &mut Translator<'_>, node: &Node<'_>, x: Activation, norm: BatchNorm) -> Result<Value> {
    let (id, _) = t.push(node, Op::BatchNorm(norm), &[x.id])?;
    Ok(Value::Activation(Activation { id, ..x }))
}
