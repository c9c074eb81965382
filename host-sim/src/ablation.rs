//! What each choice of the quantizer is worth: one model, quantized with one choice switched off at a time.
//!
//! The f64 model stands for the engine, since their bytes are equal; nothing has to be compiled.

use crate::classification::{ClassificationSummary, Comparison};
use crate::controls::{ControlComparison, ControlError, ControlOutputs};
use crate::files::FrameSource;
use crate::points;
use crate::statistics::{ErrorSums, Spread};
use crate::trace::input_codes;
use indicatif::ProgressBar;
use model_compiler::calibrate::{Statistics, calibrate};
use model_compiler::error::{Error, ErrorCode, Result};
use model_compiler::frames::{self, Frame, FrameFormat};
use model_compiler::import::ImportOptions;
use model_compiler::integer_reference;
use model_compiler::ir::{Graph, Op};
use model_compiler::passes::PassOptions;
use model_compiler::pipeline;
use model_compiler::qmodel::{QModel, QTensor};
use model_compiler::quantize::{QuantizeOptions, RangeRule, SkipStages, quantize};
use model_compiler::reference;
use serde::Serialize;
use std::path::PathBuf;

/// One way to quantize.
#[derive(Clone, Debug, PartialEq)]
pub struct Variant {
    /// What tables call it.
    pub name: &'static str,
    /// Choices of the quantizer.
    pub quantize: QuantizeOptions,
    /// Choices of the passes.
    pub passes: PassOptions,
}

/// What a variant reaches over all evaluation frames.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Fidelity {
    /// SQNR of the pooled global vector (of the logits of points; of the first output where nothing is pooled), dB:
    /// power sums over all frames.
    pub vector_sqnr_db: f64,
    /// Mean distance from the f32 waypoint, per waypoint, millimeters.
    pub mean_mm: Vec<f64>,
    /// Largest distance, per waypoint, millimeters.
    pub worst_mm: Vec<f64>,
    /// Of a network that gives controls: distance of each from the f32 network's.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    pub controls: Vec<ControlError>,
    /// Of points: distances from those of f32.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub points: Option<PointFidelity>,
    /// Of a classifier: SQNR of the logits, agreement with f32, accuracy.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub classes: Option<ClassificationSummary>,
}

/// Distances from the f32 point, per point, pixels.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct PointFidelity {
    /// Mean.
    pub mean_px: Vec<f64>,
    /// Largest.
    pub worst_px: Vec<f64>,
}

/// The default with 8-bit and with 16-bit skip values, and the former without one choice each.
pub fn variants() -> Vec<Variant> {
    let base = QuantizeOptions::default();
    let passes = PassOptions::default();
    let variant = |name, quantize: QuantizeOptions| Variant { name, quantize, passes };
    vec![
        variant("8-bit maps", base.clone()),
        variant("16-bit skip streams", QuantizeOptions { skip: SkipStages::wide(), ..base.clone() }),
        variant("without 16-bit token streams", QuantizeOptions { wide_stream: false, ..base.clone() }),
        variant("without own pool scale", QuantizeOptions { own_pool_scale: false, ..base.clone() }),
        Variant {
            name: "without fused residual",
            quantize: base.clone(),
            passes: PassOptions { fuse_residual: false },
        },
        variant("without MSE ranges", QuantizeOptions { ranges: RangeRule::MinMax, ..base.clone() }),
        variant("without bias correction", QuantizeOptions { bias_correction: false, ..base.clone() }),
        variant("without data-aware rounding", QuantizeOptions { data_aware_rounding: false, ..base }),
    ]
}

/// One line of the comparison.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Row {
    /// What is different.
    pub variant: &'static str,
    /// What it reaches.
    pub fidelity: Fidelity,
}

/// What to compare.
#[derive(Clone, Debug)]
pub struct Options {
    /// Checkpoint.
    pub model: PathBuf,
    /// How it is read.
    pub import: ImportOptions,
    /// Calibration frames.
    pub calib: PathBuf,
    /// Evaluation frames.
    pub frames: FrameSource,
    /// Also evaluate on the mirror image of every frame.
    pub mirror: bool,
}

/// Measures every variant on a checkpoint.
///
/// # Errors
/// A file cannot be read, or a variant is refused by the quantizer.
pub fn ablate(options: &Options, progress: &ProgressBar) -> Result<Vec<Row>> {
    let variants = variants();
    let graph = |passes| pipeline::load_graph(&options.model, &options.import, &passes);
    let fused = graph(PassOptions::default())?;
    let format = FrameFormat { resize: options.frames.selection.resize.resize, ..FrameFormat::of_graph(&fused) };
    let calibration = frames::load(&options.calib, &format)?;
    let mut evaluation = options.frames.load(&FrameFormat::of_graph(&fused))?;
    if options.mirror {
        evaluation.extend(evaluation.iter().map(Frame::mirrored).collect::<Vec<_>>());
    }
    progress.set_length((variants.len() * evaluation.len()) as u64);
    progress.set_message("calibrate");
    let mut bench = Bench::new(fused, &calibration, &evaluation)?;
    let mut passes = PassOptions::default();
    let mut rows = Vec::new();
    for variant in variants {
        progress.set_message(variant.name);
        if variant.passes != passes {
            passes = variant.passes;
            bench = Bench::new(graph(passes)?, &calibration, &evaluation)?;
        }
        let fidelity = bench.measure(&variant.quantize, |_| progress.inc(1))?;
        rows.push(Row { variant: variant.name, fidelity });
    }
    progress.finish_and_clear();
    Ok(rows)
}

/// A graph with its statistics and what f32 gives for the evaluation frames.
#[derive(Debug)]
pub struct Bench<'a> {
    graph: Graph,
    calibration: Vec<Vec<Vec<f32>>>,
    statistics: Statistics,
    evaluation: &'a [Frame],
    /// Per frame.
    expected: Vec<Seen>,
    is_classifier: bool,
    controls: Option<ControlOutputs>,
}

/// What one network gives for one frame.
#[derive(Debug)]
struct Seen {
    /// The pooled vector.
    vector: Vec<f32>,
    outputs: Vec<Vec<f32>>,
}

impl<'a> Bench<'a> {
    /// Calibrates a graph and runs f32 on the evaluation frames.
    ///
    /// # Errors
    /// No output in the graph, or frames that it does not accept.
    pub fn new(graph: Graph, calibration: &[Frame], evaluation: &'a [Frame]) -> Result<Self> {
        let vector = vector_name(&graph)?.to_owned();
        let calibration = pipeline::raw_inputs(&graph, calibration)?;
        let statistics = calibrate(&graph, &calibration, |_, _| {})?;
        let mut expected = Vec::with_capacity(evaluation.len());
        for inputs in pipeline::raw_inputs(&graph, evaluation)? {
            let mut seen = Vec::new();
            let outputs = reference::run(&graph, &inputs, |node, data| {
                if node.name == vector {
                    seen = data.to_vec();
                }
            })?;
            expected.push(Seen { vector: seen, outputs });
        }
        let controls = ControlOutputs::find(graph.outputs.iter().map(|&id| graph.value(id).name.as_str()));
        let is_classifier = FrameFormat::of_graph(&graph).classes.is_some();
        Ok(Self { graph, calibration, statistics, evaluation, expected, is_classifier, controls })
    }

    /// Quantizes with these choices and evaluates. `progress` is called after each frame with the number done.
    ///
    /// # Errors
    /// The quantizer refuses the choices.
    pub fn measure(&self, options: &QuantizeOptions, mut progress: impl FnMut(usize)) -> Result<Fidelity> {
        let model = quantize(&self.graph, &self.calibration, &self.statistics, options, |_, _| {})?;
        let mut vectors = ErrorSums::default();
        let mut distances = Vec::new();
        let mut classes = Comparison::default();
        let mut controls = ControlComparison::default();
        for (index, (frame, expected)) in self.evaluation.iter().zip(&self.expected).enumerate() {
            let found = self.integers(&model, frame)?;
            vectors.add(&expected.vector, &found.vector);
            let predicted = |seen: &Seen| self.controls?.read(&seen.outputs);
            let [output, expected_output] = [&found, expected].map(|seen| &seen.outputs[0]);
            if self.is_classifier {
                classes.add(frame, output, Some(expected_output));
            } else if let Some((found, expected)) = predicted(&found).zip(predicted(expected)) {
                controls.add(&found, &expected);
            } else {
                distances.resize(output.len() / 2, Spread::default());
                let pairs = expected_output.chunks_exact(2).zip(output.chunks_exact(2));
                for ((e, f), distance) in pairs.zip(&mut distances) {
                    distance.add(f64::from(e[0] - f[0]).hypot(f64::from(e[1] - f[1])));
                }
            }
            progress(index + 1);
        }
        // Waypoints are in meters, points in pixels.
        let gives_points = points::logits(&self.graph).is_some();
        let unit = if gives_points { 1.0 } else { 1e3 };
        let mean: Vec<f64> = distances.iter().map(|distance| unit * distance.mean()).collect();
        let worst: Vec<f64> = distances.iter().map(|distance| unit * distance.max()).collect();
        let (of_waypoints, points) = match gives_points {
            true => ([vec![], vec![]], Some(PointFidelity { mean_px: mean, worst_px: worst })),
            false => ([mean, worst], None),
        };
        let [mean_mm, worst_mm] = of_waypoints;
        let (vector_sqnr_db, controls, classes) = (vectors.sqnr_db(), controls.summary(), classes.summary());
        Ok(Fidelity { vector_sqnr_db, mean_mm, worst_mm, controls, points, classes })
    }

    fn integers(&self, model: &QModel, frame: &Frame) -> Result<Seen> {
        let vector = vector_name(&self.graph)?;
        let inputs = input_codes(model, frame)?;
        let mut seen = Vec::new();
        let outputs = integer_reference::run(model, &inputs, |_, step, codes| {
            let tensor = model.tensor(step.op.output());
            if tensor.value == vector {
                seen = real(tensor, codes);
            }
        })?;
        let outputs = model.outputs.iter().zip(&outputs).map(|(port, codes)| real(model.tensor(port.tensor), codes));
        Ok(Seen { vector: seen, outputs: outputs.collect() })
    }
}

/// What codes of the f64 model stand for.
fn real(tensor: &QTensor, codes: &[f64]) -> Vec<f32> {
    codes.iter().map(|c| ((c - f64::from(tensor.zero_point)) * tensor.scale) as f32).collect()
}

fn vector_name(graph: &Graph) -> Result<&str> {
    let logits = points::logits(graph).map(|id| graph.value(id).name.as_str());
    let pool = || graph.nodes.iter().rfind(|node| matches!(node.op, Op::GlobalPool)).map(|node| node.name.as_str());
    let output = || graph.outputs.first().map(|&id| graph.value(id).name.as_str());
    logits
        .or_else(pool)
        .or_else(output)
        .ok_or_else(|| Error::new(ErrorCode::Unsupported, &graph.name, "found no output to measure at"))
}
