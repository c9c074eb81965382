//! Geometric Fusion: camera and LiDAR networks; behind a stage, each map gets features of the other from the cells that
//! see the same points.
//!
//! Trained weights depend on the published network's peculiarities, which are kept: scale 2 projects image features by
//! `image_projection1`; scale 4 gathers LiDAR features of scale 3; lists and their places are columns before rows,
//! taken for rows before columns. So a checkpoint holds modules that nothing uses (`image_projection2`, `lidar_conv4`,
//! those of scales that are not fused).

use super::builder::Builder;
use super::detect::{common_length, indexed_count};
use super::resnet::{self, ResNet};
use super::{DEFAULT_RESOLUTION, has, head};
use crate::error::{Error, ErrorCode, Result};
use crate::import::NamedTensors;
use crate::ir::{Clip, InputKind, Linear, Op, Shape, ValueId};
use firmware::program::Window;

const IMAGE: &str = "encoder.image_encoder.features";
const LIDAR: &str = "encoder.lidar_encoder._model";

/// Cells in a list; no tensor tells it.
const CELLS: u16 = 5;

/// Channels of embeddings and projections as published, for a checkpoint without any.
const WIDTH: usize = 512;

pub(super) fn recognize(tensors: &NamedTensors) -> bool {
    has(tensors, "encoder.image_conv") || has(tensors, "encoder.image_projection")
}

/// The last stages are fused, as many as the options say. Where that is the last alone, there is no embedding of scale
/// 3 and scale 4 gathers its own.
pub(super) fn build(b: &mut Builder<'_>) -> Result<()> {
    let resolution = b.options.resolution.unwrap_or(DEFAULT_RESOLUTION);
    let grid = grid(resolution)?;
    let first_scale = 5 - usize::from(b.options.fusion_scales.unwrap_or(4));
    let image_network = ResNet::detect(&b.tensors, IMAGE, Some(LIDAR));
    let lidar_network = ResNet::detect(&b.tensors, LIDAR, Some(IMAGE));
    let channels = lidar_network.lidar_channels(&b.tensors);
    let sizes = Sizes::detect(&b.tensors);
    let image_side: Vec<Side> = (1..=4).map(|scale| Side::take(b, "image", scale, &image_network, &sizes)).collect();
    let lidar_side: Vec<Side> = (1..=4).map(|scale| Side::take(b, "lidar", scale, &lidar_network, &sizes)).collect();

    let rgb = b.rgb("encoder.image_encoder", resolution)?;
    let bev = b.bev(resolution, channels);
    let lists = Shape::map(grid, grid, 2 * CELLS);
    let bev_points = b.graph.push_input("bev_points", InputKind::BevPoints, lists);
    let camera_points = b.graph.push_input("cam_points", InputKind::CameraPoints, lists);
    let mut image = image_network.stem(b, rgb, 3)?;
    let mut lidar = lidar_network.stem(b, bev, channels)?;
    let mut lidar_embedding = None;
    for (scale, (image_modules, lidar_modules)) in (1..).zip(image_side.iter().zip(&lidar_side)) {
        image = image_network.stage(b, scale, image)?;
        lidar = lidar_network.stage(b, scale, lidar)?;
        if scale < first_scale {
            continue;
        }
        let from_image = image_modules.embed(b, image, grid)?;
        let from_lidar = match lidar_embedding {
            Some(third) if scale == 4 => third,
            _ => lidar_modules.embed(b, lidar, grid)?,
        };
        lidar_embedding = Some(from_lidar);
        let projection = if scale == 2 { &image_side[0] } else { image_modules };
        let to_lidar = projection.project(b, scale, from_image, bev_points)?;
        let to_image = lidar_modules.project(b, scale, from_lidar, camera_points)?;
        image = image_modules.add_back(b, to_image, image, grid)?;
        lidar = lidar_modules.add_back(b, to_lidar, lidar, grid)?;
    }
    let features = b.push("encoder", Op::GlobalPool, &[image, lidar])?;
    head::waypoints(b, features, 2)
}

/// Rows of either map's cells, and columns: since they are taken for each other, there must be as many of both.
fn grid(resolution: (u16, u16)) -> Result<u16> {
    let (rows, columns) = resnet::grid(resolution, "cells")?;
    if rows == columns {
        return Ok(rows);
    }
    let message = format!("an input of {}×{} pixels is not square", resolution.0, resolution.1);
    Err(Error::new(ErrorCode::Usage, "", message)
        .with_help("this network takes columns of the image for rows, so it needs as many of both"))
}

/// Sizes that all scales have in common.
struct Sizes {
    /// Channels of an embedding.
    embedding: usize,
    /// Outputs of each layer of a projection.
    projection: Vec<usize>,
}

impl Sizes {
    fn detect(tensors: &NamedTensors) -> Self {
        let projections: Vec<String> = ["image", "lidar"]
            .iter()
            .flat_map(|side| (1..=4).map(move |scale| format!("encoder.{side}_projection{scale}.")))
            .collect();
        let layers = projections.iter().map(|prefix| indexed_count(tensors, prefix).div_ceil(2)).max().unwrap_or(0);
        let width = |layer: usize| {
            let prefixes: Vec<String> = projections.iter().map(|prefix| format!("{prefix}{}.", 2 * layer)).collect();
            let prefixes: Vec<&str> = prefixes.iter().map(String::as_str).collect();
            common_length(tensors, &prefixes, |_| true).unwrap_or(WIDTH)
        };
        let convolutions = ["encoder.image_conv", "encoder.lidar_conv"];
        Self {
            embedding: common_length(tensors, &convolutions, |_| true).unwrap_or(WIDTH),
            projection: (0..layers).map(width).collect(),
        }
    }
}

/// The modules of one scale for one map.
struct Side {
    /// `image` or `lidar`.
    name: &'static str,
    scale: usize,
    /// From the map to its embedding.
    conv: Linear,
    /// From gathered embeddings of this map to what the other map gets; a ReLU behind each layer.
    projection: Vec<Linear>,
    /// From what this map gets to its channels.
    deconv: Linear,
}

impl Side {
    /// Takes the tensors, whether or not the network will use them.
    fn take(b: &mut Builder<'_>, name: &'static str, scale: usize, network: &ResNet, sizes: &Sizes) -> Self {
        let channels = network.widths[scale - 1];
        let mut inputs = sizes.embedding;
        let mut projection = Vec::with_capacity(sizes.projection.len());
        for (layer, &outputs) in sizes.projection.iter().enumerate() {
            projection.push(b.linear_weights(
                &format!("encoder.{name}_projection{scale}.{}", 2 * layer),
                inputs,
                outputs,
            ));
            inputs = outputs;
        }
        Self {
            name,
            scale,
            conv: b.pointwise(&format!("encoder.{name}_conv{scale}"), channels, sizes.embedding),
            projection,
            deconv: b.pointwise(&format!("encoder.{name}_deconv{scale}"), inputs, channels),
        }
    }

    /// The map's features per cell.
    fn embed(&self, b: &mut Builder<'_>, map: ValueId, grid: u16) -> Result<ValueId> {
        let Self { name, scale, .. } = self;
        let features = b.push(format!("encoder.{name}_conv{scale}"), Op::Linear(self.conv.clone()), &[map])?;
        let pixels = (b.graph.value(map).shape.height / grid) as u8;
        if pixels == 1 {
            return Ok(features);
        }
        let window = Window::square(pixels, pixels, 0);
        b.push(format!("encoder.{name}_embedding{scale}"), Op::AveragePool(window), &[features])
    }

    /// Sums of embeddings by lists of cells, projected; at another scale than its own, too.
    fn project(&self, b: &mut Builder<'_>, scale: usize, embedding: ValueId, lists: ValueId) -> Result<ValueId> {
        let Self { name, scale: own, .. } = self;
        let mut x = b.push(format!("encoder.{name}_gathered{scale}"), Op::GatherSum, &[embedding, lists])?;
        let again = if scale == *own { String::new() } else { format!(".scale{scale}") };
        for (layer, linear) in self.projection.iter().enumerate() {
            let module = |index: usize| format!("encoder.{name}_projection{own}.{index}{again}");
            x = b.push(module(2 * layer), Op::Linear(linear.clone()), &[x])?;
            x = b.push(module(2 * layer + 1), Op::Clip(Clip::RELU), &[x])?;
        }
        Ok(x)
    }

    /// What the map gets, enlarged to its size, brought to its channels and added to it.
    fn add_back(&self, b: &mut Builder<'_>, mut x: ValueId, map: ValueId, grid: u16) -> Result<ValueId> {
        let Self { name, scale, .. } = self;
        let pixels = b.graph.value(map).shape.height / grid;
        if pixels > 1 {
            let factor = (pixels, pixels);
            x = b.push(format!("encoder.{name}_upsample{scale}"), Op::ResizeBilinear { factor }, &[x])?;
        }
        x = b.push(format!("encoder.{name}_deconv{scale}"), Op::Linear(self.deconv.clone()), &[x])?;
        b.push(format!("encoder.{name}_add{scale}"), Op::Add { clip: Clip::NONE }, &[x, map])
    }
}
