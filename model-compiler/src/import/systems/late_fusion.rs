//! Late Fusion: camera and LiDAR networks side by side, their features added.

use super::builder::Builder;
use super::{DEFAULT_RESOLUTION, has, head, resnet::ResNet};
use crate::error::Result;
use crate::import::NamedTensors;
use crate::ir::Op;

const IMAGE: &str = "image_encoder.features";
const LIDAR: &str = "lidar_encoder._model";

pub(super) fn recognize(tensors: &NamedTensors) -> bool {
    has(tensors, "image_encoder.features.") && has(tensors, "lidar_encoder.")
}

pub(super) fn build(b: &mut Builder<'_>) -> Result<()> {
    let resolution = b.options.resolution.unwrap_or(DEFAULT_RESOLUTION);
    let image_network = ResNet::detect(&b.tensors, IMAGE, Some(LIDAR));
    let lidar_network = ResNet::detect(&b.tensors, LIDAR, Some(IMAGE));
    let channels = lidar_network.lidar_channels(&b.tensors);
    let rgb = b.rgb("image_encoder", resolution)?;
    let bev = b.bev(resolution, channels);
    let mut image = image_network.stem(b, rgb, 3)?;
    let mut lidar = lidar_network.stem(b, bev, channels)?;
    for stage in 1..=4 {
        image = image_network.stage(b, stage, image)?;
        lidar = lidar_network.stage(b, stage, lidar)?;
    }
    let features = b.push("fused_features", Op::GlobalPool, &[image, lidar])?;
    head::waypoints(b, features, 4)
}
