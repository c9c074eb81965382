//! Random small classifiers: every operator that such networks use, in shapes that nobody would choose by hand. The
//! graph is a function of its seed.

use crate::random::Random;
use firmware::program::Window;
use firmware::tensor::Shape;
use model_compiler::frames::{ByteMap, Frame};
use model_compiler::ir::{
    Axis, BatchNorm, Clip, Conv2d, Graph, InputKind, Linear, Normalization, Op, Pad, Slice, ValueId, Weights,
};
use std::sync::Arc;

/// Most elements of a map.
const MAX_ELEMENTS: u64 = 4096;

/// A graph as an importer leaves it, before the passes.
///
/// # Panics
/// Never: operators are drawn to fit.
pub fn graph(seed: u64) -> Graph {
    let mut random = Random::new(seed);
    let shape = Shape::map(8 + random.below(7) as u16, 8 + random.below(7) as u16, 3);
    let mut graph = Graph { name: format!("random {seed}"), ..Default::default() };
    let rgb = graph.push_input("rgb", InputKind::Image, shape);
    let mut drawing = Drawing { graph, random, maps: Vec::new() };
    drawing.stem(rgb);
    for _ in 0..4 + drawing.random.below(9) {
        drawing.grow();
    }
    drawing.head();
    drawing.graph
}

/// Random images of the graph's size, smooth enough that the networks see more than noise.
///
/// # Panics
/// The graph has no input.
pub fn frames(graph: &Graph, seed: u64, count: usize) -> Vec<Frame> {
    let mut random = Random::new(seed);
    let (input, _) = graph.inputs().next().expect("an input");
    let shape = graph.value(input).shape;
    let frame = |i: usize| {
        let mut values = [128.0_f32; 3];
        let mut pixel = |channel: usize| {
            values[channel] = (values[channel] + 60.0 * random.signed_unit()).clamp(0.0, 255.0);
            values[channel] as u8
        };
        let data = (0..shape.elements() as usize).map(|element| pixel(element % 3)).collect();
        Frame { name: format!("random {i} of seed {seed}"), rgb: Some(ByteMap { shape, data }), ..Frame::default() }
    };
    (0..count).map(frame).collect()
}

struct Drawing {
    graph: Graph,
    random: Random,
    /// Maps to go on from.
    maps: Vec<ValueId>,
}

impl Drawing {
    fn push(&mut self, op: Op, inputs: &[ValueId]) -> ValueId {
        let name = format!("{}.{}", self.graph.nodes.len(), op.name());
        self.graph.push(name, op, inputs).unwrap_or_else(|e| panic!("{}: {e}", self.graph.name))
    }

    fn shape(&self, value: ValueId) -> Shape {
        self.graph.value(value).shape
    }

    fn between(&mut self, low: u16, high: u16) -> u16 {
        low + self.random.below(usize::from(high - low) + 1) as u16
    }

    fn flag(&mut self) -> bool {
        self.random.below(2) == 1
    }

    /// A map to go on from, rather a late one.
    fn map(&mut self) -> ValueId {
        let recent = self.maps.len().saturating_sub(3);
        let all = self.maps.clone();
        if self.random.below(4) == 0 { *self.random.pick(&all) } else { *self.random.pick(&all[recent..]) }
    }

    /// Bounds as networks have them: ReLU, ReLU6 and its kind, none.
    fn bounds(&mut self) -> Clip {
        match self.random.below(4) {
            0 => Clip { min: -1.0, max: 1.0 },
            1 => Clip { min: 0.0, max: 1.5 },
            _ => Clip::RELU,
        }
    }

    fn values(&mut self, count: usize, amplitude: f32) -> Vec<f32> {
        (0..count).map(|_| amplitude * self.random.signed_unit()).collect()
    }

    /// Weights that keep the magnitude of their input.
    fn weights(&mut self, shape: Vec<usize>) -> Arc<Weights> {
        let count = shape.iter().product();
        let data = self.values(count, 2.0 * (shape[0] as f32 / count as f32).sqrt());
        Arc::new(Weights { shape, data })
    }

    fn bias(&mut self, count: usize) -> Option<Arc<Vec<f32>>> {
        self.flag().then(|| Arc::new(self.values(count, 0.3)))
    }

    fn stem(&mut self, rgb: ValueId) {
        let normalization = Normalization { mean: vec![124.0, 116.0, 104.0], std: vec![58.0, 57.0, 57.5] };
        let channels = 2 * self.between(2, 5);
        let window = self.window(self.shape(rgb));
        let conv = self.convolution(3, channels, 1, window);
        let conv = Conv2d { normalization: Some(Arc::new(normalization)), ..conv };
        let stem = self.push(Op::Conv2d(conv), &[rgb]);
        let stem = self.normalized(stem);
        self.maps.push(stem);
    }

    /// A window that fits, with paddings of its own on every side and sometimes dilation.
    fn window(&mut self, shape: Shape) -> Window {
        let [kernel_h, kernel_w] = [shape.height, shape.width].map(|size| self.between(1, size.min(3)) as u8);
        let mut pad = |kernel: u8| self.between(0, u16::from(kernel) - 1) as u8;
        let (pad_top, pad_bottom, pad_left, pad_right) = (pad(kernel_h), pad(kernel_h), pad(kernel_w), pad(kernel_w));
        let [stride_h, stride_w] = [(); 2].map(|()| 1 + u8::from(self.random.below(4) == 0));
        let fits = |kernel: u8, size: u16| 2 * (u16::from(kernel) - 1) < size;
        let dilation = 1 + u8::from(self.random.below(4) == 0);
        let dilation_h = if fits(kernel_h, shape.height) { dilation } else { 1 };
        let dilation_w = if fits(kernel_w, shape.width) { dilation } else { 1 };
        Window {
            kernel_h,
            kernel_w,
            stride_h,
            stride_w,
            pad_top,
            pad_bottom,
            pad_left,
            pad_right,
            dilation_h,
            dilation_w,
        }
    }

    fn convolution(&mut self, inputs: u16, outputs: u16, groups: u16, window: Window) -> Conv2d {
        let shape = [outputs, window.kernel_h.into(), window.kernel_w.into(), inputs / groups].map(usize::from);
        let weights = self.weights(shape.to_vec());
        let bias = self.bias(outputs.into());
        Conv2d { weights, bias, window, groups, normalization: None, clip: Clip::NONE }
    }

    /// A convolution, dense, grouped or depthwise, to this many channels (or as many as the groups make of them).
    fn conv(&mut self, input: ValueId, outputs: u16, window: Window) -> ValueId {
        let channels = self.shape(input).channels;
        let groups = match self.random.below(3) {
            0 => channels,
            1 if channels.is_multiple_of(2) => 2,
            _ => 1,
        };
        let conv = self.convolution(channels, outputs.div_ceil(groups) * groups, groups, window);
        self.push(Op::Conv2d(conv), &[input])
    }

    /// What follows a convolution: batch norm or not, bounds or not.
    fn normalized(&mut self, value: ValueId) -> ValueId {
        if self.flag() {
            return self.bounded(value);
        }
        let channels = usize::from(self.shape(value).channels);
        let mut vector =
            |center: f32| Arc::new(self.values(channels, 0.4).iter().map(|v| center + v).collect::<Vec<_>>());
        let (weight, bias, mean, variance) = (vector(1.0), vector(0.0), vector(0.0), vector(1.0));
        let norm = self.push(Op::BatchNorm(BatchNorm { weight, bias, mean, variance, epsilon: 1e-5 }), &[value]);
        self.bounded(norm)
    }

    /// Bounds or not.
    fn bounded(&mut self, value: ValueId) -> ValueId {
        if self.random.below(4) == 0 {
            return value;
        }
        let bounds = self.bounds();
        self.push(Op::Clip(bounds), &[value])
    }

    /// One more map.
    fn grow(&mut self) {
        let map = self.map();
        let shape = self.shape(map);
        let outputs = self.between(2, 9);
        let grown = match self.random.below(10) {
            0 | 1 => {
                let window = self.window(shape);
                let conv = self.conv(map, outputs, window);
                self.normalized(conv)
            }
            2 => self.residual_block(map),
            3 => {
                let window = Window { dilation_h: 1, dilation_w: 1, ..self.window(shape) };
                self.push(Op::MaxPool(window), &[map])
            }
            4 => {
                let window = Window { dilation_h: 1, dilation_w: 1, ..self.window(shape) };
                let full = Window { pad_top: 0, pad_bottom: 0, pad_left: 0, pad_right: 0, ..window };
                self.push(Op::AveragePool(full), &[map])
            }
            5 => self.slice(map),
            6 => {
                let [before, after] = [(); 2].map(|()| [(); 3].map(|()| self.between(0, 2)));
                let value = if self.flag() { 0.0 } else { 0.5 * self.random.signed_unit() };
                self.push(Op::Pad(Pad { before, after, value }), &[map])
            }
            7 | 8 => self.concat(map),
            _ => self.push(Op::ResizeBilinear { factor: (2, 2) }, &[map]),
        };
        let grown = if self.random.below(3) == 0 { self.bounded(grown) } else { grown };
        if self.shape(grown).elements() <= MAX_ELEMENTS {
            self.maps.push(grown);
        }
    }

    /// A convolution of the same size, added to its input.
    fn residual_block(&mut self, map: ValueId) -> ValueId {
        let channels = self.shape(map).channels;
        let conv = self.convolution(channels, channels, 1, Window::square(3, 1, 1));
        let branch = self.push(Op::Conv2d(conv), &[map]);
        let operands = if self.flag() { [branch, map] } else { [map, branch] };
        let sum = self.push(Op::Add { clip: Clip::NONE }, &operands);
        self.bounded(sum)
    }

    fn slice(&mut self, map: ValueId) -> ValueId {
        let Shape { height, width, channels } = self.shape(map);
        let axes = [height, width, channels].map(|size| {
            let begin = self.between(0, (size - 1) / 2);
            (begin, self.between(begin + 1, size).max(size.min(begin + 3)), self.between(1, 2))
        });
        let slice = Slice { begin: axes.map(|a| a.0), end: axes.map(|a| a.1), stride: axes.map(|a| a.2) };
        self.push(Op::Slice(slice), &[map])
    }

    /// The map and up to three others of its kind along a random axis.
    fn concat(&mut self, map: ValueId) -> ValueId {
        let axis = *self.random.pick(&[Axis::Height, Axis::Width, Axis::Channels]);
        let channels = self.shape(map).channels;
        let mut operands = vec![map];
        for _ in 0..self.between(1, 3) {
            let other = match self.random.below(3) {
                0 => self.push(Op::MaxPool(Window::square(3, 1, 1)), &[map]),
                1 => {
                    let conv = self.convolution(channels, channels, 1, Window::square(3, 1, 1));
                    let conv = self.push(Op::Conv2d(conv), &[map]);
                    self.normalized(conv)
                }
                _ => map,
            };
            let at = self.random.below(operands.len() + 1);
            operands.insert(at, other);
        }
        self.push(Op::Concat(axis), &operands)
    }

    /// Vectors of one or two maps, linear layers, probabilities or not; a convolution over a vector now and then.
    fn head(&mut self) {
        let last = *self.maps.last().expect("the stem is a map");
        let mut vector = self.push(Op::GlobalPool, &[last]);
        if self.flag() {
            let map = self.map();
            let second = self.push(Op::GlobalPool, &[map]);
            vector = self.push(Op::Concat(Axis::Channels), &[vector, second]);
        }
        for _ in 0..self.between(1, 2) {
            let outputs = usize::from(self.between(3, 12));
            let channels = self.shape(vector).channels;
            vector = if self.random.below(3) == 0 {
                let conv = self.convolution(channels, outputs as u16, 1, Window::square(1, 1, 0));
                self.push(Op::Conv2d(conv), &[vector])
            } else {
                let (weights, bias) = (self.weights(vec![outputs, channels.into()]), self.bias(outputs));
                self.push(Op::Linear(Linear { weights, bias, clip: Clip::NONE }), &[vector])
            };
            if self.flag() {
                let bounds = self.bounds();
                vector = self.push(Op::Clip(bounds), &[vector]);
            }
        }
        if self.flag() {
            vector = self.push(Op::Softmax, &[vector]);
        }
        self.graph.outputs.push(vector);
        if self.random.below(3) == 0 {
            let map = self.map();
            self.graph.outputs.push(map);
        }
    }
}
