//! The float graph: what a network computes, before any integer is chosen.
//!
//! Invariants (checked by [`verify`], which collects every violation):
//! * each node writes exactly one value, and reads only values written by earlier nodes (nodes are in topological
//!   order)
//! * activations are `height × width × channels`, batch 1, channel fastest; token matrices are `tokens × 1 × channels`
//! * weights are `[output][kh][kw][input]` for convolutions and `[output][input]` for linear layers
//! * every shape follows from the inputs' shapes and the operator ([`Op::output_shape`])
//! * every weight is finite
//!
//! The importer makes a graph close to the framework's (convolution, batch norm, ReLU, add apart); the passes fold and
//! fuse it ([`crate::passes`]). Both forms run on the reference interpreter. A fused node keeps the name of the last
//! node of its chain, so a value is found under the same name before and after.

pub use firmware::program::Axis;
use firmware::program::Window;
pub use firmware::tensor::Shape;
use std::sync::Arc;

pub mod cost;
pub mod verify;

/// Handle of a value (an activation).
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct ValueId(pub u32);

/// A constant: shape and row-major data.
#[derive(Clone, Debug, PartialEq)]
pub struct Weights {
    /// Dimensions, outermost first.
    pub shape: Vec<usize>,
    /// Row-major elements.
    pub data: Vec<f32>,
}

/// An activation of the graph.
#[derive(Clone, Debug)]
pub struct Value {
    /// Name of the module that computes it, as in the checkpoint (`encoder.image_encoder.features.layer1.0`).
    pub name: String,
    /// Shape; see the module page for layouts.
    pub shape: Shape,
}

/// What a graph input holds, in raw units.
#[derive(Clone, Copy, Debug, PartialEq, Eq, serde::Serialize, serde::Deserialize)]
pub enum InputKind {
    /// RGB or grey image, values 0..=255.
    Image,
    /// LiDAR histogram: counts 0..=5; the network sees counts / 5.
    Bev,
    /// Forward speed, m/s, one value.
    Velocity,
    /// Goal point `[right, forward-negative]`, m.
    Goal,
    /// For each cell of the LiDAR map, cells of the image map: `H×W×2K`, a row and a column each, from 0.
    BevPoints,
    /// For each cell of the image map, cells of the LiDAR map: `H×W×2K`, a row and a column each, from 0.
    CameraPoints,
    /// Navigation command, one number from 1 on: it selects a branch.
    Command,
    /// Three RGB views (front, left, right) and the heatmap of the target, in grey levels 0..=255; the heatmap's are no
    /// whole numbers.
    Views,
}

impl InputKind {
    /// Every kind.
    pub const ALL: [Self; 8] = [
        Self::Image,
        Self::Bev,
        Self::Velocity,
        Self::Goal,
        Self::BevPoints,
        Self::CameraPoints,
        Self::Command,
        Self::Views,
    ];

    /// Name of a network input of this kind, as ports carry it.
    pub fn name(self) -> &'static str {
        match self {
            Self::Image => "rgb",
            Self::Bev => "bev",
            Self::Velocity => "velocity",
            Self::Goal => "goal",
            Self::BevPoints => "bev_points",
            Self::CameraPoints => "cam_points",
            Self::Command => "command",
            Self::Views => "views",
        }
    }
}

/// Bounds of a result: `min(max(x, min), max)`. ReLU is `0..∞`, ReLU6 `0..6`.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Clip {
    /// Smallest result; may be −∞.
    pub min: f32,
    /// Largest result; may be ∞.
    pub max: f32,
}

impl Clip {
    /// No bounds.
    pub const NONE: Self = Self { min: f32::NEG_INFINITY, max: f32::INFINITY };
    /// `max(x, 0)`.
    pub const RELU: Self = Self { min: 0.0, max: f32::INFINITY };

    /// This clip, then `next`, as one.
    #[must_use]
    pub fn then(self, next: Self) -> Self {
        Self { min: self.min.clamp(next.min, next.max), max: self.max.clamp(next.min, next.max) }
    }
}

/// Per-channel `(x − mean) / std` in raw input units.
#[derive(Clone, Debug, PartialEq)]
pub struct Normalization {
    /// Mean per channel.
    pub mean: Vec<f32>,
    /// Standard deviation per channel.
    pub std: Vec<f32>,
}

/// Convolution; with `normalization` the input is raw and padding stands for the mean (zero after normalization).
#[derive(Clone, Debug)]
pub struct Conv2d {
    /// `[output][kh][kw][input / groups]`.
    pub weights: Arc<Weights>,
    /// Per output channel.
    pub bias: Option<Arc<Vec<f32>>>,
    /// Kernel, stride, padding, dilation.
    pub window: Window,
    /// Channel groups.
    pub groups: u16,
    /// Normalization of the raw input, folded in.
    pub normalization: Option<Arc<Normalization>>,
    /// Bounds at the end (after the residual, if there is one).
    pub clip: Clip,
}

/// Matrix product over the channels.
#[derive(Clone, Debug)]
pub struct Linear {
    /// `[output][input]`.
    pub weights: Arc<Weights>,
    /// Per output.
    pub bias: Option<Arc<Vec<f32>>>,
    /// Bounds at the end (after the residual, if there is one).
    pub clip: Clip,
}

/// One of several linear layers of the same size, selected by a command: `clamp(command − 1, 0, branches − 1)`.
#[derive(Clone, Debug)]
pub struct BranchLinear {
    /// `[branch][output][input]`.
    pub weights: Arc<Weights>,
    /// `[branch][output]`.
    pub bias: Option<Arc<Vec<f32>>>,
    /// Bounds at the end.
    pub clip: Clip,
}

impl BranchLinear {
    /// Number of branches.
    pub fn branches(&self) -> usize {
        self.weights.shape.first().copied().unwrap_or(0)
    }

    /// The branch that a command selects.
    pub fn branch(&self, command: f32) -> usize {
        ((command - 1.0).max(0.0) as usize).min(self.branches().saturating_sub(1))
    }
}

/// Inference batch norm: `(x − mean)·weight/√(var + eps) + bias`.
#[derive(Clone, Debug)]
pub struct BatchNorm {
    /// γ.
    pub weight: Arc<Vec<f32>>,
    /// β.
    pub bias: Arc<Vec<f32>>,
    /// Running mean.
    pub mean: Arc<Vec<f32>>,
    /// Running variance.
    pub variance: Arc<Vec<f32>>,
    /// ε.
    pub epsilon: f32,
}

/// Pooled maps, velocity embedding and positions to tokens: row t of the result is
/// `pool(map)[t] + position[t] + velocity·velocity_weights + velocity_bias`, tokens of the first map first.
#[derive(Clone, Debug)]
pub struct Tokens {
    /// Token grid (height, width) that both maps are average-pooled to.
    pub grid: (u16, u16),
    /// `[tokens][channels]`; absent in the ablation without positional embedding.
    pub position: Option<Arc<Weights>>,
    /// Per channel.
    pub velocity_weights: Arc<Vec<f32>>,
    /// Per channel.
    pub velocity_bias: Arc<Vec<f32>>,
}

/// LayerNorm over channels of rows `first_row .. first_row + output positions`.
#[derive(Clone, Debug)]
pub struct LayerNorm {
    /// γ.
    pub weight: Arc<Vec<f32>>,
    /// β.
    pub bias: Arc<Vec<f32>>,
    /// ε.
    pub epsilon: f32,
    /// First row read.
    pub first_row: u16,
    /// Height and width of the output (height·width rows are read); `(T, 1)` for a whole token matrix.
    pub grid: (u16, u16),
}

/// A strided box of a map: `out[i] = in[begin + i·stride]` along height, width and channels, up to `end` (exclusive).
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Slice {
    /// First index per axis.
    pub begin: [u16; 3],
    /// Index behind the last per axis.
    pub end: [u16; 3],
    /// Distance of neighbors per axis, at least 1.
    pub stride: [u16; 3],
}

/// A map with a border of one value, along height, width and channels.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Pad {
    /// Elements before the map per axis.
    pub before: [u16; 3],
    /// Elements behind the map per axis.
    pub after: [u16; 3],
    /// Value of the border.
    pub value: f32,
}

/// GRU cell and output layer, run `steps` times (spec 1.0). Inputs: hidden state, goal. Output `steps × 1 × 2`.
#[derive(Clone, Debug)]
pub struct WaypointDecoder {
    /// `[3H][2 or 4]`: 2 adds waypoint and goal, 4 concatenates them.
    pub input_weights: Arc<Weights>,
    /// `[3H][H]`.
    pub hidden_weights: Arc<Weights>,
    /// `[3H]`.
    pub input_bias: Arc<Vec<f32>>,
    /// `[3H]`.
    pub hidden_bias: Arc<Vec<f32>>,
    /// `[2][H]`.
    pub output_weights: Arc<Weights>,
    /// `[2]`.
    pub output_bias: Arc<Vec<f32>>,
    /// Waypoints to emit.
    pub steps: u16,
}

/// An operator. Inputs in the order given here.
#[derive(Clone, Debug)]
pub enum Op {
    /// Graph input.
    Input(InputKind),
    /// `[map]`: `(x − mean)/std` per channel.
    Normalize(Arc<Normalization>),
    /// `[map]` or `[map, residual]`.
    Conv2d(Conv2d),
    /// `[map]`.
    BatchNorm(BatchNorm),
    /// `[x]`: bounds.
    Clip(Clip),
    /// `[a, b]`, same shape.
    Add {
        /// Bounds at the end.
        clip: Clip,
    },
    /// `[map]`; padding never wins.
    MaxPool(Window),
    /// `[map]`; full windows only.
    AveragePool(Window),
    /// `[map]` or `[map, map]`: mean over all positions of each, added; a vector.
    GlobalPool,
    /// `[map]` or `[map, residual]`: half-pixel bilinear enlargement by a whole factor (height, width).
    ResizeBilinear {
        /// Vertical and horizontal factor.
        factor: (u16, u16),
    },
    /// `[x]` or `[x, residual]`.
    Linear(Linear),
    /// `[map, map, velocity]`.
    Tokens(Tokens),
    /// `[tokens]`.
    LayerNorm(LayerNorm),
    /// `[query, key, value]`, each `T×C`; softmax(q·kᵀ/√(C/heads))·v per head.
    Attention {
        /// Number of heads.
        heads: u16,
    },
    /// `[hidden, goal]`.
    WaypointDecoder(WaypointDecoder),
    /// `[map]`.
    Slice(Slice),
    /// `[map]`.
    Pad(Pad),
    /// `[map, map, …]`, one after the other along an axis; equal in the other two.
    Concat(Axis),
    /// `[x]`: `exp(x) / Σ exp(x)` over the channels of each position.
    Softmax,
    /// `[map, indices]`: `out[i,j] = Σ_k map[p_ijk]`, where the cell p is the row `indices[i,j,2k]` and the column
    /// `indices[i,j,2k+1]`; one outside the map means the nearest row or column.
    GatherSum,
    /// `[x, command]`.
    BranchLinear(BranchLinear),
    /// `[x]`: `1 / (1 + exp(−x))` of each element.
    Sigmoid,
    /// `[map]`: per channel the expected `[column, row]` under `exp(x / temperature) / Σ exp(x / temperature)` over all
    /// pixels, in pixels from the center of the first; `channels × 1 × 2`.
    SpatialSoftmax {
        /// Divides the logits; positive.
        temperature: f32,
    },
}

/// One operator application.
#[derive(Clone, Debug)]
pub struct Node {
    /// Same as the output value's name.
    pub name: String,
    /// What is computed.
    pub op: Op,
    /// Operands.
    pub inputs: Vec<ValueId>,
    /// Result.
    pub output: ValueId,
}

/// A network in topological order.
#[derive(Clone, Debug, Default)]
pub struct Graph {
    /// Model name (file stem or system).
    pub name: String,
    /// Recognized system (`transfuser`, `aim`, `late_fusion`, …).
    pub system: String,
    /// All values.
    pub values: Vec<Value>,
    /// All nodes, in order.
    pub nodes: Vec<Node>,
    /// Outputs.
    pub outputs: Vec<ValueId>,
}

impl Graph {
    /// The value behind a handle.
    pub fn value(&self, id: ValueId) -> &Value {
        &self.values[id.0 as usize]
    }

    /// The value of this name.
    pub fn find(&self, name: &str) -> Option<ValueId> {
        self.values.iter().position(|v| v.name == name).map(|i| ValueId(i as u32))
    }

    /// The node that writes a value.
    pub fn producer(&self, id: ValueId) -> Option<&Node> {
        self.nodes.iter().find(|n| n.output == id)
    }

    /// Graph inputs with their kinds, in order.
    pub fn inputs(&self) -> impl Iterator<Item = (ValueId, InputKind)> + '_ {
        self.nodes.iter().filter_map(|n| match n.op {
            Op::Input(kind) => Some((n.output, kind)),
            _ => None,
        })
    }

    /// Adds a node; its output shape follows from the operator.
    ///
    /// # Errors
    /// The operator does not accept these input shapes.
    pub fn push(&mut self, name: impl Into<String>, op: Op, inputs: &[ValueId]) -> Result<ValueId, String> {
        let shapes: Vec<Shape> = inputs.iter().map(|&i| self.value(i).shape).collect();
        let shape = op.output_shape(&shapes)?;
        Ok(self.push_with_shape(name, op, inputs, shape))
    }

    /// Adds an input of the given shape.
    pub fn push_input(&mut self, name: impl Into<String>, kind: InputKind, shape: Shape) -> ValueId {
        self.push_with_shape(name, Op::Input(kind), &[], shape)
    }

    fn push_with_shape(&mut self, name: impl Into<String>, op: Op, inputs: &[ValueId], shape: Shape) -> ValueId {
        let name = name.into();
        let output = ValueId(self.values.len() as u32);
        self.values.push(Value { name: name.clone(), shape });
        self.nodes.push(Node { name, op, inputs: inputs.to_vec(), output });
        output
    }
}

impl Op {
    /// Operator name as messages and reports print it.
    pub fn name(&self) -> &'static str {
        match self {
            Self::Input(_) => "input",
            Self::Normalize(_) => "normalize",
            Self::Conv2d(_) => "conv2d",
            Self::BatchNorm(_) => "batch_norm",
            Self::Clip(clip) => {
                if *clip == Clip::RELU {
                    "relu"
                } else {
                    "clip"
                }
            }
            Self::Add { .. } => "add",
            Self::MaxPool(_) => "max_pool",
            Self::AveragePool(_) => "average_pool",
            Self::GlobalPool => "global_pool",
            Self::ResizeBilinear { .. } => "resize_bilinear",
            Self::Linear(_) => "linear",
            Self::Tokens(_) => "tokens",
            Self::LayerNorm(_) => "layer_norm",
            Self::Attention { .. } => "attention",
            Self::WaypointDecoder(_) => "waypoint_decoder",
            Self::Slice(_) => "slice",
            Self::Pad(_) => "pad",
            Self::Concat(_) => "concat",
            Self::Softmax => "softmax",
            Self::GatherSum => "gather_sum",
            Self::BranchLinear(_) => "branch_linear",
            Self::Sigmoid => "sigmoid",
            Self::SpatialSoftmax { .. } => "spatial_softmax",
        }
    }

    /// Shape of the result for these input shapes.
    ///
    /// # Errors
    /// Says which operand does not fit and what was expected.
    pub fn output_shape(&self, inputs: &[Shape]) -> Result<Shape, String> {
        verify::output_shape(self, inputs)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::collections::BTreeSet;

    #[test]
    fn every_kind_of_input_has_a_name_of_its_own() {
        let names: BTreeSet<_> = InputKind::ALL.into_iter().map(InputKind::name).collect();
        assert_eq!(names.len(), InputKind::ALL.len(), "{names:?}");
    }
}
