//! ResNet of bottleneck blocks whose last two stages keep the resolution and dilate instead.

use super::builder::Builder;
use super::detect::{common_length, indexed_count};
use crate::error::Result;
use crate::import::NamedTensors;
use crate::ir::{Clip, Op, ValueId};
use firmware::program::Window;

/// Stride of each stage, dilation of its first block and of the others: where the stride became a dilation, the first
/// block still has that of the stage before.
const STAGES: [(u8, u8, u8); 4] = [(1, 1, 1), (2, 1, 1), (1, 1, 2), (1, 2, 4)];

pub(super) struct Bottlenecks {
    prefix: String,
    stem: usize,
    /// Channels inside the blocks, per stage.
    widths: [usize; 4],
    /// Channels between the blocks, per stage.
    outputs: [usize; 4],
    blocks: [usize; 4],
}

impl Bottlenecks {
    /// Sizes of the network under this prefix; what is missing altogether gets the published size.
    pub(super) fn detect(tensors: &NamedTensors, prefix: &str) -> Self {
        let stage = |s: usize| format!("{prefix}.layer{}.", s + 1);
        let common = |s: usize, modules: &[&str]| {
            common_length(tensors, &[&stage(s)], |name| modules.iter().any(|module| name.contains(module)))
        };
        let width = |s| common(s, &[".conv1.", ".bn1.", ".conv2.", ".bn2."]);
        let output = |s| common(s, &[".conv3.", ".bn3.", ".downsample."]);
        let stem = common_length(tensors, &[&format!("{prefix}.conv1."), &format!("{prefix}.bn1.")], |_| true);
        Self {
            prefix: prefix.into(),
            stem: stem.unwrap_or(64),
            widths: std::array::from_fn(|s| width(s).unwrap_or(64 << s)),
            outputs: std::array::from_fn(|s| output(s).unwrap_or(256 << s)),
            blocks: std::array::from_fn(|s| indexed_count(tensors, &stage(s)).max(1)),
        }
    }

    /// The map of the last stage: an eighth of the input's height and width.
    pub(super) fn features(&self, b: &mut Builder<'_>, input: ValueId, channels: usize) -> Result<ValueId> {
        let p = &self.prefix;
        let shape = [self.stem, channels, 7, 7];
        let map = b.conv_bn(&format!("{p}.conv1"), &format!("{p}.bn1"), input, shape, Window::square(7, 2, 3))?;
        let map = b.push(format!("{p}.relu"), Op::Clip(Clip::RELU), &[map])?;
        let mut map = b.push(format!("{p}.maxpool"), Op::MaxPool(Window::square(3, 2, 1)), &[map])?;
        for (s, (stride, first, others)) in STAGES.into_iter().enumerate() {
            for block in 0..self.blocks[s] {
                let module = format!("{p}.layer{}.{block}", s + 1);
                let (stride, dilation) = if block == 0 { (stride, first) } else { (1, others) };
                map = self.block(b, &module, map, s, dilated(stride, dilation))?;
            }
        }
        Ok(map)
    }

    /// `window` is that of the 3×3 convolution.
    fn block(&self, b: &mut Builder<'_>, module: &str, input: ValueId, s: usize, window: Window) -> Result<ValueId> {
        let channels = usize::from(b.graph.value(input).shape.channels);
        let (width, outputs) = (self.widths[s], self.outputs[s]);
        let name = |leaf: &str| format!("{module}.{leaf}");
        let one = Window::square(1, 1, 0);
        let map = b.conv_bn(&name("conv1"), &name("bn1"), input, [width, channels, 1, 1], one)?;
        let map = b.push(name("relu1"), Op::Clip(Clip::RELU), &[map])?;
        let map = b.conv_bn(&name("conv2"), &name("bn2"), map, [width, width, 3, 3], window)?;
        let map = b.push(name("relu2"), Op::Clip(Clip::RELU), &[map])?;
        let map = b.conv_bn(&name("conv3"), &name("bn3"), map, [outputs, width, 1, 1], one)?;
        let skip = if window.stride_h == 1 && channels == outputs {
            input
        } else {
            let shape = [outputs, channels, 1, 1];
            let window = Window::square(1, window.stride_h, 0);
            b.conv_bn(&name("downsample.0"), &name("downsample.1"), input, shape, window)?
        };
        let sum = b.push(name("add"), Op::Add { clip: Clip::NONE }, &[map, skip])?;
        b.push(module, Op::Clip(Clip::RELU), &[sum])
    }
}

/// A 3×3 window whose padding keeps the size but for the stride.
pub(super) fn dilated(stride: u8, dilation: u8) -> Window {
    Window { dilation_h: dilation, dilation_w: dilation, ..Window::square(3, stride, dilation) }
}
