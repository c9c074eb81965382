//! The bundled example: a small untrained TransFuser and procedural frames. Everything here is a pure function of
//! seeds.
//!
//! `cargo run --release -p tests --example make_bundle` writes it; `tests/demo.rs` checks that the stored files are
//! what this module gives.

use crate::golden::{self, Network};
use model_compiler::error::Result;
use model_compiler::frames::{self, Frame, FrameFormat};
use model_compiler::import::{ImportOptions, NamedTensors, System, TensorData, import};
use model_compiler::memory_plan::PlanOptions;
use model_compiler::passes::PassOptions;
use model_compiler::pipeline::{self, Compiled};
use model_compiler::quantize::QuantizeOptions;
use model_compiler::target::Target;
use std::fs;
use std::ops::Range;
use std::path::{Path, PathBuf};

mod scene;
mod sensors;
mod statistics;

pub use scene::Scene;
pub use sensors::Recording;

/// Scenes of the calibration frames.
pub const CALIBRATION: Range<u64> = 0..3;
/// Scenes of the evaluation frames.
pub const EVALUATION: Range<u64> = 3..6;
/// Scenes that batch-norm statistics are measured on; they are not stored.
const MEASURED: Range<u64> = 100..124;

/// A TransFuser whose activations fit a microcontroller: published layout, a quarter of the width, half the resolution.
pub fn network() -> Network {
    Network {
        stem: 16,
        widths: [16, 32, 64, 128],
        image_blocks: [2, 2, 3, 1],
        lidar_blocks: [1; 4],
        layers: 2,
        grid: (4, 4),
        join: vec![96, 64, 64],
        ..Network::published(System::TransFuser)
    }
}

/// The frame of a scene, as a network of this size reads it.
pub fn frame(seed: u64) -> Frame {
    Recording::of(&Scene::new(seed)).frame(format!("scene-{seed}"))
}

/// Generated weights with measured batch-norm statistics.
///
/// # Errors
/// The network is not one that the importer accepts.
pub fn checkpoint() -> Result<NamedTensors> {
    let mut tensors = golden::generate(&network().shapes());
    let graph = import("transfuser-small", tensors.clone(), &ImportOptions::default())?;
    let frames: Vec<Frame> = MEASURED.map(frame).collect();
    for (norm, statistics) in statistics::measure(&graph, pipeline::raw_inputs(&graph, &frames)?) {
        for (leaf, values) in [("running_mean", statistics.mean), ("running_var", statistics.variance)] {
            if let Some(tensor) = tensors.get_mut(&format!("{norm}.{leaf}")) {
                tensor.data = TensorData::Float(values);
            }
        }
    }
    Ok(tensors)
}

/// The stored checkpoint.
pub fn checkpoint_path() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("model-compiler/checkpoints/transfuser-small.safetensors")
}

/// The stored frames of a set: `calibration` or `evaluation`.
pub fn frames_path(set: &str) -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("host-sim/frames").join(set)
}

/// The stored checkpoint, compiled for a microcontroller.
///
/// # Panics
/// It is refused.
pub fn for_microcontroller() -> Compiled {
    let compile = || {
        let (import, passes) = (ImportOptions::default(), PassOptions::default());
        let graph = pipeline::load_graph(&checkpoint_path(), &import, &passes)?;
        let frames = frames::load(&frames_path("calibration"), &FrameFormat::of_graph(&graph))?;
        let model = pipeline::quantize_graph(&graph, &frames, &QuantizeOptions::default(), &mut |_, _, _| {})?;
        let target = Target::find("cortex-m4")?;
        pipeline::compile(&model, &target, &PlanOptions::for_target(&target), &mut |_, _, _| {})
    };
    compile().unwrap_or_else(|e| panic!("{e}"))
}

/// Writes checkpoint and frames to their places.
///
/// # Errors
/// A file cannot be made or written.
pub fn write() -> std::result::Result<(), Box<dyn std::error::Error>> {
    golden::write_safetensors(&checkpoint()?, &checkpoint_path())?;
    for (set, seeds) in [("calibration", CALIBRATION), ("evaluation", EVALUATION)] {
        for seed in seeds {
            let folder = frames_path(set).join(format!("scene-{seed}"));
            fs::create_dir_all(&folder)?;
            Recording::of(&Scene::new(seed)).write(&folder)?;
        }
    }
    Ok(())
}
