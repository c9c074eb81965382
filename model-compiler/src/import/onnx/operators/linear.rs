//! `Gemm` and `MatMul` of a vector with constant weights.

use crate::error::Result;
use crate::import::onnx::activation::{Activation, Value, extents};
use crate::import::onnx::node::Node;
use crate::import::onnx::translate::{Floats, Translator};
use crate::import::systems::oihw_to_ohwi;
use crate::ir::{Clip, Conv2d, Linear, Op};
use firmware::program::Window;
use std::sync::Arc;

/// `alpha·x·B + beta·C`, or `alpha·x·Bᵀ + beta·C`.
pub(super) fn gemm(t: &mut Translator<'_>, node: &Node<'_>) -> Result<Value> {
    if node.int("transA", 0)? != 0 {
        return Err(node.unsupported("transA is 1, expected a row vector"));
    }
    let x = t.activation(node, 0)?;
    let mut weights = matrix(t, node, node.int("transB", 0)? != 0)?;
    let (alpha, beta) = (node.float("alpha", 1.0)?, node.float("beta", 1.0)?);
    weights.data.iter_mut().for_each(|w| *w *= alpha);
    let outputs = weights.dims[0];
    let bias = match t.floats(node, 2)? {
        None => None,
        Some(c) => {
            let values = match c.dims[..] {
                [] | [1] | [1, 1] => vec![c.data[0]; outputs],
                [n] | [1, n] if n == outputs => c.data,
                _ => {
                    let (name, found) = (node.input(2), extents(&c.dims));
                    return Err(node.malformed(format!("tensor {name}: found {found}, expected {outputs}")));
                }
            };
            Some(Arc::new(values.iter().map(|b| b * beta).collect()))
        }
    };
    push(t, node, &x, weights, bias)
}

pub(super) fn mat_mul(t: &mut Translator<'_>, node: &Node<'_>) -> Result<Value> {
    let x = t.activation(node, 0)?;
    let weights = matrix(t, node, false)?;
    push(t, node, &x, weights, None)
}

/// The second operand as `outputs × inputs`; in the file it is so where `is_transposed`, else the other way round.
fn matrix(t: &mut Translator<'_>, node: &Node<'_>, is_transposed: bool) -> Result<Floats> {
    let weights = t.weights(node, 1)?;
    let [rows, columns] = weights.dims[..] else {
        let (name, found) = (node.input(1), extents(&weights.dims));
        return Err(node.unsupported(format!("weights {name}: found {found}, expected a matrix")));
    };
    if is_transposed {
        return Ok(weights);
    }
    let data = (0..columns).flat_map(|c| weights.data.iter().skip(c).step_by(columns).copied()).collect();
    Ok(Floats { dims: vec![columns, rows], data })
}

/// A vector `1×K` gives a linear layer; a flattened map a convolution whose window is the whole map, with the weights
/// in the map's order.
fn push(
    t: &mut Translator<'_>,
    node: &Node<'_>,
    x: &Activation,
    weights: Floats,
    bias: Option<Arc<Vec<f32>>>,
) -> Result<Value> {
    let [outputs, inputs] = weights.dims[..] else { return Err(node.malformed("found no matrix")) };
    if x.dims != [1, inputs] {
        let (name, found) = (node.input(0), x.described());
        return Err(node.unsupported(format!("operand {name}: found {found}, expected 1×{inputs}")));
    }
    let op = if x.shape.positions() == 1 {
        Op::Linear(Linear { weights: weights.into_weights(), bias, clip: Clip::NONE })
    } else {
        let (Ok(kernel_h), Ok(kernel_w)) = (u8::try_from(x.shape.height), u8::try_from(x.shape.width)) else {
            return Err(node.unsupported(format!("reads {}, expected at most 255 pixels a side", x.described())));
        };
        let sizes = [outputs, x.shape.channels.into(), x.shape.height.into(), x.shape.width.into()];
        Op::Conv2d(Conv2d {
            weights: oihw_to_ohwi(&weights.data, sizes),
            bias,
            window: Window { kernel_h, kernel_w, ..Window::square(1, 1, 0) },
            groups: 1,
            normalization: None,
            clip: Clip::NONE,
        })
    };
    let (id, shape) = t.push(node, op, &[x.id])?;
    Ok(Value::Activation(Activation::vector(id, shape)))
}
