//! Head of DeepLabV3: convolutions of several dilations and the mean of the whole map side by side (atrous spatial
//! pyramid pooling), then one map per class.

use super::bottleneck::dilated;
use super::builder::Builder;
use super::detect::common_length;
use crate::error::Result;
use crate::ir::{Axis, Clip, Op, ValueId};
use firmware::program::Window;

/// Dilations of the 3×3 convolutions.
const DILATIONS: [u8; 3] = [12, 24, 36];
/// Channels of every branch, and maps at the end, as published.
const WIDTH: usize = 256;
const MAPS: usize = 4;

/// From the backbone's last map to logits of the same size.
pub(super) fn head(b: &mut Builder<'_>, module: &str, features: ValueId) -> Result<ValueId> {
    let width = common_length(&b.tensors, &[&format!("{module}.0.")], |_| true).unwrap_or(WIDTH);
    let maps = common_length(&b.tensors, &[&format!("{module}.4.")], |_| true).unwrap_or(MAPS);
    let one = Window::square(1, 1, 0);
    let mut branches = vec![layer(b, &format!("{module}.0.convs.0"), 0, features, width, one)?];
    for (branch, dilation) in (1..).zip(DILATIONS) {
        branches.push(layer(b, &format!("{module}.0.convs.{branch}"), 0, features, width, dilated(1, dilation))?);
    }
    branches.push(pooling(b, &format!("{module}.0.convs.{}", DILATIONS.len() + 1), features, width)?);
    let joined = b.push(format!("{module}.0.join"), Op::Concat(Axis::Channels), &branches)?;
    let map = layer(b, &format!("{module}.0.project"), 0, joined, width, one)?;
    let map = layer(b, module, 1, map, width, Window::square(3, 1, 1))?;
    b.conv_1x1(&format!("{module}.4"), map, maps)
}

/// The mean of the whole map through a layer of its own, the same at every position.
fn pooling(b: &mut Builder<'_>, module: &str, features: ValueId, width: usize) -> Result<ValueId> {
    let size = b.graph.value(features).shape;
    let mean = b.push(format!("{module}.0"), Op::GlobalPool, &[features])?;
    let mean = layer(b, module, 1, mean, width, Window::square(1, 1, 0))?;
    b.push(module, Op::ResizeBilinear { factor: (size.height, size.width) }, &[mean])
}

/// Convolution, batch norm and ReLU: members `first` to `first + 2` of a module.
fn layer(
    b: &mut Builder<'_>,
    module: &str,
    first: usize,
    input: ValueId,
    outputs: usize,
    window: Window,
) -> Result<ValueId> {
    let member = |i: usize| format!("{module}.{}", first + i);
    let side = usize::from(window.kernel_h);
    let shape = [outputs, usize::from(b.graph.value(input).shape.channels), side, side];
    let map = b.conv_bn(&member(0), &member(1), input, shape, window)?;
    b.push(member(2), Op::Clip(Clip::RELU), &[map])
}
