//! The smallest network that uses every operator of the image format in every form: for suites that run it a million
//! times. Two branches of 4 to 8 channels, one fusion by a transformer layer, the waypoint head.

use crate::build;
use crate::random::Random;
use firmware::image::{Image, Region, RegionName};
use firmware::program::Window;
use firmware::tensor::{ElementType, Shape};
use model_compiler::emit::{AlignedBytes, ImageParts, KnownAnswer};
use model_compiler::frames::{ByteMap, Frame};
use model_compiler::ir::{
    Axis, BranchLinear, Clip, Conv2d, Graph, InputKind, LayerNorm, Linear, Normalization, Op, Pad, Slice, Tokens,
    ValueId, WaypointDecoder, Weights,
};
use model_compiler::pack::pack;
use model_compiler::pipeline::{self, Compiled};
use model_compiler::quantize::{QuantizeOptions, SkipStages};
use std::sync::Arc;

/// Seed of weights and frames.
pub const SEED: u64 = 2026;

/// Channels of both branches and of the transformer.
const CHANNELS: usize = 4;
/// Commands that select a branch.
const BRANCHES: usize = 3;
/// Height and width of both inputs.
const SIZE: u16 = 16;

/// Three cells for each of four.
const LISTS: Shape = Shape::map(2, 2, 6);

/// Names of all operators, as [`firmware::program::Step::name`] gives them.
pub const OPERATORS: [&str; 19] = [
    "conv2d",
    "linear",
    "max_pool",
    "average_pool",
    "global_pool",
    "add",
    "requantize",
    "resize_bilinear",
    "tokens",
    "layer_norm",
    "attention",
    "waypoint_decoder",
    "copy_box",
    "concat",
    "softmax",
    "gather_sum",
    "branch_linear",
    "sigmoid",
    "spatial_softmax",
];

/// The float network.
///
/// # Panics
/// Never: the operators fit together.
pub fn graph() -> Graph {
    let mut b = Builder { graph: Graph { name: "every step".into(), ..Default::default() }, random: Random::new(SEED) };
    let rgb = b.graph.push_input("rgb", InputKind::Image, Shape::map(SIZE, SIZE, 3));
    let bev = b.graph.push_input("bev", InputKind::Bev, Shape::map(SIZE, SIZE, 2));
    let velocity = b.graph.push_input("velocity", InputKind::Velocity, Shape::vector(1));
    let bev_points = b.graph.push_input("bev_points", InputKind::BevPoints, LISTS);
    let camera_points = b.graph.push_input("cam_points", InputKind::CameraPoints, LISTS);
    let goal = b.graph.push_input("goal", InputKind::Goal, Shape::vector(2));
    let command = b.graph.push_input("command", InputKind::Command, Shape::vector(1));
    let image = b.image_branch(rgb);
    let stem = b.conv("lidar.stem", &[bev], Window::square(3, 2, 1), 1, None, Clip::RELU);
    let lidar = b.push("lidar.pool", Op::AveragePool(Window::square(2, 2, 0)), &[stem]);
    let [image_tokens, lidar_normed] = b.transformer(image, lidar, velocity);
    let enlarged = Op::ResizeBilinear { factor: (2, 2) };
    let image = b.push("image.fused", enlarged.clone(), &[image_tokens, image]);
    let lidar_tokens = b.push("lidar.enlarged", enlarged, &[lidar_normed]);
    let lidar = b.push("lidar.fused", Op::Add { clip: Clip::RELU }, &[lidar, lidar_tokens]);
    let image_sums = b.push("image.gathered", Op::GatherSum, &[lidar, camera_points]);
    let counts = b.push("lidar.gathered", Op::GatherSum, &[bev, bev_points]);
    let channels = Pad { before: [0, 0, 2], after: [0; 3], value: 0.0 };
    let lidar_sums = b.push("lidar.sums", Op::Pad(channels), &[counts]);
    let sums = b.push("gathered", Op::Add { clip: Clip::NONE }, &[image_sums, lidar_sums]);
    let image = b.push("image.projected", Op::ResizeBilinear { factor: (2, 2) }, &[sums, image]);
    let features = b.push("features", Op::GlobalPool, &[image, lidar]);
    let joined = b.linear("join.0", &[features], 6, Clip::RELU);
    let hidden = b.linear("join.2", &[joined], CHANNELS, Clip::NONE);
    let decoder = b.decoder();
    let waypoints = b.push("waypoints", decoder, &[hidden, goal]);
    let probabilities = b.classifier(image, lidar, bev);
    let points = b.points(image);
    b.graph.outputs.extend([waypoints, probabilities, points]);
    let controls = b.controls(features, lidar_normed, bev, command);
    b.graph.outputs.extend(controls);
    b.graph
}

/// A few random frames of the network's size.
pub fn frames(seed: u64, count: usize) -> Vec<Frame> {
    let mut random = Random::new(seed);
    let mut map = |shape: Shape, values: usize| {
        let data = (0..shape.elements()).map(|_| random.below(values) as u8).collect();
        Some(ByteMap { shape, data })
    };
    let frame = |i: usize| Frame {
        name: format!("random {i} of seed {seed}"),
        rgb: map(Shape::map(SIZE, SIZE, 3), 256),
        bev: map(Shape::map(SIZE, SIZE, 2), 6),
        velocity: Some(1.5 * i as f64),
        goal: Some([2.0 - i as f64, -8.0 - 3.0 * i as f64]),
        command: Some(1 + (i % BRANCHES) as u8),
        bev_points: map(LISTS, 2),
        camera_points: map(LISTS, 2),
        ..Frame::default()
    };
    (0..count).map(frame).collect()
}

/// The network quantized with wide skips and compiled for the portable target.
///
/// # Panics
/// The compiler refuses it, or an operator or one of its forms is missing in the program.
pub fn compiled() -> Compiled {
    compiled_for("portable")
}

/// The same compiled for a built-in target.
///
/// # Panics
/// As [`compiled`].
pub fn compiled_for(target: &str) -> Compiled {
    let options = QuantizeOptions { skip: SkipStages::wide(), ..Default::default() };
    let model = pipeline::quantize_graph(&graph(), &frames(SEED, 4), &options, &mut |_, _, _| {});
    build::compiled_for(&model.unwrap_or_else(|e| panic!("{e}")), target)
}

/// What the image is made of, with its known answer: for tests that assemble it in another way.
///
/// # Panics
/// As [`compiled`].
pub fn parts() -> ImageParts {
    parts_for("portable")
}

/// The same for a built-in target.
///
/// # Panics
/// As [`compiled`].
pub fn parts_for(target: &str) -> ImageParts {
    let compiled = compiled_for(target);
    let mut parts = pack(&compiled.record.model, &compiled.record.plan).unwrap_or_else(|e| panic!("{e}"));
    parts.known_answer = Image::parse(&AlignedBytes::from(compiled.image.as_slice())).ok().and_then(stored_answer);
    parts
}

/// The same parts in two memory regions: scratch and every third chain of tensors lie in a second one.
///
/// # Panics
/// Never: the name is a name.
pub fn in_two_regions(mut parts: ImageParts) -> ImageParts {
    for id in 0..parts.tensors.len() {
        let mut root = id;
        while let Some(operand) = parts.tensors[root].in_place_of {
            root = operand.0.into();
        }
        let second = parts.tensors[id].element == ElementType::Scratch || root.is_multiple_of(3);
        parts.tensors[id].region = u8::from(second);
    }
    parts.regions.push(Region { name: RegionName::new("slow").expect("a name"), ..parts.regions[0] });
    parts
}

fn stored_answer(image: Image<'_>) -> Option<KnownAnswer> {
    let answer = image.known_answer()?;
    let step_crcs = (0..image.step_count()).map(|position| answer.step_crc(position)).collect::<Option<_>>()?;
    Some(KnownAnswer { seed: answer.seed(), step_crcs })
}

struct Builder {
    graph: Graph,
    random: Random,
}

impl Builder {
    fn push(&mut self, name: &str, op: Op, inputs: &[ValueId]) -> ValueId {
        self.graph.push(name, op, inputs).unwrap_or_else(|e| panic!("{name}: {e}"))
    }

    fn values(&mut self, count: usize, amplitude: f32) -> Vec<f32> {
        (0..count).map(|_| amplitude * self.random.signed_unit()).collect()
    }

    /// Weights that keep the magnitude of their input.
    fn weights(&mut self, shape: &[usize]) -> Arc<Weights> {
        let count = shape.iter().product();
        let depth = count / shape[0];
        let data = self.values(count, (3.0 / depth as f32).sqrt());
        Arc::new(Weights { shape: shape.to_vec(), data })
    }

    fn bias(&mut self, count: usize) -> Arc<Vec<f32>> {
        Arc::new(self.values(count, 0.2))
    }

    fn channels(&self, value: ValueId) -> usize {
        self.graph.value(value).shape.channels.into()
    }

    fn conv(
        &mut self,
        name: &str,
        inputs: &[ValueId],
        window: Window,
        groups: u16,
        normalization: Option<Normalization>,
        clip: Clip,
    ) -> ValueId {
        let depth = self.channels(inputs[0]) / usize::from(groups);
        let conv = Conv2d {
            weights: self.weights(&[CHANNELS, window.kernel_h.into(), window.kernel_w.into(), depth]),
            bias: Some(self.bias(CHANNELS)),
            window,
            groups,
            normalization: normalization.map(Arc::new),
            clip,
        };
        self.push(name, Op::Conv2d(conv), inputs)
    }

    fn linear(&mut self, name: &str, inputs: &[ValueId], outputs: usize, clip: Clip) -> ValueId {
        let depth = self.channels(inputs[0]);
        let linear = Linear { weights: self.weights(&[outputs, depth]), bias: Some(self.bias(outputs)), clip };
        self.push(name, Op::Linear(linear), inputs)
    }

    fn branch_linear(&mut self, name: &str, input: ValueId, command: ValueId, outputs: usize, clip: Clip) -> ValueId {
        let depth = self.channels(input);
        let data = self.values(BRANCHES * outputs * depth, (3.0 / depth as f32).sqrt());
        let weights = Arc::new(Weights { shape: vec![BRANCHES, outputs, depth], data });
        let layer = BranchLinear { weights, bias: Some(self.bias(BRANCHES * outputs)), clip };
        self.push(name, Op::BranchLinear(layer), &[input, command])
    }

    fn layer_norm(&mut self, name: &str, input: ValueId, first_row: u16, grid: (u16, u16)) -> ValueId {
        let weight = Arc::new(self.values(CHANNELS, 0.3).into_iter().map(|v| 1.0 + v).collect());
        let norm = LayerNorm { weight, bias: self.bias(CHANNELS), epsilon: 1e-5, first_row, grid };
        self.push(name, Op::LayerNorm(norm), &[input])
    }

    /// Strided stem, padded max pool, a residual block with a grouped convolution.
    fn image_branch(&mut self, rgb: ValueId) -> ValueId {
        let normalization = Normalization { mean: vec![124.0, 116.0, 104.0], std: vec![58.0, 57.0, 57.5] };
        let stem = self.conv("image.stem", &[rgb], Window::square(3, 2, 1), 1, Some(normalization), Clip::NONE);
        let pooled = self.push("image.pool", Op::MaxPool(Window::square(3, 2, 1)), &[stem]);
        let grouped = self.conv("image.conv1", &[pooled], Window::square(3, 1, 1), 2, None, Clip::RELU);
        self.conv("image.conv2", &[grouped, pooled], Window::square(3, 1, 1), 1, None, Clip::RELU)
    }

    /// One layer over four tokens of each branch; returns the normalized maps of both.
    fn transformer(&mut self, image: ValueId, lidar: ValueId, velocity: ValueId) -> [ValueId; 2] {
        let tokens = Tokens {
            grid: (2, 2),
            position: Some(self.weights(&[8, CHANNELS])),
            velocity_weights: Arc::new(self.values(CHANNELS, 0.1)),
            velocity_bias: self.bias(CHANNELS),
        };
        let x = self.push("tokens", Op::Tokens(tokens), &[image, lidar, velocity]);
        let normed = self.layer_norm("ln1", x, 0, (8, 1));
        let heads = ["query", "key", "value"].map(|name| self.linear(name, &[normed], CHANNELS, Clip::NONE));
        let context = self.push("attention", Op::Attention { heads: 2 }, &heads);
        let x = self.linear("proj", &[context, x], CHANNELS, Clip::NONE);
        let normed = self.layer_norm("ln2", x, 0, (8, 1));
        let mlp = self.linear("mlp.0", &[normed], 8, Clip::RELU);
        let x = self.linear("mlp.2", &[mlp, x], CHANNELS, Clip::NONE);
        [("ln_f.image", 0), ("ln_f.lidar", 4)].map(|(name, first_row)| self.layer_norm(name, x, first_row, (2, 2)))
    }

    /// Every other pixel of one map in a border of channels (the shortcut without weights), bordered pixels of the
    /// other within bounds, both joined; probabilities per pixel of that, and of a corner of an input.
    fn classifier(&mut self, image: ValueId, lidar: ValueId, bev: ValueId) -> ValueId {
        let every_other = Slice { begin: [1, 0, 1], end: [4, 4, 4], stride: [2, 2, 1] };
        let sliced = self.push("class.slice", Op::Slice(every_other), &[image]);
        let channels = Pad { before: [0, 0, 2], after: [0; 3], value: 0.0 };
        let shortcut = self.push("class.shortcut", Op::Pad(channels), &[sliced]);
        let pooled = self.push("class.pool", Op::MaxPool(Window::square(4, 1, 0)), &[lidar]);
        let pixels = Pad { before: [1, 0, 0], after: [0, 1, 0], value: 0.25 };
        let padded = self.push("class.pad", Op::Pad(pixels), &[pooled]);
        let clipped = self.push("class.clip", Op::Clip(Clip { min: 0.125, max: 1.0 }), &[padded]);
        let joined = self.push("class.join", Op::Concat(Axis::Channels), &[shortcut, clipped]);
        let logits = self.conv("class.logits", &[joined], Window::square(1, 1, 0), 1, None, Clip::NONE);
        let probabilities = self.push("class.softmax", Op::Softmax, &[logits]);
        let corner = Slice { begin: [6, 6, 0], end: [8, 8, 2], stride: [1; 3] };
        let counts = self.push("class.corner", Op::Slice(corner), &[bev]);
        let counts = self.push("class.counts", Op::Pad(channels), &[counts]);
        let counts = self.push("class.likely", Op::Softmax, &[counts]);
        self.push("class.probabilities", Op::Concat(Axis::Width), &[probabilities, counts])
    }

    /// Branches on a vector and on a map, sigmoids of both and of a corner of an input.
    fn controls(&mut self, vector: ValueId, map: ValueId, bev: ValueId, command: ValueId) -> [ValueId; 3] {
        let hidden = self.branch_linear("branch.0", vector, command, 5, Clip::RELU);
        let logits = self.branch_linear("branch.2", hidden, command, 3, Clip::NONE);
        let controls = self.push("controls", Op::Sigmoid, &[logits]);
        let gates = self.branch_linear("branch.map", map, command, 2, Clip::NONE);
        let corner = Slice { begin: [7, 7, 0], end: [8, 8, 2], stride: [1; 3] };
        let counts = self.push("branch.corner", Op::Slice(corner), &[bev]);
        [controls, gates, self.push("branch.counts", Op::Sigmoid, &[counts])]
    }

    /// Logits enlarged in 16 bits, and the pixel that each map expects.
    fn points(&mut self, image: ValueId) -> ValueId {
        let logits = self.conv("points.logits", &[image], Window::square(1, 1, 0), 1, None, Clip::NONE);
        let enlarged = self.push("points.enlarged", Op::ResizeBilinear { factor: (2, 3) }, &[logits]);
        self.push("points", Op::SpatialSoftmax { temperature: 0.5 }, &[enlarged])
    }

    fn decoder(&mut self) -> Op {
        Op::WaypointDecoder(WaypointDecoder {
            input_weights: self.weights(&[3 * CHANNELS, 2]),
            hidden_weights: self.weights(&[3 * CHANNELS, CHANNELS]),
            input_bias: self.bias(3 * CHANNELS),
            hidden_bias: self.bias(3 * CHANNELS),
            output_weights: self.weights(&[2, CHANNELS]),
            output_bias: self.bias(2),
            steps: 4,
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use firmware::engine::Engine;
    use firmware::kernels::Portable;
    use firmware::program::{Requant, Residual, ResizeBilinear, Step};
    use firmware::tensor::TensorId;
    use model_compiler::emit::emit;

    #[test]
    fn every_operator_occurs_in_every_form() {
        let parts = parts();
        let forms = |matches: &dyn Fn(&Step) -> bool| parts.steps.iter().any(matches);
        for name in OPERATORS {
            assert!(forms(&|step| step.name() == name), "{name}");
        }
        let scaled = |residual: &Residual| matches!(residual, Residual::Scaled { .. });
        assert!(forms(&|s| matches!(s, Step::Conv2d(s) if s.groups > 1)));
        assert!(forms(&|s| matches!(s, Step::Conv2d(s) if s.window.stride_h > 1)));
        assert!(forms(&|s| matches!(s, Step::Conv2d(s) if s.rescale.residual == Residual::None)));
        assert!(forms(&|s| matches!(s, Step::Conv2d(s) if scaled(&s.rescale.residual))));
        assert!(forms(&|s| matches!(s, Step::Linear(s) if s.rescale.residual == Residual::None)));
        assert!(forms(&|s| matches!(s, Step::Linear(s) if matches!(s.rescale.residual, Residual::Stream { .. }))));
        assert!(forms(&|s| matches!(s, Step::Linear(s) if s.scratch.is_none())), "16-bit input");
        assert!(forms(&|s| matches!(s, Step::GlobalPool(s) if s.second.is_some())));
        assert!(forms(&|s| matches!(s, Step::ResizeBilinear(s) if s.residual.is_some())));
        assert!(forms(&|s| matches!(s, Step::ResizeBilinear(s) if s.residual.is_none())));
        assert!(forms(&|s| matches!(s, Step::LayerNorm(s) if s.first_row > 0)));
        let element = |id: TensorId| parts.tensors[usize::from(id.0)].element;
        assert!(
            forms(&|s| matches!(s, Step::CopyBox(s) if s.stride[0] > 1 && s.before[2] > 0)),
            "slice and pad in one"
        );
        assert!(forms(&|s| matches!(s, Step::CopyBox(s) if s.stride == [1; 3] && s.begin == [0; 3])), "pad alone");
        assert!(forms(&|s| matches!(s, Step::Concat(s) if s.axis == Axis::Channels)));
        assert!(forms(&|s| matches!(s, Step::Concat(s) if s.axis == Axis::Width)));
        let exact = Requant { multiplier: 1 << 23, shift: 23 };
        assert!(forms(&|s| matches!(s, Step::Concat(s) if s.second.requant == exact)), "moved");
        assert!(forms(&|s| matches!(s, Step::Concat(s) if s.first.requant != exact)), "rescaled");
        assert!(forms(&|s| matches!(s, Step::Softmax(s) if element(s.input) == ElementType::I16)));
        assert!(forms(&|s| matches!(s, Step::Softmax(s) if element(s.input) == ElementType::I8)));
        assert!(forms(&|s| matches!(s, Step::GatherSum(s) if element(s.input) == ElementType::I8)));
        assert!(forms(&|s| matches!(s, Step::GatherSum(s) if element(s.input) == ElementType::I16)));
        assert!(forms(&|s| matches!(s, Step::BranchLinear(s) if element(s.input) == ElementType::I16)));
        assert!(forms(&|s| matches!(s, Step::BranchLinear(s) if element(s.input) == ElementType::I8)));
        assert!(forms(&|s| matches!(s, Step::Sigmoid(s) if element(s.input) == ElementType::I16)));
        assert!(forms(&|s| matches!(s, Step::Sigmoid(s) if element(s.input) == ElementType::I8)));
        let wide_enlargement = |s: &ResizeBilinear| {
            [s.input.tensor, s.output].map(element) == [ElementType::I16; 2] && s.weight_bits == 11
        };
        assert!(forms(&|s| matches!(s, Step::ResizeBilinear(s) if wide_enlargement(s))), "logits stay in 16 bits");
        let in_place = parts.tensors.iter().filter(|tensor| tensor.in_place_of.is_some()).count();
        assert!(in_place >= 3, "{in_place} tensors in place");
    }

    #[test]
    fn the_image_passes_its_self_test() {
        let bytes = AlignedBytes::from(emit(&parts()).unwrap().as_slice());
        let image = Image::parse(&bytes).unwrap();
        let mut arena = AlignedBytes::zeroed(image.arena_bytes() as usize);
        Engine::new(image, Portable, &mut arena).unwrap().self_test().unwrap();
        println!("{} steps, {} bytes, {} operations", image.step_count(), bytes.len(), image.work());
    }
}
