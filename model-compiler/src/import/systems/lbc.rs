//! LBC (Learning by Cheating, version of the 2020 challenge): three views and a heatmap of the target through DeepLabV3
//! on a dilated ResNet-50, to a spatial softmax for each of four points.

use super::bottleneck::Bottlenecks;
use super::builder::Builder;
use super::deeplab;
use crate::error::{Error, ErrorCode, Result};
use crate::frames::views::CHANNELS;
use crate::import::NamedTensors;
use crate::ir::{InputKind, Op, Shape, ValueId};
use firmware::program::Window;

/// Height and width of the views as published, pixels.
const DEFAULT_RESOLUTION: (u16, u16) = (144, 256);
/// As published for the network that reads images.
const DEFAULT_TEMPERATURE: f32 = 5.0;
/// Pixels of the network's input per pixel of its last map.
const STRIDE: u16 = 8;

const BACKBONE: &str = "network.backbone.";
/// Modules beside the network that are not used when it drives: the kernel of the heatmap, the camera model, a learned
/// controller, the network that taught it.
const UNUSED: [&str; 4] = ["to_heatmap.", "converter.", "controller.", "teacher."];

pub(super) fn recognize(tensors: &NamedTensors) -> bool {
    prefix(tensors).is_some()
}

/// What stands before `network.…`: `net.`, with or without a wrapper's name in front, or nothing.
fn prefix(tensors: &NamedTensors) -> Option<String> {
    let mut prefixes = tensors.iter().filter_map(|(name, _)| Some(name.split_once(BACKBONE)?.0));
    let of_student = |prefix: &&str| (prefix.is_empty() || prefix.ends_with('.')) && !prefix.contains("teacher.");
    prefixes.find(of_student).map(str::to_owned)
}

pub(super) fn build(b: &mut Builder<'_>) -> Result<()> {
    let prefix = prefix(&b.tensors).unwrap_or_else(|| "net.".to_owned());
    drop_unused(&mut b.tensors, prefix.strip_suffix("net.").unwrap_or_default());
    let (height, width) = resolution(b)?;
    let backbone = Bottlenecks::detect(&b.tensors, &format!("{prefix}network.backbone"));
    let mut map = b.graph.push_input("views", InputKind::Views, Shape::map(height, width, CHANNELS));
    if b.options.hack {
        // Bilinear reduction to a half takes the mean of four pixels.
        map = b.push(format!("{prefix}resize"), Op::AveragePool(Window::square(2, 2, 0)), &[map])?;
    }
    map = b.grey_norm(&format!("{prefix}norm"), map)?;
    map = backbone.features(b, map, usize::from(CHANNELS))?;
    map = deeplab::head(b, &format!("{prefix}network.classifier"), map)?;
    map = enlarged(b, &format!("{prefix}network"), map, STRIDE)?;
    if b.options.hack {
        map = enlarged(b, &format!("{prefix}upsample"), map, 2)?;
    }
    let temperature = b.options.temperature.unwrap_or(DEFAULT_TEMPERATURE);
    let points = b.push("points", Op::SpatialSoftmax { temperature }, &[map])?;
    b.graph.outputs.push(points);
    Ok(())
}

fn enlarged(b: &mut Builder<'_>, name: &str, map: ValueId, factor: u16) -> Result<ValueId> {
    b.push(name, Op::ResizeBilinear { factor: (factor, factor) }, &[map])
}

fn drop_unused(tensors: &mut NamedTensors, wrapper: &str) {
    for module in UNUSED {
        let module = format!("{wrapper}{module}");
        let names: Vec<String> = tensors.under(&module).map(|(name, _)| name.to_owned()).collect();
        names.iter().for_each(|name| drop(tensors.remove(name)));
    }
}

/// The input size that was asked for, or the published one; the last map must be a whole fraction of it.
fn resolution(b: &Builder<'_>) -> Result<(u16, u16)> {
    let (height, width) = b.options.resolution.unwrap_or(DEFAULT_RESOLUTION);
    let divisor = if b.options.hack { 2 * STRIDE } else { STRIDE };
    if height == 0 || width == 0 || height % divisor != 0 || width % divisor != 0 {
        let message = format!("an input of {height}×{width} pixels does not divide into the network's last map");
        return Err(Error::new(ErrorCode::Usage, "", message)
            .with_help(format!("height and width must be multiples of {divisor} pixels")));
    }
    Ok((height, width))
}
