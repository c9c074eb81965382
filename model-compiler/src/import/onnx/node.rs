//! A node as the operators see it: names and attributes, with errors that say which node.

use super::model::{decode, operator};
use super::proto::{self, attribute};
use crate::error::{Error, ErrorCode, Result};

/// No operator has more; each may be hundreds of bytes once decoded.
const MAX_ATTRIBUTES: usize = 64;

pub(super) struct Node<'a> {
    /// Operator, with its domain where it is not ONNX's own.
    pub(super) operator: String,
    /// Name, or the first output where the file gives none.
    pub(super) name: &'a str,
    pub(super) inputs: &'a [String],
    pub(super) outputs: &'a [String],
    /// Version of the operator set.
    pub(super) opset: i64,
    attributes: Vec<proto::Attribute>,
}

impl<'a> Node<'a> {
    pub(super) fn new(proto: &'a proto::Node, opset: i64) -> Result<Self> {
        let unnamed = || proto.output.first().map_or("", String::as_str);
        let mut node = Self {
            operator: operator(proto),
            name: if proto.name.is_empty() { unnamed() } else { &proto.name },
            inputs: &proto.input,
            outputs: &proto.output,
            opset,
            attributes: Vec::new(),
        };
        if proto.attribute.len() > MAX_ATTRIBUTES {
            let found = proto.attribute.len();
            return Err(node.malformed(format!("found {found} attributes, expected at most {MAX_ATTRIBUTES}")));
        }
        let decoded = proto.attribute.iter().map(|bytes| decode(&node.place(), bytes.clone()));
        node.attributes = decoded.collect::<Result<_>>()?;
        Ok(node)
    }

    /// How messages name the node.
    pub(super) fn place(&self) -> String {
        format!("{} {}", self.operator, self.name)
    }

    /// The node is well-formed, but this is not supported.
    pub(super) fn unsupported(&self, message: impl Into<String>) -> Error {
        Error::new(ErrorCode::Unsupported, self.place(), message)
    }

    /// The node contradicts itself or ONNX.
    pub(super) fn malformed(&self, message: impl Into<String>) -> Error {
        Error::new(ErrorCode::Malformed, self.place(), message).with_help("export the model again, or repair it")
    }

    /// Name of an operand; empty where it is left out.
    pub(super) fn input(&self, index: usize) -> &'a str {
        self.inputs.get(index).map_or("", String::as_str)
    }

    fn attribute(&self, name: &str, r#type: i32) -> Result<Option<&proto::Attribute>> {
        match self.attributes.iter().find(|a| a.name == name) {
            Some(found) if found.r#type != r#type && found.r#type != 0 => {
                Err(self.malformed(format!("attribute {name}: found type {}, expected {}", found.r#type, r#type)))
            }
            found => Ok(found),
        }
    }

    pub(super) fn has(&self, name: &str) -> bool {
        self.attributes.iter().any(|a| a.name == name)
    }

    pub(super) fn int(&self, name: &str, default: i64) -> Result<i64> {
        Ok(self.attribute(name, attribute::INT)?.map_or(default, |a| a.i))
    }

    pub(super) fn float(&self, name: &str, default: f32) -> Result<f32> {
        Ok(self.attribute(name, attribute::FLOAT)?.map_or(default, |a| a.f))
    }

    pub(super) fn ints(&self, name: &str) -> Result<Option<&[i64]>> {
        Ok(self.attribute(name, attribute::INTS)?.map(|a| a.ints.as_slice()))
    }

    pub(super) fn floats(&self, name: &str) -> Result<Option<&[f32]>> {
        Ok(self.attribute(name, attribute::FLOATS)?.map(|a| a.floats.as_slice()))
    }

    /// Text, or `default` where there is none; what is no UTF-8 equals nothing that is expected.
    pub(super) fn text(&self, name: &str, default: &'static str) -> Result<String> {
        let found = self.attribute(name, attribute::STRING)?;
        Ok(found.map_or(default.into(), |a| String::from_utf8_lossy(&a.s).into_owned()))
    }

    pub(super) fn tensor(&self, name: &str) -> Result<Option<&proto::Tensor>> {
        Ok(self.attribute(name, attribute::TENSOR)?.and_then(|a| a.t.as_ref()))
    }

    /// An index that counts from the end where it is negative.
    pub(super) fn axis(&self, axis: i64, rank: usize) -> Result<usize> {
        let counted = if axis < 0 { axis.checked_add(rank as i64) } else { Some(axis) };
        let found = counted.and_then(|a| usize::try_from(a).ok()).filter(|&a| a < rank);
        found.ok_or_else(|| self.malformed(format!("found axis {axis}, expected one of a tensor of rank {rank}")))
    }
}
