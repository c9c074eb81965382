//! Waypoints, controls, points or classes of frames: int8 from an image, f32 from a checkpoint.

use crate::answer::Answer;
use crate::backends::Backend;
use crate::buffers::GuardedArena;
use crate::classification::{Accuracy, Classification};
use crate::codes::decode;
use crate::controls::{ControlOutputs, ControlPrediction, Controls};
use crate::files::{self, FrameSource, ImageFile};
use crate::points::{PixelGrid, Points};
use crate::system;
use firmware::drive::profile::Answer as AnswerKind;
use firmware::drive::{Profile, Real};
use firmware::engine::{Engine, EngineError};
use firmware::image::{Image, Port, TensorRecord};
use firmware::program::Step;
use firmware::tensor::ElementType;
use indicatif::ProgressBar;
use model_compiler::artifact;
use model_compiler::error::{Error, ErrorCode, Result};
use model_compiler::frames::{Frame, FrameFormat};
use model_compiler::import::ImportOptions;
use model_compiler::integer_reference;
use model_compiler::ir::{Graph, Op};
use model_compiler::reference;
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;
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
#[derive(Clone, Debug, PartialEq, Serialize, JsonSchema)]
pub struct FrameResult {
    /// Frame.
    pub name: String,
    /// What the network gives.
    #[serde(flatten)]
    pub output: Output,
}

/// What networks give.
#[derive(Clone, Debug, PartialEq, Serialize, JsonSchema)]
#[serde(untagged)]
pub enum Output {
    /// Of a driving network.
    Waypoints {
        /// Where to drive.
        waypoints: Waypoints,
        /// How to drive there: of the firmware's controller in its fresh state, so of no frame before. Absent where the
        /// frame tells no speed, the network is of no published system, or the waypoints are no possible plan.
        #[serde(skip_serializing_if = "Option::is_none")]
        controls: Option<Controls>,
    },
    /// Of a driving network that gives controls.
    Controls(ControlPrediction),
    /// Of a driving network that points into its image.
    Points {
        /// Where to drive.
        points: Points,
        /// How to drive there, as of waypoints. Absent also where a point shows no ground.
        #[serde(skip_serializing_if = "Option::is_none")]
        controls: Option<Controls>,
    },
    /// Of a classifier.
    Class(Classification),
}

/// Result of a run.
#[derive(Clone, Debug, PartialEq, Serialize, JsonSchema)]
pub struct RunReport {
    /// Version of this structure.
    pub schema: u32,
    /// The network.
    pub model: ModelInfo,
    /// Every frame, in order.
    pub frames: Vec<FrameResult>,
    /// How often a classifier is right, where frames are labeled.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub accuracy: Option<Accuracy>,
    /// What people call the classes, as far as the labels say.
    #[serde(skip)]
    pub class_names: BTreeMap<usize, String>,
}

impl RunReport {
    /// Sums up the frames of a run.
    pub fn new(model: ModelInfo, frames: Vec<FrameResult>) -> Self {
        let classes = frames.iter().filter_map(|frame| match &frame.output {
            Output::Class(classification) => Some(classification),
            Output::Waypoints { .. } | Output::Controls(_) | Output::Points { .. } => None,
        });
        let accuracy = Accuracy::of(classes);
        Self { schema: 1, model, frames, accuracy, class_names: BTreeMap::new() }
    }

    fn with_names(mut self, frames: &[Frame]) -> Self {
        let labels = frames.iter().filter_map(|frame| frame.label.as_ref()).filter(|label| !label.name.is_empty());
        self.class_names = labels.map(|label| (usize::from(label.class), label.name.clone())).collect();
        self
    }
}

/// Runs a model image (int8, on the firmware's engine) or a checkpoint (f32) over frames.
///
/// # Errors
/// The model or a frame cannot be read, or the network gives neither waypoints nor controls nor points nor classes.
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
    let format = files::frame_format(&image)?;
    let mut device = Device::new(image, backend)?;
    let (port, record) = device.outputs[0];
    let points = PixelGrid::of_image(&image, port.tensor).map(OutputKind::Points);
    let gives_pairs = record.element == ElementType::I32 && record.shape.channels == 2;
    let pairs = points.or(gives_pairs.then_some(OutputKind::Waypoints));
    let names = device.outputs.iter().map(|(port, _)| port.name);
    let kind = OutputKind::of(pairs, names, &format, image.name())?;
    let reader = Reader::new(kind, &system::input_names(&image));
    let frames = source.load(&format)?;
    let results = each_frame(&frames, progress, |frame| reader.read(device.infer(frame)?, frame))?;
    let model = ModelInfo { name: image.name().to_owned(), sha256: artifact::hex(&file.sha256()) };
    Ok(RunReport::new(model, results).with_names(&frames))
}

fn run_graph(graph: &Graph, model: ModelInfo, source: &FrameSource, progress: &ProgressBar) -> Result<RunReport> {
    let format = FrameFormat::of_graph(graph);
    let gives_waypoints = graph.outputs.first().and_then(|&id| graph.producer(id));
    let gives_waypoints = gives_waypoints.is_some_and(|node| matches!(node.op, Op::WaypointDecoder(_)));
    let points = PixelGrid::of_graph(graph).map(OutputKind::Points);
    let pairs = points.or(gives_waypoints.then_some(OutputKind::Waypoints));
    let names = graph.outputs.iter().map(|&id| graph.value(id).name.as_str());
    let kind = OutputKind::of(pairs, names, &format, &graph.name)?;
    let inputs: Vec<&str> = graph.inputs().map(|(_, kind)| kind.name()).collect();
    let reader = Reader::new(kind, &inputs);
    let frames = source.load(&format)?;
    let results = each_frame(&frames, progress, |frame| {
        let inputs: Vec<Vec<f32>> = graph.inputs().map(|(_, kind)| frame.raw(kind)).collect::<Result<_>>()?;
        let outputs = reference::run(graph, &inputs, |_, _| ())?;
        reader.read(outputs.into_iter().map(|output| output.into_iter().map(f64::from).collect()).collect(), frame)
    })?;
    Ok(RunReport::new(model, results).with_names(&frames))
}

fn each_frame(
    frames: &[Frame],
    progress: &ProgressBar,
    mut infer: impl FnMut(&Frame) -> Result<Output>,
) -> Result<Vec<FrameResult>> {
    progress.set_length(frames.len() as u64);
    let mut result = |frame: &Frame| {
        progress.set_message(frame.name.clone());
        let output = infer(frame).map_err(|e| e.within(format!("frame {}", frame.name)))?;
        progress.inc(1);
        Ok(FrameResult { name: frame.name.clone(), output })
    };
    frames.iter().map(&mut result).collect()
}

/// What kind of outputs they are.
#[derive(Clone, Copy)]
enum OutputKind {
    Waypoints,
    Controls(ControlOutputs),
    Points(PixelGrid),
    Classes,
}

impl OutputKind {
    /// `pairs`: what the first output is, if it holds pairs.
    fn of<'n>(
        pairs: Option<Self>,
        outputs: impl Iterator<Item = &'n str>,
        format: &FrameFormat,
        network: &str,
    ) -> Result<Self> {
        let controls = || ControlOutputs::find(outputs).map(Self::Controls);
        let classes = || format.classes.map(|_| Self::Classes);
        pairs.or_else(controls).or_else(classes).ok_or_else(|| {
            let message = "its first output holds neither waypoints nor controls nor points nor classes";
            Error::new(ErrorCode::Unsupported, format!("network {network}"), message)
        })
    }
}

/// Reads the outputs of a network.
struct Reader {
    kind: OutputKind,
    /// Of the system whose answers they are, if a controller drives by them.
    profile: Option<Profile>,
}

impl Reader {
    /// For a network with inputs of these names.
    fn new(kind: OutputKind, inputs: &[&str]) -> Self {
        let maps = if let OutputKind::Points(maps) = kind { Some(maps) } else { None };
        let is_answer = |profile: &Profile| match profile.answer {
            AnswerKind::Waypoints => matches!(kind, OutputKind::Waypoints),
            AnswerKind::ImagePoints(_) => maps.is_some(),
            AnswerKind::Controls => false,
        };
        let profile = system::of_inputs(inputs).map(|system| system::profile(system, maps)).filter(is_answer);
        Self { kind, profile }
    }

    /// Reads the real values of all outputs.
    fn read(&self, mut outputs: Vec<Vec<f64>>, frame: &Frame) -> Result<Output> {
        Ok(match self.kind {
            OutputKind::Waypoints => {
                Output::Waypoints { waypoints: waypoints(&outputs[0]), controls: self.controls(&outputs[0], frame) }
            }
            OutputKind::Controls(controls) => Output::Controls(controls.read(&outputs).ok_or_else(|| {
                Error::new(ErrorCode::Unsupported, "output `controls`", "expected steer, throttle and brake")
            })?),
            OutputKind::Points(grid) => {
                Output::Points { points: grid.points(&outputs[0]), controls: self.controls(&outputs[0], frame) }
            }
            OutputKind::Classes => Output::Class(Classification::new(outputs.swap_remove(0), frame)),
        })
    }

    /// What the firmware makes of waypoints or points.
    fn controls(&self, values: &[f64], frame: &Frame) -> Option<Controls> {
        let (profile, speed) = (self.profile.as_ref()?, Real::saturating_from_num(frame.speed?));
        let answer = Answer::of_real(&profile.answer, values)?;
        Some(profile.controls(answer.output().ok()?, speed).ok()?.into())
    }
}

/// Pairs of the network's own frame (forward is negative) as waypoints.
pub fn waypoints<T: Copy + Into<f64>>(values: &[T]) -> Waypoints {
    values.as_chunks::<2>().0.iter().map(|&[right, y]| [right.into(), 0.0 - y.into()]).collect()
}

/// An image with its working memory and its outputs, one at least.
pub(crate) struct Device<'a> {
    image: Image<'a>,
    backend: Backend,
    arena: GuardedArena,
    outputs: Vec<(Port<'a>, TensorRecord)>,
}

impl<'a> Device<'a> {
    pub(crate) fn new(image: Image<'a>, backend: Backend) -> Result<Self> {
        let output = |i| image.output(i).and_then(|port| Some((port, image.tensor(port.tensor)?)));
        let outputs: Vec<_> = (0..image.output_count()).filter_map(output).collect();
        if outputs.is_empty() {
            let place = format!("network {}", image.name());
            return Err(Error::new(ErrorCode::Unsupported, place, "it has no output"));
        }
        let arena = GuardedArena::new(&image);
        Ok(Self { image, backend, arena, outputs })
    }

    /// Real values of the outputs.
    fn infer(&mut self, frame: &Frame) -> Result<Vec<Vec<f64>>> {
        self.infer_observed(frame, |_, _, _| ())
    }

    /// The same; `observe` sees every step with its position and output bytes.
    pub(crate) fn infer_observed(
        &mut self,
        frame: &Frame,
        observe: impl FnMut(usize, &Step, &[u8]),
    ) -> Result<Vec<Vec<f64>>> {
        let inputs = self.input_bytes(frame)?;
        let inputs: Vec<&[u8]> = inputs.iter().map(Vec::as_slice).collect();
        let refuse = |e: EngineError| Error::new(ErrorCode::Malformed, "engine", e.to_string());
        let mut engine = Engine::new(self.image, self.backend.kernels(), self.arena.poisoned(0)).map_err(refuse)?;
        engine.infer_observed(&inputs, observe).map_err(refuse)?;
        let real = |(index, (port, record)): (usize, &(Port<'_>, TensorRecord))| {
            let codes = decode(engine.output(index).map_err(refuse)?, record.element);
            let real = |&code: &i32| (f64::from(code) - f64::from(port.zero_point)) * f64::from(port.scale);
            Ok(codes.iter().map(real).collect())
        };
        self.outputs.iter().enumerate().map(real).collect()
    }

    /// Bytes of the inputs as the host prepares them.
    pub(crate) fn input_bytes(&self, frame: &Frame) -> Result<Vec<Vec<u8>>> {
        let ports = (0..self.image.input_count()).filter_map(|i| self.image.input(i));
        let encode = |port: Port<'_>| {
            let kind = files::input_kind(&port)?;
            let raw: Vec<f64> = frame.raw(kind)?.into_iter().map(f64::from).collect();
            let element = self.image.tensor(port.tensor).map_or(ElementType::I8, |record| record.element);
            Ok(integer_reference::to_bytes(&integer_reference::encode_input(kind, &raw), element))
        };
        ports.map(encode).collect()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn waypoints_turn_forward_positive() {
        assert_eq!(waypoints(&[0.5_f32, -2.0, 0.0, 0.0]), [[0.5, 2.0], [0.0, 0.0]]);
        assert!(waypoints(&[0.0, 0.0])[0][1].is_sign_positive());
    }

    #[test]
    fn controls_need_a_published_system_and_a_possible_speed() {
        let controls = |inputs: &[&str], speed| {
            let frame = Frame { speed, ..Frame::default() };
            let reader = Reader::new(OutputKind::Waypoints, inputs);
            match reader.read(vec![vec![0.0, -2.0, 0.0, -4.0]], &frame).unwrap() {
                Output::Waypoints { controls, .. } => controls,
                other => panic!("{other:?}"),
            }
        };
        let aim = &["rgb", "goal"];
        let found = controls(aim, Some(1.0)).unwrap();
        assert_eq!((found.throttle, found.brake), (0.75, 0.0));
        assert!(found.steer.abs() < 1e-6, "straight ahead: {found:?}");
        assert_eq!(controls(aim, Some(10.0)).map(|controls| controls.brake), Some(1.0), "4 m/s are wanted");
        assert_eq!(controls(aim, None), None);
        assert_eq!(controls(aim, Some(1e30)), None);
        assert_eq!(controls(&["rgb"], Some(1.0)), None);
        assert_eq!(controls(&["views"], Some(1.0)), None, "LBC gives points");
    }
}
