//! The way from a checkpoint to an image, a line per stage.

use crate::artifact::{self, hex};
use crate::calibrate::calibrate;
use crate::emit::{self, emit};
use crate::error::{Error, ErrorCode, Result};
use crate::frames::{self, Frame, FrameFormat};
use crate::import::{self, ImportOptions};
use crate::ir::Graph;
use crate::known_answer::known_answer;
use crate::memory_plan::{self, PlanOptions};
use crate::pack::pack;
use crate::passes::{self, PassOptions};
use crate::qmodel::QModel;
use crate::quantize::{QuantizeOptions, quantize};
use crate::record::Record;
use crate::target::Target;
use std::path::Path;

/// Where the stages report how far they are: stage name, units done, units in all.
pub type Progress<'a> = &'a mut dyn FnMut(&str, usize, usize);

/// A checkpoint or ONNX file as an optimized float graph.
///
/// # Errors
/// Those of [`import::read`]; the file is named.
pub fn load_graph(path: &Path, import: &ImportOptions, passes: &PassOptions) -> Result<Graph> {
    let name = path.display().to_string();
    let mut graph = import::read(path, import)?;
    graph.name = path.file_stem().map_or(name.clone(), |stem| stem.to_string_lossy().into_owned());
    passes::optimize_with(&mut graph, *passes).map_err(|e| e.within(name))?;
    Ok(graph)
}

/// The raw inputs of frames in the graph's order.
///
/// # Errors
/// A frame without one of the graph's inputs.
pub fn raw_inputs(graph: &Graph, frames: &[Frame]) -> Result<Vec<Vec<Vec<f32>>>> {
    frames.iter().map(|frame| graph.inputs().map(|(_, kind)| frame.raw(kind)).collect()).collect()
}

/// Calibrates a graph on frames and quantizes it.
///
/// # Errors
/// See [`calibrate`] and [`quantize`].
pub fn quantize_graph(
    graph: &Graph,
    calibration: &[Frame],
    options: &QuantizeOptions,
    progress: Progress<'_>,
) -> Result<QModel> {
    let inputs = raw_inputs(graph, calibration)?;
    let statistics = calibrate(graph, &inputs, |done, total| progress("calibrate", done, total))?;
    progress("quantize", 0, 1);
    let mut model = quantize(graph, &inputs, &statistics, options, |done, total| progress("quantize", done, total))?;
    let digests: Vec<String> = calibration.iter().map(Frame::short_digest).collect();
    model.provenance = vec![
        ("calibration_frames".into(), digests.join(",")),
        ("skip_stages".into(), options.skip.to_string()),
        ("ranges".into(), format!("{:?}", options.ranges)),
        ("bias_correction".into(), options.bias_correction.to_string()),
        ("data_aware_rounding".into(), options.data_aware_rounding.to_string()),
        ("wide_stream".into(), options.wide_stream.to_string()),
        ("own_pool_scale".into(), options.own_pool_scale.to_string()),
        ("max_velocity".into(), options.max_velocity.to_string()),
    ];
    Ok(model)
}

/// Loads calibration frames for a graph.
///
/// # Errors
/// Missing or damaged frames.
pub fn load_frames(graph: &Graph, path: &Path) -> Result<Vec<Frame>> {
    frames::load(path, &FrameFormat::of_graph(graph))
}

/// An image and its record.
#[derive(Clone, Debug)]
pub struct Compiled {
    /// The bytes to flash.
    pub image: Vec<u8>,
    /// What they were made of.
    pub record: Record,
}

impl Compiled {
    /// The same with another revision of the model; a fresh image has revision 0.
    ///
    /// # Errors
    /// The image is none.
    pub fn with_revision(mut self, revision: u32) -> Result<Self> {
        self.image = emit::with_revision(&self.image, revision)?;
        self.record.image_sha256 = artifact::sha256(&self.image);
        Ok(self)
    }
}

/// Plans, packs and emits a quantized model for a target.
///
/// # Errors
/// The model does not fit the target (by how much, and which step is the peak), or the plan fails its own check.
pub fn compile(model: &QModel, target: &Target, options: &PlanOptions, progress: Progress<'_>) -> Result<Compiled> {
    progress("plan", 0, 1);
    let plan = memory_plan::plan(model, target, options)?;
    memory_plan::check(model, &plan).map_err(|violations| {
        Error::new(ErrorCode::Check, "memory plan", violations.join("\n  "))
            .with_help("this is a defect of the planner")
    })?;
    progress("plan", 1, 1);
    let mut parts = pack(model, &plan)?;
    parts.target = target.name.clone();
    parts.known_answer = Some(known_answer(model, &plan, |done, total| progress("known answer", done, total))?);
    progress("emit", 0, 1);
    let image = emit(&parts)?;
    target.fits(model, &plan, image.len() as u64)?;
    progress("emit", 1, 1);
    let record =
        Record { image_sha256: artifact::sha256(&image), target: target.name.clone(), model: model.clone(), plan };
    Ok(Compiled { image, record })
}

/// Writes `OUT.img` and `OUT.record`.
///
/// # Errors
/// A file cannot be written; then neither is left half-written, nor one without the other.
pub fn write(compiled: &Compiled, image_path: &Path) -> Result<()> {
    write_with(compiled, image_path, &[])
}

/// Writes `OUT.img`, `OUT.record` and other files that belong to them.
///
/// # Errors
/// A file cannot be written; then none is left half-written, nor one without the others.
pub fn write_with(compiled: &Compiled, image_path: &Path, others: &[(&Path, &[u8])]) -> Result<()> {
    let (record, record_path) = (artifact::to_bytes(&compiled.record)?, record_path(image_path));
    let mut files = vec![(record_path.as_path(), record.as_slice())];
    files.extend_from_slice(others);
    files.push((image_path, &compiled.image));
    artifact::write_files(&files)
}

/// The record that belongs to an image: the same name with the extension `record`.
pub fn record_path(image_path: &Path) -> std::path::PathBuf {
    image_path.with_extension("record")
}

/// One line per fact about a compiled image, for people.
pub fn summary(compiled: &Compiled) -> Vec<(String, String)> {
    let (model, plan) = (&compiled.record.model, &compiled.record.plan);
    let weights = model.steps.iter().map(|s| s.op.weight_bytes()).sum::<u64>();
    let mut facts = vec![
        ("model".into(), format!("{} ({})", model.name, model.system)),
        ("target".into(), compiled.record.target.clone()),
        ("steps".into(), model.steps.len().to_string()),
        (
            "image".into(),
            format!(
                "{} B, {:.4} of its {} B of int8 weights",
                compiled.image.len(),
                compiled.image.len() as f64 / weights.max(1) as f64,
                weights
            ),
        ),
        (
            "arena".into(),
            format!(
                "{} B ({:.3} MiB), bound {} B: {}",
                plan.arena_bytes(),
                mib(plan.arena_bytes()),
                plan.bound_bytes(),
                plan.status().words()
            ),
        ),
    ];
    let step = |position: u32| format!("step {position} {}", model.steps[plan.order[position as usize] as usize].name);
    match plan.regions.as_slice() {
        [only] => facts.push(("peak".into(), step(only.peak_step))),
        parts => facts.extend(parts.iter().map(|part| {
            let of = part.capacity.map(|capacity| format!(" of {capacity} B")).unwrap_or_default();
            let share = 100.0 * plan.traffic_share(part);
            let (bytes, bound, status) = (part.bytes, part.bound_bytes, part.status.words());
            let text = format!("{bytes} B{of}, bound {bound} B: {status}; {share:.1} % of the traffic");
            (part.name.clone(), format!("{text}; peak {}", step(part.peak_step)))
        })),
    }
    facts.push(("sha256".into(), hex(&compiled.record.image_sha256)));
    facts
}

fn mib(bytes: u64) -> f64 {
    bytes as f64 / f64::from(1 << 20)
}
