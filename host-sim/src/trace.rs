//! One frame through all three: the engine, the f64 model and, where a checkpoint is given, the f32 network.

use crate::backends::Backend;
use crate::buffers::GuardedArena;
use crate::channels::Channels;
use crate::codes::{SaturationBounds, decode, dequantize};
use crate::compare::{StepDifference, first_difference};
use crate::histogram::Histogram;
use crate::statistics::ErrorSums;
use firmware::engine::Engine;
use firmware::image::Image;
use firmware::tensor::Shape;
use indicatif::ProgressBar;
use model_compiler::error::{Error, ErrorCode, Result};
use model_compiler::frames::Frame;
use model_compiler::integer_reference;
use model_compiler::ir::{Graph, Node, ValueId};
use model_compiler::qmodel::{QModel, QStep, QTensor, QTensorId};
use model_compiler::record::Record;
use model_compiler::reference::{self, Activations, Change};

/// Figures of one step, summed over the traced frames.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct StepFigures {
    /// What the step itself adds: its operator in f32 on its own integer inputs, against its output.
    pub local: Option<ErrorSums>,
    /// What has added up until here: the f32 network's value against the output.
    pub accumulated: Option<ErrorSums>,
    /// Codes written.
    pub codes: u64,
    /// Codes at a clamp bound that is not the network's own; `None` where the operator cannot saturate.
    pub saturated: Option<u64>,
    /// Distribution of the values; absent before the first frame.
    pub histogram: Option<Histogram>,
    /// Ranges per channel of a weighted step.
    pub channels: Option<Channels>,
    /// The engine's bytes equal the f64 model's in every frame.
    pub equal: bool,
}

/// What one frame gave.
#[derive(Clone, Debug)]
pub struct FrameTrace {
    /// The first step with unequal bytes.
    pub difference: Option<StepDifference>,
    /// Real values of every network output, from the engine.
    pub outputs: Vec<Vec<f32>>,
    /// The same from the f32 network.
    pub reference_outputs: Option<Vec<Vec<f32>>>,
    /// Errors that have added up on this frame alone, by position; empty without an f32 network.
    pub accumulated: Vec<ErrorSums>,
}

/// What a step alone adds, element by element, and where it goes.
#[derive(Clone, Debug)]
pub struct LocalError<'a> {
    /// Position of the step.
    pub position: usize,
    /// The value of the f32 network that it approximates, and the nodes that read this step's output.
    pub change: Change<'a>,
    /// Output of the engine minus the operator in f32 on the engine's operands.
    pub error: Vec<f32>,
}

/// Traces frames and sums up the figures of every step.
#[derive(Debug)]
pub struct Tracer<'a> {
    image: Image<'a>,
    record: &'a Record,
    reference: Option<FloatNetwork<'a>>,
    arena: GuardedArena,
    backend: Backend,
    frames: u32,
    /// By position in the program.
    figures: Vec<StepFigures>,
}

/// The f32 network and how the steps relate to it.
#[derive(Debug)]
struct FloatNetwork<'a> {
    graph: &'a Graph,
    /// By step of the model.
    counterparts: Vec<Counterpart<'a>>,
    /// By output of the model.
    outputs: Vec<ValueId>,
}

/// What a step corresponds to in the f32 network.
#[derive(Debug)]
struct Counterpart<'a> {
    /// The value that its output approximates.
    value: ValueId,
    /// Its function, and the step's operands in the function's order.
    function: Function<'a>,
}

#[derive(Debug)]
enum Function<'a> {
    Node(&'a Node, Vec<QTensorId>),
    /// A pure change of type.
    Identity(QTensorId),
    /// The step does not read what the node reads.
    Unknown,
}

/// Bytes of every tensor of one inference of the engine.
struct EngineRun {
    /// By tensor of the model.
    tensors: Vec<Vec<u8>>,
    /// The network's outputs, as they lie in the arena at the end.
    outputs: Vec<Vec<u8>>,
}

impl<'a> Tracer<'a> {
    /// Prepares for an image and its record, and for the checkpoint's graph where there is one.
    ///
    /// # Errors
    /// Image and record, or record and graph, do not belong together.
    pub fn new(image: Image<'a>, record: &'a Record, graph: Option<&'a Graph>, backend: Backend) -> Result<Self> {
        check_record(&image, record)?;
        let reference = graph.map(|graph| FloatNetwork::new(graph, &record.model)).transpose()?;
        let arena = GuardedArena::new(&image);
        let figures = |&step: &u32| StepFigures {
            equal: true,
            channels: Channels::of(&record.model, &record.model.steps[step as usize].op),
            ..StepFigures::default()
        };
        let figures = record.plan.order.iter().map(figures).collect();
        Ok(Self { image, record, reference, arena, backend, frames: 0, figures })
    }

    /// Figures by position in the program.
    pub fn figures(&self) -> &[StepFigures] {
        &self.figures
    }

    /// Progress units of one frame: each step once per participant.
    pub fn units_per_frame(&self) -> u64 {
        let participants = if self.reference.is_some() { 3 } else { 2 };
        self.figures.len() as u64 * participants
    }

    /// Runs a frame everywhere, compares and measures.
    ///
    /// # Errors
    /// The frame lacks an input, the engine refuses, or it wrote outside its arena. Unequal bytes are no error here.
    pub fn trace(&mut self, frame: &Frame, progress: &ProgressBar) -> Result<FrameTrace> {
        let model = &self.record.model;
        let codes = input_codes(model, frame)?;
        let expected = f64_model(model, &codes, progress)?;
        let run = self.run_engine(&codes, progress)?;
        let difference = self.compare(frame, &run, &expected);
        drop(expected);
        self.arena.check_guards().map_err(|e| e.within(format!("frame {}", frame.name)))?;
        self.frames += 1;
        self.count_saturation(&run);
        let activations = self.reference.as_ref().map(|network| network.run(frame)).transpose()?;
        let accumulated = self.measure(&run, activations.as_ref(), progress);
        let reference_outputs =
            self.reference.as_ref().zip(activations.as_ref()).map(|(network, activations)| {
                network.outputs.iter().map(|&id| kept(activations, id).to_vec()).collect()
            });
        let outputs =
            model.outputs.iter().zip(&run.outputs).map(|(port, bytes)| real(model.tensor(port.tensor), bytes));
        Ok(FrameTrace { difference, outputs: outputs.collect(), reference_outputs, accumulated })
    }

    /// The f32 network.
    pub fn graph(&self) -> Option<&'a Graph> {
        self.reference.as_ref().map(|network| network.graph)
    }

    /// Name of the step at a position.
    pub fn step_name(&self, position: usize) -> &'a str {
        &self.record.model.steps[self.record.plan.order[position] as usize].name
    }

    /// Positions of the steps whose own error can be told, with the value that each changes.
    pub fn noisy_steps(&self) -> impl Iterator<Item = (usize, Change<'a>)> {
        let network = self.reference.as_ref();
        self.steps().filter_map(move |(position, step)| {
            let counterpart = &network?.counterparts[self.record.plan.order[position] as usize];
            let known = !matches!(counterpart.function, Function::Unknown);
            let readers = || readers(&self.record.model, step.op.output());
            known.then(|| (position, Change { value: counterpart.value, readers: readers() }))
        })
    }

    /// Runs a frame without counting it: every value of the f32 network, the own errors of the steps at `positions`,
    /// and the whole error at `target`, where a step writes that.
    ///
    /// # Errors
    /// See [`Tracer::trace`].
    pub fn local_errors(
        &mut self,
        frame: &Frame,
        positions: &[usize],
        target: ValueId,
    ) -> Result<(Activations, Vec<LocalError<'a>>, Option<ErrorSums>)> {
        let model = &self.record.model;
        let hidden = ProgressBar::hidden();
        let run = self.run_engine(&input_codes(model, frame)?, &hidden)?;
        let Some(network) = &self.reference else {
            return Err(Error::new(ErrorCode::Usage, "noise shares", "need the f32 network"));
        };
        let activations = network.run(frame)?;
        let mut errors = Vec::new();
        let mut whole = None;
        for (position, change) in self.noisy_steps() {
            let step = self.record.plan.order[position] as usize;
            let output = || tensor_values(model, &run, model.steps[step].op.output());
            if change.value == target {
                whole.get_or_insert_with(ErrorSums::default).add(kept(&activations, target), &output());
            }
            if !positions.contains(&position) {
                continue;
            }
            if let Some(ideal) = network.apply(&network.counterparts[step].function, model, &run) {
                let error = output().iter().zip(&ideal).map(|(output, ideal)| output - ideal).collect();
                errors.push(LocalError { position, change, error });
            }
        }
        Ok((activations, errors, whole))
    }

    fn steps(&self) -> impl Iterator<Item = (usize, &'a QStep)> + use<'a> {
        let record = self.record;
        record.plan.order.iter().map(|&step| &record.model.steps[step as usize]).enumerate()
    }

    fn run_engine(&mut self, codes: &[Vec<f64>], progress: &ProgressBar) -> Result<EngineRun> {
        let model = &self.record.model;
        let mut tensors = vec![Vec::new(); model.tensors.len()];
        for (port, codes) in model.inputs.iter().zip(codes) {
            tensors[port.tensor.0 as usize] = integer_reference::to_bytes(codes, model.tensor(port.tensor).element);
        }
        let inputs: Vec<Vec<u8>> = model.inputs.iter().map(|port| tensors[port.tensor.0 as usize].clone()).collect();
        let inputs: Vec<&[u8]> = inputs.iter().map(Vec::as_slice).collect();
        let written: Vec<usize> = self.steps().map(|(_, step)| step.op.output().0 as usize).collect();
        // Two patterns in turn, so that a byte that is read before it was written cannot go unnoticed.
        let arena = self.arena.poisoned(if self.frames.is_multiple_of(2) { 0x5A } else { 0xA5 });
        let refuse = |e: firmware::engine::EngineError| Error::new(ErrorCode::Check, "engine", e.to_string());
        let mut engine = Engine::new(self.image, self.backend.kernels(), arena).map_err(refuse)?;
        let observe = |position: usize, _: &firmware::program::Step, bytes: &[u8]| {
            tensors[written[position]] = bytes.to_vec();
            progress.inc(1);
        };
        engine.infer_observed(&inputs, observe).map_err(refuse)?;
        let outputs = (0..model.outputs.len()).map(|i| engine.output(i).map(<[u8]>::to_vec).map_err(refuse));
        let outputs = outputs.collect::<Result<_>>()?;
        Ok(EngineRun { tensors, outputs })
    }

    /// Marks unequal steps and returns the first. `expected` is by tensor.
    fn compare(&mut self, frame: &Frame, run: &EngineRun, expected: &[Vec<u8>]) -> Option<StepDifference> {
        let model = &self.record.model;
        let mut first = None;
        let mut check = |position: usize, step: &str, id: QTensorId, found: &[u8]| {
            let tensor = model.tensor(id);
            let difference = first_difference(found, &expected[id.0 as usize], tensor.element);
            if let (Some(d), None) = (difference, &first) {
                first = Some(StepDifference {
                    frame: frame.name.clone(),
                    position,
                    step: step.to_owned(),
                    tensor: tensor.name.clone(),
                    index: d.index,
                    at: StepDifference::place(d.index, tensor.shape),
                    found: d.found,
                    expected: d.expected,
                    differing: d.differing,
                    elements: tensor.shape.elements(),
                });
            }
            difference.is_none()
        };
        for (position, step) in self.steps() {
            let id = step.op.output();
            self.figures[position].equal &= check(position, &step.name, id, &run.tensors[id.0 as usize]);
        }
        // An output that a later step overwrote was right when it was written.
        let end = self.figures.len().saturating_sub(1);
        for (port, bytes) in model.outputs.iter().zip(&run.outputs) {
            check(end, &format!("(output {} after the last step)", port.name), port.tensor, bytes);
        }
        first
    }

    fn count_saturation(&mut self, run: &EngineRun) {
        for (position, step) in self.steps() {
            let tensor = self.record.model.tensor(step.op.output());
            let codes = decode(&run.tensors[step.op.output().0 as usize], tensor.element);
            let figures = &mut self.figures[position];
            figures.codes += codes.len() as u64;
            if let Some(bounds) = SaturationBounds::of(step) {
                *figures.saturated.get_or_insert(0) += bounds.count(&codes);
            }
        }
    }

    /// Adds the frame's values and its errors against f32 to the figures; returns the errors that have added up.
    fn measure(
        &mut self,
        run: &EngineRun,
        activations: Option<&Activations>,
        progress: &ProgressBar,
    ) -> Vec<ErrorSums> {
        let model = &self.record.model;
        let mut frame = Vec::new();
        for (position, step) in self.steps() {
            let tensor = model.tensor(step.op.output());
            let output = tensor_values(model, run, step.op.output());
            let step = self.record.plan.order[position] as usize;
            let figures = &mut self.figures[position];
            if let Some(channels) = &mut figures.channels {
                channels.add(&output);
            }
            let mut reference = None;
            if let (Some(network), Some(activations)) = (&self.reference, activations) {
                let counterpart = &network.counterparts[step];
                let expected = kept(activations, counterpart.value);
                let mut sums = ErrorSums::default();
                sums.add(expected, &output);
                figures.accumulated.get_or_insert_default().merge(&sums);
                frame.push(sums);
                if let Some(ideal) = network.apply(&counterpart.function, model, run) {
                    figures.local.get_or_insert_default().add(&ideal, &output);
                }
                reference = Some(expected);
                progress.inc(1);
            }
            let histogram = || Histogram::spanning(tensor, reference, &output);
            figures.histogram.get_or_insert_with(histogram).add(reference, &output);
        }
        frame
    }
}

impl<'a> FloatNetwork<'a> {
    fn new(graph: &'a Graph, model: &QModel) -> Result<Self> {
        let counterpart = |step: &QStep| {
            let tensor = model.tensor(step.op.output());
            Ok(Counterpart { value: find_value(graph, tensor)?, function: Function::of(graph, model, step)? })
        };
        let counterparts = model.steps.iter().map(counterpart).collect::<Result<_>>()?;
        let outputs = model.outputs.iter().map(|port| find_value(graph, model.tensor(port.tensor)));
        Ok(Self { graph, counterparts, outputs: outputs.collect::<Result<_>>()? })
    }

    fn run(&self, frame: &Frame) -> Result<Activations> {
        let inputs: Vec<Vec<f32>> = self.graph.inputs().map(|(_, kind)| frame.raw(kind)).collect::<Result<_>>()?;
        reference::run_all(self.graph, &inputs)
    }

    /// The step's function in f32 on the engine's own integers.
    fn apply(&self, function: &Function<'_>, model: &QModel, run: &EngineRun) -> Option<Vec<f32>> {
        match function {
            Function::Unknown => None,
            Function::Identity(input) => Some(tensor_values(model, run, *input)),
            Function::Node(node, operands) => {
                let shapes: Vec<Shape> = node.inputs.iter().map(|&id| self.graph.value(id).shape).collect();
                let values: Vec<Vec<f32>> = operands.iter().map(|&id| tensor_values(model, run, id)).collect();
                let values: Vec<&[f32]> = values.iter().map(Vec::as_slice).collect();
                Some(reference::evaluate(&node.op, &shapes, &values, self.graph.value(node.output).shape))
            }
        }
    }
}

impl<'a> Function<'a> {
    fn of(graph: &'a Graph, model: &QModel, step: &QStep) -> Result<Self> {
        let reads = step.op.reads();
        let Some(name) = &step.node else {
            return Ok(reads.first().map_or(Self::Unknown, |&input| Self::Identity(input)));
        };
        let node = graph.nodes.iter().find(|node| node.name == *name);
        let node = node.ok_or_else(|| foreign(format!("it has no node {name}, of which the record has a step")))?;
        let operand = |id: &ValueId| {
            let name = &graph.value(*id).name;
            reads.iter().copied().find(|&read| model.tensor(read).value == *name)
        };
        let operands: Option<Vec<QTensorId>> = node.inputs.iter().map(operand).collect();
        Ok(operands.map_or(Self::Unknown, |operands| Self::Node(node, operands)))
    }
}

/// Names of the nodes whose steps read a tensor, or a copy of it in another type.
fn readers(model: &QModel, tensor: QTensorId) -> Vec<&str> {
    let reading = model.steps.iter().filter(|step| step.op.reads().contains(&tensor));
    reading
        .flat_map(|step| match &step.node {
            Some(node) => vec![node.as_str()],
            None => readers(model, step.op.output()),
        })
        .collect()
}

fn check_record(image: &Image<'_>, record: &Record) -> Result<()> {
    let (model, plan) = (&record.model, &record.plan);
    let pairs = [
        ("steps", u64::from(image.step_count()), plan.order.len() as u64),
        ("inputs", u64::from(image.input_count()), model.inputs.len() as u64),
        ("outputs", u64::from(image.output_count()), model.outputs.len() as u64),
        ("memory regions", u64::from(image.region_count()), plan.regions.len() as u64),
    ]
    .map(|(what, image, record)| (what.to_owned(), image, record));
    let regions = image.regions().zip(&plan.regions);
    let bytes =
        regions.map(|(region, part)| (format!("bytes in region {}", part.name), region.bytes.into(), part.bytes));
    let pairs: Vec<(String, u64, u64)> = pairs.into_iter().chain(bytes).collect();
    match pairs.iter().find(|(_, image, record)| image != record) {
        None => Ok(()),
        Some((what, image, record)) => {
            let message = format!("the image has {image} {what}, the record {record}");
            Err(Error::new(ErrorCode::Malformed, "record", message))
        }
    }
}

/// Codes of the network's inputs, in the record's order.
pub(crate) fn input_codes(model: &QModel, frame: &Frame) -> Result<Vec<Vec<f64>>> {
    let codes = |port: &model_compiler::qmodel::Port| {
        let kind = port.kind.ok_or_else(|| {
            Error::new(ErrorCode::Malformed, "record", format!("input {} does not say what it holds", port.name))
        })?;
        let raw: Vec<f64> = frame.raw(kind)?.into_iter().map(f64::from).collect();
        Ok(integer_reference::encode_input(kind, &raw))
    };
    model.inputs.iter().map(codes).collect()
}

/// The bytes that every tensor must have, by tensor.
fn f64_model(model: &QModel, codes: &[Vec<f64>], progress: &ProgressBar) -> Result<Vec<Vec<u8>>> {
    let mut bytes = vec![Vec::new(); model.tensors.len()];
    integer_reference::run(model, codes, |_, step, codes| {
        let id = step.op.output();
        bytes[id.0 as usize] = integer_reference::to_bytes(codes, model.tensor(id).element);
        progress.inc(1);
    })?;
    Ok(bytes)
}

fn real(tensor: &QTensor, bytes: &[u8]) -> Vec<f32> {
    dequantize(tensor, &decode(bytes, tensor.element))
}

fn tensor_values(model: &QModel, run: &EngineRun, id: QTensorId) -> Vec<f32> {
    real(model.tensor(id), &run.tensors[id.0 as usize])
}

fn kept(activations: &Activations, id: ValueId) -> &[f32] {
    activations.get(id).expect("run_all keeps every value")
}

fn find_value(graph: &Graph, tensor: &QTensor) -> Result<ValueId> {
    let id = graph.find(&tensor.value);
    let id = id
        .ok_or_else(|| foreign(format!("it has no value {}, which tensor {} stands for", tensor.value, tensor.name)))?;
    let shape = graph.value(id).shape;
    if shape.elements() != tensor.shape.elements() {
        return Err(foreign(format!("value {} is {shape:?}, in the record {:?}", tensor.value, tensor.shape)));
    }
    Ok(id)
}

fn foreign(message: String) -> Error {
    let error = Error::new(ErrorCode::Tensors, "model", message);
    error.with_help("give the checkpoint that the image was compiled from")
}
