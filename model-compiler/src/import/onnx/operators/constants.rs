//! Constants, and the arithmetic on shapes that exporters write around `Reshape` and `Pad`: computed here.

use crate::error::Result;
use crate::import::checkpoint::TensorData;
use crate::import::onnx::activation::{Value, extents};
use crate::import::onnx::node::Node;
use crate::import::onnx::proto::element;
use crate::import::onnx::tensor::{Tensor, elements};
use crate::import::onnx::translate::Translator;

/// The value in any of its attributes.
pub(super) fn constant(t: &mut Translator<'_>, node: &Node<'_>) -> Result<Value> {
    let tensor = if let Some(proto) = node.tensor("value")? {
        t.decoded(proto).map_err(|e| e.within(node.place()))?
    } else if node.has("value_float") {
        Tensor::new(vec![], TensorData::Float(vec![node.float("value_float", 0.0)?]))
    } else if let Some(values) = node.floats("value_floats")? {
        Tensor::new(vec![values.len()], TensorData::Float(values.to_vec()))
    } else if node.has("value_int") {
        Tensor::new(vec![], TensorData::Integer(vec![node.int("value_int", 0)?]))
    } else if let Some(values) = node.ints("value_ints")? {
        Tensor::integers(values.to_vec())
    } else {
        return Err(node.unsupported("found no value, expected a dense tensor, floats or integers"));
    };
    Ok(Value::Constant(tensor))
}

/// The extents, from `start` to `end` where given (since operator set 15).
pub(super) fn shape(t: &mut Translator<'_>, node: &Node<'_>) -> Result<Value> {
    let x = t.value(node, 0)?;
    let rank = x.dims().len() as i64;
    let inside = |at: i64| (if at < 0 { at.saturating_add(rank) } else { at }).clamp(0, rank) as usize;
    let (start, end) = (inside(node.int("start", 0)?), inside(node.int("end", i64::MAX)?));
    let dims = x.dims().get(start..end.max(start)).unwrap_or_default();
    Ok(Value::Constant(Tensor::integers(dims.iter().map(|&d| d as i64).collect())))
}

pub(super) fn constant_of_shape(t: &mut Translator<'_>, node: &Node<'_>) -> Result<Value> {
    let wanted = t.integers(node, 0)?.ok_or_else(|| node.malformed("found no shape"))?;
    let dims: Option<Vec<usize>> = wanted.iter().map(|&d| usize::try_from(d).ok()).collect();
    let (Some(count), Some(dims)) = (dims.as_ref().and_then(|dims| elements(dims)), dims) else {
        return Err(node.malformed(format!("found shape {wanted:?}, expected sizes")));
    };
    t.charge(count)?;
    let value = match node.tensor("value")? {
        None => TensorData::Float(vec![0.0]),
        Some(proto) => (*t.decoded(proto).map_err(|e| e.within(node.place()))?.data).clone(),
    };
    let data = match value {
        TensorData::Float(v) if v.len() == 1 => TensorData::Float(vec![v[0]; count]),
        TensorData::Integer(v) if v.len() == 1 => TensorData::Integer(vec![v[0]; count]),
        other => return Err(node.malformed(format!("value: found {} elements, expected 1", other.len()))),
    };
    Ok(Value::Constant(Tensor::new(dims, data)))
}

/// The elements of a constant at constant indices of one axis.
pub(super) fn gather(t: &mut Translator<'_>, node: &Node<'_>) -> Result<Value> {
    let missing = |index| node.malformed(format!("found no operand {index}"));
    let data = t.constant(node, 0)?.ok_or_else(|| missing(0))?;
    let indices = t.constant(node, 1)?.ok_or_else(|| missing(1))?;
    let axis = node.axis(node.int("axis", 0)?, data.dims.len())?;
    let TensorData::Integer(list) = &*indices.data else {
        return Err(node.malformed("found floating indices, expected integers"));
    };
    let places = list.iter().map(|&index| node.axis(index, data.dims[axis])).collect::<Result<Vec<usize>>>()?;
    let others = data.len() / data.dims[axis].max(1);
    t.charge(places.len().saturating_mul(others))?;
    let selected = data.select(axis, &places);
    let dims = [&data.dims[..axis], &indices.dims, &data.dims[axis + 1..]].concat();
    Ok(Value::Constant(Tensor { dims, ..selected }))
}

/// Of constants between integers and floats; of activations between floating types, which changes nothing here.
pub(super) fn cast(t: &mut Translator<'_>, node: &Node<'_>) -> Result<Value> {
    let to = i32::try_from(node.int("to", 0)?).unwrap_or(0);
    let unsupported = |found: &str| {
        let message = format!("casts {found} to {}, which is not supported", element::name(to));
        Err(node.unsupported(message))
    };
    let value = t.value(node, 0)?;
    let Value::Constant(tensor) = value else {
        return match to {
            element::FLOAT | element::DOUBLE | element::FLOAT16 | element::BFLOAT16 => Ok(value),
            _ => unsupported("a value computed from the image"),
        };
    };
    t.charge(tensor.len())?;
    let data = match (&*tensor.data, to) {
        (TensorData::Float(v), element::FLOAT | element::DOUBLE) => TensorData::Float(v.clone()),
        (TensorData::Integer(v), element::FLOAT | element::DOUBLE) => {
            TensorData::Float(v.iter().map(|&v| v as f32).collect())
        }
        (TensorData::Float(v), element::INT64 | element::INT32) => {
            TensorData::Integer(v.iter().map(|&v| v as i64).collect())
        }
        (TensorData::Integer(v), element::INT64 | element::INT32) => TensorData::Integer(v.clone()),
        _ => return unsupported(&format!("a {} constant {}", tensor.kind(), extents(&tensor.dims))),
    };
    Ok(Value::Constant(Tensor::new(tensor.dims, data)))
}
