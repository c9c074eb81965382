//! `Add`, `Sub`, `Mul`, `Div`: of two activations (a sum only), of an activation and one constant per channel, of two
//! constants.

use super::batch_norm::scale_and_shift;
use crate::error::Result;
use crate::import::checkpoint::TensorData;
use crate::import::onnx::activation::{Activation, Value, extents};
use crate::import::onnx::node::Node;
use crate::import::onnx::tensor::{Tensor, elements};
use crate::import::onnx::translate::Translator;
use crate::ir::{Clip, Op};

#[derive(Clone, Copy, PartialEq, Eq)]
enum Arithmetic {
    Add,
    Sub,
    Mul,
    Div,
}

pub(super) fn add(t: &mut Translator<'_>, node: &Node<'_>) -> Result<Value> {
    compute(t, node, Arithmetic::Add)
}

pub(super) fn sub(t: &mut Translator<'_>, node: &Node<'_>) -> Result<Value> {
    compute(t, node, Arithmetic::Sub)
}

pub(super) fn mul(t: &mut Translator<'_>, node: &Node<'_>) -> Result<Value> {
    compute(t, node, Arithmetic::Mul)
}

pub(super) fn div(t: &mut Translator<'_>, node: &Node<'_>) -> Result<Value> {
    compute(t, node, Arithmetic::Div)
}

fn compute(t: &mut Translator<'_>, node: &Node<'_>, what: Arithmetic) -> Result<Value> {
    match (t.value(node, 0)?, t.value(node, 1)?) {
        (Value::Constant(a), Value::Constant(b)) => constants(t, node, what, &a, &b),
        (Value::Activation(a), Value::Activation(b)) => sum(t, node, what, a, &b),
        (Value::Activation(x), Value::Constant(_)) => {
            let c = per_channel(t, node, 1, &x)?;
            let (zeros, ones) = (vec![0.0; c.len()], vec![1.0; c.len()]);
            match what {
                Arithmetic::Add => scale_and_shift(t, node, x, ones, c),
                Arithmetic::Sub => scale_and_shift(t, node, x, ones, c.iter().map(|c| -c).collect()),
                Arithmetic::Mul => scale_and_shift(t, node, x, c, zeros),
                Arithmetic::Div if c.contains(&0.0) => Err(node.malformed("divides by zero")),
                Arithmetic::Div => scale_and_shift(t, node, x, c.iter().map(|c| c.recip()).collect(), zeros),
            }
        }
        (Value::Constant(_), Value::Activation(x)) => {
            let c = per_channel(t, node, 0, &x)?;
            let count = c.len();
            match what {
                Arithmetic::Add => scale_and_shift(t, node, x, vec![1.0; count], c),
                Arithmetic::Sub => scale_and_shift(t, node, x, vec![-1.0; count], c),
                Arithmetic::Mul => scale_and_shift(t, node, x, c, vec![0.0; count]),
                Arithmetic::Div => Err(node.unsupported("divides by a value computed from the image")),
            }
        }
    }
}

fn sum(t: &mut Translator<'_>, node: &Node<'_>, what: Arithmetic, a: Activation, b: &Activation) -> Result<Value> {
    if what != Arithmetic::Add {
        return Err(node.unsupported("both operands are computed from the image, expected one constant per channel"));
    }
    if a.dims != b.dims || a.shape != b.shape {
        let (a, b) = (a.described(), b.described());
        return Err(node.unsupported(format!("found operands {a} and {b}, expected equal extents")));
    }
    let (id, _) = t.push(node, Op::Add { clip: Clip::NONE }, &[a.id, b.id])?;
    Ok(Value::Activation(Activation { id, ..a }))
}

/// One value per channel of `x`, from a constant that broadcasts along its other extents.
fn per_channel(t: &mut Translator<'_>, node: &Node<'_>, index: usize, x: &Activation) -> Result<Vec<f32>> {
    let channels = usize::from(x.shape.channels);
    let constant = t.weights(node, index)?;
    if constant.data.len() == 1 && constant.dims.len() <= x.dims.len() {
        return Ok(vec![constant.data[0]; channels]);
    }
    // Aligned at the last extent, only that of the channels (the second of `1×C×…`) may differ from 1.
    let behind = x.dims.len() - 2.min(x.dims.len());
    let only_channels = constant.dims.iter().rev().enumerate().all(|(i, &d)| d == 1 || (i == behind && d == channels));
    if x.has_channels_second() && constant.dims.len() <= x.dims.len() && only_channels {
        return Ok(constant.data);
    }
    let (found, x) = (extents(&constant.dims), x.described());
    let name = node.input(index);
    Err(node.unsupported(format!("constant {name}: found {found}, expected one value or one per channel of {x}")))
}

/// Element by element with broadcasting.
fn constants(t: &mut Translator<'_>, node: &Node<'_>, what: Arithmetic, a: &Tensor, b: &Tensor) -> Result<Value> {
    let rank = a.dims.len().max(b.dims.len());
    let aligned = |dims: &[usize]| [vec![1; rank - dims.len()], dims.to_vec()].concat();
    let (a_dims, b_dims) = (aligned(&a.dims), aligned(&b.dims));
    let joined = |(&a, &b): (&usize, &usize)| match (a, b) {
        (a, b) if a == b || b == 1 => Some(a),
        (1, b) => Some(b),
        _ => None,
    };
    let dims: Option<Vec<usize>> = a_dims.iter().zip(&b_dims).map(joined).collect();
    let count = dims.as_ref().and_then(|dims| elements(dims));
    let (Some(dims), Some(count)) = (dims, count) else {
        let (a, b) = (extents(&a.dims), extents(&b.dims));
        return Err(node.malformed(format!("constants {a} and {b} do not broadcast")));
    };
    t.charge(count)?;
    let at = |own: &[usize], mut index: usize| {
        let (mut at, mut stride) = (0, 1);
        for (&extent, &own) in dims.iter().zip(own).rev() {
            at += if own == 1 { 0 } else { index % extent * stride };
            stride *= own;
            index /= extent;
        }
        at
    };
    let pairs = (0..count).map(|i| (at(&a_dims, i), at(&b_dims, i)));
    let data = match (&*a.data, &*b.data) {
        (TensorData::Float(a), TensorData::Float(b)) => {
            TensorData::Float(pairs.map(|(i, j)| floats(what, a[i], b[j])).collect())
        }
        (TensorData::Integer(a), TensorData::Integer(b)) => {
            let values: Option<Vec<i64>> = pairs.map(|(i, j)| integers(what, a[i], b[j])).collect();
            TensorData::Integer(values.ok_or_else(|| node.malformed("integers overflow, or divide by zero"))?)
        }
        _ => return Err(node.malformed(format!("found a {} and a {} constant", a.kind(), b.kind()))),
    };
    Ok(Value::Constant(Tensor::new(dims, data)))
}

fn floats(what: Arithmetic, a: f32, b: f32) -> f32 {
    match what {
        Arithmetic::Add => a + b,
        Arithmetic::Sub => a - b,
        Arithmetic::Mul => a * b,
        Arithmetic::Div => a / b,
    }
}

fn integers(what: Arithmetic, a: i64, b: i64) -> Option<i64> {
    match what {
        Arithmetic::Add => a.checked_add(b),
        Arithmetic::Sub => a.checked_sub(b),
        Arithmetic::Mul => a.checked_mul(b),
        Arithmetic::Div => a.checked_div(b),
    }
}
