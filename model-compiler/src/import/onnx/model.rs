//! An ONNX file, opened: version, producer, nodes, constants, inputs and outputs. Nothing is translated yet.

use super::proto;
use crate::error::{Error, ErrorCode, Result};
use crate::import::checkpoint::malformed;
use prost::Message;
use prost::bytes::Bytes;
use std::collections::{BTreeMap, HashMap};
use std::ops::RangeInclusive;

/// Versions of ONNX's operator set that are read.
pub(super) const OPSETS: RangeInclusive<i64> = 7..=20;
/// Versions of the file format that are read: from the one that came with operator set 7 to the latest published.
const FORMATS: RangeInclusive<i64> = 3..=13;

/// A decoded file.
#[derive(Clone, Debug)]
pub struct Model {
    pub(super) opset: i64,
    pub(super) nodes: Vec<proto::Node>,
    /// Encoded constants by name.
    pub(super) initializers: HashMap<String, Bytes>,
    /// Inputs that no initializer stands for.
    pub(super) inputs: Vec<proto::ValueInfo>,
    pub(super) outputs: Vec<proto::ValueInfo>,
    /// Length of the file.
    pub(super) bytes: usize,
    producer: String,
    parameters: u64,
}

impl Model {
    /// Opens a file.
    ///
    /// # Errors
    /// `Malformed` for bytes that are no ONNX file or a damaged one, `Unsupported` for another version.
    pub fn parse(bytes: Vec<u8>) -> Result<Self> {
        let length = bytes.len();
        let file: proto::Model = decode("file", Bytes::from(bytes))?;
        let opset = supported_opset(&file)?;
        let graph = file.graph.ok_or_else(|| malformed("", "found no graph in the file"))?;
        if !graph.sparse_initializer.is_empty() {
            let message = format!("found {} sparse initializers, which are not read", graph.sparse_initializer.len());
            return Err(Error::new(ErrorCode::Unsupported, "", message).with_help("store the weights as dense tensors"));
        }
        let (initializers, parameters) = initializers(&graph.initializer)?;
        let mut inputs: Vec<proto::ValueInfo> = decode_all("input", &graph.input)?;
        inputs.retain(|input| !initializers.contains_key(&input.name));
        Ok(Self {
            opset,
            nodes: decode_all("node", &graph.node)?,
            initializers,
            inputs,
            outputs: decode_all("output", &graph.output)?,
            bytes: length,
            producer: [file.producer_name, file.producer_version].join(" ").trim().to_owned(),
            parameters,
        })
    }

    /// Version of ONNX's operator set.
    pub fn opset(&self) -> i64 {
        self.opset
    }

    /// The program that wrote the file, with its version; may be empty.
    pub fn producer(&self) -> &str {
        &self.producer
    }

    /// Number of nodes per operator, in the order of the operators' names.
    pub fn operators(&self) -> BTreeMap<String, usize> {
        let mut counts = BTreeMap::new();
        self.nodes.iter().for_each(|node| *counts.entry(operator(node)).or_insert(0) += 1);
        counts
    }

    /// Name and type (`float N×3×32×32`) of each input that is no constant.
    pub fn inputs(&self) -> impl Iterator<Item = (&str, String)> {
        self.inputs.iter().map(|value| (value.name.as_str(), described(value)))
    }

    /// Name and type of each output.
    pub fn outputs(&self) -> impl Iterator<Item = (&str, String)> {
        self.outputs.iter().map(|value| (value.name.as_str(), described(value)))
    }

    /// Number of constants, and of their elements in all.
    pub fn parameters(&self) -> (usize, u64) {
        (self.initializers.len(), self.parameters)
    }
}

/// An operator's name, with its domain where it is not ONNX's own.
pub(super) fn operator(node: &proto::Node) -> String {
    match node.domain.as_str() {
        "" | "ai.onnx" => node.op_type.clone(),
        domain => format!("{domain}.{}", node.op_type),
    }
}

/// A message out of its bytes.
pub(super) fn decode<M: Message + Default>(place: &str, bytes: Bytes) -> Result<M> {
    M::decode(bytes).map_err(|e| malformed(place, format!("found {e}, expected an ONNX message")))
}

fn decode_all<M: Message + Default>(what: &str, list: &[Bytes]) -> Result<Vec<M>> {
    list.iter().enumerate().map(|(index, bytes)| decode(&format!("{what} {index}"), bytes.clone())).collect()
}

fn supported_opset(file: &proto::Model) -> Result<i64> {
    let unsupported = |message: String| {
        let (first, last) = (OPSETS.start(), OPSETS.end());
        Error::new(ErrorCode::Unsupported, "", message)
            .with_help(format!("export the model with an opset of {first} to {last}, such as 17"))
    };
    if !FORMATS.contains(&file.ir_version) {
        let message = format!("found ONNX format version {}, expected {FORMATS:?}", file.ir_version);
        return Err(unsupported(message.replace("..=", " to ")));
    }
    let own = file.opset_import.iter().find(|set| matches!(set.domain.as_str(), "" | "ai.onnx"));
    match own.map(|set| set.version) {
        Some(opset) if OPSETS.contains(&opset) => Ok(opset),
        Some(opset) => Err(unsupported(format!("found opset {opset}, expected {OPSETS:?}").replace("..=", " to "))),
        None => Err(unsupported("the file names no version of ONNX's operator set".into())),
    }
}

/// Constants by name, and the number of their elements.
fn initializers(list: &[Bytes]) -> Result<(HashMap<String, Bytes>, u64)> {
    let mut by_name = HashMap::new();
    let mut elements = 0u64;
    for (index, bytes) in list.iter().enumerate() {
        let tensor: proto::Tensor = decode(&format!("initializer {index}"), bytes.clone())?;
        let count = tensor.dims.iter().try_fold(1u64, |n, &d| n.checked_mul(u64::try_from(d).ok()?)).unwrap_or(0);
        elements = elements.saturating_add(count);
        if by_name.insert(tensor.name.clone(), bytes.clone()).is_some() {
            return Err(malformed(format!("initializer {}", tensor.name), "found it twice"));
        }
    }
    Ok((by_name, elements))
}

/// Element type and shape of an input or output.
fn described(value: &proto::ValueInfo) -> String {
    let Some(tensor) = value.r#type.as_ref().and_then(|t| t.tensor_type.as_ref()) else {
        return "no tensor".into();
    };
    let element = proto::element::name(tensor.elem_type);
    match &tensor.shape {
        None => format!("{element}, shape unknown"),
        Some(shape) if shape.dim.is_empty() => element,
        Some(shape) => {
            let sizes: Vec<String> = shape.dim.iter().map(size).collect();
            format!("{element} {}", sizes.join("×"))
        }
    }
}

fn size(dimension: &proto::Dimension) -> String {
    match (dimension.dim_value, &dimension.dim_param) {
        (Some(value), _) => value.to_string(),
        (None, Some(name)) => name.clone(),
        (None, None) => "?".into(),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn file(ir_version: i64, opsets: &[(&str, i64)]) -> Vec<u8> {
        let opset_import =
            opsets.iter().map(|&(domain, version)| proto::OperatorSet { domain: domain.into(), version }).collect();
        let graph = Some(proto::Graph::default());
        proto::Model { ir_version, graph, opset_import, ..Default::default() }.encode_to_vec()
    }

    #[test]
    fn versions_are_told_from_the_file() {
        assert_eq!(Model::parse(file(8, &[("ai.onnx.ml", 3), ("", 13)])).unwrap().opset(), 13);
        for (bytes, message) in [
            (file(8, &[("", 6)]), "found opset 6, expected 7 to 20"),
            (file(8, &[("ai.onnx", 21)]), "found opset 21, expected 7 to 20"),
            (file(2, &[("", 7)]), "found ONNX format version 2, expected 3 to 13"),
            (file(8, &[("ai.onnx.ml", 3)]), "the file names no version of ONNX's operator set"),
        ] {
            let error = Model::parse(bytes).unwrap_err();
            assert_eq!((error.code, error.message.as_str()), (ErrorCode::Unsupported, message));
            assert_eq!(error.help, "export the model with an opset of 7 to 20, such as 17");
        }
    }

    #[test]
    fn a_constant_of_the_same_name_twice_is_refused() {
        let tensor = proto::Tensor { name: "w".into(), ..Default::default() }.encode_to_vec();
        let error = initializers(&[Bytes::from(tensor.clone()), Bytes::from(tensor)]).unwrap_err();
        assert_eq!((error.location.as_str(), error.message.as_str()), ("initializer w", "found it twice"));
    }
}
