//! Proof and measure of an image: its bytes against the f64 model, its numbers against the f32 network.

use crate::backends::Backend;
use crate::channels::Channels;
use crate::classification::Comparison;
use crate::codes;
use crate::controls::{ControlComparison, ControlOutputs};
use crate::diff::Diff;
use crate::files::{self, FrameSource, ImageFile};
use crate::gates::Gates;
use crate::noise::{self, Selection};
use crate::points::PixelGrid;
use crate::report::memory::MemoryReport;
use crate::report::{FrameReport, MeanAndMax, StepReport, Summary, VerifyReport, json, worst};
use crate::run::{ModelInfo, Waypoints, waypoints};
use crate::statistics::{ErrorSums, Spread};
use crate::trace::{FrameTrace, StepFigures, Tracer};
use firmware::image::Image;
use firmware::tensor::ElementType;
use indicatif::ProgressBar;
use model_compiler::artifact;
use model_compiler::error::Result;
use model_compiler::frames::{self, Frame, FrameFormat};
use model_compiler::import::ImportOptions;
use model_compiler::ir::Graph;
use model_compiler::qmodel::{QModel, QOp};
use model_compiler::record::Record;
use std::path::PathBuf;

/// What to verify.
#[derive(Clone, Debug)]
pub struct Options {
    /// The image.
    pub image: PathBuf,
    /// Its build record; beside the image if not given.
    pub record: Option<PathBuf>,
    /// The checkpoint that it was compiled from; without it only bytes are compared.
    pub model: Option<PathBuf>,
    /// How the checkpoint is read.
    pub import: ImportOptions,
    /// Frames to run.
    pub frames: FrameSource,
    /// Kernels of the engine.
    pub backend: Backend,
    /// Also run the mirror image of every frame.
    pub mirror: bool,
    /// Limits that the report must keep.
    pub gates: Gates,
    /// Report of an earlier verification to compare with.
    pub baseline: Option<PathBuf>,
    /// Tensors whose share of the output's noise is measured.
    pub noise: Selection,
}

/// A report, and the frames that it is about.
#[derive(Clone, Debug)]
pub struct Verified {
    /// What was found.
    pub report: VerifyReport,
    /// Every frame that was to run, in order; mirror images included.
    pub frames: Vec<Frame>,
}

/// Runs the comparison. Unequal bytes and missed gates are in the report ([`VerifyReport::failure`]), not errors.
///
/// # Errors
/// A file cannot be read, the files do not belong together, or the engine refuses or leaves its arena.
pub fn verify(options: &Options, progress: &ProgressBar) -> Result<Verified> {
    options.gates.check_sources(options.model.is_some(), options.baseline.is_some())?;
    let baseline = options.baseline.as_deref().map(json::read).transpose()?;
    let file = ImageFile::read(&options.image)?;
    let image = file.parse()?;
    let record = file.record(options.record.as_deref())?;
    let graph = options.model.as_deref().map(|path| files::load_graph(path, &options.import)).transpose()?;
    let mut frames = options.frames.load(&FrameFormat::of_model(&record.model))?;
    if options.mirror {
        frames.extend(frames.iter().map(Frame::mirrored).collect::<Vec<_>>());
    }
    let sources = Sources { image, record: &record, graph: graph.as_ref(), backend: options.backend };
    let model = ModelInfo { name: record.model.name.clone(), sha256: artifact::hex(&file.sha256()) };
    let mut report = compare_and_measure(&sources, &frames, model, Some(options.noise), progress)?;
    report.summary.flash_bytes = file.flash_bytes();
    report.baseline = baseline.map(|baseline| Diff::between(&baseline, &report)).transpose()?;
    let outcomes = options.gates.outcomes(&report)?;
    report.check(outcomes);
    Ok(Verified { report, frames })
}

/// Everything that takes part, loaded.
#[derive(Clone, Copy, Debug)]
pub struct Sources<'a> {
    /// The image.
    pub image: Image<'a>,
    /// Its record.
    pub record: &'a Record,
    /// The f32 network.
    pub graph: Option<&'a Graph>,
    /// Kernels of the engine.
    pub backend: Backend,
}

/// Traces frames up to the first with unequal bytes and sums up.
///
/// # Errors
/// See [`Tracer::new`] and [`Tracer::trace`].
pub fn compare(
    sources: &Sources<'_>,
    frames: &[Frame],
    model: ModelInfo,
    progress: &ProgressBar,
) -> Result<VerifyReport> {
    compare_and_measure(sources, frames, model, None, progress)
}

/// The same, and the shares of the noise where they are selected.
fn compare_and_measure(
    sources: &Sources<'_>,
    frames: &[Frame],
    model: ModelInfo,
    noise: Option<Selection>,
    progress: &ProgressBar,
) -> Result<VerifyReport> {
    let record = sources.record;
    let mut tracer = Tracer::new(sources.image, record, sources.graph, sources.backend)?;
    progress.set_length(tracer.units_per_frame() * frames.len() as u64);
    let known = calibration_digests(&record.model);
    let overlap = frames::overlap(&known, frames);
    let (mut waypoint_errors, mut point_errors) = (Vec::new(), Vec::new());
    let is_classifier = FrameFormat::of_model(&record.model).classes.is_some();
    let mut classes = Comparison::default();
    let mut controls = ControlComparison::default();
    let mut first_difference = None;
    let mut frame_reports = Vec::new();
    for frame in frames {
        progress.set_message(frame.name.clone());
        let trace = tracer.trace(frame, progress)?;
        let mut report = frame_report(record, frame, &trace, overlap.contains(&frame.name.as_str()));
        if is_classifier {
            let reference = trace.reference_outputs.as_ref().map(|outputs| outputs[0].as_slice());
            report.classes = Some(classes.add(frame, &trace.outputs[0], reference));
        }
        add_errors(&mut waypoint_errors, &report.waypoint_error_mm);
        add_errors(&mut point_errors, &report.point_error_px);
        if let (Some(found), Some(expected)) = (&report.control, &report.reference_control) {
            controls.add(found, expected);
        }
        frame_reports.push(report);
        first_difference = trace.difference;
        if first_difference.is_some() {
            break;
        }
    }
    progress.finish_and_clear();
    // A frame that the calibration has not seen, if there is one.
    let unseen = frames.iter().find(|frame| !overlap.contains(&frame.name.as_str())).or(frames.first());
    let noise = match (noise, unseen, &first_difference) {
        (Some(selection), Some(frame), None) => noise::shares(&mut tracer, frame, selection, progress)?,
        _ => None,
    };
    let steps = step_reports(record, tracer.figures());
    let summary = Summary {
        accuracy: classes.summary(),
        control_error: controls.summary(),
        ..summary(record, &steps, &waypoint_errors, &point_errors)
    };
    Ok(VerifyReport {
        schema: json::SCHEMA,
        model,
        target: record.target.clone(),
        untrained: false,
        passed: true,
        bytes_equal: first_difference.is_none(),
        first_difference,
        summary,
        steps,
        memory: MemoryReport::of(record),
        noise,
        calibration_frames: overlap.into_iter().map(str::to_owned).collect(),
        frames: frame_reports,
        gates: Vec::new(),
        baseline: None,
        failure: None,
    })
}

/// How the frames that a model was calibrated on are known.
pub(crate) fn calibration_digests(model: &QModel) -> Vec<&str> {
    let digests = model.provenance.iter().find(|(key, _)| key == "calibration_frames");
    digests.map(|(_, digests)| digests.split(',').map(str::trim).collect()).unwrap_or_default()
}

fn frame_report(record: &Record, frame: &Frame, trace: &FrameTrace, calibration: bool) -> FrameReport {
    let model = &record.model;
    let is_waypoints = |port: &model_compiler::qmodel::Port| {
        let tensor = model.tensor(port.tensor);
        let pairs = tensor.element == ElementType::I32 && tensor.shape.channels == 2;
        pairs && PixelGrid::of_model(model, port.tensor).is_none()
    };
    let output = model.outputs.iter().position(is_waypoints);
    let reference = trace.reference_outputs.as_ref();
    let grids = model.outputs.iter().map(|port| PixelGrid::of_model(model, port.tensor));
    let grid = grids.enumerate().find_map(|(i, grid)| Some((i, grid?)));
    let points = grid.map(|(i, grid)| grid.points(&trace.outputs[i]));
    let reference_points = grid.and_then(|(i, grid)| Some(grid.points(&reference?[i])));
    let point_distances = || Some(grid?.1.distances(points.as_ref()?, reference_points.as_ref()?));
    let found = output.map(|i| waypoints(&trace.outputs[i]));
    let expected = output.and_then(|i| Some(waypoints(&reference?[i])));
    let controls = ControlOutputs::find(model.outputs.iter().map(|port| port.name.as_str()));
    let decibels = |position: Option<usize>| Some(trace.accumulated.get(position?)?.sqnr_db());
    let rank = |sums: &ErrorSums| Some(sums.sqnr_db()).filter(|db| !db.is_nan()).unwrap_or(f64::NEG_INFINITY);
    let worst = (0..trace.accumulated.len())
        .min_by(|&a, &b| rank(&trace.accumulated[a]).total_cmp(&rank(&trace.accumulated[b])));
    FrameReport {
        name: frame.name.clone(),
        digest: frame.short_digest(),
        calibration,
        dropped_points: frame.dropped_points,
        worst_step: worst.map(|position| model.steps[record.plan.order[position] as usize].name.clone()),
        worst_sqnr_db: decibels(worst),
        vector_sqnr_db: decibels(vector_position(record)),
        output_sqnr_db: decibels(output_position(record)),
        waypoint_error_mm: found.as_ref().zip(expected.as_ref()).map(|(f, e)| distances_mm(f, e)).unwrap_or_default(),
        point_error_px: point_distances().unwrap_or_default(),
        waypoints: found,
        reference_waypoints: expected,
        control: controls.and_then(|controls| controls.read(&trace.outputs)),
        reference_control: controls.and_then(|controls| controls.read(reference?)),
        points,
        reference_points,
        classes: None,
    }
}

/// Position of the step that writes the last pooled vector; what points come from is a map, whatever is pooled beside
/// it.
fn vector_position(record: &Record) -> Option<usize> {
    let is_pool = |&step: &u32| matches!(record.model.steps[step as usize].op, QOp::GlobalPool { .. });
    let points = record.model.outputs.first().and_then(|port| PixelGrid::of_model(&record.model, port.tensor));
    record.plan.order.iter().rposition(is_pool).filter(|_| points.is_none())
}

/// Position of the step that writes the first output.
fn output_position(record: &Record) -> Option<usize> {
    let output = record.model.outputs.first()?.tensor;
    record.plan.order.iter().rposition(|&step| record.model.steps[step as usize].op.output() == output)
}

fn add_errors(errors: &mut Vec<Spread>, of_frame: &[f64]) {
    errors.resize(errors.len().max(of_frame.len()), Spread::default());
    for (spread, error) in errors.iter_mut().zip(of_frame) {
        spread.add(*error);
    }
}

fn means_and_maxima(errors: &[Spread]) -> Vec<MeanAndMax> {
    errors.iter().map(|spread| MeanAndMax { mean: spread.mean(), max: spread.max() }).collect()
}

fn distances_mm(found: &Waypoints, expected: &Waypoints) -> Vec<f64> {
    let distance = |(f, e): (&[f64; 2], &[f64; 2])| 1000.0 * (f[0] - e[0]).hypot(f[1] - e[1]);
    found.iter().zip(expected).map(distance).collect()
}

fn step_reports(record: &Record, figures: &[StepFigures]) -> Vec<StepReport> {
    let steps = record.plan.order.iter().map(|&step| &record.model.steps[step as usize]);
    let report = |(position, (step, figures)): (usize, (&model_compiler::qmodel::QStep, &StepFigures))| {
        let tensor = record.model.tensor(step.op.output());
        let elements = tensor.shape.elements();
        StepReport {
            position,
            step: step.name.clone(),
            op: step.op.name().into(),
            tensor: tensor.name.clone(),
            shape: [tensor.shape.height, tensor.shape.width, tensor.shape.channels],
            element: codes::element_name(tensor.element).into(),
            scale: tensor.scale,
            zero_point: tensor.zero_point,
            clip: codes::clip_range(tensor, &step.op),
            local_sqnr_db: figures.local.map(|sums| sums.sqnr_db()),
            sqnr_db: figures.accumulated.map(|sums| sums.sqnr_db()),
            cosine: figures.accumulated.map(|sums| sums.cosine()),
            max_error_lsb: figures.local.map(|sums| sums.largest_error() / tensor.scale),
            saturation_ppm: figures.saturated.map(|n| 1e6 * n as f64 / figures.codes.max(1) as f64),
            headroom_bits: step.bounds.headroom_bits,
            bytes: elements * u64::from(tensor.element.bytes()),
            bytes_equal: figures.equal,
            histogram: figures.histogram.clone(),
            channels: figures.channels.as_ref().map(Channels::rounded),
        }
    };
    steps.zip(figures).enumerate().map(report).collect()
}

fn summary(record: &Record, steps: &[StepReport], waypoint_errors: &[Spread], point_errors: &[Spread]) -> Summary {
    let plan = &record.plan;
    let step = |position: Option<usize>| steps.get(position?);
    let (vector, output) = (step(vector_position(record)), step(output_position(record)));
    Summary {
        steps: steps.len(),
        worst_step: worst(steps).map(|step| step.step.clone()),
        worst_sqnr_db: worst(steps).and_then(|step| step.sqnr_db),
        vector_step: vector.map(|step| step.step.clone()),
        vector_sqnr_db: vector.and_then(|step| step.sqnr_db),
        output_step: output.map(|step| step.step.clone()),
        output_sqnr_db: output.and_then(|step| step.sqnr_db),
        waypoint_error_mm: means_and_maxima(waypoint_errors),
        control_error: Vec::new(),
        point_error_px: means_and_maxima(point_errors),
        arena_bytes: plan.arena_bytes(),
        arena_bound_bytes: plan.bound_bytes(),
        arena_status: plan.status(),
        flash_bytes: 0,
        accuracy: None,
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::testing::{Sample, frame, graph, sample};
    use model_compiler::error::ErrorCode;
    use std::fs;

    fn info() -> ModelInfo {
        ModelInfo { name: "sample".into(), sha256: String::new() }
    }

    fn compare_sample(sample: &Sample, graph: Option<&Graph>, frames: &[Frame]) -> Result<VerifyReport> {
        let image = Image::parse(&sample.image).expect("the sample is a valid image");
        let sources = Sources { image, record: &sample.record, graph, backend: Backend::choose(None)? };
        compare(&sources, frames, info(), &ProgressBar::hidden())
    }

    #[test]
    fn engine_f64_model_and_f32_network_agree_on_the_sample() {
        let report = compare_sample(&sample(), Some(&graph()), &[frame(0), frame(1), frame(2)]).unwrap();
        assert!(report.bytes_equal && report.first_difference.is_none());
        assert_eq!(report.frames.len(), 3);
        assert_eq!(report.calibration_frames, ["frame 1"]);
        // All values are exact: codes are whole grey levels, means whole quarters.
        for step in &report.steps {
            assert_eq!((step.local_sqnr_db, step.sqnr_db), (Some(f64::INFINITY), Some(f64::INFINITY)), "{}", step.step);
        }
        assert_eq!(
            (&*report.steps[1].op, &*report.steps[1].element, report.steps[1].bytes),
            ("average_pool", "i16", 6)
        );
        assert_eq!(report.steps[0].saturation_ppm, None);
        assert_eq!(report.steps[1].saturation_ppm, Some(0.0));
    }

    #[test]
    fn a_record_of_other_integers_is_found_at_its_first_step() {
        let mut sample = sample();
        if let model_compiler::qmodel::QOp::AveragePool { requant, .. } = &mut sample.record.model.steps[1].op {
            requant.multiplier += 1 << 12;
        }
        let report = compare_sample(&sample, None, &[frame(0), frame(1)]).unwrap();
        let difference = report.first_difference.expect("the multiplier differs");
        assert_eq!((difference.position, difference.step.as_str(), difference.tensor.as_str()), (1, "mean", "mean"));
        assert_ne!(difference.found, difference.expected);
        assert_eq!(report.frames.len(), 1, "later frames are not run");
        assert!(report.steps[0].bytes_equal && !report.steps[1].bytes_equal);
    }

    #[test]
    fn noise_of_one_step_is_told_apart_from_what_adds_up() {
        // A network whose first pool is something else: the second step is exact by itself, its value is not.
        let mut other = graph();
        if let model_compiler::ir::Op::MaxPool(window) = &other.nodes[1].op {
            other.nodes[1].op = model_compiler::ir::Op::AveragePool(*window);
        }
        let report = compare_sample(&sample(), Some(&other), &[frame(3)]).unwrap();
        assert!(report.steps[0].local_sqnr_db.unwrap() < 40.0);
        assert_eq!(report.steps[1].local_sqnr_db, Some(f64::INFINITY));
        assert!(report.steps[1].sqnr_db.unwrap() < 40.0);
        assert!(report.steps[0].max_error_lsb.unwrap() > 1.0);
    }

    #[test]
    fn files_that_do_not_belong_together_are_refused() {
        let mut other = graph();
        other.nodes[1].name = "elsewhere".into();
        other.values[1].name = "elsewhere".into();
        let error = compare_sample(&sample(), Some(&other), &[frame(0)]).unwrap_err();
        assert!(error.to_string().contains("it has no value pool"), "{error}");
        let mut bigger = sample();
        bigger.record.plan.regions[0].bytes += 16;
        let error = compare_sample(&bigger, None, &[frame(0)]).unwrap_err();
        assert_eq!(error.message, "the image has 80 bytes in region main, the record 96");
        let blind = Frame { rgb: None, ..frame(0) };
        assert_eq!(compare_sample(&sample(), None, &[blind]).unwrap_err().code, ErrorCode::Frames);
    }

    /// Image, record and frames as files.
    fn files(sample: &Sample) -> (tempfile::TempDir, Options) {
        let folder = tempfile::tempdir().unwrap();
        let path = |name: &str| folder.path().join(name);
        fs::write(path("sample.img"), &*sample.image).unwrap();
        fs::write(path("sample.record"), artifact::to_bytes(&sample.record).unwrap()).unwrap();
        let pixels: Vec<u8> = (0..2 * 48).collect();
        let rgb = safetensors::tensor::TensorView::new(safetensors::Dtype::U8, vec![2, 3, 4, 4], &pixels).unwrap();
        fs::write(path("inputs.safetensors"), safetensors::serialize([("rgb", rgb)], None).unwrap()).unwrap();
        let options = Options {
            image: path("sample.img"),
            record: None,
            model: None,
            import: ImportOptions::default(),
            frames: FrameSource { inputs: Some(path("inputs.safetensors")), ..FrameSource::default() },
            backend: Backend::choose(None).unwrap(),
            mirror: false,
            gates: Gates::default(),
            baseline: None,
            noise: Selection::WhereCheap,
        };
        (folder, options)
    }

    #[test]
    fn files_are_verified_with_their_mirror_images() {
        let (_folder, mut options) = files(&sample());
        let report = verify(&options, &ProgressBar::hidden()).unwrap().report;
        assert!(report.passed);
        assert_eq!((report.frames.len(), report.summary.flash_bytes), (2, sample().image.len() as u64));
        options.mirror = true;
        let report = verify(&options, &ProgressBar::hidden()).unwrap().report;
        assert_eq!(report.frames[3].name, "inputs#1 (mirrored)");
        options.gates.min_sqnr_db = Some(10.0);
        let error = verify(&options, &ProgressBar::hidden()).unwrap_err();
        assert_eq!((error.code, error.help.as_str()), (ErrorCode::Usage, "add --model MODEL"));
    }

    #[test]
    fn a_record_of_another_build_is_refused() {
        let mut sample = sample();
        sample.record.image_sha256[0] ^= 1;
        let (folder, options) = files(&sample);
        let error = verify(&options, &ProgressBar::hidden()).unwrap_err();
        assert!(error.message.contains("the record belongs to another image"), "{error}");
        fs::remove_file(folder.path().join("sample.record")).unwrap();
        let error = verify(&options, &ProgressBar::hidden()).unwrap_err();
        assert!(error.location.ends_with("sample.record") && error.help.contains("--record"), "{error}");
    }

    #[test]
    fn a_file_that_is_no_image_is_refused() {
        let (folder, options) = files(&sample());
        fs::write(folder.path().join("sample.img"), b"PK\x03\x04").unwrap();
        let error = verify(&options, &ProgressBar::hidden()).unwrap_err();
        assert!(error.to_string().contains("this is no model image"), "{error}");
    }
}
