//! The translation: node by node from an ONNX graph to the float graph.

use super::activation::{Activation, Value, extents};
use super::external::Folder;
use super::model::{Model, decode};
use super::node::Node;
use super::operators;
use super::problems::Problems;
use super::proto;
use super::tensor::{self, Tensor};
use crate::error::{Error, ErrorCode, Result};
use crate::import::checkpoint::TensorData;
use crate::ir::{Graph, Op, Shape, ValueId, Weights};
use std::collections::{HashMap, HashSet};
use std::sync::Arc;

/// Elements of the largest activation: far above any network for a microcontroller.
const MAX_ELEMENTS: u64 = 1 << 28;

pub(super) struct Translator<'a> {
    pub(super) graph: Graph,
    model: &'a Model,
    folder: Folder<'a>,
    /// Values by ONNX's names, as far as they are known.
    values: HashMap<String, Value>,
    /// Outputs of nodes that were refused.
    unknown: HashSet<&'a str>,
    /// Names that some node or the file's interface reads.
    read: HashSet<&'a str>,
    /// Names of the file's outputs.
    outputs: HashSet<&'a str>,
    /// Names of the graph, with the number of the last one that was made unique.
    names: HashMap<String, u32>,
    /// Elements that were made of the file's constants: weights in another order, results of folding.
    made: usize,
    pub(super) problems: Problems,
}

impl<'a> Translator<'a> {
    pub(super) fn new(model: &'a Model, folder: Folder<'a>) -> Self {
        let read = model.nodes.iter().flat_map(|node| &node.input).chain(model.outputs.iter().map(|o| &o.name));
        Self {
            graph: Graph { system: "classifier".into(), ..Graph::default() },
            model,
            folder,
            values: HashMap::new(),
            unknown: HashSet::new(),
            read: read.map(String::as_str).collect(),
            outputs: model.outputs.iter().map(|output| output.name.as_str()).collect(),
            names: model.outputs.iter().map(|output| (output.name.clone(), 1)).collect(),
            made: 0,
            problems: Problems::default(),
        }
    }

    /// Gives an input its value.
    pub(super) fn define(&mut self, name: &str, value: Value) {
        self.values.insert(name.into(), value);
    }

    /// A name that no other value of the graph has.
    pub(super) fn unique(&mut self, name: &str) -> String {
        let mut candidate = name.to_owned();
        while self.names.contains_key(&candidate) {
            let count = self.names.entry(name.to_owned()).or_insert(1);
            *count += 1;
            candidate = format!("{name}#{count}");
        }
        self.names.insert(candidate.clone(), 1);
        candidate
    }

    /// Translates all nodes; what is wrong is listed in `problems`.
    pub(super) fn nodes(&mut self) {
        let model = self.model;
        let writers = self.writers();
        for proto in &model.nodes {
            if let Err(error) = self.node(proto, &writers) {
                self.problems.add(error);
                self.unknown.extend(proto.output.iter().map(String::as_str));
            }
        }
    }

    /// The first node that writes each name.
    fn writers(&self) -> HashMap<&'a str, &'a proto::Node> {
        let mut writers = HashMap::new();
        for node in &self.model.nodes {
            for output in &node.output {
                writers.entry(output.as_str()).or_insert(node);
            }
        }
        writers
    }

    fn node(&mut self, proto: &'a proto::Node, writers: &HashMap<&str, &proto::Node>) -> Result<()> {
        let node = Node::new(proto, self.model.opset)?;
        let Some(operator) = operators::find(&node.operator) else {
            let inputs = node.inputs.join(", ");
            return Err(node
                .unsupported(format!("this operator is not supported (it reads {inputs})"))
                .with_help(format!("supported are {}", operators::names())));
        };
        self.check_names(&node, writers)?;
        if node.inputs.iter().any(|name| self.unknown.contains(name.as_str())) {
            self.unknown.extend(proto.output.iter().map(String::as_str));
            return Ok(());
        }
        let value = operator(self, &node)?;
        self.values.insert(node.outputs[0].clone(), value);
        Ok(())
    }

    /// The node reads what was written before, and writes one new value.
    fn check_names(&self, node: &Node<'_>, writers: &HashMap<&str, &proto::Node>) -> Result<()> {
        let known = |name: &str| {
            self.values.contains_key(name) || self.unknown.contains(name) || self.model.initializers.contains_key(name)
        };
        if let Some(name) = node.inputs.iter().find(|name| !name.is_empty() && !known(name)) {
            let message = match writers.get(name.as_str()) {
                Some(later) => {
                    let place = Node::new(later, node.opset).map_or(String::new(), |n| n.place());
                    format!("reads {name} before {place} writes it; ONNX's nodes are in topological order")
                }
                None => format!("reads {name}, which no node, input or initializer gives"),
            };
            return Err(node.malformed(message));
        }
        let Some(first) = node.outputs.first().filter(|name| !name.is_empty()) else {
            return Err(node.malformed("found no output"));
        };
        if known(first) {
            return Err(node.malformed(format!("writes {first}, which has a value already")));
        }
        match node.outputs[1..].iter().find(|name| !name.is_empty() && self.read.contains(name.as_str())) {
            Some(name) => Err(node
                .unsupported(format!("its output {name} is read, expected only the first output"))
                .with_help("export the model for inference, without additional outputs")),
            None => Ok(()),
        }
    }

    /// Adds a node to the graph.
    pub(super) fn push(&mut self, node: &Node<'_>, op: Op, inputs: &[ValueId]) -> Result<(ValueId, Shape)> {
        let output = &node.outputs[0];
        let is_output = self.outputs.contains(output.as_str());
        let name = if is_output { output.clone() } else { self.unique(node.name) };
        self.push_as(node, name, op, inputs)
    }

    /// Adds a node before the one that stands for the ONNX node.
    pub(super) fn push_before(&mut self, node: &Node<'_>, op: Op, inputs: &[ValueId]) -> Result<(ValueId, Shape)> {
        let name = self.unique(&format!("{}.{}", node.name, op.name()));
        self.push_as(node, name, op, inputs)
    }

    fn push_as(&mut self, node: &Node<'_>, name: String, op: Op, inputs: &[ValueId]) -> Result<(ValueId, Shape)> {
        let id = self.graph.push(name, op, inputs).map_err(|message| node.malformed(message))?;
        let shape = self.graph.value(id).shape;
        if shape.elements() > MAX_ELEMENTS {
            let (found, most) = (shape.elements(), MAX_ELEMENTS);
            return Err(node.unsupported(format!("its result has {found} elements, expected at most {most}")));
        }
        Ok((id, shape))
    }

    /// An operand that must be there.
    pub(super) fn value(&mut self, node: &Node<'_>, index: usize) -> Result<Value> {
        let found = self.optional(node, index)?;
        found.ok_or_else(|| node.malformed(format!("found no operand {index}")))
    }

    /// An operand, unless it is left out.
    pub(super) fn optional(&mut self, node: &Node<'_>, index: usize) -> Result<Option<Value>> {
        let name = node.input(index);
        if name.is_empty() {
            return Ok(None);
        }
        if let Some(value) = self.values.get(name) {
            return Ok(Some(value.clone()));
        }
        let Some(bytes) = self.model.initializers.get(name) else { return Ok(None) };
        let tensor = self.decoded(&decode(name, bytes.clone())?).map_err(|e| e.within(format!("tensor {name}")))?;
        self.values.insert(name.into(), Value::Constant(tensor.clone()));
        Ok(Some(Value::Constant(tensor)))
    }

    /// A constant of the file.
    pub(super) fn decoded(&mut self, proto: &proto::Tensor) -> Result<Tensor> {
        let tensor = tensor::read(proto, &self.folder)?;
        self.charge(tensor.len())?;
        Ok(tensor)
    }

    /// Counts elements made of the file's constants. A few bytes may name one constant many times; real files need
    /// about two elements per stored one.
    pub(super) fn charge(&mut self, elements: usize) -> Result<()> {
        let stored = usize::try_from(self.folder.bytes()).unwrap_or(usize::MAX).saturating_add(self.model.bytes);
        let limit = stored.saturating_mul(4).saturating_add(1 << 22);
        self.made = self.made.saturating_add(elements);
        if self.made > limit {
            let message = format!("the nodes make more than {limit} elements of {stored} bytes of constants");
            return Err(Error::new(ErrorCode::Refused, "", message).with_help("store constants folded"));
        }
        Ok(())
    }

    /// An operand that is computed from the image.
    pub(super) fn activation(&mut self, node: &Node<'_>, index: usize) -> Result<Activation> {
        match self.value(node, index)? {
            Value::Activation(activation) => Ok(activation),
            Value::Constant(_) => {
                let name = node.input(index);
                Err(node.unsupported(format!("operand {name} is a constant, expected a value computed from the image")))
            }
        }
    }

    /// A map `1×C×H×W`.
    pub(super) fn map(&mut self, node: &Node<'_>, index: usize) -> Result<Activation> {
        let activation = self.activation(node, index)?;
        if activation.is_map() {
            return Ok(activation);
        }
        let found = activation.described();
        Err(node.unsupported(format!("operand {}: found {found}, expected a map 1×C×H×W", node.input(index))))
    }

    /// A constant operand, unless it is left out.
    pub(super) fn constant(&mut self, node: &Node<'_>, index: usize) -> Result<Option<Tensor>> {
        match self.optional(node, index)? {
            None => Ok(None),
            Some(Value::Constant(tensor)) => Ok(Some(tensor)),
            Some(Value::Activation(_)) => {
                let name = node.input(index);
                Err(node.unsupported(format!("operand {name} is computed from the image, expected a constant")))
            }
        }
    }

    /// Integers of a constant operand, unless it is left out.
    pub(super) fn integers(&mut self, node: &Node<'_>, index: usize) -> Result<Option<Vec<i64>>> {
        let Some(tensor) = self.constant(node, index)? else { return Ok(None) };
        match &*tensor.data {
            TensorData::Integer(values) if tensor.dims.len() < 2 => Ok(Some(values.clone())),
            _ => {
                let (kind, dims) = (tensor.kind(), extents(&tensor.dims));
                Err(node.malformed(format!("operand {}: found {kind} {dims}, expected integers", node.input(index))))
            }
        }
    }

    /// Finite floating elements of a constant operand, unless it is left out; at least one.
    pub(super) fn floats(&mut self, node: &Node<'_>, index: usize) -> Result<Option<Floats>> {
        let name = node.input(index);
        let Some(tensor) = self.constant(node, index)? else { return Ok(None) };
        let wrong = |message: String| {
            let help = "the file is damaged, or the network was not trained to its end";
            Err(Error::new(ErrorCode::Tensors, format!("{}: tensor {name}", node.place()), message).with_help(help))
        };
        let TensorData::Float(values) = &*tensor.data else {
            return wrong(format!("found {} elements, expected floating", tensor.kind()));
        };
        if values.is_empty() {
            return wrong(format!("found {}, expected at least one element", extents(&tensor.dims)));
        }
        match values.iter().position(|v| !v.is_finite()) {
            Some(at) => wrong(format!("{} at index {at}", values[at])),
            None => Ok(Some(Floats { dims: tensor.dims.clone(), data: values.clone() })),
        }
    }

    /// Weights that must be there.
    pub(super) fn weights(&mut self, node: &Node<'_>, index: usize) -> Result<Floats> {
        let weights = self.floats(node, index)?;
        let weights = weights.ok_or_else(|| node.malformed(format!("found no operand {index}")))?;
        self.charge(weights.data.len())?;
        Ok(weights)
    }

    /// One finite value per channel, unless it is left out.
    pub(super) fn vector(&mut self, node: &Node<'_>, index: usize, length: usize) -> Result<Option<Arc<Vec<f32>>>> {
        let Some(values) = self.floats(node, index)? else { return Ok(None) };
        if values.dims != [length] {
            let (name, found) = (node.input(index), extents(&values.dims));
            return Err(node.malformed(format!("tensor {name}: found {found}, expected {length}")));
        }
        Ok(Some(Arc::new(values.data)))
    }

    /// Names the graph's outputs as the file does.
    pub(super) fn name_outputs(&mut self) {
        if self.model.outputs.is_empty() {
            self.problems.add(Error::new(ErrorCode::Malformed, "", "found no outputs in the file"));
        }
        let mut seen = HashSet::new();
        for output in &self.model.outputs {
            if !seen.insert(&output.name) {
                self.problems.add(Error::new(
                    ErrorCode::Malformed,
                    format!("output {}", output.name),
                    "found it twice",
                ));
            } else if let Err(error) = self.output(&output.name) {
                self.problems.add(error);
            }
        }
    }

    fn output(&mut self, name: &str) -> Result<()> {
        if self.unknown.contains(name) {
            return Ok(());
        }
        let refuse = |message: String| Err(Error::new(ErrorCode::Unsupported, format!("output {name}"), message));
        let Some(value) = self.values.get(name) else {
            return refuse("no node writes it".into());
        };
        let Value::Activation(activation) = value else {
            return refuse(format!("{}, expected a value computed from the image", value.described()));
        };
        if !activation.is_map() && activation.shape.positions() > 1 {
            return refuse(format!("found {}, expected a map or a vector", activation.described()));
        }
        // Each node of the new graph writes the value of its own number.
        let id = activation.id;
        let node = &mut self.graph.nodes[id.0 as usize];
        let value = &mut self.graph.values[id.0 as usize];
        if value.name != name && self.outputs.contains(value.name.as_str()) {
            let other = &value.name;
            return refuse(format!("it is the same value as the output {other}"));
        }
        name.clone_into(&mut value.name);
        name.clone_into(&mut node.name);
        self.graph.outputs.push(id);
        Ok(())
    }
}

/// A floating constant.
pub(super) struct Floats {
    /// Extents, outermost first.
    pub(super) dims: Vec<usize>,
    /// Row-major, finite, at least one.
    pub(super) data: Vec<f32>,
}

impl Floats {
    pub(super) fn into_weights(self) -> Arc<Weights> {
        Arc::new(Weights { shape: self.dims, data: self.data })
    }
}
