//! Writes small ONNX files, straight from the published field numbers.

use crate::random::Random;
use prost::Message;

#[derive(Clone, PartialEq, Message)]
struct Model {
    #[prost(int64, tag = "1")]
    ir_version: i64,
    #[prost(string, tag = "2")]
    producer_name: String,
    #[prost(message, optional, tag = "7")]
    graph: Option<Graph>,
    #[prost(message, repeated, tag = "8")]
    opset_import: Vec<OperatorSet>,
}

#[derive(Clone, PartialEq, Message)]
struct OperatorSet {
    #[prost(string, tag = "1")]
    domain: String,
    #[prost(int64, tag = "2")]
    version: i64,
}

#[derive(Clone, PartialEq, Message)]
struct Graph {
    #[prost(message, repeated, tag = "1")]
    node: Vec<Node>,
    #[prost(string, tag = "2")]
    name: String,
    #[prost(message, repeated, tag = "5")]
    initializer: Vec<Tensor>,
    #[prost(message, repeated, tag = "11")]
    input: Vec<ValueInfo>,
    #[prost(message, repeated, tag = "12")]
    output: Vec<ValueInfo>,
}

/// One operator application.
#[derive(Clone, PartialEq, Message)]
pub struct Node {
    /// Operands.
    #[prost(string, repeated, tag = "1")]
    pub input: Vec<String>,
    /// Results.
    #[prost(string, repeated, tag = "2")]
    pub output: Vec<String>,
    /// Name.
    #[prost(string, tag = "3")]
    pub name: String,
    /// Operator.
    #[prost(string, tag = "4")]
    pub op_type: String,
    /// Settings.
    #[prost(message, repeated, tag = "5")]
    pub attribute: Vec<Attribute>,
    /// Whose operator it is; empty for ONNX's own.
    #[prost(string, tag = "7")]
    pub domain: String,
}

/// A named setting.
#[derive(Clone, PartialEq, Message)]
pub struct Attribute {
    #[prost(string, tag = "1")]
    name: String,
    #[prost(float, optional, tag = "2")]
    f: Option<f32>,
    #[prost(int64, optional, tag = "3")]
    i: Option<i64>,
    #[prost(bytes = "vec", optional, tag = "4")]
    s: Option<Vec<u8>>,
    #[prost(message, optional, tag = "5")]
    t: Option<Tensor>,
    #[prost(float, repeated, packed = "false", tag = "7")]
    floats: Vec<f32>,
    #[prost(int64, repeated, packed = "false", tag = "8")]
    ints: Vec<i64>,
    #[prost(int32, tag = "20")]
    kind: i32,
}

/// A constant.
#[derive(Clone, PartialEq, Message)]
pub struct Tensor {
    /// Extents.
    #[prost(int64, repeated, packed = "false", tag = "1")]
    pub dims: Vec<i64>,
    /// Element type by its number.
    #[prost(int32, tag = "2")]
    pub data_type: i32,
    /// Name.
    #[prost(string, tag = "8")]
    pub name: String,
    /// Little-endian elements.
    #[prost(bytes = "vec", tag = "9")]
    pub raw_data: Vec<u8>,
    /// Where the elements lie otherwise.
    #[prost(message, repeated, tag = "13")]
    pub external_data: Vec<Entry>,
    /// 1: in another file.
    #[prost(int32, tag = "14")]
    pub data_location: i32,
}

/// A key and its value.
#[derive(Clone, PartialEq, Message)]
pub struct Entry {
    #[prost(string, tag = "1")]
    key: String,
    #[prost(string, tag = "2")]
    value: String,
}

#[derive(Clone, PartialEq, Message)]
struct ValueInfo {
    #[prost(string, tag = "1")]
    name: String,
    #[prost(message, optional, tag = "2")]
    kind: Option<Type>,
}

#[derive(Clone, PartialEq, Message)]
struct Type {
    #[prost(message, optional, tag = "1")]
    tensor: Option<TensorType>,
}

#[derive(Clone, PartialEq, Message)]
struct TensorType {
    #[prost(int32, tag = "1")]
    element: i32,
    #[prost(message, optional, tag = "2")]
    shape: Option<TensorShape>,
}

#[derive(Clone, PartialEq, Message)]
struct TensorShape {
    #[prost(message, repeated, tag = "1")]
    dim: Vec<Dimension>,
}

#[derive(Clone, PartialEq, Message)]
struct Dimension {
    #[prost(int64, optional, tag = "1")]
    value: Option<i64>,
    #[prost(string, optional, tag = "2")]
    name: Option<String>,
}

/// Element type numbers.
pub const FLOAT: i32 = 1;
/// 64-bit integers.
pub const INT64: i32 = 7;
/// Truth values.
pub const BOOL: i32 = 9;

/// A setting.
pub fn int(name: &str, value: i64) -> Attribute {
    Attribute { name: name.into(), i: Some(value), kind: 2, ..Default::default() }
}

/// A list of integers.
pub fn ints(name: &str, values: &[i64]) -> Attribute {
    Attribute { name: name.into(), ints: values.to_vec(), kind: 7, ..Default::default() }
}

/// A floating setting.
pub fn float(name: &str, value: f32) -> Attribute {
    Attribute { name: name.into(), f: Some(value), kind: 1, ..Default::default() }
}

/// A list of floats.
pub fn floats(name: &str, values: &[f32]) -> Attribute {
    Attribute { name: name.into(), floats: values.to_vec(), kind: 6, ..Default::default() }
}

/// A word.
pub fn text(name: &str, value: &str) -> Attribute {
    Attribute { name: name.into(), s: Some(value.into()), kind: 3, ..Default::default() }
}

/// A constant as a setting.
pub fn tensor(name: &str, value: Tensor) -> Attribute {
    Attribute { name: name.into(), t: Some(value), kind: 4, ..Default::default() }
}

impl Tensor {
    /// Floats.
    pub fn floats(name: &str, dims: &[i64], values: &[f32]) -> Self {
        let raw_data = values.iter().flat_map(|v| v.to_le_bytes()).collect();
        Self { dims: dims.to_vec(), data_type: FLOAT, name: name.into(), raw_data, ..Default::default() }
    }

    /// 64-bit integers.
    pub fn integers(name: &str, dims: &[i64], values: &[i64]) -> Self {
        let raw_data = values.iter().flat_map(|v| v.to_le_bytes()).collect();
        Self { dims: dims.to_vec(), data_type: INT64, name: name.into(), raw_data, ..Default::default() }
    }

    /// The elements lie in another file.
    #[must_use]
    pub fn external(mut self, entries: &[(&str, &str)]) -> Self {
        self.raw_data.clear();
        self.data_location = 1;
        self.external_data =
            entries.iter().map(|(key, value)| Entry { key: (*key).into(), value: (*value).into() }).collect();
        self
    }
}

/// A file under construction.
#[derive(Clone, Debug)]
pub struct OnnxFile {
    /// Version of the operator set.
    pub opset: i64,
    /// Nodes in order.
    pub nodes: Vec<Node>,
    /// Constants.
    pub tensors: Vec<Tensor>,
    inputs: Vec<ValueInfo>,
    outputs: Vec<ValueInfo>,
    random: Random,
}

impl OnnxFile {
    /// A file whose weights are drawn from a seed.
    pub fn new(opset: i64, seed: u64) -> Self {
        let random = Random::new(seed);
        Self { opset, nodes: Vec::new(), tensors: Vec::new(), inputs: Vec::new(), outputs: Vec::new(), random }
    }

    /// An input; 0 stands for a size that is not fixed.
    pub fn input(&mut self, name: &str, dims: &[i64]) -> &mut Self {
        self.inputs.push(value(name, FLOAT, dims));
        self
    }

    /// An input of another element type.
    pub fn typed_input(&mut self, name: &str, element: i32, dims: &[i64]) -> &mut Self {
        self.inputs.push(value(name, element, dims));
        self
    }

    /// An output of unknown shape.
    pub fn output(&mut self, name: &str) -> &mut Self {
        let tensor = Some(TensorType { element: FLOAT, shape: None });
        self.outputs.push(ValueInfo { name: name.into(), kind: Some(Type { tensor }) });
        self
    }

    /// A node without a name.
    pub fn node(&mut self, op: &str, inputs: &[&str], output: &str, attributes: &[Attribute]) -> &mut Self {
        self.nodes.push(Node {
            input: inputs.iter().map(|name| (*name).into()).collect(),
            output: vec![output.into()],
            op_type: op.into(),
            attribute: attributes.to_vec(),
            ..Default::default()
        });
        self
    }

    /// A constant of random floats in −0.5..0.5; its name.
    pub fn weights(&mut self, name: &str, dims: &[i64]) -> String {
        let values = self.draw(dims.iter().product::<i64>() as usize, -0.5, 0.5);
        self.floats(name, dims, &values)
    }

    /// A constant of random floats in 0.5..1.5 (variances, scales); its name.
    pub fn positive(&mut self, name: &str, dims: &[i64]) -> String {
        let values = self.draw(dims.iter().product::<i64>() as usize, 0.5, 1.5);
        self.floats(name, dims, &values)
    }

    /// Random floats.
    pub fn draw(&mut self, count: usize, from: f32, to: f32) -> Vec<f32> {
        (0..count).map(|_| from + (to - from) * (self.random.signed_unit() + 1.0) / 2.0).collect()
    }

    /// A floating constant; its name.
    pub fn floats(&mut self, name: &str, dims: &[i64], values: &[f32]) -> String {
        self.tensors.push(Tensor::floats(name, dims, values));
        name.into()
    }

    /// A list of integers; its name.
    pub fn integers(&mut self, name: &str, values: &[i64]) -> String {
        self.tensors.push(Tensor::integers(name, &[values.len() as i64], values));
        name.into()
    }

    /// Extents of the first input, sizes that are not fixed as 1.
    pub fn input_dims(&self) -> Vec<usize> {
        let shape = self.inputs[0].kind.as_ref().and_then(|k| k.tensor.as_ref()).and_then(|t| t.shape.as_ref());
        shape.map_or(vec![], |s| s.dim.iter().map(|d| d.value.unwrap_or(1) as usize).collect())
    }

    /// The file.
    pub fn bytes(&self) -> Vec<u8> {
        let graph = Graph {
            node: self.nodes.clone(),
            name: "network".into(),
            initializer: self.tensors.clone(),
            input: self.inputs.clone(),
            output: self.outputs.clone(),
        };
        Model {
            // The first format whose initializers need not be inputs.
            ir_version: 4,
            producer_name: "tests".into(),
            graph: Some(graph),
            opset_import: vec![OperatorSet { domain: String::new(), version: self.opset }],
        }
        .encode_to_vec()
    }
}

fn value(name: &str, element: i32, dims: &[i64]) -> ValueInfo {
    let dimension = |&size: &i64| match size {
        0 => Dimension { value: None, name: Some("n".into()) },
        size => Dimension { value: Some(size), name: None },
    };
    let shape = Some(TensorShape { dim: dims.iter().map(dimension).collect() });
    ValueInfo { name: name.into(), kind: Some(Type { tensor: Some(TensorType { element, shape }) }) }
}
