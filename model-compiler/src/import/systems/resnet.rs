//! ResNet of basic blocks: stem, then four stages.

use super::builder::Builder;
use super::detect::{common_length, indexed_count};
use crate::error::{Error, ErrorCode, Result};
use crate::import::NamedTensors;
use crate::ir::{Clip, Op, ValueId};
use firmware::program::Window;

/// Channels the LiDAR histogram has in the published networks: below and above the height threshold.
const LIDAR_CHANNELS: usize = 2;

/// Pixels per position of the last stage: the networks halve the resolution five times.
pub(super) const TOTAL_STRIDE: u16 = 32;

/// Size of the last stage's map, which divides the maps of all stages by 8, 4, 2, 1: the grid that fusion works on.
/// `parts` are what it consists of, for the message.
pub(super) fn grid((height, width): (u16, u16), parts: &str) -> Result<(u16, u16)> {
    let (rows, columns) = (height / TOTAL_STRIDE, width / TOTAL_STRIDE);
    if rows == 0 || columns == 0 || height % TOTAL_STRIDE != 0 || width % TOTAL_STRIDE != 0 {
        let message = format!("an input of {height}×{width} pixels does not divide into {parts}");
        return Err(Error::new(ErrorCode::Usage, "", message)
            .with_help(format!("height and width must be multiples of {TOTAL_STRIDE} pixels")));
    }
    Ok((rows, columns))
}

pub(super) struct ResNet {
    prefix: String,
    stem: usize,
    /// Channels per stage.
    pub(super) widths: [usize; 4],
    blocks: [usize; 4],
}

impl ResNet {
    /// Sizes of the network under this prefix. What is missing altogether gets the size of the network under the
    /// `sibling` prefix, or the published one.
    pub(super) fn detect(tensors: &NamedTensors, prefix: &str, sibling: Option<&str>) -> Self {
        let networks = || [Some(prefix), sibling].into_iter().flatten();
        let stem = |p: &str| common_length(tensors, &[&format!("{p}.conv1."), &format!("{p}.bn1.")], |_| true);
        let stage = |p: &str, s: usize| common_length(tensors, &[&format!("{p}.layer{}.", s + 1)], |_| true);
        let blocks = |s: usize| indexed_count(tensors, &format!("{prefix}.layer{}.", s + 1)).max(1);
        Self {
            prefix: prefix.into(),
            stem: networks().find_map(stem).unwrap_or(64),
            widths: std::array::from_fn(|s| networks().find_map(|p| stage(p, s)).unwrap_or(64 << s)),
            blocks: std::array::from_fn(blocks),
        }
    }

    /// Channels of the histogram that the first convolution reads.
    pub(super) fn lidar_channels(&self, tensors: &NamedTensors) -> usize {
        let weight = tensors.get(&format!("{}.conv1.weight", self.prefix));
        match weight.map(|w| &w.shape[..]) {
            Some(&[_, channels @ 1..=64, _, _]) => channels,
            _ => LIDAR_CHANNELS,
        }
    }

    /// Convolution 7×7 of stride 2, ReLU, max pool of stride 2.
    pub(super) fn stem(&self, b: &mut Builder<'_>, input: ValueId, channels: usize) -> Result<ValueId> {
        let p = &self.prefix;
        let shape = [self.stem, channels, 7, 7];
        let map = b.conv_bn(&format!("{p}.conv1"), &format!("{p}.bn1"), input, shape, Window::square(7, 2, 3))?;
        let map = b.push(format!("{p}.relu"), Op::Clip(Clip::RELU), &[map])?;
        b.push(format!("{p}.maxpool"), Op::MaxPool(Window::square(3, 2, 1)), &[map])
    }

    /// The blocks of stage 1..=4; all but the first stage halve the resolution.
    pub(super) fn stage(&self, b: &mut Builder<'_>, stage: usize, mut map: ValueId) -> Result<ValueId> {
        for block in 0..self.blocks[stage - 1] {
            let stride = if stage > 1 && block == 0 { 2 } else { 1 };
            let module = format!("{}.layer{stage}.{block}", self.prefix);
            map = self.block(b, &module, map, self.widths[stage - 1], stride)?;
        }
        Ok(map)
    }

    fn block(&self, b: &mut Builder<'_>, module: &str, input: ValueId, width: usize, stride: u8) -> Result<ValueId> {
        let channels = usize::from(b.graph.value(input).shape.channels);
        let name = |leaf: &str| format!("{module}.{leaf}");
        let shape = [width, channels, 3, 3];
        let map = b.conv_bn(&name("conv1"), &name("bn1"), input, shape, Window::square(3, stride, 1))?;
        let map = b.push(name("relu"), Op::Clip(Clip::RELU), &[map])?;
        let map = b.conv_bn(&name("conv2"), &name("bn2"), map, [width, width, 3, 3], Window::square(3, 1, 1))?;
        let skip = if stride == 1 && channels == width {
            input
        } else {
            let shape = [width, channels, 1, 1];
            b.conv_bn(&name("downsample.0"), &name("downsample.1"), input, shape, Window::square(1, stride, 0))?
        };
        let sum = b.push(name("add"), Op::Add { clip: Clip::NONE }, &[map, skip])?;
        b.push(module, Op::Clip(Clip::RELU), &[sum])
    }
}
