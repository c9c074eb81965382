//! Packs a planned model for a target: steps that name tensors and constant ranges, constants in each kernel's order.
//!
//! Tensor i of the image is tensor i of the model; scratch buffers follow in the order of the steps that use them.

use crate::artifact;
use crate::emit::{ConstantsBuilder, ImageParts, ImagePort};
use crate::error::{Error, ErrorCode, Result};
use crate::memory_plan::{ArenaPart, MemoryPlan, Placement};
use crate::qmodel::{
    Port, QConcatSource, QModel, QOp, QRescale, QResidual, QTensorId, QTerm, QTokenSource, QWaypointDecoder,
};
use firmware::image::{Region, RegionName, TensorRecord};
use firmware::kernels::{k4n16, plan};
use firmware::program::{
    Add, Attention, AveragePool, BranchLinear, Concat, ConcatSource, ConstRange, Conv2d, CopyBox, GatherSum,
    GlobalPool, KernelId, LayerNorm, Linear, MaxPool, Requantize, Rescale, Residual, ResizeBilinear, Sigmoid, Softmax,
    SpatialSoftmax, Step, Term, TokenSource, Tokens, WaypointDecoder,
};
use firmware::tensor::TensorId;

/// Alignment of the arena in each region: enough for every kernel's loads.
const ARENA_ALIGNMENT: u32 = 16;

/// Packs a model along its plan.
///
/// # Errors
/// More tensors, steps or bytes than the image format can hold.
pub fn pack(model: &QModel, memory: &MemoryPlan) -> Result<ImageParts> {
    let mut packer = Packer { constants: ConstantsBuilder::new(), tensors: Vec::new() };
    for (tensor, placement) in model.tensors.iter().zip(&memory.tensors) {
        let record = TensorRecord {
            element: tensor.element,
            shape: tensor.shape,
            region: placement.region,
            offset: narrow(placement.offset, "arena offset")?,
            bytes: narrow(placement.bytes, "tensor bytes")?,
            first_step: narrow(placement.first_step, "steps")?,
            last_step: narrow(placement.last_step, "steps")?,
            in_place_of: placement.in_place_of.map(tensor_id).transpose()?,
        };
        packer.tensors.push(record);
    }
    let mut steps = Vec::with_capacity(memory.order.len());
    for (position, &index) in memory.order.iter().enumerate() {
        let scratch = packer.scratch(position, memory.scratch[position])?;
        let kernel = memory.kernels[position].unwrap_or(KernelId::Direct);
        steps.push(packer.step(model, &model.steps[index as usize].op, kernel, scratch)?);
    }
    let ports = |ports: &[Port]| ports.iter().map(|port| image_port(model, port)).collect::<Result<Vec<_>>>();
    Ok(ImageParts {
        name: model.name[..model.name.floor_char_boundary(32)].to_owned(),
        tensors: packer.tensors,
        steps,
        constants: packer.constants.finish(),
        inputs: ports(&model.inputs)?,
        outputs: ports(&model.outputs)?,
        regions: memory.regions.iter().map(|part| region(part, memory.alignment)).collect::<Result<_>>()?,
        qmodel_digest: artifact::sha256(&artifact::to_bytes(model)?),
        build_digest: [0; 32],
        target: String::new(),
        revision: 0,
        known_answer: None,
    })
}

fn narrow<A: Copy + std::fmt::Display, B: TryFrom<A>>(value: A, what: &str) -> Result<B> {
    B::try_from(value)
        .map_err(|_| Error::new(ErrorCode::TooBig, "image", format!("{what}: {value} exceeds what an image can hold")))
}

fn tensor_id(id: QTensorId) -> Result<TensorId> {
    Ok(TensorId(narrow(id.0, "tensors")?))
}

fn image_port(model: &QModel, port: &Port) -> Result<ImagePort> {
    let tensor = model.tensor(port.tensor);
    Ok(ImagePort {
        name: port.name.clone(),
        tensor: tensor_id(port.tensor)?,
        scale: tensor.scale as f32,
        zero_point: tensor.zero_point as i16,
    })
}

fn region(part: &ArenaPart, alignment: u32) -> Result<Region> {
    let name = RegionName::new(&part.name).ok_or_else(|| {
        let message = format!("region {:?} needs a name of 1 to 8 visible ASCII characters", part.name);
        Error::new(ErrorCode::Usage, "image", message)
    })?;
    Ok(Region { name, bytes: narrow(part.bytes, "arena bytes")?, alignment: ARENA_ALIGNMENT.max(alignment) })
}

fn term(term: &QTerm) -> Result<Term> {
    Ok(Term { tensor: tensor_id(term.tensor)?, zero_point: term.zero_point, multiplier: term.multiplier })
}

fn token_source(source: &QTokenSource) -> Result<TokenSource> {
    let QTokenSource { map, zero_point, pool_h, pool_w, multiplier } = *source;
    Ok(TokenSource { map: tensor_id(map)?, zero_point, pool_h, pool_w, multiplier })
}

fn concat_source(source: &QConcatSource) -> Result<ConcatSource> {
    let QConcatSource { tensor, zero_point, requant } = *source;
    Ok(ConcatSource { tensor: tensor_id(tensor)?, zero_point, requant })
}

struct Packer {
    constants: ConstantsBuilder,
    tensors: Vec<TensorRecord>,
}

impl Packer {
    fn scratch(&mut self, position: usize, placement: Option<Placement>) -> Result<Option<TensorId>> {
        let Some(placement) = placement else { return Ok(None) };
        let scratch = TensorRecord::scratch(
            narrow(placement.offset, "arena offset")?,
            narrow(placement.bytes, "scratch bytes")?,
            narrow(position, "steps")?,
        );
        let record = TensorRecord { region: placement.region, ..scratch };
        let id = TensorId(narrow(self.tensors.len(), "tensors")?);
        self.tensors.push(record);
        Ok(Some(id))
    }

    /// Weights of `outputs` output channels in `groups` groups, in a kernel's order.
    fn weights(&mut self, kernel: KernelId, groups: u16, outputs: u16, weights: &[i8]) -> Result<ConstRange> {
        match kernel {
            KernelId::Direct => self.constants.push(weights),
            KernelId::K4N16 => {
                let depth = weights.len() / usize::from(outputs).max(1);
                let bytes = plan::weight_bytes(kernel, groups, outputs, depth as u64);
                let mut packed = vec![0; narrow(bytes, "weight bytes")?];
                k4n16::pack(weights, outputs / groups.max(1), depth, &mut packed);
                self.constants.push(&packed)
            }
        }
    }

    fn rescale(&mut self, rescale: &QRescale) -> Result<Rescale> {
        Ok(Rescale {
            pre_shift: rescale.pre_shift,
            bias: self.constants.push(&rescale.bias)?,
            multipliers: self.constants.push(&rescale.multipliers)?,
            shifts: self.constants.push(&rescale.shifts)?,
            zero_point: rescale.zero_point,
            clamp: rescale.clamp,
            residual: match &rescale.residual {
                QResidual::None => Residual::None,
                QResidual::Scaled { tensor, zero_point, multipliers } => Residual::Scaled {
                    tensor: tensor_id(*tensor)?,
                    zero_point: *zero_point,
                    multipliers: self.constants.push(multipliers)?,
                },
                QResidual::Stream { tensor } => Residual::Stream { tensor: tensor_id(*tensor)? },
            },
        })
    }

    fn step(&mut self, model: &QModel, op: &QOp, kernel: KernelId, scratch: Option<TensorId>) -> Result<Step> {
        let channels = |id: &QTensorId| model.tensor(*id).shape.channels;
        Ok(match op {
            QOp::Conv2d { input, output, window, groups, weights, padding_codes, rescale } => Step::Conv2d(Conv2d {
                input: tensor_id(*input)?,
                output: tensor_id(*output)?,
                window: *window,
                groups: *groups,
                kernel,
                weights: self.weights(kernel, *groups, channels(output), weights)?,
                padding_codes: self.constants.push(padding_codes)?,
                rescale: self.rescale(rescale)?,
                scratch,
            }),
            QOp::Linear { input, output, weights, wide, rescale } => Step::Linear(Linear {
                input: tensor_id(*input)?,
                output: tensor_id(*output)?,
                kernel,
                weights: self.weights(kernel, 1, channels(output), weights)?,
                wide: *wide,
                rescale: self.rescale(rescale)?,
                scratch,
            }),
            QOp::MaxPool { input, output, window } => {
                Step::MaxPool(MaxPool { input: tensor_id(*input)?, output: tensor_id(*output)?, window: *window })
            }
            QOp::AveragePool { input, output, window, input_zero_point, requant, zero_point, clamp } => {
                Step::AveragePool(AveragePool {
                    input: tensor_id(*input)?,
                    output: tensor_id(*output)?,
                    window: *window,
                    input_zero_point: *input_zero_point,
                    requant: *requant,
                    zero_point: *zero_point,
                    clamp: *clamp,
                })
            }
            QOp::GlobalPool { first, second, output, shift, zero_point, clamp } => Step::GlobalPool(GlobalPool {
                first: term(first)?,
                second: second.as_ref().map(term).transpose()?,
                output: tensor_id(*output)?,
                shift: *shift,
                zero_point: *zero_point,
                clamp: *clamp,
            }),
            QOp::Add { first, second, output, shift, zero_point, clamp } => Step::Add(Add {
                first: term(first)?,
                second: term(second)?,
                output: tensor_id(*output)?,
                shift: *shift,
                zero_point: *zero_point,
                clamp: *clamp,
            }),
            QOp::Requantize { input, output, input_zero_point, requant, zero_point, clamp } => {
                Step::Requantize(Requantize {
                    input: tensor_id(*input)?,
                    output: tensor_id(*output)?,
                    input_zero_point: *input_zero_point,
                    requant: *requant,
                    zero_point: *zero_point,
                    clamp: *clamp,
                })
            }
            QOp::ResizeBilinear { input, residual, output, rows, columns, weight_bits, shift, zero_point, clamp } => {
                Step::ResizeBilinear(ResizeBilinear {
                    input: term(input)?,
                    residual: residual.as_ref().map(term).transpose()?,
                    output: tensor_id(*output)?,
                    rows: self.constants.push(rows)?,
                    columns: self.constants.push(columns)?,
                    weight_bits: *weight_bits,
                    shift: *shift,
                    zero_point: *zero_point,
                    clamp: *clamp,
                })
            }
            QOp::Tokens {
                first,
                second,
                velocity,
                output,
                velocity_multipliers,
                position,
                shift,
                zero_point,
                clamp,
            } => Step::Tokens(Tokens {
                first: token_source(first)?,
                second: token_source(second)?,
                velocity: tensor_id(*velocity)?,
                output: tensor_id(*output)?,
                velocity_multipliers: self.constants.push(velocity_multipliers)?,
                position: self.constants.push(position)?,
                shift: *shift,
                zero_point: *zero_point,
                clamp: *clamp,
            }),
            QOp::LayerNorm { input, output, first_row, epsilon, gains, offsets, shift, zero_point, clamp } => {
                Step::LayerNorm(LayerNorm {
                    input: tensor_id(*input)?,
                    output: tensor_id(*output)?,
                    first_row: *first_row,
                    epsilon: *epsilon,
                    gains: self.constants.push(gains)?,
                    offsets: self.constants.push(offsets)?,
                    shift: *shift,
                    zero_point: *zero_point,
                    clamp: *clamp,
                })
            }
            QOp::Attention { query, key, value, output, heads, exponent, exp_table, requant, zero_point, clamp } => {
                Step::Attention(Attention {
                    query: tensor_id(*query)?,
                    key: tensor_id(*key)?,
                    value: tensor_id(*value)?,
                    output: tensor_id(*output)?,
                    heads: *heads,
                    exponent: *exponent,
                    exp_table: self.constants.push(exp_table)?,
                    requant: *requant,
                    zero_point: *zero_point,
                    clamp: *clamp,
                    scratch,
                })
            }
            QOp::WaypointDecoder(decoder) => Step::WaypointDecoder(self.waypoint_decoder(decoder, scratch)?),
            QOp::CopyBox { input, output, begin, stride, size, before, border } => Step::CopyBox(CopyBox {
                input: tensor_id(*input)?,
                output: tensor_id(*output)?,
                begin: *begin,
                stride: *stride,
                size: *size,
                before: *before,
                border: *border,
            }),
            QOp::Concat { first, second, output, axis, zero_point, clamp } => Step::Concat(Concat {
                first: concat_source(first)?,
                second: concat_source(second)?,
                output: tensor_id(*output)?,
                axis: *axis,
                zero_point: *zero_point,
                clamp: *clamp,
            }),
            QOp::Softmax { input, output, exponent, exp_table } => Step::Softmax(Softmax {
                input: tensor_id(*input)?,
                output: tensor_id(*output)?,
                exponent: *exponent,
                exp_table: self.constants.push(exp_table)?,
            }),
            QOp::GatherSum { input, indices, output, input_zero_point, requant, zero_point, clamp } => {
                Step::GatherSum(GatherSum {
                    input: tensor_id(*input)?,
                    indices: tensor_id(*indices)?,
                    output: tensor_id(*output)?,
                    input_zero_point: *input_zero_point,
                    requant: *requant,
                    zero_point: *zero_point,
                    clamp: *clamp,
                })
            }
            QOp::BranchLinear { input, command, output, branches, weights, wide, rescale } => {
                let outputs = narrow(u32::from(*branches) * u32::from(channels(output)), "outputs of all branches")?;
                Step::BranchLinear(BranchLinear {
                    input: tensor_id(*input)?,
                    command: tensor_id(*command)?,
                    output: tensor_id(*output)?,
                    branches: *branches,
                    kernel,
                    weights: self.weights(kernel, *branches, outputs, weights)?,
                    wide: *wide,
                    rescale: self.rescale(rescale)?,
                    scratch,
                })
            }
            QOp::Sigmoid { input, output, input_zero_point, requant, tanh_table } => Step::Sigmoid(Sigmoid {
                input: tensor_id(*input)?,
                output: tensor_id(*output)?,
                input_zero_point: *input_zero_point,
                requant: *requant,
                tanh_table: self.constants.push(tanh_table)?,
            }),
            QOp::SpatialSoftmax { input, output, exponent, exp_table } => Step::SpatialSoftmax(SpatialSoftmax {
                input: tensor_id(*input)?,
                output: tensor_id(*output)?,
                exponent: *exponent,
                exp_table: self.constants.push(exp_table)?,
            }),
        })
    }

    fn waypoint_decoder(&mut self, d: &QWaypointDecoder, scratch: Option<TensorId>) -> Result<WaypointDecoder> {
        Ok(WaypointDecoder {
            hidden: tensor_id(d.hidden)?,
            goal: tensor_id(d.goal)?,
            output: tensor_id(d.output)?,
            hidden_fraction_bits: d.hidden_fraction_bits,
            concat: d.concat,
            input_weights: self.constants.push(&d.input_weights)?,
            hidden_weights: self.constants.push(&d.hidden_weights)?,
            input_pre_shift: d.input_pre_shift,
            hidden_pre_shift: d.hidden_pre_shift,
            input_multipliers: self.constants.push(&d.input_multipliers)?,
            hidden_multipliers: self.constants.push(&d.hidden_multipliers)?,
            shifts: self.constants.push(&d.shifts)?,
            biases: self.constants.push(&d.biases)?,
            output_weights: self.constants.push(&d.output_weights)?,
            output_bias: self.constants.push(&d.output_bias)?,
            output_pre_shift: d.output_pre_shift,
            output_requant: d.output_requant,
            tanh_table: self.constants.push(&d.tanh_table)?,
            scratch,
        })
    }
}
