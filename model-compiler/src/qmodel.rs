//! The quantized model (`.qmodel`): integers, scales and tables, independent of any target.
//!
//! This is the single hand-over from the quantizer to everything behind it. The back end packs it for a target; the f64
//! model of `integer_reference` executes it as it stands. Formulas: the structs of [`firmware::program`] and
//! numerics (the one arithmetic); arrays here are plain vectors in canonical order.

use crate::ir::InputKind;
use firmware::program::{Axis, Clamp, Requant, Window};
use firmware::tensor::{ElementType, Shape};
use serde::{Deserialize, Serialize};

/// Index into [`QModel::tensors`].
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
pub struct QTensorId(pub u32);

/// A whole quantized network.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct QModel {
    /// Model name.
    pub name: String,
    /// System (`transfuser`, …).
    pub system: String,
    /// All activations.
    pub tensors: Vec<QTensor>,
    /// Operators in an executable order.
    pub steps: Vec<QStep>,
    /// Inputs in the order of the graph.
    pub inputs: Vec<Port>,
    /// Outputs.
    pub outputs: Vec<Port>,
    /// How it was made, for reports: `(key, value)`.
    pub provenance: Vec<(String, String)>,
}

/// An input or output.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Port {
    /// `rgb`, `bev`, `velocity`, `goal`, `waypoints`, …
    pub name: String,
    /// The tensor.
    pub tensor: QTensorId,
    /// For inputs: how raw values become codes (numerics, "Inputs").
    pub kind: Option<InputKind>,
}

/// A quantized activation: `real = scale · (code − zero_point)`.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct QTensor {
    /// Unique name.
    pub name: String,
    /// Name of the graph value that it approximates.
    pub value: String,
    /// Shape.
    pub shape: Shape,
    /// `I8`, `I16` or `I32`.
    pub element: ElementType,
    /// Scale, snapped to 12 significant bits (exact powers of two for fixed-point tensors).
    pub scale: f64,
    /// Zero point; 0 for 16 and 32 bit.
    pub zero_point: i32,
    /// Codes at a clamp bound other than by ReLU, per million, on the calibration frames; `None` where unknown.
    pub saturation_ppm: Option<f64>,
}

/// One operator with all its integers.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct QStep {
    /// Name (of the graph node, with a suffix where a node became several steps).
    pub name: String,
    /// Name of the graph node whose function this step computes; `None` for a pure change of type.
    pub node: Option<String>,
    /// The operator.
    pub op: QOp,
    /// Result of the interval analysis.
    pub bounds: Bounds,
}

/// What the interval analysis proved about a step's intermediates.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct Bounds {
    /// Bits of the largest accumulator magnitude (partial sums of raw codes included).
    pub accumulator_bits: u8,
    /// Spare bits of the tightest intermediate against its type or 2^53.
    pub headroom_bits: u8,
    /// `max |t_k|·2^-(n+1)`: rounding of the multipliers, in output LSB.
    pub multiplier_rounding: f64,
    /// Whether the output's smallest and largest code stand for bounds of the network (ReLU, clip): codes there are no
    /// loss.
    pub clipped: [bool; 2],
}

/// See [`firmware::program::Rescale`].
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct QRescale {
    /// p.
    pub pre_shift: u8,
    /// b' per output channel.
    pub bias: Vec<i32>,
    /// M per output channel.
    pub multipliers: Vec<i32>,
    /// n per output channel.
    pub shifts: Vec<u8>,
    /// z_o.
    pub zero_point: i16,
    /// Output bounds.
    pub clamp: Clamp,
    /// Second term.
    pub residual: QResidual,
}

/// See [`firmware::program::Residual`].
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[allow(missing_docs, reason = "field for field the image's")]
pub enum QResidual {
    None,
    Scaled { tensor: QTensorId, zero_point: i16, multipliers: Vec<i32> },
    Stream { tensor: QTensorId },
}

/// See [`firmware::program::Term`].
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[allow(missing_docs, reason = "field for field the image's")]
pub struct QTerm {
    pub tensor: QTensorId,
    pub zero_point: i16,
    pub multiplier: i32,
}

/// See [`firmware::program::TokenSource`].
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[allow(missing_docs, reason = "field for field the image's")]
pub struct QTokenSource {
    pub map: QTensorId,
    pub zero_point: i16,
    pub pool_h: u8,
    pub pool_w: u8,
    pub multiplier: i32,
}

/// See [`firmware::program::ConcatSource`].
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[allow(missing_docs, reason = "field for field the image's")]
pub struct QConcatSource {
    pub tensor: QTensorId,
    pub zero_point: i16,
    pub requant: Requant,
}

/// The GRU decoder's integers; see [`firmware::program::WaypointDecoder`].
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[allow(missing_docs, reason = "field for field the image's")]
pub struct QWaypointDecoder {
    pub hidden: QTensorId,
    pub goal: QTensorId,
    pub output: QTensorId,
    pub hidden_fraction_bits: u8,
    pub concat: bool,
    pub input_weights: Vec<i16>,
    pub hidden_weights: Vec<i16>,
    pub input_pre_shift: u8,
    pub hidden_pre_shift: u8,
    pub input_multipliers: Vec<i32>,
    pub hidden_multipliers: Vec<i32>,
    pub shifts: Vec<u8>,
    /// B of r, B of z, B_i of n, B_h of n: `[4H]`.
    pub biases: Vec<i64>,
    pub output_weights: Vec<i16>,
    pub output_bias: Vec<i64>,
    pub output_pre_shift: u8,
    pub output_requant: [Requant; 2],
    pub tanh_table: Vec<i16>,
}

/// A quantized operator; the formulas are at the structs of the same name in [`firmware::program`].
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[allow(missing_docs, reason = "field for field the image's")]
pub enum QOp {
    Conv2d {
        input: QTensorId,
        output: QTensorId,
        window: Window,
        groups: u16,
        /// `[O][kh][kw][C/groups]`.
        weights: Vec<i8>,
        /// Per input channel.
        padding_codes: Vec<i8>,
        rescale: QRescale,
    },
    Linear {
        input: QTensorId,
        output: QTensorId,
        /// `[O][I]`.
        weights: Vec<i8>,
        wide: bool,
        rescale: QRescale,
    },
    MaxPool {
        input: QTensorId,
        output: QTensorId,
        window: Window,
    },
    AveragePool {
        input: QTensorId,
        output: QTensorId,
        window: Window,
        input_zero_point: i16,
        requant: Requant,
        zero_point: i16,
        clamp: Clamp,
    },
    GlobalPool {
        first: QTerm,
        second: Option<QTerm>,
        output: QTensorId,
        shift: u8,
        zero_point: i16,
        clamp: Clamp,
    },
    Add {
        first: QTerm,
        second: QTerm,
        output: QTensorId,
        shift: u8,
        zero_point: i16,
        clamp: Clamp,
    },
    Requantize {
        input: QTensorId,
        output: QTensorId,
        input_zero_point: i16,
        requant: Requant,
        zero_point: i16,
        clamp: Clamp,
    },
    ResizeBilinear {
        input: QTerm,
        residual: Option<QTerm>,
        output: QTensorId,
        /// `[i0, w1]` per output row.
        rows: Vec<[u16; 2]>,
        /// `[i0, w1]` per output column.
        columns: Vec<[u16; 2]>,
        weight_bits: u8,
        shift: u8,
        zero_point: i16,
        clamp: Clamp,
    },
    Tokens {
        first: QTokenSource,
        second: QTokenSource,
        velocity: QTensorId,
        output: QTensorId,
        velocity_multipliers: Vec<i32>,
        /// `[T][C]`.
        position: Vec<i16>,
        shift: u8,
        zero_point: i16,
        clamp: Clamp,
    },
    LayerNorm {
        input: QTensorId,
        output: QTensorId,
        first_row: u16,
        epsilon: i64,
        gains: Vec<i32>,
        offsets: Vec<i64>,
        shift: u8,
        zero_point: i16,
        clamp: Clamp,
    },
    Attention {
        query: QTensorId,
        key: QTensorId,
        value: QTensorId,
        output: QTensorId,
        heads: u16,
        exponent: Requant,
        /// 257 entries.
        exp_table: Vec<i16>,
        requant: Requant,
        zero_point: i16,
        clamp: Clamp,
    },
    WaypointDecoder(QWaypointDecoder),
    CopyBox {
        input: QTensorId,
        output: QTensorId,
        begin: [u16; 3],
        stride: [u16; 3],
        size: [u16; 3],
        before: [u16; 3],
        border: i16,
    },
    Concat {
        first: QConcatSource,
        second: QConcatSource,
        output: QTensorId,
        axis: Axis,
        zero_point: i16,
        clamp: Clamp,
    },
    Softmax {
        input: QTensorId,
        output: QTensorId,
        exponent: Requant,
        /// 257 entries.
        exp_table: Vec<i16>,
    },
    GatherSum {
        input: QTensorId,
        indices: QTensorId,
        output: QTensorId,
        input_zero_point: i16,
        requant: Requant,
        zero_point: i16,
        clamp: Clamp,
    },
    BranchLinear {
        input: QTensorId,
        command: QTensorId,
        output: QTensorId,
        branches: u16,
        /// `[B][O][I]`.
        weights: Vec<i8>,
        wide: bool,
        /// Arrays are `[B][O]`; no second term.
        rescale: QRescale,
    },
    Sigmoid {
        input: QTensorId,
        output: QTensorId,
        input_zero_point: i16,
        requant: Requant,
        /// 513 entries.
        tanh_table: Vec<i16>,
    },
    SpatialSoftmax {
        input: QTensorId,
        output: QTensorId,
        exponent: Requant,
        /// 257 entries.
        exp_table: Vec<i16>,
    },
}

impl QModel {
    /// The tensor behind a handle.
    pub fn tensor(&self, id: QTensorId) -> &QTensor {
        &self.tensors[id.0 as usize]
    }
}

impl QOp {
    /// Operator name as reports print it.
    pub fn name(&self) -> &'static str {
        match self {
            Self::Conv2d { .. } => "conv2d",
            Self::Linear { .. } => "linear",
            Self::MaxPool { .. } => "max_pool",
            Self::AveragePool { .. } => "average_pool",
            Self::GlobalPool { .. } => "global_pool",
            Self::Add { .. } => "add",
            Self::Requantize { .. } => "requantize",
            Self::ResizeBilinear { .. } => "resize_bilinear",
            Self::Tokens { .. } => "tokens",
            Self::LayerNorm { .. } => "layer_norm",
            Self::Attention { .. } => "attention",
            Self::WaypointDecoder(_) => "waypoint_decoder",
            Self::CopyBox { .. } => "copy_box",
            Self::Concat { .. } => "concat",
            Self::Softmax { .. } => "softmax",
            Self::GatherSum { .. } => "gather_sum",
            Self::BranchLinear { .. } => "branch_linear",
            Self::Sigmoid { .. } => "sigmoid",
            Self::SpatialSoftmax { .. } => "spatial_softmax",
        }
    }

    /// Whether the operator bounds its output codes; the others copy codes or give fixed point.
    pub fn has_clamp(&self) -> bool {
        !matches!(
            self,
            Self::MaxPool { .. }
                | Self::CopyBox { .. }
                | Self::Softmax { .. }
                | Self::Sigmoid { .. }
                | Self::SpatialSoftmax { .. }
                | Self::WaypointDecoder(_)
        )
    }

    /// Bounds of the output code.
    pub fn clamp_mut(&mut self) -> Option<&mut Clamp> {
        match self {
            Self::Conv2d { rescale, .. } | Self::Linear { rescale, .. } | Self::BranchLinear { rescale, .. } => {
                Some(&mut rescale.clamp)
            }
            Self::AveragePool { clamp, .. }
            | Self::GlobalPool { clamp, .. }
            | Self::Add { clamp, .. }
            | Self::Requantize { clamp, .. }
            | Self::ResizeBilinear { clamp, .. }
            | Self::Tokens { clamp, .. }
            | Self::LayerNorm { clamp, .. }
            | Self::Attention { clamp, .. }
            | Self::Concat { clamp, .. }
            | Self::GatherSum { clamp, .. } => Some(clamp),
            Self::MaxPool { .. }
            | Self::CopyBox { .. }
            | Self::Softmax { .. }
            | Self::Sigmoid { .. }
            | Self::SpatialSoftmax { .. }
            | Self::WaypointDecoder(_) => None,
        }
    }

    /// Bytes of the weights (not bias, multipliers or tables).
    pub fn weight_bytes(&self) -> u64 {
        match self {
            Self::Conv2d { weights, .. } | Self::Linear { weights, .. } | Self::BranchLinear { weights, .. } => {
                weights.len() as u64
            }
            Self::WaypointDecoder(d) => {
                2 * (d.input_weights.len() + d.hidden_weights.len() + d.output_weights.len()) as u64
            }
            _ => 0,
        }
    }

    /// Tensors read, each once, in operand order (residual last).
    pub fn reads(&self) -> Vec<QTensorId> {
        fn residual(rescale: &QRescale) -> Option<QTensorId> {
            match rescale.residual {
                QResidual::None => None,
                QResidual::Scaled { tensor, .. } | QResidual::Stream { tensor } => Some(tensor),
            }
        }
        match self {
            Self::Conv2d { input, rescale, .. } | Self::Linear { input, rescale, .. } => {
                std::iter::once(*input).chain(residual(rescale)).collect()
            }
            Self::MaxPool { input, .. }
            | Self::AveragePool { input, .. }
            | Self::Requantize { input, .. }
            | Self::LayerNorm { input, .. }
            | Self::CopyBox { input, .. }
            | Self::Softmax { input, .. }
            | Self::Sigmoid { input, .. }
            | Self::SpatialSoftmax { input, .. } => vec![*input],
            Self::BranchLinear { input, command, .. } => vec![*input, *command],
            Self::GlobalPool { first, second, .. } => {
                std::iter::once(first.tensor).chain(second.map(|t| t.tensor)).collect()
            }
            Self::Add { first, second, .. } => vec![first.tensor, second.tensor],
            Self::Concat { first, second, .. } => vec![first.tensor, second.tensor],
            Self::GatherSum { input, indices, .. } => vec![*input, *indices],
            Self::ResizeBilinear { input, residual, .. } => {
                std::iter::once(input.tensor).chain(residual.map(|t| t.tensor)).collect()
            }
            Self::Tokens { first, second, velocity, .. } => vec![first.map, second.map, *velocity],
            Self::Attention { query, key, value, .. } => vec![*query, *key, *value],
            Self::WaypointDecoder(d) => vec![d.hidden, d.goal],
        }
    }

    /// The tensor written.
    pub fn output(&self) -> QTensorId {
        match self {
            Self::Conv2d { output, .. }
            | Self::Linear { output, .. }
            | Self::MaxPool { output, .. }
            | Self::AveragePool { output, .. }
            | Self::GlobalPool { output, .. }
            | Self::Add { output, .. }
            | Self::Requantize { output, .. }
            | Self::ResizeBilinear { output, .. }
            | Self::Tokens { output, .. }
            | Self::LayerNorm { output, .. }
            | Self::Attention { output, .. }
            | Self::CopyBox { output, .. }
            | Self::Concat { output, .. }
            | Self::Softmax { output, .. }
            | Self::GatherSum { output, .. }
            | Self::BranchLinear { output, .. }
            | Self::Sigmoid { output, .. }
            | Self::SpatialSoftmax { output, .. } => *output,
            Self::WaypointDecoder(d) => d.output,
        }
    }
}
