//! How the inputs of each weight vary together: the covariance of what the layers read, in integer codes.
//!
//! All sums are of integers below 2^53, so they are exact in any order, on any machine.

use super::types::{Stored, Types};
use crate::error::Result;
use crate::ir::{Conv2d, Graph, Linear, Node, Op, Shape, ValueId, Weights};
use crate::reference;
use firmware::program::Window;
use ndarray::linalg::general_mat_mul;
use ndarray::{Array2, ArrayView2};
use rayon::prelude::*;
use std::collections::HashMap;
use std::sync::Arc;

/// The work of a factorization grows with the cube of the depth; deeper layers are left alone.
const DEEPEST: usize = 1152;
/// Fewer samples per weight of an output and the covariance tells more about the samples than about the layer.
const FEWEST_SAMPLES: usize = 8;
/// More samples per weight change little.
const MOST_SAMPLES: usize = 16;
/// Frames looked at, evenly spaced among those given.
const MOST_FRAMES: usize = 128;

/// Sums over the samples of one group of output channels.
#[derive(Clone, Debug)]
struct Sums {
    products: Array2<f64>,
    codes: Vec<f64>,
}

/// What one layer reads.
struct Reader<'a> {
    node: &'a Node,
    shape: Shape,
    stored: Stored,
    window: Window,
    groups: usize,
    /// Code that stands in the padding, per input channel.
    padding: Vec<f64>,
    /// Every how many positions a sample is taken.
    step: usize,
    samples: usize,
    /// Per group.
    sums: Vec<Sums>,
}

/// What was measured of one layer.
struct Measured<'a> {
    node: &'a Node,
    /// Scale of the codes.
    scale: f64,
    samples: usize,
    /// Per group.
    covariances: Vec<Array2<f64>>,
}

impl Measured<'_> {
    /// The covariance over all layers that share this one's weights: such weights are rounded once, so
    /// that they are stored once.
    fn with_sharers(&self, all: &[Measured<'_>]) -> Vec<Array2<f64>> {
        let sharers: Vec<_> = all.iter().filter(|other| weights(other.node) == weights(self.node)).collect();
        if sharers.len() == 1 {
            return self.covariances.clone();
        }
        // In real units, divided by the same numbers for each of the sharers: they get the same bits.
        let total: f64 = sharers.iter().map(|layer| layer.samples as f64).sum();
        let of_group = |group: usize| {
            let mut sum = Array2::zeros(self.covariances[group].dim());
            for layer in &sharers {
                let weight = layer.samples as f64 * layer.scale * layer.scale / total;
                sum.scaled_add(weight, &layer.covariances[group]);
            }
            sum
        };
        (0..self.covariances.len()).map(of_group).collect()
    }
}

/// The weights of a layer, by identity.
fn weights(node: &Node) -> Option<*const Weights> {
    match &node.op {
        Op::Conv2d(conv) => Some(Arc::as_ptr(&conv.weights)),
        Op::Linear(linear) => Some(Arc::as_ptr(&linear.weights)),
        _ => None,
    }
}

/// Covariance of the inputs of every layer that has samples enough: by the layer's output, a matrix per group.
#[derive(Clone, Debug, Default)]
pub struct Covariances {
    of: HashMap<ValueId, Vec<Array2<f64>>>,
}

impl Covariances {
    /// Runs f32 over the frames (raw inputs per frame, in graph order) and rounds what the layers read as they will.
    ///
    /// # Errors
    /// A frame that the graph refuses.
    pub fn measure(graph: &Graph, frames: &[Vec<Vec<f32>>], types: &Types) -> Result<Self> {
        let frames: Vec<_> = frames.iter().step_by(frames.len().div_ceil(MOST_FRAMES).max(1)).collect();
        let readers = graph.nodes.iter().filter_map(|node| Reader::new(graph, node, types, frames.len()));
        let mut readers: Vec<Reader<'_>> = readers.collect();
        for frame in frames {
            let mut values: HashMap<ValueId, Vec<f32>> = HashMap::new();
            let is_read = |id| readers.iter().any(|reader| reader.node.inputs[0] == id);
            reference::run(graph, frame, |node, data| {
                if is_read(node.output) {
                    values.insert(node.output, data.to_vec());
                }
            })?;
            readers.par_iter_mut().for_each(|reader| reader.add(&values[&reader.node.inputs[0]]));
        }
        let measured: Vec<Measured<'_>> = readers.into_iter().map(Reader::measured).collect();
        let of = measured.iter().map(|layer| (layer.node.output, layer.with_sharers(&measured))).collect();
        Ok(Self { of })
    }

    /// The matrices of a layer, `depth × depth` in squared codes (or another unit common to the layer), one per group;
    /// `None` where they are not known.
    pub fn of(&self, output: ValueId) -> Option<&[Array2<f64>]> {
        self.of.get(&output).map(Vec::as_slice)
    }
}

impl<'a> Reader<'a> {
    /// `None` for what has no weights, too many, or too few samples.
    fn new(graph: &Graph, node: &'a Node, types: &Types, frames: usize) -> Option<Self> {
        let input = *node.inputs.first()?;
        let shape = graph.value(input).shape;
        let output = graph.value(node.output).shape;
        let (stored, window, groups, normalization) = match &node.op {
            Op::Conv2d(Conv2d { window, groups, normalization, .. }) => {
                (types.narrow(input), *window, usize::from(*groups), normalization.as_deref())
            }
            Op::Linear(Linear { .. }) => (types.of(input), Window::square(1, 1, 0), 1, None),
            _ => return None,
        };
        let channels = usize::from(shape.channels);
        let padding = match normalization {
            Some(n) => n.mean.iter().map(|&mean| stored.code(f64::from(mean))).collect(),
            None => vec![0.0; channels],
        };
        let depth = usize::from(window.kernel_h) * usize::from(window.kernel_w) * channels / groups;
        let positions = usize::from(output.height) * usize::from(output.width);
        let samples = frames * positions;
        if depth > DEEPEST || samples < FEWEST_SAMPLES * depth {
            return None;
        }
        let step = (samples / (MOST_SAMPLES * depth)).clamp(1, positions);
        let sums = Sums { products: Array2::zeros((depth, depth)), codes: vec![0.0; depth] };
        let stored = *stored;
        Some(Self { node, shape, stored, window, groups, padding, step, samples: 0, sums: vec![sums; groups] })
    }

    fn add(&mut self, data: &[f32]) {
        let codes: Vec<f64> = data.iter().map(|&x| self.stored.code(f64::from(x))).collect();
        let w = &self.window;
        let fits = |size: u16, pads: [u8; 2], kernel: u8, dilation: u8, stride: u8| {
            let reach = usize::from(dilation) * (usize::from(kernel) - 1) + 1;
            (usize::from(size) + usize::from(pads[0]) + usize::from(pads[1]) - reach) / usize::from(stride) + 1
        };
        let rows = fits(self.shape.height, [w.pad_top, w.pad_bottom], w.kernel_h, w.dilation_h, w.stride_h);
        let columns = fits(self.shape.width, [w.pad_left, w.pad_right], w.kernel_w, w.dilation_w, w.stride_w);
        // Another first position in every frame, so that no column of the map is passed over.
        let first = self.samples % self.step;
        let positions: Vec<usize> = (first..rows * columns).step_by(self.step).collect();
        for group in 0..self.groups {
            let mut samples = Vec::with_capacity(positions.len() * self.sums[group].codes.len());
            positions.iter().for_each(|p| self.gather(&codes, p / columns, p % columns, group, &mut samples));
            let Sums { products, codes } = &mut self.sums[group];
            let samples = ArrayView2::from_shape((positions.len(), codes.len()), &samples).expect("whole samples");
            general_mat_mul(1.0, &samples.t(), &samples, 1.0, products);
            samples.rows().into_iter().for_each(|row| row.iter().zip(&mut *codes).for_each(|(x, sum)| *sum += x));
        }
        self.samples += positions.len();
    }

    /// Appends `[kh][kw][C/groups]` of one output position.
    fn gather(&self, codes: &[f64], row: usize, column: usize, group: usize, samples: &mut Vec<f64>) {
        let w = &self.window;
        let channels = usize::from(self.shape.channels);
        let of_group = group * channels / self.groups..(group + 1) * channels / self.groups;
        let tap = |out: usize, stride: u8, tap: u8, dilation: u8, pad: u8, size: u16| {
            let place = out * usize::from(stride) + usize::from(tap) * usize::from(dilation);
            place.checked_sub(usize::from(pad)).filter(|&place| place < usize::from(size))
        };
        for tap_y in 0..w.kernel_h {
            let y = tap(row, w.stride_h, tap_y, w.dilation_h, w.pad_top, self.shape.height);
            for tap_x in 0..w.kernel_w {
                let x = tap(column, w.stride_w, tap_x, w.dilation_w, w.pad_left, self.shape.width);
                samples.extend_from_slice(match (y, x) {
                    (Some(y), Some(x)) => {
                        &codes[(y * usize::from(self.shape.width) + x) * channels..][of_group.clone()]
                    }
                    _ => &self.padding[of_group.clone()],
                });
            }
        }
    }

    fn measured(self) -> Measured<'a> {
        let n = self.samples as f64;
        let covariance = |sums: Sums| {
            let mean: Vec<f64> = sums.codes.iter().map(|sum| sum / n).collect();
            Array2::from_shape_fn(sums.products.dim(), |(i, j)| sums.products[[i, j]] / n - mean[i] * mean[j])
        };
        let covariances = self.sums.into_iter().map(covariance).collect();
        Measured { node: self.node, scale: self.stored.scale, samples: self.samples, covariances }
    }
}

#[cfg(test)]
mod tests {
    use super::super::{QuantizeOptions, types};
    use super::*;
    use crate::calibrate::calibrate;
    use crate::ir::{Clip, InputKind};

    /// A convolution of two taps, padded on the left, over a map of one row and `width` columns.
    fn graph(width: u16) -> Graph {
        let mut graph = Graph::default();
        let x = graph.push_input("x", InputKind::Image, Shape::map(1, width, 1));
        let window = Window { kernel_w: 2, pad_left: 1, pad_right: 0, ..Window::square(1, 1, 0) };
        let conv = Conv2d {
            weights: Arc::new(Weights { shape: vec![1, 1, 2, 1], data: vec![0.3, -1.0] }),
            bias: None,
            window,
            groups: 1,
            normalization: None,
            clip: Clip::NONE,
        };
        let y = graph.push("y", Op::Conv2d(conv), &[x]).unwrap();
        graph.outputs = vec![y];
        graph
    }

    fn measured(graph: &Graph, frames: &[Vec<Vec<f32>>]) -> Covariances {
        let statistics = calibrate(graph, frames, |_, _| {}).unwrap();
        let types = types::assign(graph, &statistics, &QuantizeOptions::default()).unwrap();
        Covariances::measure(graph, frames, &types).unwrap()
    }

    #[test]
    fn windows_of_all_frames_count_with_their_padding() {
        // Windows (0, 10), (10, 30) and (0, 50), (50, 20); as often again, to have samples enough.
        let frame = |a: f32, b: f32| vec![vec![a, b]];
        let frames: Vec<_> = [frame(10.0, 30.0), frame(50.0, 20.0)].into_iter().cycle().take(16).collect();
        let graph = graph(2);
        let found = measured(&graph, &frames);
        let windows = [[0.0, 10.0], [10.0, 30.0], [0.0, 50.0], [50.0, 20.0]];
        let mean = |f: &dyn Fn(&[f64; 2]) -> f64| windows.iter().map(f).sum::<f64>() / 4.0;
        let matrix = &found.of(graph.outputs[0]).unwrap()[0];
        for ((i, j), &value) in matrix.indexed_iter() {
            let expected = mean(&|w| w[i] * w[j]) - mean(&|w| w[i]) * mean(&|w| w[j]);
            assert!((value - expected).abs() < 1e-9, "{i}, {j}: {value}, expected {expected}");
        }
    }

    #[test]
    fn layers_that_share_their_weights_get_one_covariance() {
        let mut graph = graph(2);
        let Op::Conv2d(conv) = graph.nodes[1].op.clone() else { unreachable!("the second node") };
        let (x, first) = (graph.nodes[0].output, graph.nodes[1].output);
        let second = graph.push("second", Op::Conv2d(conv.clone()), &[first]).unwrap();
        let copy = Conv2d { weights: Arc::new((*conv.weights).clone()), ..conv };
        let other = graph.push("other", Op::Conv2d(copy), &[x]).unwrap();
        graph.outputs.extend([second, other]);
        let frames: Vec<_> = (0..16).map(|i| vec![vec![(i * 37 % 100) as f32, (i * 11 % 90) as f32]]).collect();
        let found = measured(&graph, &frames);
        assert_eq!(found.of(first), found.of(second));
        assert_ne!(found.of(first), found.of(other), "equal weights are not shared ones");
    }

    #[test]
    fn a_layer_of_few_samples_is_left_alone() {
        let (narrow, wide) = (graph(2), graph(16));
        assert!(measured(&narrow, &vec![vec![vec![1.0, 2.0]]; 7]).of(narrow.outputs[0]).is_none());
        assert!(measured(&wide, &[vec![vec![3.0; 16]]]).of(wide.outputs[0]).is_some());
    }
}
