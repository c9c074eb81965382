//! From a described network to an image, with the stored frames as calibration.

use crate::golden::{self, Lbc, Network};
use model_compiler::frames::{ByteMap, Frame, RealMap, views};
use model_compiler::import::{ImportOptions, NamedTensors, import};
use model_compiler::ir::{Graph, InputKind, Shape};
use model_compiler::memory_plan::PlanOptions;
use model_compiler::passes::{PassOptions, optimize_with};
use model_compiler::pipeline::{self, Compiled};
use model_compiler::qmodel::QModel;
use model_compiler::quantize::QuantizeOptions;
use model_compiler::target::Target;

/// The optimized graph of a checkpoint.
///
/// # Panics
/// The checkpoint is refused.
pub fn graph(tensors: NamedTensors) -> Graph {
    graph_with(tensors, PassOptions::default())
}

/// The graph of a checkpoint, optimized with these switches.
///
/// # Panics
/// The checkpoint is refused.
pub fn graph_with(tensors: NamedTensors, passes: PassOptions) -> Graph {
    optimized(tensors, &ImportOptions::default(), passes)
}

fn optimized(tensors: NamedTensors, options: &ImportOptions, passes: PassOptions) -> Graph {
    let mut graph = import("network", tensors, options).unwrap_or_else(|e| panic!("{e}"));
    optimize_with(&mut graph, passes).unwrap_or_else(|e| panic!("{e}"));
    graph
}

/// The stored frames, cropped to a network's resolution.
pub fn frames((height, width): (u16, u16)) -> Vec<Frame> {
    let bytes = |values: &[f32], channels: u16| ByteMap {
        shape: Shape::map(height, width, channels),
        data: values.iter().map(|&v| v as u8).collect(),
    };
    let cells = |values: &[f32]| ByteMap {
        shape: Shape::map(height / 32, width / 32, 10),
        data: values.iter().map(|&v| v as u8).collect(),
    };
    golden::frames()
        .iter()
        .enumerate()
        .map(|(i, full)| {
            let frame = full.cropped(height.into(), width.into());
            Frame {
                name: format!("golden {i}"),
                rgb: Some(bytes(&frame.rgb, 3)),
                bev: Some(bytes(&frame.bev, 2)),
                velocity: Some(frame.velocity.into()),
                goal: Some(frame.target.map(f64::from)),
                command: Some(frame.command as u8),
                bev_points: Some(cells(&frame.bev_points)),
                camera_points: Some(cells(&frame.camera_points)),
                ..Frame::default()
            }
        })
        .collect()
}

/// The stored views of LBC, cropped to a network's resolution.
pub fn views((height, width): (u16, u16)) -> Vec<Frame> {
    let shape = Shape::map(height, width, views::CHANNELS);
    let frame = |(i, full): (usize, &golden::Frame)| Frame {
        name: format!("golden {i}"),
        views: Some(RealMap { shape, data: full.cropped_views(height.into(), width.into()) }),
        ..Frame::default()
    };
    golden::frames().iter().enumerate().map(frame).collect()
}

/// The frames of a graph: of the size of its image input, or of its views.
pub fn frames_of(graph: &Graph) -> Vec<Frame> {
    let (image, kind) = graph.inputs().next().expect("a graph has inputs");
    let shape = graph.value(image).shape;
    if kind == InputKind::Views { views((shape.height, shape.width)) } else { frames((shape.height, shape.width)) }
}

/// Quantizes a graph on the stored frames.
///
/// # Panics
/// The quantizer refuses it.
pub fn quantized(graph: &Graph, options: &QuantizeOptions) -> QModel {
    pipeline::quantize_graph(graph, &frames_of(graph), options, &mut |_, _, _| {}).unwrap_or_else(|e| panic!("{e}"))
}

/// Compiles a quantized model for the portable target.
///
/// # Panics
/// The compiler refuses it.
pub fn compiled(model: &QModel) -> Compiled {
    compiled_for(model, "portable")
}

/// Compiles a quantized model for a built-in target.
///
/// # Panics
/// The compiler refuses it.
pub fn compiled_for(model: &QModel, target: &str) -> Compiled {
    let target = Target::find(target).unwrap_or_else(|e| panic!("{e}"));
    let options = PlanOptions::for_target(&target);
    pipeline::compile(model, &target, &options, &mut |_, _, _| {}).unwrap_or_else(|e| panic!("{e}"))
}

/// LBC of any size, ready to compile; `hack` halves its views first.
pub fn lbc(network: &Lbc, hack: bool) -> Graph {
    let options = ImportOptions { hack, resolution: Some(network.resolution), ..Default::default() };
    optimized(network.tensors(), &options, PassOptions::default())
}

/// A small network of a system, ready to compile.
pub fn small(network: &Network) -> Graph {
    graph(network.tensors())
}
