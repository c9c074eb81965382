//! Shape rules and the checklist of graph invariants.

use super::{BranchLinear, Clip, Conv2d, Graph, Linear, Node, Op, Shape, ValueId};
use std::collections::HashSet;

/// Checks every invariant of the [module page](super) and of the names, and collects all violations.
///
/// * handles are in range; each value is written at most once, and read only after it was written
/// * the output shapes are those that the operators give; no dimension is zero
/// * constants have as many elements as their shape says and are finite; variances, deviations and temperatures are
///   positive
/// * every value has a name of its own, and its node has the same
/// * there are outputs, and they are written
///
/// # Errors
/// One line per violation, led by the node.
pub fn verify(graph: &Graph) -> Result<(), Vec<String>> {
    let mut checklist = Checklist { graph, written: HashSet::new(), errors: Vec::new() };
    for node in &graph.nodes {
        checklist.node(node);
    }
    checklist.outputs();
    checklist.names();
    if checklist.errors.is_empty() { Ok(()) } else { Err(checklist.errors) }
}

struct Checklist<'a> {
    graph: &'a Graph,
    written: HashSet<ValueId>,
    errors: Vec<String>,
}

impl Checklist<'_> {
    fn error(&mut self, node: &Node, message: impl std::fmt::Display) {
        self.errors.push(format!("{} {}: {message}", node.op.name(), node.name));
    }

    fn node(&mut self, node: &Node) {
        for &input in &node.inputs {
            if !self.written.contains(&input) {
                self.error(node, format!("reads value {} before it is written", input.0));
            }
        }
        match self.graph.values.get(node.output.0 as usize) {
            None => self.error(node, format!("writes value {}, which does not exist", node.output.0)),
            Some(value) if value.name != node.name => {
                self.error(node, format!("writes the value named {}", value.name));
            }
            Some(_) => {}
        }
        if !self.written.insert(node.output) {
            self.error(node, format!("writes value {} a second time", node.output.0));
        }
        self.shape(node);
        self.constants(node);
    }

    fn shape(&mut self, node: &Node) {
        let shape = |id: &ValueId| self.graph.values.get(id.0 as usize).map(|v| v.shape);
        let (Some(output), Some(inputs)) =
            (shape(&node.output), node.inputs.iter().map(shape).collect::<Option<Vec<_>>>())
        else {
            return;
        };
        if output.elements() == 0 {
            self.error(node, format!("{output:?} is empty"));
        }
        if let Op::Input(_) = node.op {
            if !inputs.is_empty() {
                self.error(node, "an input has operands");
            }
            return;
        }
        match node.op.output_shape(&inputs) {
            Err(message) => self.error(node, message),
            Ok(expected) if expected != output => {
                self.error(node, format!("output: found {output:?}, expected {expected:?}"));
            }
            Ok(_) => {}
        }
    }

    fn constants(&mut self, node: &Node) {
        for constant in node.op.constants() {
            let (what, data) = (constant.what, constant.data);
            if let Some(shape) = constant.shape {
                let count = shape.iter().try_fold(1usize, |n, &d| n.checked_mul(d));
                if count != Some(data.len()) {
                    self.error(node, format!("{what}: found {} values for {shape:?}", data.len()));
                }
            }
            if let Some(i) = data.iter().position(|v| !v.is_finite()) {
                self.error(node, format!("{what}: {} at index {i}", data[i]));
            }
        }
        let clip = match &node.op {
            Op::Conv2d(Conv2d { clip, .. })
            | Op::Linear(Linear { clip, .. })
            | Op::BranchLinear(BranchLinear { clip, .. })
            | Op::Clip(clip)
            | Op::Add { clip } => *clip,
            _ => Clip::NONE,
        };
        if clip.min > clip.max || clip.min.is_nan() || clip.max.is_nan() {
            self.error(node, format!("bounds {} and {} are in the wrong order", clip.min, clip.max));
        }
        if let Op::Pad(pad) = &node.op
            && !pad.value.is_finite()
        {
            self.error(node, format!("border value {}", pad.value));
        }
        if let Op::SpatialSoftmax { temperature } = node.op
            && !(temperature.is_finite() && temperature > 0.0)
        {
            self.error(node, format!("temperature {temperature}"));
        }
        let (what, divisors) = match &node.op {
            Op::BatchNorm(bn) => ("variance + ε", bn.variance.iter().map(|v| v + bn.epsilon).collect()),
            Op::Normalize(n) => ("standard deviation", n.std.clone()),
            Op::Conv2d(c) => ("standard deviation", c.normalization.as_ref().map_or(vec![], |n| n.std.clone())),
            _ => return,
        };
        if let Some(i) = divisors.iter().position(|&v| v <= 0.0) {
            self.error(node, format!("{what}: {} at index {i}", divisors[i]));
        }
    }

    fn outputs(&mut self) {
        if self.graph.outputs.is_empty() {
            self.errors.push("the graph has no outputs".into());
        }
        for output in self.graph.outputs.iter().filter(|o| !self.written.contains(o)) {
            self.errors.push(format!("output value {} is never written", output.0));
        }
    }

    fn names(&mut self) {
        let mut names = HashSet::new();
        for value in &self.graph.values {
            if value.name.is_empty() || !names.insert(&value.name) {
                self.errors.push(format!("value name '{}' is empty or not unique", value.name));
            }
        }
    }
}

fn arity(op: &Op, inputs: &[Shape], allowed: std::ops::RangeInclusive<usize>) -> Result<(), String> {
    if allowed.contains(&inputs.len()) {
        return Ok(());
    }
    Err(format!("{} takes {allowed:?} operands, found {}", op.name(), inputs.len()))
}

fn expect(what: &str, found: impl PartialEq<usize> + std::fmt::Debug, expected: usize) -> Result<(), String> {
    if found == expected { Ok(()) } else { Err(format!("{what}: found {found:?}, expected {expected}")) }
}

fn same_shape(what: &str, found: Shape, expected: Shape) -> Result<(), String> {
    if found == expected { Ok(()) } else { Err(format!("{what}: found {found:?}, expected {expected:?}")) }
}

fn narrow(what: &str, value: usize) -> Result<u16, String> {
    u16::try_from(value).map_err(|_| format!("{what}: {value} exceeds 65535"))
}

/// Names of the axes of a map, in order.
const AXES: [&str; 3] = ["height", "width", "channels"];

/// The shape whose axes follow one by one.
fn map_axes(shape: Shape, size: impl Fn(usize, u16) -> Result<u16, String>) -> Result<Shape, String> {
    Ok(Shape::map(size(0, shape.height)?, size(1, shape.width)?, size(2, shape.channels)?))
}

/// See [`Op::output_shape`].
pub(super) fn output_shape(op: &Op, inputs: &[Shape]) -> Result<Shape, String> {
    let channels = |s: Shape| usize::from(s.channels);
    let windowed = |window: &firmware::program::Window, s: Shape, c: u16| {
        let (h, w) = window
            .output_size(s.height, s.width)
            .ok_or_else(|| format!("window {window:?} does not fit a map of {}×{}", s.height, s.width))?;
        Ok::<_, String>(Shape::map(h, w, c))
    };
    match op {
        Op::Input(_) => Err("an input has no operands to take its shape from".into()),
        Op::Normalize(n) => {
            arity(op, inputs, 1..=1)?;
            expect("means", n.mean.len(), channels(inputs[0]))?;
            expect("standard deviations", n.std.len(), channels(inputs[0]))?;
            Ok(inputs[0])
        }
        Op::Conv2d(conv) => {
            arity(op, inputs, 1..=2)?;
            let w = &conv.weights.shape;
            expect("rank of convolution weights", w.len(), 4)?;
            expect("kernel height", w[1], usize::from(conv.window.kernel_h))?;
            expect("kernel width", w[2], usize::from(conv.window.kernel_w))?;
            expect("input channels", w[3] * usize::from(conv.groups), channels(inputs[0]))?;
            if conv.groups == 0 || w[0] % usize::from(conv.groups) != 0 {
                return Err(format!("{} output channels are not divisible by {} groups", w[0], conv.groups));
            }
            if let Some(bias) = &conv.bias {
                expect("bias length", bias.len(), w[0])?;
            }
            let out = windowed(&conv.window, inputs[0], narrow("output channels", w[0])?)?;
            if let Some(&residual) = inputs.get(1) {
                same_shape("residual", residual, out)?;
            }
            Ok(out)
        }
        Op::BatchNorm(bn) => {
            arity(op, inputs, 1..=1)?;
            for v in [&bn.weight, &bn.bias, &bn.mean, &bn.variance] {
                expect("batch-norm vector", v.len(), channels(inputs[0]))?;
            }
            Ok(inputs[0])
        }
        Op::Clip(_) | Op::Softmax | Op::Sigmoid => {
            arity(op, inputs, 1..=1)?;
            Ok(inputs[0])
        }
        Op::SpatialSoftmax { .. } => {
            arity(op, inputs, 1..=1)?;
            Ok(Shape::tokens(inputs[0].channels, 2))
        }
        Op::Add { .. } => {
            arity(op, inputs, 2..=2)?;
            same_shape("second operand", inputs[1], inputs[0])?;
            Ok(inputs[0])
        }
        Op::MaxPool(window) | Op::AveragePool(window) => {
            arity(op, inputs, 1..=1)?;
            windowed(window, inputs[0], inputs[0].channels)
        }
        Op::GlobalPool => {
            arity(op, inputs, 1..=2)?;
            if let Some(second) = inputs.get(1) {
                expect("channels of the second map", second.channels as usize, channels(inputs[0]))?;
            }
            Ok(Shape::vector(inputs[0].channels))
        }
        Op::ResizeBilinear { factor } => {
            arity(op, inputs, 1..=2)?;
            let s = inputs[0];
            let out = Shape::map(
                narrow("height", usize::from(s.height) * usize::from(factor.0))?,
                narrow("width", usize::from(s.width) * usize::from(factor.1))?,
                s.channels,
            );
            if let Some(&residual) = inputs.get(1) {
                same_shape("residual", residual, out)?;
            }
            Ok(out)
        }
        Op::Linear(linear) => {
            arity(op, inputs, 1..=2)?;
            let w = &linear.weights.shape;
            expect("rank of linear weights", w.len(), 2)?;
            expect("input channels", w[1], channels(inputs[0]))?;
            if let Some(bias) = &linear.bias {
                expect("bias length", bias.len(), w[0])?;
            }
            let out = Shape { channels: narrow("output channels", w[0])?, ..inputs[0] };
            if let Some(&residual) = inputs.get(1) {
                same_shape("residual", residual, out)?;
            }
            Ok(out)
        }
        Op::BranchLinear(layer) => {
            arity(op, inputs, 2..=2)?;
            let w = &layer.weights.shape;
            expect("rank of branch weights", w.len(), 3)?;
            // As many as an i8 command can name.
            if !(1..=127).contains(&w[0]) {
                return Err(format!("branches: found {}, expected 1..=127", w[0]));
            }
            expect("input channels", w[2], channels(inputs[0]))?;
            if let Some(bias) = &layer.bias {
                expect("bias length", bias.len(), w[0] * w[1])?;
            }
            expect("command values", inputs[1].elements() as usize, 1)?;
            Ok(Shape { channels: narrow("output channels", w[1])?, ..inputs[0] })
        }
        Op::Tokens(tokens) => {
            arity(op, inputs, 3..=3)?;
            let (h, w) = tokens.grid;
            for s in &inputs[..2] {
                if h == 0 || w == 0 || s.height % h != 0 || s.width % w != 0 {
                    return Err(format!("a map of {}×{} does not divide into {h}×{w} tokens", s.height, s.width));
                }
            }
            expect("channels of the second map", inputs[1].channels as usize, channels(inputs[0]))?;
            expect("velocity values", inputs[2].elements() as usize, 1)?;
            let count = 2 * usize::from(h) * usize::from(w);
            if let Some(p) = &tokens.position
                && p.shape != [count, channels(inputs[0])]
            {
                let (found, c) = (&p.shape, inputs[0].channels);
                return Err(format!("positional embedding: found {found:?}, expected [{count}, {c}]"));
            }
            for v in [&tokens.velocity_weights, &tokens.velocity_bias] {
                expect("velocity embedding", v.len(), channels(inputs[0]))?;
            }
            Ok(Shape::tokens(narrow("tokens", count)?, inputs[0].channels))
        }
        Op::LayerNorm(norm) => {
            arity(op, inputs, 1..=1)?;
            expect("LayerNorm weight", norm.weight.len(), channels(inputs[0]))?;
            expect("LayerNorm bias", norm.bias.len(), channels(inputs[0]))?;
            let (h, w) = norm.grid;
            let rows = u32::from(h) * u32::from(w);
            if u32::from(norm.first_row) + rows > inputs[0].positions() {
                return Err(format!("rows {} + {rows} exceed the input's {}", norm.first_row, inputs[0].positions()));
            }
            Ok(Shape::map(h, w, inputs[0].channels))
        }
        Op::Attention { heads } => {
            arity(op, inputs, 3..=3)?;
            same_shape("key", inputs[1], inputs[0])?;
            same_shape("value", inputs[2], inputs[0])?;
            if *heads == 0 || !inputs[0].channels.is_multiple_of(*heads) {
                return Err(format!("{} channels are not divisible by {heads} heads", inputs[0].channels));
            }
            Ok(inputs[0])
        }
        Op::WaypointDecoder(d) => {
            arity(op, inputs, 2..=2)?;
            let h = channels(inputs[0]);
            let u = d.input_weights.shape.get(1).copied().unwrap_or(0);
            if u != 2 && u != 4 {
                return Err(format!("GRU input width: found {u}, expected 2 (added) or 4 (concatenated)"));
            }
            for (what, found, expected) in [
                ("GRU input weights", &d.input_weights.shape, [3 * h, u]),
                ("GRU hidden weights", &d.hidden_weights.shape, [3 * h, h]),
                ("output weights", &d.output_weights.shape, [2, h]),
            ] {
                if found[..] != expected {
                    return Err(format!("{what}: found {found:?}, expected {expected:?}"));
                }
            }
            expect("GRU input bias", d.input_bias.len(), 3 * h)?;
            expect("GRU hidden bias", d.hidden_bias.len(), 3 * h)?;
            expect("output bias", d.output_bias.len(), 2)?;
            expect("goal values", inputs[1].elements() as usize, 2)?;
            Ok(Shape::tokens(d.steps, 2))
        }
        Op::Slice(slice) => {
            arity(op, inputs, 1..=1)?;
            map_axes(inputs[0], |axis, size| {
                let (begin, end, stride) = (slice.begin[axis], slice.end[axis], slice.stride[axis]);
                if stride == 0 || begin >= end || end > size {
                    return Err(format!("slice {begin}..{end} of stride {stride} does not fit {size} {}", AXES[axis]));
                }
                Ok((end - begin).div_ceil(stride))
            })
        }
        Op::Pad(pad) => {
            arity(op, inputs, 1..=1)?;
            map_axes(inputs[0], |axis, size| {
                let sum = usize::from(pad.before[axis]) + usize::from(size) + usize::from(pad.after[axis]);
                narrow(AXES[axis], sum)
            })
        }
        Op::GatherSum => {
            arity(op, inputs, 2..=2)?;
            let indices = inputs[1];
            if !indices.channels.is_multiple_of(2) {
                return Err(format!("{} channels of indices are no pairs of row and column", indices.channels));
            }
            Ok(Shape { channels: inputs[0].channels, ..indices })
        }
        Op::Concat(axis) => {
            arity(op, inputs, 1..=usize::MAX)?;
            let joined = *axis as usize;
            map_axes(inputs[0], |axis, size| {
                let sizes = inputs.iter().map(|s| [s.height, s.width, s.channels][axis]);
                if axis == joined {
                    return narrow(AXES[axis], sizes.map(usize::from).sum());
                }
                match sizes.into_iter().find(|&other| other != size) {
                    Some(other) => Err(format!("{} of the operands: found {other}, expected {size}", AXES[axis])),
                    None => Ok(size),
                }
            })
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::ir::{InputKind, Weights};
    use std::sync::Arc;

    fn linear(outputs: usize, inputs: usize, value: f32) -> Op {
        let weights = Arc::new(Weights { shape: vec![outputs, inputs], data: vec![value; outputs * inputs] });
        Op::Linear(Linear { weights, bias: None, clip: Clip::NONE })
    }

    fn small() -> Graph {
        let mut graph = Graph::default();
        let x = graph.push_input("x", InputKind::Goal, Shape::vector(2));
        let a = graph.push("a", linear(3, 2, 1.0), &[x]).unwrap();
        let b = graph.push("b", Op::Clip(Clip::RELU), &[a]).unwrap();
        graph.outputs.push(b);
        graph
    }

    #[test]
    fn sound_graph_passes() {
        assert_eq!(verify(&small()), Ok(()));
    }

    #[test]
    fn all_violations_are_collected() {
        let mut graph = small();
        graph.nodes.swap(1, 2);
        graph.nodes[2].op = linear(4, 2, f32::NAN);
        graph.values[2].name = "a".into();
        graph.outputs.push(ValueId(9));
        assert_eq!(
            verify(&graph).unwrap_err(),
            [
                "relu b: reads value 1 before it is written",
                "relu b: writes the value named a",
                "linear a: output: found Shape { height: 1, width: 1, channels: 3 }, \
                 expected Shape { height: 1, width: 1, channels: 4 }",
                "linear a: weights: NaN at index 0",
                "output value 9 is never written",
                "value name 'a' is empty or not unique",
            ]
        );
    }

    #[test]
    fn value_written_twice_and_missing_outputs_are_found() {
        let mut graph = small();
        graph.nodes[2].output = ValueId(1);
        graph.nodes[2].name = "a".into();
        graph.outputs.clear();
        assert_eq!(verify(&graph).unwrap_err(), ["relu a: writes value 1 a second time", "the graph has no outputs"]);
    }
}
