//! Element type, scale and zero point of every value.
//!
//! | value | type |
//! |---|---|
//! | image, views and their average pools, BEV, cells to gather | i8 codes with the fixed scales of the numerics page |
//! | feature maps, LayerNorm outputs, attention context, MLP hidden | i8 affine |
//! | queries, keys, values | i8 symmetric |
//! | residual stream of a transformer | i16, one scale for all its taps |
//! | skip values of the ResNets | i8 affine, or i16 per stage |
//! | global pools and the vectors behind them, vectors behind the velocity | i16 |
//! | maps that cells are gathered from, their sums and the layers behind these | i16 |
//! | what a softmax or sigmoid reads (before an enlargement, too) | i16 |
//! | probabilities, results of a sigmoid | i16, scale 2^-15 |
//! | GRU start state | i16, a power of two |
//! | velocity, goal, command, waypoints, points | fixed point |
//!
//! Pools, slices and pads copy codes, so what they give is stored like what they read (`copies`).

use super::QuantizeOptions;
use super::copies;
use super::factors::round;
use super::ranges::{Quantization, affine_i8, symmetric_i8, symmetric_i16};
use crate::calibrate::Statistics;
use crate::error::Result;
use crate::ir::{Graph, InputKind, Node, Op, ValueId};
use firmware::tensor::ElementType;
use std::collections::HashMap;

/// How one value is stored.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Stored {
    /// Element type.
    pub element: ElementType,
    /// Scale.
    pub scale: f64,
    /// Zero point.
    pub zero_point: i32,
    /// Calibration values outside the range, per million.
    pub saturation_ppm: Option<f64>,
}

impl Stored {
    /// i8 codes of a quantization.
    pub fn i8(q: Quantization) -> Self {
        Self {
            element: ElementType::I8,
            scale: q.scale,
            zero_point: q.zero_point,
            saturation_ppm: Some(q.saturation_ppm),
        }
    }

    /// Whether equal codes stand for equal values.
    pub fn holds_like(&self, other: &Self) -> bool {
        (self.element, self.scale, self.zero_point) == (other.element, other.scale, other.zero_point)
    }

    fn i16(q: Quantization) -> Self {
        Self { element: ElementType::I16, ..Self::i8(q) }
    }

    /// The representable real value nearest to `x`.
    pub fn rounded(&self, x: f64) -> f64 {
        self.code(x) * self.scale
    }

    /// The same in units of the scale: `q − z`, an integer.
    pub fn code(&self, x: f64) -> f64 {
        let (min, max) = super::code_range(self.element);
        let z = f64::from(self.zero_point);
        round(x / self.scale + z).clamp(f64::from(min), f64::from(max)) - z
    }

    fn fixed(element: ElementType, scale: f64, zero_point: i32) -> Self {
        Self { element, scale, zero_point, saturation_ppm: None }
    }
}

/// The storage of every value of a graph.
#[derive(Clone, Debug)]
pub struct Types {
    stored: Vec<Stored>,
    /// i8 form of the 16-bit values that a convolution reads.
    narrowed: HashMap<ValueId, Stored>,
}

impl Types {
    /// Storage of one value.
    pub fn of(&self, id: ValueId) -> &Stored {
        &self.stored[id.0 as usize]
    }

    /// How a convolution reads a value: as it is stored, or its i8 copy.
    pub fn narrow(&self, id: ValueId) -> &Stored {
        self.narrowed.get(&id).unwrap_or_else(|| self.of(id))
    }
}

/// Role of a value, found from the graph alone.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Role {
    Input(InputKind),
    /// An ordinary i8 activation.
    Narrow,
    /// Query, key or value of attention.
    Symmetric,
    /// Residual stream number k.
    Stream(usize),
    /// A value that skips over a residual block.
    Skip,
    /// A pooled vector or sum of cells, or a vector behind it, or behind the velocity.
    Vector,
    /// Start state of the decoder.
    Hidden,
    Waypoints,
    /// Results of a softmax or sigmoid.
    Probabilities,
    /// Results of a spatial softmax.
    Points,
}

/// Decides the storage of every value.
///
/// # Errors
/// None today; the signature leaves room for per-value overrides.
pub fn assign(graph: &Graph, statistics: &Statistics, options: &QuantizeOptions) -> Result<Types> {
    let roles = roles(graph);
    let stages = stages(graph);
    let borders = copies::borders(graph, statistics);
    let stream_maxima = stream_maxima(graph, statistics, options, &roles);
    let headroom = headroom(graph, statistics);
    let mut types: Vec<Stored> = Vec::with_capacity(graph.values.len());
    for (index, role) in roles.iter().enumerate() {
        let id = ValueId(index as u32);
        let seen = statistics.of(*borders.get(&id).unwrap_or(&id));
        let narrow = || Stored::i8(affine_i8(seen, options.ranges));
        types.push(match *role {
            Role::Input(InputKind::Image | InputKind::Views) => Stored::fixed(ElementType::I8, 1.0, -128),
            Role::Input(InputKind::Bev) => Stored::fixed(ElementType::I8, 0.2, 0),
            Role::Input(InputKind::BevPoints | InputKind::CameraPoints) => Stored::fixed(ElementType::I8, 1.0, 0),
            Role::Input(InputKind::Command) => Stored::fixed(ElementType::I8, 1.0, 0),
            Role::Input(InputKind::Velocity) => Stored::fixed(ElementType::I16, f64::exp2(-8.0), 0),
            Role::Input(InputKind::Goal) | Role::Waypoints => Stored::fixed(ElementType::I32, f64::exp2(-16.0), 0),
            Role::Narrow => narrow(),
            Role::Symmetric => Stored::i8(symmetric_i8(seen, options.ranges)),
            Role::Stream(k) if options.wide_stream => Stored::i16(symmetric_i16(stream_maxima[k], 2.0)),
            Role::Stream(_) => narrow(),
            Role::Skip if options.skip.is_wide(stages[index]) => Stored::i16(symmetric_i16(seen.max_abs(), 1.25)),
            Role::Skip => narrow(),
            Role::Vector => Stored::i16(symmetric_i16(headroom[index] * seen.max_abs(), 1.25)),
            Role::Hidden => hidden_state(seen.max_abs()),
            Role::Probabilities => Stored::fixed(ElementType::I16, f64::exp2(-15.0), 0),
            Role::Points => Stored::fixed(ElementType::I32, f64::exp2(-6.0), 0),
        });
    }
    copies::share_storage(graph, &roles, &mut types);
    if !options.own_pool_scale {
        for node in graph.nodes.iter().filter(|n| matches!(n.op, Op::GlobalPool)) {
            types[node.output.0 as usize].scale = types[node.inputs[0].0 as usize].scale;
        }
    }
    let convolves = |n: &&Node| matches!(&n.op, Op::Conv2d(c) if !super::is_linear(c, graph.value(n.inputs[0]).shape));
    let convolved = graph.nodes.iter().filter(convolves).map(|n| n.inputs[0]);
    let wide = convolved.filter(|id| types[id.0 as usize].element != ElementType::I8);
    let narrowed = wide.map(|id| (id, Stored::i8(affine_i8(statistics.of(id), options.ranges)))).collect();
    Ok(Types { stored: types, narrowed })
}

/// Start state of the decoder: scale `2^-f`, `f = 15 − max(0, ceil(log2(1.25·max|h0|)))`.
fn hidden_state(max_abs: f64) -> Stored {
    let integer_bits = if max_abs > 0.0 { (1.25 * max_abs).log2().ceil().max(0.0) } else { 0.0 };
    Stored::fixed(ElementType::I16, f64::exp2(integer_bits.min(15.0) - 15.0), 0)
}

fn roles(graph: &Graph) -> Vec<Role> {
    let mut roles = vec![Role::Narrow; graph.values.len()];
    let mut streams = 0;
    for node in &graph.nodes {
        let of = |k: usize| node.inputs.get(k).map(|id: &ValueId| roles[id.0 as usize]);
        let wide = |k: usize| matches!(of(k), Some(Role::Vector | Role::Probabilities));
        let shape = |k: usize| graph.value(node.inputs[k]).shape;
        let role = match &node.op {
            Op::Input(kind) => Role::Input(*kind),
            Op::Tokens(_) => {
                streams += 1;
                Role::Stream(streams - 1)
            }
            Op::Linear(_) => match (of(0), of(1)) {
                (_, Some(stream @ Role::Stream(_))) => stream,
                (Some(Role::Vector | Role::Input(InputKind::Velocity)), _) => Role::Vector,
                _ => Role::Narrow,
            },
            Op::BranchLinear(_) if of(0) == Some(Role::Vector) => Role::Vector,
            Op::Add { .. } => match (of(0), of(1)) {
                (Some(stream @ Role::Stream(_)), _) | (_, Some(stream @ Role::Stream(_))) => stream,
                (Some(Role::Vector), _) | (_, Some(Role::Vector)) => Role::Vector,
                _ => Role::Skip,
            },
            Op::Conv2d(conv) if of(0) == Some(Role::Vector) && super::is_linear(conv, shape(0)) => Role::Vector,
            Op::Conv2d(_) if node.inputs.len() == 2 => Role::Skip,
            Op::ResizeBilinear { .. } if node.inputs.len() == 2 => Role::Skip,
            Op::GlobalPool | Op::GatherSum => Role::Vector,
            Op::AveragePool(_) if graph.value(node.output).shape.positions() == 1 => Role::Vector,
            // A mean of grey levels is one, and what stands for padding behind it must have a code, too.
            Op::AveragePool(_) => match of(0) {
                Some(grey @ Role::Input(InputKind::Image | InputKind::Views)) => grey,
                _ => Role::Narrow,
            },
            Op::Concat(_) if (0..node.inputs.len()).any(wide) => Role::Vector,
            Op::Slice(_) | Op::Pad(_) | Op::Clip(_) if of(0) == Some(Role::Vector) => Role::Vector,
            Op::Softmax | Op::Sigmoid => Role::Probabilities,
            Op::SpatialSoftmax { .. } => Role::Points,
            Op::WaypointDecoder(_) => Role::Waypoints,
            _ => Role::Narrow,
        };
        roles[node.output.0 as usize] = role;
    }
    for node in &graph.nodes {
        for id in promoted(node) {
            let role = &mut roles[id.0 as usize];
            match (&node.op, *role) {
                (Op::Attention { .. }, Role::Narrow) => *role = Role::Symmetric,
                (Op::WaypointDecoder(_), _) => *role = Role::Hidden,
                (Op::Attention { .. }, _) => {}
                (Op::Softmax | Op::Sigmoid | Op::SpatialSoftmax { .. }, Role::Narrow | Role::Skip) => {
                    *role = Role::Vector;
                }
                (Op::GatherSum, Role::Narrow) => *role = Role::Vector,
                (Op::Softmax | Op::Sigmoid | Op::SpatialSoftmax { .. } | Op::GatherSum, _) => {}
                (_, Role::Narrow) => *role = Role::Skip,
                _ => {}
            }
        }
    }
    // What a copy's reader asks for, its operand must give; of an enlargement that holds for 16 bits.
    for node in graph.nodes.iter().rev() {
        let result = roles[node.output.0 as usize];
        let asks = match &node.op {
            op if copies::is_copy(op) => {
                matches!(result, Role::Symmetric | Role::Hidden | Role::Skip | Role::Vector)
            }
            Op::ResizeBilinear { .. } => node.inputs.len() == 1 && result == Role::Vector,
            _ => false,
        };
        if asks && let operand @ Role::Narrow = &mut roles[node.inputs[0].0 as usize] {
            *operand = result;
        }
    }
    roles
}

/// Operands whose role is decided by this consumer.
fn promoted(node: &Node) -> Vec<ValueId> {
    match &node.op {
        Op::Attention { .. } => node.inputs.clone(),
        Op::WaypointDecoder(_) | Op::Softmax | Op::Sigmoid | Op::SpatialSoftmax { .. } | Op::GatherSum => {
            vec![node.inputs[0]]
        }
        Op::Conv2d(_) | Op::ResizeBilinear { .. } => node.inputs.iter().skip(1).copied().collect(),
        Op::MaxPool(_) => vec![node.inputs[0], node.output],
        _ => Vec::new(),
    }
}

/// ResNet stage of every value: the number in a `layerN` name segment, else the largest of its operands'.
fn stages(graph: &Graph) -> Vec<u8> {
    let mut stages = vec![0; graph.values.len()];
    for node in &graph.nodes {
        let named = node.name.split('.').find_map(|segment| segment.strip_prefix("layer")?.parse().ok());
        let inherited = node.inputs.iter().map(|id| stages[id.0 as usize]).max().unwrap_or(0);
        stages[node.output.0 as usize] = named.unwrap_or(inherited);
    }
    stages
}

/// How many times larger than seen a value may become: where sums of cells come from the calibration frames' cells,
/// others may sum up to more, and the layers behind them follow. 16 bits have room for it.
fn headroom(graph: &Graph, statistics: &Statistics) -> Vec<f64> {
    let mut headroom = vec![1.0; graph.values.len()];
    for node in &graph.nodes {
        let max = |id: ValueId| statistics.of(id).max_abs();
        headroom[node.output.0 as usize] = match &node.op {
            Op::GatherSum if max(node.output) > 0.0 => {
                let cells = graph.value(node.inputs[1]).shape.channels / 2;
                f64::from(cells) * max(node.inputs[0]) / max(node.output)
            }
            Op::Linear(_) | Op::Clip(_) | Op::GlobalPool => {
                node.inputs.iter().map(|id| headroom[id.0 as usize]).fold(1.0, f64::max)
            }
            _ => 1.0,
        };
    }
    headroom
}

/// Largest magnitude of each stream over all its taps, with room for the fastest velocity.
fn stream_maxima(graph: &Graph, statistics: &Statistics, options: &QuantizeOptions, roles: &[Role]) -> Vec<f64> {
    let count = roles.iter().filter_map(|r| if let Role::Stream(k) = r { Some(k + 1) } else { None }).max();
    let mut maxima = vec![0.0; count.unwrap_or(0)];
    for (index, role) in roles.iter().enumerate() {
        if let Role::Stream(k) = *role {
            maxima[k] = f64::max(maxima[k], statistics.of(ValueId(index as u32)).max_abs());
        }
    }
    for node in &graph.nodes {
        if let (Op::Tokens(tokens), Role::Stream(k)) = (&node.op, roles[node.output.0 as usize]) {
            let unseen = (options.max_velocity - statistics.of(node.inputs[2]).max_abs()).max(0.0);
            let steepest = tokens.velocity_weights.iter().map(|w| f64::from(w.abs())).fold(0.0, f64::max);
            maxima[k] += unseen * steepest;
        }
    }
    maxima
}
