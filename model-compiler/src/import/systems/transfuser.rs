//! TransFuser: camera and LiDAR networks, fused by a transformer after each of their stages.

use super::builder::Builder;
use super::resnet::{self, ResNet, TOTAL_STRIDE};
use super::transformer::{self, Fusions};
use super::{DEFAULT_RESOLUTION, has, head};
use crate::error::Result;
use crate::import::NamedTensors;
use crate::ir::{InputKind, Op, Shape};

const IMAGE: &str = "encoder.image_encoder.features";
const LIDAR: &str = "encoder.lidar_encoder._model";

pub(super) fn recognize(tensors: &NamedTensors) -> bool {
    has(tensors, "encoder.image_encoder.") || has(tensors, "encoder.transformer")
}

/// The ablations with fewer scales lack the first transformers: a scale without one is not fused.
pub(super) fn build(b: &mut Builder<'_>) -> Result<()> {
    let resolution = resolution(b);
    let grid = resnet::grid(resolution, "tokens")?;
    let image_network = ResNet::detect(&b.tensors, IMAGE, Some(LIDAR));
    let lidar_network = ResNet::detect(&b.tensors, LIDAR, Some(IMAGE));
    let channels = lidar_network.lidar_channels(&b.tensors);
    let fusions = Fusions::detect(b, image_network.widths, grid);

    let rgb = b.rgb("encoder.image_encoder", resolution)?;
    let bev = b.bev(resolution, channels);
    let velocity = fusions.any().then(|| b.graph.push_input("velocity", InputKind::Velocity, Shape::vector(1)));
    let mut image = image_network.stem(b, rgb, 3)?;
    let mut lidar = lidar_network.stem(b, bev, channels)?;
    for stage in 1..=4 {
        image = image_network.stage(b, stage, image)?;
        lidar = lidar_network.stage(b, stage, lidar)?;
        if let (Some(fusion), Some(velocity)) = (fusions.take(b, stage), velocity) {
            (image, lidar) = fusion.fuse(b, image, lidar, velocity)?;
        }
    }
    let features = b.push("encoder", Op::GlobalPool, &[image, lidar])?;
    head::waypoints(b, features, 2)
}

/// The input size that was asked for, or that a square positional embedding tells, or the published one.
fn resolution(b: &Builder<'_>) -> (u16, u16) {
    b.options.resolution.unwrap_or_else(|| {
        let tokens = transformer::tokens(&b.tensors).unwrap_or(0);
        let side = (tokens / 2).isqrt();
        if (1..=64).contains(&side) && 2 * side * side == tokens {
            let pixels = side as u16 * TOTAL_STRIDE;
            (pixels, pixels)
        } else {
            DEFAULT_RESOLUTION
        }
    })
}
