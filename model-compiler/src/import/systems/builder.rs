//! The graph under construction, next to the tensors that it has not used yet.

use super::weights::{Problems, oihw_to_ohwi};
use crate::error::{Error, ErrorCode, Result};
use crate::frames::views::LEVELS;
use crate::import::{ImportOptions, NamedTensors, System};
use crate::ir::{
    BatchNorm, Clip, Conv2d, Graph, InputKind, LayerNorm, Linear, Normalization, Op, Shape, ValueId, Weights,
};
use firmware::program::Window;
use std::sync::Arc;

/// ε of the framework's batch norm and LayerNorm.
const EPSILON: f32 = 1e-5;

/// ImageNet statistics for values 0..1, which the networks apply to values 0..255 without dividing (spec 0.1).
const IMAGE_MEAN: [f32; 3] = [0.485, 0.456, 0.406];
const IMAGE_STD: [f32; 3] = [0.229, 0.224, 0.225];

pub(super) struct Builder<'a> {
    pub(super) graph: Graph,
    pub(super) tensors: NamedTensors,
    pub(super) options: &'a ImportOptions,
    problems: Problems,
}

impl<'a> Builder<'a> {
    pub(super) fn new(name: &str, system: System, tensors: NamedTensors, options: &'a ImportOptions) -> Self {
        let graph = Graph { name: name.into(), system: system.name().into(), ..Graph::default() };
        Self { graph, tensors, options, problems: Problems::default() }
    }

    /// The graph, or everything that is wrong with the tensors, or (only where those are in order) why the recipe
    /// stopped. What is surplus is known only where it ran to its end.
    pub(super) fn finish(mut self, built: Result<()>) -> Result<Graph> {
        if built.is_ok() {
            self.problems.add_surplus(&self.tensors);
        }
        self.problems.into_result(&self.graph.system)?;
        built.map(|()| self.graph)
    }

    /// Adds a node; operands that do not fit make the network unsupported.
    pub(super) fn push(&mut self, name: impl Into<String>, op: Op, inputs: &[ValueId]) -> Result<ValueId> {
        let (name, kind) = (name.into(), op.name());
        self.graph
            .push(&name, op, inputs)
            .map_err(|message| Error::new(ErrorCode::Unsupported, format!("{kind} {name}"), message))
    }

    /// Values of a tensor; zeros where it does not fit (the graph is then refused at the end).
    pub(super) fn vector(&mut self, name: &str, shape: &[usize]) -> Arc<Vec<f32>> {
        let mut values = self.problems.take(&mut self.tensors, name, shape);
        values.resize(shape.iter().product(), 0.0);
        Arc::new(values)
    }

    /// A matrix or higher tensor, kept in the checkpoint's order; without data where it does not fit.
    pub(super) fn weights(&mut self, name: &str, shape: &[usize]) -> Arc<Weights> {
        Arc::new(Weights { shape: shape.to_vec(), data: self.problems.take(&mut self.tensors, name, shape) })
    }

    /// Camera image, normalized.
    pub(super) fn rgb(&mut self, module: &str, (height, width): (u16, u16)) -> Result<ValueId> {
        let input = self.graph.push_input("rgb", InputKind::Image, Shape::map(height, width, 3));
        let normalization = Normalization { mean: IMAGE_MEAN.to_vec(), std: IMAGE_STD.to_vec() };
        self.push(format!("{module}.normalize"), Op::Normalize(Arc::new(normalization)), &[input])
    }

    /// LiDAR histogram; the division of its counts belongs to the input's kind.
    pub(super) fn bev(&mut self, (height, width): (u16, u16), channels: usize) -> ValueId {
        self.graph.push_input("bev", InputKind::Bev, Shape::map(height, width, channels as u16))
    }

    /// Convolution without bias (`shape` is `[O, I, kh, kw]`), then batch norm.
    pub(super) fn conv_bn(
        &mut self,
        conv: &str,
        norm: &str,
        input: ValueId,
        shape: [usize; 4],
        window: Window,
    ) -> Result<ValueId> {
        let values = self.problems.take(&mut self.tensors, &format!("{conv}.weight"), &shape);
        let op = Conv2d {
            weights: oihw_to_ohwi(&values, shape),
            bias: None,
            window,
            groups: 1,
            normalization: None,
            clip: Clip::NONE,
        };
        let map = self.push(conv, Op::Conv2d(op), &[input])?;
        let mut vector = |leaf: &str| self.vector(&format!("{norm}.{leaf}"), &shape[..1]);
        let op = BatchNorm {
            weight: vector("weight"),
            bias: vector("bias"),
            mean: vector("running_mean"),
            variance: vector("running_var"),
            epsilon: EPSILON,
        };
        self.push(norm, Op::BatchNorm(op), &[map])
    }

    /// Weights and bias of a 1×1 convolution: a linear layer for each position.
    pub(super) fn pointwise(&mut self, module: &str, inputs: usize, outputs: usize) -> Linear {
        let weights = self.weights(&format!("{module}.weight"), &[outputs, inputs, 1, 1]);
        let weights = Weights { shape: vec![outputs, inputs], data: Arc::unwrap_or_clone(weights).data };
        let bias = Some(self.vector(&format!("{module}.bias"), &[outputs]));
        Linear { weights: Arc::new(weights), bias, clip: Clip::NONE }
    }

    /// Batch norm that was trained on values 0..=1, over grey levels 0..=255: all its statistics are times 255.
    pub(super) fn grey_norm(&mut self, module: &str, input: ValueId) -> Result<ValueId> {
        let channels = [usize::from(self.graph.value(input).shape.channels)];
        let mut vector = |leaf: &str| self.vector(&format!("{module}.{leaf}"), &channels);
        let scaled = |values: Arc<Vec<f32>>, factor: f32| Arc::new(values.iter().map(|v| v * factor).collect());
        let op = BatchNorm {
            weight: vector("weight"),
            bias: vector("bias"),
            mean: scaled(vector("running_mean"), LEVELS),
            variance: scaled(vector("running_var"), LEVELS * LEVELS),
            epsilon: EPSILON * LEVELS * LEVELS,
        };
        self.push(module, Op::BatchNorm(op), &[input])
    }

    /// 1×1 convolution with bias: a linear layer for each position.
    pub(super) fn conv_1x1(&mut self, module: &str, input: ValueId, outputs: usize) -> Result<ValueId> {
        let inputs = usize::from(self.graph.value(input).shape.channels);
        let op = self.pointwise(module, inputs, outputs);
        self.push(module, Op::Linear(op), &[input])
    }

    /// The mean of equal windows, one for each of so many rows and columns, which divide the map's; a map of that size
    /// stays as it is.
    pub(super) fn pooled_to(
        &mut self,
        name: impl Into<String>,
        map: ValueId,
        (rows, columns): (u16, u16),
    ) -> Result<ValueId> {
        let size = self.graph.value(map).shape;
        let (height, width) = (size.height / rows, size.width / columns);
        if (height, width) == (1, 1) {
            return Ok(map);
        }
        let name = name.into();
        let (Ok(kernel_h), Ok(kernel_w)) = (u8::try_from(height), u8::try_from(width)) else {
            let message = format!("found windows of {height}×{width}, expected at most {0}×{0}", u8::MAX);
            return Err(Error::new(ErrorCode::Unsupported, format!("average_pool {name}"), message));
        };
        let window = Window { kernel_h, kernel_w, stride_h: kernel_h, stride_w: kernel_w, ..Window::square(1, 1, 0) };
        self.push(name, Op::AveragePool(window), &[map])
    }

    /// A map enlarged to a height and width, multiples of its own; one of that size stays as it is.
    pub(super) fn enlarged_to(
        &mut self,
        name: impl Into<String>,
        map: ValueId,
        (height, width): (u16, u16),
    ) -> Result<ValueId> {
        let size = self.graph.value(map).shape;
        let factor = (height / size.height, width / size.width);
        if factor == (1, 1) {
            return Ok(map);
        }
        self.push(name, Op::ResizeBilinear { factor }, &[map])
    }

    /// Linear layer with bias.
    pub(super) fn linear(&mut self, module: &str, input: ValueId, outputs: usize) -> Result<ValueId> {
        let inputs = usize::from(self.graph.value(input).shape.channels);
        let linear = self.linear_weights(module, inputs, outputs);
        self.push(module, Op::Linear(linear), &[input])
    }

    /// Weights and bias of a linear layer.
    pub(super) fn linear_weights(&mut self, module: &str, inputs: usize, outputs: usize) -> Linear {
        let weights = self.weights(&format!("{module}.weight"), &[outputs, inputs]);
        let bias = Some(self.vector(&format!("{module}.bias"), &[outputs]));
        Linear { weights, bias, clip: Clip::NONE }
    }

    /// Weight and bias of a LayerNorm, for rows `first_row ..` as a map of `grid`.
    pub(super) fn layer_norm(&mut self, module: &str, channels: usize, grid: (u16, u16)) -> LayerNorm {
        LayerNorm {
            weight: self.vector(&format!("{module}.weight"), &[channels]),
            bias: self.vector(&format!("{module}.bias"), &[channels]),
            epsilon: EPSILON,
            first_row: 0,
            grid,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn maps_are_pooled_and_enlarged_to_a_size_unless_they_have_it() {
        let options = ImportOptions::default();
        let mut b = Builder::new("m", System::TransFuser, NamedTensors::default(), &options);
        let map = b.graph.push_input("map", InputKind::Image, Shape::map(8, 6, 3));
        let pooled = b.pooled_to("pooled", map, (2, 6)).unwrap();
        assert_eq!(b.graph.value(pooled).shape, Shape::map(2, 6, 3));
        let enlarged = b.enlarged_to("enlarged", pooled, (8, 12)).unwrap();
        assert_eq!(b.graph.value(enlarged).shape, Shape::map(8, 12, 3));
        assert_eq!(b.pooled_to("same", map, (8, 6)).unwrap(), map);
        assert_eq!(b.enlarged_to("same", map, (8, 6)).unwrap(), map);
        let high = b.graph.push_input("high", InputKind::Image, Shape::map(256, 1, 3));
        assert_eq!(
            b.pooled_to("column", high, (1, 1)).unwrap_err().to_string(),
            "average_pool column: found windows of 256×1, expected at most 255×255"
        );
    }
}
