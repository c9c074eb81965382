//! The f32 interpreter of the float graph: the source of calibration ranges and the measure of every error report.
//!
//! * It runs graphs as imported and as optimized; a fused operator computes bias, then residual, then ReLU.
//! * Products are f32 with a fixed order of summation, the same on every machine; means, variances, softmax and the
//!   waypoint decoder are f64 inside. The number of threads never changes a result.
//! * Activations are `height × width × channels`, as everywhere in the crate.

use crate::error::{Error, ErrorCode, Result};
use crate::ir::{Graph, InputKind, Node, Op, Shape, ValueId};

mod attention;
mod branches;
mod conv2d;
mod elementwise;
mod gather_sum;
mod layer_norm;
mod linear;
mod matmul;
mod pool;
mod rerun;
mod resize_bilinear;
mod slice;
mod spatial_softmax;
mod tokens;
mod waypoint_decoder;

pub use attention::attention_weights;
pub use branches::{Branches, run_branches};
pub use rerun::{Change, rerun};

#[cfg(test)]
mod testing;

/// Largest LiDAR count of a cell; the network sees `count / 5`.
const BEV_LEVELS: f32 = 5.0;

/// Values of a graph, those that were kept.
#[derive(Clone, Debug)]
pub struct Activations {
    values: Vec<Option<Vec<f32>>>,
}

impl Activations {
    /// The elements of a value, or `None` where it was not kept.
    pub fn get(&self, id: ValueId) -> Option<&[f32]> {
        self.values.get(id.0 as usize)?.as_deref()
    }
}

/// Runs a graph and returns its outputs; a value is dropped after its last use.
///
/// `inputs` are raw, in the order of [`Graph::inputs`]: image and views 0..=255 and BEV counts 0..=5, all
/// `height × width × channels`; velocity `[m/s]`; goal `[right, forward-negative]` in m; `bev_points` and `cam_points`
/// per cell of their map cells `[row, column]…` of the other, from 0; command `[1, 2, …]`. `observe` sees every node
/// with its output, in order (for a BEV input that is counts / 5).
///
/// # Errors
/// The number or a length of the inputs is wrong, or the graph breaks an invariant of [`crate::ir`].
pub fn run(graph: &Graph, inputs: &[Vec<f32>], mut observe: impl FnMut(&Node, &[f32])) -> Result<Vec<Vec<f32>>> {
    let mut last_use = vec![0; graph.values.len()];
    for (step, node) in graph.nodes.iter().enumerate() {
        for id in node.inputs.iter().chain([&node.output]) {
            if let Some(last) = last_use.get_mut(id.0 as usize) {
                *last = step;
            }
        }
    }
    for id in &graph.outputs {
        if let Some(last) = last_use.get_mut(id.0 as usize) {
            *last = usize::MAX;
        }
    }
    let values = execute(graph, inputs, |step, values| {
        let node = &graph.nodes[step];
        if let Some(output) = values.get(node.output) {
            observe(node, output);
        }
        for id in node.inputs.iter().chain([&node.output]) {
            if last_use[id.0 as usize] == step {
                values.values[id.0 as usize] = None;
            }
        }
    })?;
    graph.outputs.iter().map(|&id| Ok(operand(graph, &values, id, "graph output")?.to_vec())).collect()
}

/// Runs a graph and keeps every value; `inputs` as for [`run`].
///
/// # Errors
/// See [`run`].
pub fn run_all(graph: &Graph, inputs: &[Vec<f32>]) -> Result<Activations> {
    execute(graph, inputs, |_, _| ())
}

/// Computes one operator alone. An [`Op::Input`] takes its raw input as the operand.
///
/// # Panics
/// The operands do not have the lengths of `input_shapes`, or the shapes are not those that [`Op::output_shape`]
/// accepts and returns.
pub fn evaluate(op: &Op, input_shapes: &[Shape], inputs: &[&[f32]], output_shape: Shape) -> Vec<f32> {
    match op {
        Op::Input(InputKind::Bev) => inputs[0].iter().map(|count| count / BEV_LEVELS).collect(),
        Op::Input(_) => inputs[0].to_vec(),
        Op::Normalize(n) => elementwise::normalize(n, inputs[0]),
        Op::Conv2d(conv) => conv2d::conv2d(conv, input_shapes[0], inputs, output_shape),
        Op::BatchNorm(bn) => elementwise::batch_norm(bn, inputs[0]),
        Op::Clip(bounds) => {
            let mut out = inputs[0].to_vec();
            elementwise::clip(&mut out, *bounds);
            out
        }
        Op::Add { clip } => {
            let mut out = inputs[0].to_vec();
            elementwise::finish(&mut out, None, Some(inputs[1]), *clip);
            out
        }
        Op::MaxPool(window) => pool::max_pool(window, input_shapes[0], inputs[0], output_shape),
        Op::AveragePool(window) => pool::average_pool(window, input_shapes[0], inputs[0], output_shape),
        Op::GlobalPool => pool::global_pool(inputs, usize::from(output_shape.channels)),
        Op::ResizeBilinear { factor } => {
            resize_bilinear::resize_bilinear(*factor, input_shapes[0], inputs, output_shape)
        }
        Op::Linear(linear) => linear::linear(linear, inputs),
        Op::Tokens(t) => tokens::tokens(t, input_shapes, inputs),
        Op::LayerNorm(norm) => layer_norm::layer_norm(norm, inputs[0]),
        Op::Attention { heads } => attention::attention(*heads, output_shape, inputs),
        Op::WaypointDecoder(decoder) => waypoint_decoder::waypoint_decoder(decoder, inputs),
        Op::Slice(s) => slice::slice(s, input_shapes[0], inputs[0]),
        Op::Pad(pad) => slice::pad(pad, input_shapes[0], inputs[0], output_shape),
        Op::Concat(axis) => slice::concat(*axis, input_shapes, inputs),
        Op::Softmax => elementwise::softmax(inputs[0], usize::from(output_shape.channels)),
        Op::GatherSum => gather_sum::gather_sum(input_shapes[0], inputs, output_shape),
        Op::BranchLinear(layer) => linear::branch_linear(layer, inputs),
        Op::Sigmoid => elementwise::sigmoid(inputs[0]),
        Op::SpatialSoftmax { temperature } => {
            spatial_softmax::spatial_softmax(*temperature, input_shapes[0], inputs[0])
        }
    }
}

/// Runs all nodes; `after` sees the values after each step and may drop some.
fn execute(graph: &Graph, inputs: &[Vec<f32>], mut after: impl FnMut(usize, &mut Activations)) -> Result<Activations> {
    let mut raw = check_inputs(graph, inputs)?.into_iter();
    let mut values = Activations { values: vec![None; graph.values.len()] };
    for (step, node) in graph.nodes.iter().enumerate() {
        let output_shape = graph.value(node.output).shape;
        let shapes: Vec<Shape> = match node.op {
            Op::Input(_) => vec![output_shape],
            _ => node.inputs.iter().map(|&id| graph.value(id).shape).collect(),
        };
        let operands: Vec<&[f32]> = match node.op {
            Op::Input(_) => raw.next().into_iter().collect(),
            _ => node.inputs.iter().map(|&id| operand(graph, &values, id, &node.name)).collect::<Result<_>>()?,
        };
        check_shape(node, &shapes, output_shape)?;
        let out = evaluate(&node.op, &shapes, &operands, output_shape);
        values.values[node.output.0 as usize] = Some(out);
        after(step, &mut values);
    }
    Ok(values)
}

fn check_shape(node: &Node, shapes: &[Shape], output: Shape) -> Result<()> {
    if matches!(node.op, Op::Input(_)) {
        return Ok(());
    }
    let malformed = |message: String| Error::new(ErrorCode::Malformed, format!("node {}", node.name), message);
    match node.op.output_shape(shapes).map_err(malformed)? {
        shape if shape == output => Ok(()),
        shape => Err(malformed(format!("its value is declared {output:?}, the operator gives {shape:?}"))),
    }
}

fn operand<'a>(graph: &Graph, values: &'a Activations, id: ValueId, reader: &str) -> Result<&'a [f32]> {
    values.get(id).ok_or_else(|| {
        let name = &graph.value(id).name;
        Error::new(ErrorCode::Malformed, reader, format!("value {name} is read before any node writes it"))
    })
}

fn check_inputs<'a>(graph: &Graph, inputs: &'a [Vec<f32>]) -> Result<Vec<&'a [f32]>> {
    let expected: Vec<_> = graph.inputs().collect();
    if inputs.len() != expected.len() {
        let kinds: Vec<_> = expected.iter().map(|(_, kind)| format!("{kind:?}")).collect();
        let message = format!("found {} inputs, expected {} ({})", inputs.len(), expected.len(), kinds.join(", "));
        return Err(Error::new(ErrorCode::Frames, format!("network {}", graph.name), message));
    }
    for (input, &(id, kind)) in inputs.iter().zip(&expected) {
        let value = graph.value(id);
        if input.len() as u64 != value.shape.elements() {
            let Shape { height, width, channels } = value.shape;
            let message = format!("found {} values, expected {height}×{width}×{channels}", input.len());
            return Err(Error::new(ErrorCode::Frames, format!("input {} ({kind:?})", value.name), message));
        }
    }
    Ok(inputs.iter().map(Vec::as_slice).collect())
}

#[cfg(test)]
mod tests;
