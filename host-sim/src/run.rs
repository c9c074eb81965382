//! Waypoints of frames: int8 from an image, f32 from a checkpoint.

use crate::backends::Backend;
use crate::buffers::GuardedArena;
use crate::codes::decode;
use crate::files::{self, FrameSource, ImageFile};
use firmware::engine::{Engine, EngineError};
use firmware::image::{Image, Port, TensorRecord};
use firmware::tensor::ElementType;
use indicatif::ProgressBar;
use model_compiler::artifact;
use model_compiler::error::{Error, ErrorCode, Result};
use model_compiler::frames::{Frame, FrameFormat};
use model_compiler::import::ImportOptions;
use model_compiler::integer_reference;
use model_compiler::ir::Graph;
use model_compiler::reference;
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use std::path::Path;

/// `[right, forward]` per future half second, m; forward is positive.
pub type Waypoints = Vec<[f64; 2]>;

/// Which network ran.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
pub struct ModelInfo {
    /// Its name.
    pub name: String,
    /// SHA-256 of the file, 64 hexadecimal digits.
    pub sha256: String,
}

/// Result of one frame.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct FrameResult {
    /// Frame.
    pub name: String,
    /// Where to drive.
    pub waypoints: Waypoints,
}

/// Result of a run.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct RunReport {
    /// Version of this structure.
    pub schema: u32,
    /// The network.
    pub model: ModelInfo,
    /// Every frame, in order.
    pub frames: Vec<FrameResult>,
}

/// Runs a model image (int8, on the firmware's engine) or a checkpoint (f32) over frames.
///
/// # Errors
/// The model or a frame cannot be read, or the network does not give waypoints.
pub fn run(
    model: &Path,
    import: &ImportOptions,
    source: &FrameSource,
    backend: Backend,
    progress: &ProgressBar,
) -> Result<RunReport> {
    if files::is_image_file(model)? {
        run_image(&ImageFile::read(model)?, source, backend, progress)
    } else {
        let graph = files::load_graph(model, import)?;
        let info = ModelInfo { name: graph.name.clone(), sha256: files::file_sha256(model)? };
        run_graph(&graph, info, source, progress)
    }
}

fn run_image(file: &ImageFile, source: &FrameSource, backend: Backend, progress: &ProgressBar) -> Result<RunReport> {
    let image = file.parse()?;
    let mut device = Device::new(image, backend)?;
    let frames = source.load(&files::frame_format(&image)?)?;
    let waypoints = each_frame(&frames, progress, |frame| device.waypoints(frame))?;
    let model = ModelInfo { name: image.name().to_owned(), sha256: artifact::hex(&file.sha256()) };
    Ok(RunReport { schema: 1, model, frames: waypoints })
}

fn run_graph(graph: &Graph, model: ModelInfo, source: &FrameSource, progress: &ProgressBar) -> Result<RunReport> {
    let frames = source.load(&FrameFormat::of_graph(graph))?;
    if graph.outputs.first().is_none_or(|&id| graph.value(id).shape.channels != 2) {
        return Err(no_waypoints(&graph.name));
    }
    let waypoints = each_frame(&frames, progress, |frame| {
        let inputs: Vec<Vec<f32>> = graph.inputs().map(|(_, kind)| frame.raw(kind)).collect::<Result<_>>()?;
        Ok(waypoints(&reference::run(graph, &inputs, |_, _| ())?[0]))
    })?;
    Ok(RunReport { schema: 1, model, frames: waypoints })
}

fn each_frame(
    frames: &[Frame],
    progress: &ProgressBar,
    mut infer: impl FnMut(&Frame) -> Result<Waypoints>,
) -> Result<Vec<FrameResult>> {
    progress.set_length(frames.len() as u64);
    let mut result = |frame: &Frame| {
        progress.set_message(frame.name.clone());
        let waypoints = infer(frame).map_err(|e| e.within(format!("frame {}", frame.name)))?;
        progress.inc(1);
        Ok(FrameResult { name: frame.name.clone(), waypoints })
    };
    frames.iter().map(&mut result).collect()
}

/// Pairs of the network's own frame (forward is negative) as waypoints.
pub fn waypoints(values: &[f32]) -> Waypoints {
    values.as_chunks::<2>().0.iter().map(|&[right, y]| [f64::from(right), 0.0 - f64::from(y)]).collect()
}

/// An image with its working memory and the output that holds the waypoints.
struct Device<'a> {
    image: Image<'a>,
    backend: Backend,
    arena: GuardedArena,
    port: Port<'a>,
    record: TensorRecord,
}

impl<'a> Device<'a> {
    fn new(image: Image<'a>, backend: Backend) -> Result<Self> {
        let port = image.output(0).and_then(|port| Some((port, image.tensor(port.tensor)?)));
        let is_waypoints = |record: &TensorRecord| record.element == ElementType::I32 && record.shape.channels == 2;
        let (port, record) =
            port.filter(|(_, record)| is_waypoints(record)).ok_or_else(|| no_waypoints(image.name()))?;
        let arena = GuardedArena::new(image.arena_bytes() as usize, image.arena_alignment() as usize);
        Ok(Self { image, backend, arena, port, record })
    }

    fn waypoints(&mut self, frame: &Frame) -> Result<Waypoints> {
        let inputs = self.input_bytes(frame)?;
        let inputs: Vec<&[u8]> = inputs.iter().map(Vec::as_slice).collect();
        let refuse = |e: EngineError| Error::new(ErrorCode::Malformed, "engine", e.to_string());
        let mut engine = Engine::new(self.image, self.backend.kernels(), self.arena.poisoned(0)).map_err(refuse)?;
        engine.infer(&inputs).map_err(refuse)?;
        let codes = decode(engine.output(0).map_err(refuse)?, self.record.element);
        let real = |&code: &i32| (f64::from(code) - f64::from(self.port.zero_point)) * f64::from(self.port.scale);
        let values: Vec<f64> = codes.iter().map(real).collect();
        Ok(values.as_chunks::<2>().0.iter().map(|&[right, y]| [right, 0.0 - y]).collect())
    }

    fn input_bytes(&self, frame: &Frame) -> Result<Vec<Vec<u8>>> {
        let ports = (0..self.image.input_count()).filter_map(|i| self.image.input(i));
        let encode = |port: Port<'_>| {
            let kind = files::input_kind(port.name)?;
            let raw: Vec<f64> = frame.raw(kind)?.into_iter().map(f64::from).collect();
            let element = self.image.tensor(port.tensor).map_or(ElementType::I8, |record| record.element);
            Ok(integer_reference::to_bytes(&integer_reference::encode_input(kind, &raw), element))
        };
        ports.map(encode).collect()
    }
}

fn no_waypoints(name: &str) -> Error {
    Error::new(ErrorCode::Unsupported, format!("network {name}"), "its first output holds no waypoints")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn waypoints_turn_forward_positive() {
        assert_eq!(waypoints(&[0.5, -2.0, 0.0, 0.0]), [[0.5, 2.0], [0.0, 0.0]]);
        assert!(waypoints(&[0.0, 0.0])[0][1].is_sign_positive());
    }
}
