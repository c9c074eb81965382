//! ONNX Runtime as the judge of imported networks: our f32 interpreter, before and after the passes, against it.

use crate::onnx_file::OnnxFile;
use crate::random::Random;
use model_compiler::import::{ImportOptions, onnx};
use model_compiler::ir::{Graph, Normalization, Shape};
use model_compiler::{passes, reference};
use serde_json::json;
use std::io::Write;
use std::path::PathBuf;
use std::process::{Command, Stdio};

/// Largest difference, relative to the largest output.
const TOLERANCE: f32 = 1e-5;

/// Of all generated weights and images.
const SEED: u64 = 7;

/// A network and an image for it.
pub struct Case {
    /// What messages call it.
    pub name: String,
    /// The file.
    pub model: Vec<u8>,
    /// Extents `1×C×H×W` of the image.
    pub dims: Vec<usize>,
    /// Values of the image in that order.
    pub image: Vec<f32>,
}

impl Case {
    /// A generated file with a random image of values in −2..2.
    pub fn new(name: impl Into<String>, file: &OnnxFile, seed: u64) -> Self {
        let mut random = Random::new(seed);
        let dims = file.input_dims();
        let image = (0..dims.iter().product()).map(|_| 2.0 * random.signed_unit()).collect();
        Self { name: format!("{} (seed {seed})", name.into()), model: file.bytes(), dims, image }
    }
}

/// Options under which the network reads the image as it is.
pub fn unnormalized() -> ImportOptions {
    let normalization = Some(Normalization { mean: vec![0.0], std: vec![1.0] });
    ImportOptions { normalization, ..Default::default() }
}

/// All outputs of each case by ONNX Runtime, or `None` where it is not installed; says so past the test's capture.
///
/// # Panics
/// ONNX Runtime refuses a model.
pub fn outputs(cases: &[Case]) -> Option<Vec<Vec<f32>>> {
    let root = PathBuf::from(env!("CARGO_MANIFEST_DIR"));
    let python = root.join("target/onnxruntime/bin/python");
    if !python.exists() {
        let _ = writeln!(
            std::io::stderr(),
            "not run: comparison with ONNX Runtime, which is not installed; get it with tests/run, or: \
             python3 -m venv target/onnxruntime && target/onnxruntime/bin/pip install onnxruntime==1.27.0 numpy==2.3.5"
        );
        return None;
    }
    let folder = tempfile::tempdir().expect("a temporary folder");
    let path = |index: usize, extension: &str| folder.path().join(format!("{index}.{extension}"));
    let mut list = Vec::new();
    for (index, case) in cases.iter().enumerate() {
        let image: Vec<u8> = case.image.iter().flat_map(|v| v.to_le_bytes()).collect();
        std::fs::write(path(index, "onnx"), &case.model).expect("a writable folder");
        std::fs::write(path(index, "input"), image).expect("a writable folder");
        list.push(json!({
            "model": path(index, "onnx"), "input": path(index, "input"), "shape": case.dims,
            "output": path(index, "output"),
        }));
    }
    let mut child = Command::new(python)
        .arg(root.join("tests/tools/onnxruntime_outputs.py"))
        .stdin(Stdio::piped())
        .stderr(Stdio::piped())
        .spawn()
        .expect("python");
    let mut stdin = child.stdin.take().expect("a pipe");
    stdin.write_all(json!(list).to_string().as_bytes()).expect("a pipe");
    drop(stdin);
    let done = child.wait_with_output().expect("an exit");
    let message = String::from_utf8_lossy(&done.stderr);
    let refused = message.lines().rev().find_map(|line| {
        let index: usize = line.split(".onnx: ").next()?.rsplit('/').next()?.parse().ok()?;
        Some(&cases[index].name)
    });
    assert!(done.status.success(), "ONNX Runtime refuses {refused:?}: {message}");
    let floats = |bytes: Vec<u8>| bytes.as_chunks().0.iter().map(|&b| f32::from_le_bytes(b)).collect();
    Some((0..cases.len()).map(|index| floats(std::fs::read(path(index, "output")).expect("an output"))).collect())
}

/// Imports each case, runs it before and after the passes, and compares both with ONNX Runtime where it is installed.
///
/// # Panics
/// A difference, or a case that is not imported.
pub fn compare(cases: &[Case]) {
    let ours: Vec<_> = cases.iter().map(|case| (case, run(case))).collect();
    let Some(expected) = outputs(cases) else { return };
    for ((case, [imported, optimized]), expected) in ours.iter().zip(&expected) {
        assert_close(&format!("{}, as imported", case.name), imported, expected);
        assert_close(&format!("{}, optimized", case.name), optimized, expected);
    }
}

/// Outputs as imported and after the passes, each map in ONNX's order.
fn run(case: &Case) -> [Vec<f32>; 2] {
    let imported = onnx::Model::parse(case.model.clone()).and_then(|m| onnx::import(&m, None, &unnormalized()));
    let imported = imported.unwrap_or_else(|e| panic!("{}: {e}", case.name));
    let mut optimized = imported.clone();
    passes::optimize(&mut optimized).unwrap_or_else(|e| panic!("{}: {e}", case.name));
    [&imported, &optimized].map(|graph| {
        let (_, shape) = image_shape(graph);
        let input = channels_last(&case.image, shape);
        let found = reference::run(graph, &[input], |_, _| ()).unwrap_or_else(|e| panic!("{}: {e}", case.name));
        let shapes = graph.outputs.iter().map(|&id| graph.value(id).shape);
        found.iter().zip(shapes).flat_map(|(values, shape)| channels_first(values, shape)).collect()
    })
}

/// Builds the nodes from `x` to `y`.
pub type Build = fn(&mut OnnxFile);

/// Compares a network of each operator set.
///
/// # Panics
/// See [`compare`].
#[track_caller]
pub fn check(name: &str, dims: &[i64], opsets: &[i64], build: Build) {
    let cases: Vec<Case> = opsets.iter().map(|&opset| case(name, dims, opset, build)).collect();
    compare(&cases);
}

fn case(name: &str, dims: &[i64], opset: i64, build: Build) -> Case {
    let mut file = OnnxFile::new(opset, SEED);
    file.input("x", dims).output("y");
    build(&mut file);
    Case::new(format!("{name}, opset {opset}"), &file, SEED)
}

/// Compares several networks of each operator set.
///
/// # Panics
/// See [`compare`].
#[track_caller]
pub fn check_all(name: &str, dims: &[i64], opsets: &[i64], builds: &[Build]) {
    let cases: Vec<Case> = builds
        .iter()
        .enumerate()
        .flat_map(|(i, &build)| opsets.iter().map(move |&opset| case(&format!("{name} {i}"), dims, opset, build)))
        .collect();
    compare(&cases);
}

/// A linear layer that shows the order of a flattened map.
pub fn linear(f: &mut OnnxFile, input: &str, inputs: i64) {
    let (w, b) = (f.weights("w", &[inputs, 4]), f.weights("b", &[4]));
    f.node("Gemm", &[input, &w, &b], "y", &[]);
}

fn image_shape(graph: &Graph) -> (String, Shape) {
    let (id, _) = graph.inputs().next().expect("an input");
    let value = graph.value(id);
    (value.name.clone(), value.shape)
}

/// `C×H×W` to `H×W×C`.
pub fn channels_last(values: &[f32], shape: Shape) -> Vec<f32> {
    let positions = shape.positions() as usize;
    (0..values.len())
        .map(|i| values[i % usize::from(shape.channels) * positions + i / usize::from(shape.channels)])
        .collect()
}

/// `H×W×C` to `C×H×W`.
pub fn channels_first(values: &[f32], shape: Shape) -> Vec<f32> {
    let (positions, channels) = (shape.positions() as usize, usize::from(shape.channels));
    (0..values.len()).map(|i| values[i % positions * channels + i / positions]).collect()
}

/// # Panics
/// A length or a value differs.
pub fn assert_close(what: &str, found: &[f32], expected: &[f32]) {
    assert_eq!(found.len(), expected.len(), "{what}: number of outputs");
    let largest = expected.iter().fold(0.0_f32, |m, v| m.max(v.abs()));
    for (i, (f, e)) in found.iter().zip(expected).enumerate() {
        assert!((f - e).abs() <= TOLERANCE * largest, "{what}: output {i}: found {f}, ONNX Runtime gives {e}");
    }
}
