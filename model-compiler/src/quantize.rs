//! The quantizer: an optimized graph and its statistics become a [`QModel`], all integers.
//!
//! In three moves: [`types`] decides element type, scale and zero point of every value; one builder per operator turns
//! real weights into integers (`weighted`, `sums`, `token`, `decoder`); the interval analysis refuses whatever
//! could leave its type or exceed 2^53. Formulas follow the numerics page, section by section.

use crate::calibrate::{self, Statistics};
use crate::error::{Error, ErrorCode, Result};
use crate::ir::{Conv2d, Graph, Node, Op, Shape, ValueId};
use crate::qmodel::{Bounds, Port, QModel, QOp, QStep, QTensor, QTensorId};
use covariance::Covariances;
use firmware::program::{Clamp, Window};
use firmware::tensor::ElementType;
use serde::{Deserialize, Serialize};
use std::collections::HashMap;
use std::fmt;

mod bounds;
mod branches;
mod copies;
mod covariance;
mod decoder;
pub mod factors;
mod gather_sum;
mod moves;
pub mod ranges;
mod rounding;
mod sigmoid;
mod softmax;
mod spatial_softmax;
mod sums;
pub mod tables;
#[cfg(test)]
mod tests;
mod token;
pub mod types;
mod weighted;

pub use ranges::RangeRule;

/// Which ResNet stages keep their skip values (block outputs, shortcuts) in 16 bits; stage 0 is the stem.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct SkipStages(Vec<u8>);

/// ResNets have a stem and four stages.
const LAST_STAGE: u8 = 4;

impl SkipStages {
    /// All skip values in 8 bits.
    pub fn narrow() -> Self {
        Self(Vec::new())
    }

    /// All skip values in 16 bits.
    pub fn wide() -> Self {
        Self((0..=LAST_STAGE).collect())
    }

    /// These stages in 16 bits, in any order.
    fn of(mut stages: Vec<u8>) -> Self {
        stages.sort_unstable();
        stages.dedup();
        Self(stages)
    }

    /// Whether a stage is kept in 16 bits.
    pub fn is_wide(&self, stage: u8) -> bool {
        self.0.contains(&stage)
    }
}

/// The form that `FromStr` reads.
impl fmt::Display for SkipStages {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        if self.0.is_empty() {
            write!(f, "i8")
        } else if *self == Self::wide() {
            write!(f, "i16")
        } else {
            let stages: Vec<String> = self.0.iter().map(u8::to_string).collect();
            write!(f, "{}", stages.join(","))
        }
    }
}

impl std::str::FromStr for SkipStages {
    type Err = String;

    /// `i8`, `i16`, or a list of wide stages such as `0,1,2` (0 is the stem).
    fn from_str(text: &str) -> std::result::Result<Self, String> {
        match text {
            "i8" => Ok(Self::narrow()),
            "i16" => Ok(Self::wide()),
            list => {
                let stage = |s: &str| s.trim().parse::<u8>().ok().filter(|&stage| stage <= LAST_STAGE);
                let stages: Option<Vec<u8>> = list.split(',').map(stage).collect();
                let expected = "expected i8, i16 or a list of 16-bit stages 0..4 such as 0,1,2 (0 is the stem)";
                stages.map(Self::of).ok_or_else(|| format!("found {list:?}, {expected}"))
            }
        }
    }
}

/// Choices of the quantizer. The defaults are the best known; the switches exist to measure what each is worth.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct QuantizeOptions {
    /// Width of the ResNets' skip values, per stage.
    pub skip: SkipStages,
    /// Clipping ranges of i8 activations.
    pub ranges: RangeRule,
    /// Correct biases for the mean error of quantized weights.
    pub bias_correction: bool,
    /// Round weights so that their errors cancel on the calibration frames, where these say enough about a layer.
    pub data_aware_rounding: bool,
    /// Residual stream of the transformers in 16 bits.
    pub wide_stream: bool,
    /// Global pools get a scale of their own instead of their input's.
    pub own_pool_scale: bool,
    /// Fastest velocity to be driven, m/s: the token streams leave room for it.
    pub max_velocity: f64,
}

impl Default for QuantizeOptions {
    fn default() -> Self {
        Self {
            skip: SkipStages::narrow(),
            ranges: RangeRule::Mse,
            bias_correction: true,
            data_aware_rounding: true,
            wide_stream: true,
            own_pool_scale: true,
            max_velocity: 10.0,
        }
    }
}

/// Quantizes an optimized graph with the statistics of its calibration frames (raw inputs per frame, in graph order).
/// `progress` is called after each frame that the bias correction looks at with the number done and the total.
///
/// # Errors
/// An operator without an integer form, or an intermediate that exceeds its type or 2^53; the node is named.
pub fn quantize(
    graph: &Graph,
    frames: &[Vec<Vec<f32>>],
    statistics: &Statistics,
    options: &QuantizeOptions,
    progress: impl FnMut(usize, usize),
) -> Result<QModel> {
    let types = types::assign(graph, statistics, options)?;
    let rounded = |value, x| {
        let stored = types.narrow(value);
        (options.bias_correction && stored.element == ElementType::I8).then(|| stored.rounded(x))
    };
    let quantized_means = calibrate::quantized_means(graph, frames, statistics, rounded, progress)?;
    let covariances = match options.data_aware_rounding {
        true => Covariances::measure(graph, frames, &types)?,
        false => Covariances::default(),
    };
    let mut builder = Builder {
        graph,
        statistics,
        quantized_means,
        covariances,
        options,
        types,
        model: QModel {
            name: graph.name.clone(),
            system: graph.system.clone(),
            tensors: Vec::new(),
            steps: Vec::new(),
            inputs: Vec::new(),
            outputs: Vec::new(),
            provenance: Vec::new(),
        },
        stored: HashMap::new(),
        narrowed: HashMap::new(),
    };
    for node in &graph.nodes {
        builder.node(node).map_err(|e| e.within(format!("node {}", node.name)))?;
    }
    for &output in &graph.outputs {
        let port = Port { name: graph.value(output).name.clone(), tensor: builder.tensor(output), kind: None };
        builder.model.outputs.push(port);
    }
    Ok(builder.model)
}

/// The model under construction.
struct Builder<'a> {
    graph: &'a Graph,
    statistics: &'a Statistics,
    /// Mean per channel (and branch, behind a command) of each value as the layers read it.
    quantized_means: Vec<Vec<f64>>,
    /// How what the layers read varies.
    covariances: Covariances,
    options: &'a QuantizeOptions,
    types: types::Types,
    model: QModel,
    /// Tensor of each value in its main form.
    stored: HashMap<ValueId, QTensorId>,
    /// i8 copy of a 16-bit value, made once for all convolutions that read it.
    narrowed: HashMap<ValueId, QTensorId>,
}

impl Builder<'_> {
    fn node(&mut self, node: &Node) -> Result<()> {
        match &node.op {
            Op::Input(kind) => {
                let tensor = self.tensor(node.output);
                self.model.inputs.push(Port { name: node.name.clone(), tensor, kind: Some(*kind) });
                Ok(())
            }
            Op::Conv2d(conv) => self.conv2d(node, conv),
            Op::Linear(linear) => self.linear(node, linear),
            Op::MaxPool(window) | Op::AveragePool(window) if [window.dilation_h, window.dilation_w] != [1, 1] => {
                let message = format!(
                    "{} of dilation {}×{} has no integer form",
                    node.op.name(),
                    window.dilation_h,
                    window.dilation_w
                );
                Err(Error::new(ErrorCode::Unsupported, "", message).with_help("use a pool of dilation 1"))
            }
            Op::MaxPool(window) => {
                let (input, output) = (self.tensor(node.inputs[0]), self.tensor(node.output));
                self.step(node, QOp::MaxPool { input, output, window: *window }, Bounds::default());
                Ok(())
            }
            Op::AveragePool(window) => self.average_pool(node, window),
            Op::GlobalPool => self.global_pool(node),
            Op::Add { clip } => self.add(node, *clip),
            Op::ResizeBilinear { factor } => self.resize_bilinear(node, *factor),
            Op::Tokens(tokens) => self.tokens(node, tokens),
            Op::LayerNorm(norm) => self.layer_norm(node, norm),
            Op::Attention { heads } => self.attention(node, *heads),
            Op::WaypointDecoder(decoder) => self.waypoint_decoder(node, decoder),
            Op::Slice(slice) => self.slice(node, slice),
            Op::Pad(pad) => self.pad(node, pad),
            Op::Concat(axis) => self.concat(node, *axis),
            Op::Clip(clip) => self.clip(node, *clip),
            Op::Softmax => self.softmax(node),
            Op::GatherSum => self.gather_sum(node),
            Op::BranchLinear(layer) => self.branch_linear(node, layer),
            Op::Sigmoid => self.sigmoid(node),
            Op::SpatialSoftmax { temperature } => self.spatial_softmax(node, *temperature),
            Op::Normalize(_) | Op::BatchNorm(_) => Err(Error::new(
                ErrorCode::Unsupported,
                "",
                format!("{} stands alone and has no integer form", node.op.name()),
            )
            .with_help("it is only supported behind a convolution or linear layer, where the passes fold it in")),
        }
    }

    /// The tensor that holds a value in its main form; made on first use.
    fn tensor(&mut self, value: ValueId) -> QTensorId {
        if let Some(&id) = self.stored.get(&value) {
            return id;
        }
        let (name, stored) = (self.graph.value(value).name.clone(), *self.types.of(value));
        let id = self.add_tensor(name, value, stored);
        self.stored.insert(value, id);
        id
    }

    /// The tensor of a value that must be stored as codes.
    fn codes(&mut self, value: ValueId) -> Result<QTensorId> {
        let id = self.tensor(value);
        if matches!(self.model.tensor(id).element, ElementType::I8 | ElementType::I16) {
            return Ok(id);
        }
        let place = format!("operand {}", self.graph.value(value).name);
        Err(Error::new(ErrorCode::Unsupported, place, "found 32-bit fixed point, expected 8- or 16-bit codes"))
    }

    /// The step that computes the operand of `node`, where nothing else reads that operand and it is stored like the
    /// result: it becomes the step of `node`, and the caller adds what the node does. None where `suits` declines it.
    fn take_over(&mut self, node: &Node, suits: impl Fn(&QOp) -> bool) -> Option<usize> {
        let (operand, result) = (node.inputs[0], node.output);
        let alike = self.types.of(operand).holds_like(self.types.of(result));
        if !alike || copies::use_counts(self.graph)[operand.0 as usize] != 1 {
            return None;
        }
        let id = *self.stored.get(&operand)?;
        let index = self.model.steps.iter().rposition(|step| step.op.output() == id && suits(&step.op))?;
        let taken = self.qtensor(node.name.clone(), result, *self.types.of(result));
        self.model.tensors[id.0 as usize] = taken;
        self.stored.insert(result, id);
        self.model.steps[index].name.clone_from(&node.name);
        self.model.steps[index].node = Some(node.name.clone());
        Some(index)
    }

    fn add_tensor(&mut self, name: String, value: ValueId, stored: types::Stored) -> QTensorId {
        let id = QTensorId(self.model.tensors.len() as u32);
        let tensor = self.qtensor(name, value, stored);
        self.model.tensors.push(tensor);
        id
    }

    fn qtensor(&self, name: String, value: ValueId, stored: types::Stored) -> QTensor {
        let source = self.graph.value(value);
        QTensor {
            name,
            value: source.name.clone(),
            shape: source.shape,
            element: stored.element,
            scale: stored.scale,
            zero_point: stored.zero_point,
            saturation_ppm: stored.saturation_ppm,
        }
    }

    /// A value as i8: itself, or a copy made by an extra step where it is stored in 16 bits.
    fn narrow(&mut self, value: ValueId) -> Result<QTensorId> {
        let wide = self.tensor(value);
        if self.model.tensor(wide).element == ElementType::I8 {
            return Ok(wide);
        }
        if let Some(&id) = self.narrowed.get(&value) {
            return Ok(id);
        }
        let stored = *self.types.narrow(value);
        let name = format!("{}.i8", self.graph.value(value).name);
        let id = self.add_tensor(name.clone(), value, stored);
        let requant = factors::requant(self.scale(wide) / stored.scale)?;
        let op = QOp::Requantize {
            input: wide,
            output: id,
            input_zero_point: 0,
            requant,
            zero_point: stored.zero_point as i16,
            clamp: Clamp { min: -128, max: 127 },
        };
        let bounds = bounds_of(factors::bits(32768.0), &[32768.0 * f64::from(requant.multiplier)], 0.0);
        self.model.steps.push(QStep { name, node: None, op, bounds });
        self.narrowed.insert(value, id);
        Ok(id)
    }

    fn step(&mut self, node: &Node, op: QOp, bounds: Bounds) {
        self.model.steps.push(QStep { name: node.name.clone(), node: Some(node.name.clone()), op, bounds });
    }

    fn scale(&self, id: QTensorId) -> f64 {
        self.model.tensor(id).scale
    }

    fn zero_point(&self, id: QTensorId) -> i16 {
        self.model.tensor(id).zero_point as i16
    }

    /// Largest `|q − z|` of a tensor.
    fn magnitude(&self, id: QTensorId) -> f64 {
        let (min, max) = code_range(self.model.tensor(id).element);
        let z = f64::from(self.zero_point(id));
        (f64::from(max) - z).max(z - f64::from(min))
    }
}

/// Whether a convolution is the matrix product of one position, which takes 16-bit codes as they are.
fn is_linear(conv: &Conv2d, input: Shape) -> bool {
    let Window { kernel_h, kernel_w, pad_top, pad_bottom, pad_left, pad_right, .. } = conv.window;
    let alone = [kernel_h, kernel_w, pad_top, pad_bottom, pad_left, pad_right] == [1, 1, 0, 0, 0, 0];
    alone && input.positions() == 1 && conv.groups == 1 && conv.normalization.is_none()
}

/// Smallest and largest code of an element type that activations use.
fn code_range(element: ElementType) -> (i16, i16) {
    if element == ElementType::I8 { (-128, 127) } else { (-32768, 32767) }
}

/// Bounds record: accumulator bits against 31 (63 where `accumulator_bits` says it is wide), products against 2^53.
fn bounds_of(accumulator_bits: u32, products: &[f64], multiplier_rounding: f64) -> Bounds {
    let product_bits = products.iter().map(|&p| factors::bits(p)).max().unwrap_or(0);
    let accumulator_spare = if accumulator_bits > 31 { 63 - accumulator_bits } else { 31 - accumulator_bits };
    Bounds {
        accumulator_bits: accumulator_bits as u8,
        clipped: [false; 2],
        headroom_bits: accumulator_spare.min(53u32.saturating_sub(product_bits)) as u8,
        multiplier_rounding,
    }
}
