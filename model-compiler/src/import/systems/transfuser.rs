//! TransFuser: camera and LiDAR networks, fused by a transformer after each of their stages.

use super::builder::Builder;
use super::{has, head, resnet::ResNet, transformer::Transformer};
use crate::error::Result;
use crate::import::NamedTensors;
use crate::ir::{InputKind, Op, Shape};

/// Camera crop and LiDAR histogram as published, pixels.
pub(super) const DEFAULT_RESOLUTION: (u16, u16) = (256, 256);

/// Pixels per token of the last stage: the networks halve the resolution five times.
const TOTAL_STRIDE: u16 = 32;

pub(super) fn recognize(tensors: &NamedTensors) -> bool {
    has(tensors, "encoder.image_encoder.") || has(tensors, "encoder.transformer")
}

/// The ablations with fewer scales lack the first transformers: a scale without one is not fused.
pub(super) fn build(b: &mut Builder<'_>) -> Result<()> {
    let resolution = resolution(b);
    let grid = (resolution.0.div_ceil(TOTAL_STRIDE), resolution.1.div_ceil(TOTAL_STRIDE));
    let image_network = ResNet::detect(&b.tensors, "encoder.image_encoder.features");
    let lidar_network = ResNet::detect(&b.tensors, "encoder.lidar_encoder._model");
    let channels = lidar_network.lidar_channels(&b.tensors);
    let scales = Transformer::detect_all(&b.tensors, &image_network.widths, grid);

    let rgb = b.rgb("encoder.image_encoder", resolution)?;
    let bev = b.bev("encoder.lidar_encoder", resolution, channels)?;
    let velocity = scales
        .iter()
        .any(Option::is_some)
        .then(|| b.graph.push_input("velocity", InputKind::Velocity, Shape::vector(1)));
    let mut image = image_network.stem(b, rgb, 3)?;
    let mut lidar = lidar_network.stem(b, bev, channels)?;
    for (stage, scale) in (1..=4).zip(&scales) {
        image = image_network.stage(b, stage, image)?;
        lidar = lidar_network.stage(b, stage, lidar)?;
        if let (Some(transformer), Some(velocity)) = (scale, velocity) {
            (image, lidar) = transformer.fuse(b, image, lidar, velocity)?;
        }
    }
    let features = b.push("encoder", Op::GlobalPool, &[image, lidar])?;
    head::waypoints(b, features, 2)
}

/// Both maps are enlarged by 8, 4, 2, 1 from the token grid, so the grid is the size of the last stage's map and a
/// square positional embedding tells the input size.
fn resolution(b: &Builder<'_>) -> (u16, u16) {
    b.options.resolution.unwrap_or_else(|| {
        let side = Transformer::tokens(&b.tensors).map_or(0, |tokens| (tokens / 2).isqrt());
        match (side, Transformer::tokens(&b.tensors)) {
            (1..=64, Some(tokens)) if 2 * side * side == tokens => {
                let pixels = side as u16 * TOTAL_STRIDE;
                (pixels, pixels)
            }
            _ => DEFAULT_RESOLUTION,
        }
    })
}
