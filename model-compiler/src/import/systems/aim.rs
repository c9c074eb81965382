//! AIM: the camera image alone.

use super::builder::Builder;
use super::{DEFAULT_RESOLUTION, has, head, resnet::ResNet};
use crate::error::Result;
use crate::import::NamedTensors;
use crate::ir::Op;

pub(super) fn recognize(tensors: &NamedTensors) -> bool {
    has(tensors, "image_encoder.features.")
}

pub(super) fn build(b: &mut Builder<'_>) -> Result<()> {
    let resolution = b.options.resolution.unwrap_or(DEFAULT_RESOLUTION);
    let network = ResNet::detect(&b.tensors, "image_encoder.features", None);
    let rgb = b.rgb("image_encoder", resolution)?;
    let mut map = network.stem(b, rgb, 3)?;
    for stage in 1..=4 {
        map = network.stage(b, stage, map)?;
    }
    let features = b.push("image_encoder", Op::GlobalPool, &[map])?;
    head::waypoints(b, features, 4)
}
