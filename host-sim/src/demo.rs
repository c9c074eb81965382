//! What `host-sim` does without arguments: the whole way from a checkpoint to verified waypoints, on files of the
//! source tree.
//!
//! ```text
//! checkpoint ─► import ─► calibrate, quantize ─► compile for a microcontroller ─► demo.img, demo.record
//!                              ▲                                                        │
//!                     calibration frames                  evaluation frames ─► run and verify ─► report.html, report.json
//! ```
//!
//! The bundled network is small and untrained. What the demo shows is that the engine computes what the arithmetic's
//! definition says, to the last byte, and how near that is to f32; never how to drive.

use crate::backends::Backend;
use crate::files::{self, FrameSource};
use crate::gates::Gates;
use crate::noise::Selection;
use crate::report::{self, VerifyReport, terminal};
use crate::verify::{self, Verified};
use indicatif::ProgressBar;
use model_compiler::error::{Error, ErrorCode, Result};
use model_compiler::frames::Frame;
use model_compiler::import::ImportOptions;
use model_compiler::ir::Graph;
use model_compiler::memory_plan::PlanOptions;
use model_compiler::pipeline::{self, Compiled};
use model_compiler::qmodel::QModel;
use model_compiler::quantize::QuantizeOptions;
use model_compiler::target::Target;
use std::path::{Path, PathBuf};

/// What must be known before anything else.
pub const NOTICE: &str = "\
The bundled network is untrained: its weights are random numbers, so its waypoints mean nothing.
Look at the bytes, at the memory and at the distance from f32, not at where it would drive.";

const TARGET: &str = "cortex-m7";

/// The files that the demo starts from.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Bundle {
    root: PathBuf,
}

impl Bundle {
    /// The files of the source tree that this program was built from.
    ///
    /// # Errors
    /// The tree is gone or was moved.
    pub fn of_sources() -> Result<Self> {
        let crate_folder = Path::new(env!("CARGO_MANIFEST_DIR"));
        Self::in_workspace(crate_folder.parent().unwrap_or(crate_folder))
    }

    /// The files of the workspace at `root`.
    ///
    /// # Errors
    /// One of them is not there.
    pub fn in_workspace(root: &Path) -> Result<Self> {
        let bundle = Self { root: root.to_path_buf() };
        let files = [bundle.checkpoint(), bundle.frames("calibration"), bundle.frames("evaluation")];
        match files.iter().find(|path| !path.exists()) {
            None => Ok(bundle),
            Some(path) => {
                Err(Error::new(ErrorCode::Io, path.display().to_string(), "this file of the demo is missing")
                    .with_help(
                        "the demo reads the source tree that it was built from: go to the tree and start it with \
                     `cargo run --release -p host-sim`; for files elsewhere there are `run` and `verify`",
                    ))
            }
        }
    }

    /// The network.
    pub fn checkpoint(&self) -> PathBuf {
        self.root.join("model-compiler/checkpoints/transfuser-small.safetensors")
    }

    /// Frame directory `calibration` or `evaluation`.
    pub fn frames(&self, set: &str) -> PathBuf {
        self.root.join("host-sim/frames").join(set)
    }

    /// Where results go unless told otherwise.
    pub fn default_out(&self) -> PathBuf {
        self.root.join("target/demo")
    }
}

/// Compiles the bundled network, runs and verifies it, and writes `demo.img`, `demo.record`, `report.html` and
/// `report.json` to `out`.
/// `say` gets the text for people, piece by piece. Unequal bytes are in the report, no error.
///
/// # Errors
/// A bundled file is damaged, or `out` cannot be written.
pub fn demo(bundle: &Bundle, out: &Path, progress: &ProgressBar, say: &mut dyn FnMut(&str)) -> Result<VerifyReport> {
    say(NOTICE);
    let graph = files::load_graph(&bundle.checkpoint(), &ImportOptions::default())?;
    say(&imported(bundle, &graph));
    let model = quantized(bundle, &graph, progress, say)?;
    let target = Target::find(TARGET)?;
    let mut show = |stage: &str, done: usize, total: usize| show_stage(progress, stage, done, total);
    let compiled = pipeline::compile(&model, &target, &PlanOptions::for_target(&target), &mut show)?;
    let image = out.join("demo.img");
    std::fs::create_dir_all(out).map_err(|e| Error::io(out, &e))?;
    pipeline::write(&compiled, &image)?;
    say(&compiled_for(&compiled));
    let Verified { mut report, frames } = verified(bundle, image, progress)?;
    report.untrained = true;
    report::write(out, &report, &frames)?;
    say(&results(bundle, out, &report));
    Ok(report)
}

fn imported(bundle: &Bundle, graph: &Graph) -> String {
    format!(
        "\nimport     {}: {} parameters, {:.1} million multiply-accumulates",
        shown(&bundle.checkpoint()),
        graph.parameters(),
        graph.macs() as f64 / 1e6
    )
}

fn quantized(bundle: &Bundle, graph: &Graph, progress: &ProgressBar, say: &mut dyn FnMut(&str)) -> Result<QModel> {
    let folder = bundle.frames("calibration");
    let mut frames = pipeline::load_frames(graph, &folder)?;
    frames.extend(frames.iter().map(Frame::mirrored).collect::<Vec<_>>());
    let mut show = |stage: &str, done: usize, total: usize| show_stage(progress, stage, done, total);
    let model = pipeline::quantize_graph(graph, &frames, &QuantizeOptions::default(), &mut show)?;
    say(&format!("calibrate  {} frames: those of {} and their mirror images", frames.len(), shown(&folder)));
    say(&format!("quantize   {} tensors, {} integer steps", model.tensors.len(), model.steps.len()));
    Ok(model)
}

fn compiled_for(compiled: &Compiled) -> String {
    let (record, plan) = (&compiled.record, &compiled.record.plan);
    format!("compile    for {}: image {} B, arena {} B", record.target, compiled.image.len(), plan.arena_bytes())
}

fn verified(bundle: &Bundle, image: PathBuf, progress: &ProgressBar) -> Result<Verified> {
    let options = verify::Options {
        image,
        record: None,
        model: Some(bundle.checkpoint()),
        import: ImportOptions::default(),
        frames: FrameSource { frames: Some(bundle.frames("evaluation")), ..FrameSource::default() },
        backend: Backend::choose(None)?,
        mirror: true,
        gates: Gates::default(),
        baseline: None,
        noise: Selection::WhereCheap,
    };
    progress.reset();
    verify::verify(&options, progress)
}

fn results(bundle: &Bundle, out: &Path, report: &VerifyReport) -> String {
    let frames = shown(&bundle.frames("evaluation"));
    format!(
        "verify     {} frames: those of {frames} and their mirror images\n\n\
         Waypoints in meters (of an untrained network: they mean nothing)\n\n{}\n\n{}\n\
         Written to {}: demo.img (to flash), demo.record (what it is made of), report.html (to \
         look at), report.json (every figure)\n\
         Once more by hand: cargo run --release -p host-sim -- verify {} --model {} --frames {frames} --mirror",
        report.frames.len(),
        terminal::waypoints(&report.frames),
        terminal::summary(report),
        shown(out),
        shown(&out.join("demo.img")),
        shown(&bundle.checkpoint()),
    )
}

/// A path as people type it: from the current folder, if it lies below.
fn shown(path: &Path) -> String {
    let here = std::env::current_dir().unwrap_or_default();
    path.strip_prefix(here).unwrap_or(path).display().to_string()
}

fn show_stage(progress: &ProgressBar, stage: &str, done: usize, total: usize) {
    progress.set_message(stage.to_owned());
    progress.set_length(total as u64);
    progress.set_position(done as u64);
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_moved_tree_is_told_with_its_remedy() {
        let elsewhere = tempfile::tempdir().unwrap();
        let error = Bundle::in_workspace(elsewhere.path()).unwrap_err();
        assert_eq!(error.code, ErrorCode::Io);
        assert!(error.location.ends_with("transfuser-small.safetensors"), "{error}");
        assert!(error.help.contains("cargo run --release -p host-sim"), "{error}");
    }

    #[test]
    fn paths_below_the_current_folder_are_short() {
        let bundle = Bundle::of_sources().unwrap();
        // Unit tests run in the folder of their crate.
        assert_eq!(shown(&bundle.frames("evaluation")), "frames/evaluation");
        assert_eq!(shown(Path::new("/elsewhere/a")), "/elsewhere/a");
    }
}
