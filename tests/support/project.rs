//! A small network with all its files, and host-sim run on them as a user would.

use crate::build;
use crate::golden::{self, Network};
use host_sim::cli::{self, Console};
use model_compiler::frames::{ByteMap, Frame};
use model_compiler::import::System;
use model_compiler::pipeline::{self, Compiled};
use model_compiler::quantize::QuantizeOptions;
use safetensors::Dtype;
use safetensors::tensor::TensorView;
use serde_json::Value;
use std::path::{Path, PathBuf};
use tempfile::TempDir;

/// A folder with `net.safetensors` (checkpoint), `net.img`, `net.record` and `inputs.safetensors` (the calibration
/// frames).
pub struct Project {
    folder: TempDir,
    /// Image and record.
    pub compiled: Compiled,
}

/// What a command left behind.
pub struct Outcome {
    /// Exit status.
    pub status: u8,
    /// Standard output.
    pub out: String,
    /// Standard error.
    pub err: String,
}

impl Project {
    /// A small network of a system.
    ///
    /// # Panics
    /// The network cannot be compiled or written.
    pub fn new(system: System) -> Self {
        let network = Network::small(system);
        let graph = build::small(&network);
        let folder = tempfile::tempdir().unwrap();
        golden::write_safetensors(&network.tensors(), &folder.path().join("net.safetensors")).unwrap();
        let inputs = folder.path().join("inputs.safetensors");
        write_inputs(&build::frames_of(&graph), &inputs);
        let frames = pipeline::load_frames(&graph, &inputs).unwrap();
        let options = QuantizeOptions::default();
        let model = pipeline::quantize_graph(&graph, &frames, &options, &mut |_, _, _| {}).unwrap();
        let compiled = build::compiled(&model);
        pipeline::write(&compiled, &folder.path().join("net.img")).unwrap();
        Self { folder, compiled }
    }

    /// A file of the folder.
    pub fn path(&self, name: &str) -> PathBuf {
        self.folder.path().join(name)
    }

    /// Runs a command of host-sim; words that name a file of the project become its path.
    ///
    /// # Panics
    /// The output is no text.
    pub fn host_sim(&self, command: &str) -> Outcome {
        let word = |word: &str| if self.path(word).exists() { self.path(word).into() } else { word.into() };
        let arguments = std::iter::once("host-sim".into()).chain(command.split(' ').map(word));
        let (mut out, mut err) = (Vec::new(), Vec::new());
        let status = cli::main(arguments, Console { out: &mut out, err: &mut err });
        Outcome { status, out: String::from_utf8(out).unwrap(), err: String::from_utf8(err).unwrap() }
    }

    /// Exit status and JSON document of a command.
    ///
    /// # Panics
    /// The output is no JSON.
    pub fn json(&self, command: &str) -> (u8, Value) {
        let outcome = self.host_sim(command);
        let document = serde_json::from_str(&outcome.out);
        (outcome.status, document.unwrap_or_else(|e| panic!("{e}: {}{}", outcome.out, outcome.err)))
    }
}

/// The frames as a file of raw inputs, planes first.
fn write_inputs(frames: &[Frame], path: &Path) {
    let planes = |map: &ByteMap| -> Vec<u8> {
        let channels = usize::from(map.shape.channels);
        (0..channels).flat_map(|c| map.data.iter().skip(c).step_by(channels).copied()).collect()
    };
    let bytes = |map: fn(&Frame) -> &Option<ByteMap>| -> Vec<u8> {
        frames.iter().flat_map(|frame| map(frame).iter().flat_map(planes).collect::<Vec<_>>()).collect()
    };
    let floats = |values: fn(&Frame) -> Vec<f64>| -> Vec<u8> {
        frames.iter().flat_map(values).flat_map(|v| (v as f32).to_le_bytes()).collect()
    };
    let commands = frames.iter().flat_map(|f| i32::from(f.command.unwrap_or(0)).to_le_bytes()).collect();
    let shape = frames[0].rgb.as_ref().unwrap().shape;
    let (count, height, width) = (frames.len(), usize::from(shape.height), usize::from(shape.width));
    let tensors = [
        ("rgb", Dtype::U8, vec![count, 3, height, width], bytes(|f| &f.rgb)),
        ("bev", Dtype::U8, vec![count, 2, height, width], bytes(|f| &f.bev)),
        ("velocity", Dtype::F32, vec![count], floats(|f| f.velocity.into_iter().collect())),
        ("target", Dtype::F32, vec![count, 2], floats(|f| f.goal.into_iter().flatten().collect())),
        ("command", Dtype::I32, vec![count], commands),
    ];
    let views = tensors.iter().map(|(name, element, shape, data)| {
        (*name, TensorView::new(*element, shape.clone(), data).expect("shape and data agree"))
    });
    std::fs::write(path, safetensors::serialize(views, None).unwrap()).unwrap();
}
