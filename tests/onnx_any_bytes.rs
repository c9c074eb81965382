//! No bytes and no numbers in an ONNX file make the importer or the passes panic.

use model_compiler::import::{ImportOptions, onnx};
use model_compiler::passes;
use std::path::Path;
use tests::onnx_file::{Attribute, OnnxFile, Tensor, float, int, ints, tensor, text};
use tests::random::Random;

const SEED: u64 = 5;

/// Small networks of most operators, in their forms of three operator sets.
fn seeds() -> [(&'static str, OnnxFile); 3] {
    [("opset7.onnx", opset_7()), ("opset12.onnx", opset_12()), ("opset18.onnx", opset_18())]
}

fn norm(f: &mut OnnxFile, x: &str, y: &str, channels: i64) {
    let names = ["gamma", "beta", "mean"].map(|name| f.weights(name, &[channels]));
    let v = f.positive("variance", &[channels]);
    f.node("BatchNormalization", &[x, &names[0], &names[1], &names[2], &v], y, &[float("epsilon", 1e-5)]);
}

fn opset_7() -> OnnxFile {
    let mut f = OnnxFile::new(7, SEED);
    f.input("x", &[1, 3, 8, 8]).output("y");
    let w = f.weights("w", &[2, 3, 3, 3]);
    f.node("Conv", &["x", &w], "c", &[ints("strides", &[2, 2]), ints("pads", &[1; 4]), int("group", 1)]);
    norm(&mut f, "c", "n", 2);
    f.node("Clip", &["n"], "r", &[float("min", 0.0), float("max", 6.0)]);
    f.node("Pad", &["r"], "p", &[ints("pads", &[0, 1, 0, 0, 0, 1, 0, 0]), text("mode", "constant")]);
    f.node("Slice", &["p"], "q", &[ints("axes", &[1]), ints("starts", &[1]), ints("ends", &[3])]);
    f.node("Add", &["q", "r"], "a", &[]).node("Concat", &["a", "q"], "j", &[int("axis", 1)]);
    f.node("AveragePool", &["j"], "h", &[ints("kernel_shape", &[2, 2]), ints("strides", &[2, 2])]);
    f.node("Flatten", &["h"], "flat", &[int("axis", 1)]);
    let (g, b) = (f.weights("g", &[3, 16]), f.weights("gb", &[3]));
    f.node("Gemm", &["flat", &g, &b], "l", &[int("transB", 1), float("alpha", 0.5)]);
    f.node("Softmax", &["l"], "y", &[int("axis", 1)]);
    f
}

fn opset_12() -> OnnxFile {
    let mut f = OnnxFile::new(12, SEED);
    f.input("x", &[0, 1, 0, 0]).output("y");
    let (pads, w) = (f.integers("pads", &[0, 0, 1, 1, 0, 0, 1, 1]), f.weights("w", &[2, 1, 3, 3]));
    f.node("Pad", &["x", &pads], "p", &[]).node("Conv", &["p", &w], "c", &[]);
    f.node("MaxPool", &["c"], "m", &[ints("kernel_shape", &[3, 3]), ints("strides", &[2, 2]), int("ceil_mode", 1)]);
    f.node("ReduceMean", &["m"], "r", &[ints("axes", &[2, 3]), int("keepdims", 1)]);
    let zero = Tensor::integers("", &[], &[0]);
    f.node("Shape", &["r"], "shape", &[]).node("Constant", &[], "zero", &[tensor("value", zero)]);
    f.node("Gather", &["shape", "zero"], "n", &[int("axis", 0)]).node("Unsqueeze", &["n"], "u", &[ints("axes", &[0])]);
    let rest = f.integers("rest", &[-1]);
    f.node("Concat", &["u", &rest], "s", &[int("axis", 0)]).node("Reshape", &["r", "s"], "flat", &[]);
    let (k, b) = (f.weights("k", &[2, 4]), f.weights("b", &[4]));
    f.node("MatMul", &["flat", &k], "l", &[]).node("Add", &["l", &b], "y", &[]);
    f
}

fn opset_18() -> OnnxFile {
    let mut f = OnnxFile::new(18, SEED);
    f.input("x", &[0, 3, 8, 8]).output("y").output("z");
    let lists =
        ["starts", "ends", "axes", "steps"].map(|name| f.integers(name, &[if name == "ends" { i64::MAX } else { 2 }]));
    f.node("Slice", &["x", &lists[0], &lists[1], &lists[2], &lists[3]], "s", &[]);
    let (w, max) = (f.weights("w", &[3, 1, 3, 3]), f.floats("max", &[], &[6.0]));
    f.node("Conv", &["s", &w], "c", &[int("group", 3), text("auto_pad", "SAME_UPPER"), ints("dilations", &[1, 2])]);
    f.node("Clip", &["c", "", &max], "z", &[]);
    let four = f.integers("four", &[4]);
    let one = Tensor::integers("", &[1], &[1]);
    f.node("ConstantOfShape", &[&four], "ones", &[tensor("value", one)]).node("Mul", &["ones", "ones"], "pads", &[]);
    let both = f.integers("both", &[2, 3]);
    f.node("Pad", &["z", "pads", "", &both], "p", &[]);
    norm(&mut f, "p", "n", 3);
    f.node("ReduceMean", &["n", &both], "r", &[int("keepdims", 1)]).node("Squeeze", &["r", &both], "flat", &[]);
    let k = f.weights("k", &[2, 3]);
    f.node("Transpose", &[&k], "t", &[ints("perm", &[1, 0])]).node("Gemm", &["flat", "t"], "y", &[]);
    f
}

/// Whether a file is imported; a panic is the caller's to report.
fn is_imported(bytes: Vec<u8>) -> bool {
    let options = ImportOptions { resolution: Some((8, 8)), ..Default::default() };
    let options = if bytes.len().is_multiple_of(2) { ImportOptions::default() } else { options };
    let graph = onnx::Model::parse(bytes).and_then(|model| onnx::import(&model, None, &options));
    graph.is_ok_and(|mut graph| passes::optimize(&mut graph).is_ok())
}

#[test]
fn the_seeds_are_imported() {
    let options = ImportOptions { resolution: Some((8, 8)), ..Default::default() };
    for (name, file) in seeds() {
        let model = onnx::Model::parse(file.bytes()).unwrap_or_else(|e| panic!("{name}: {e}"));
        let mut graph = onnx::import(&model, None, &options).unwrap_or_else(|e| panic!("{name}: {e}"));
        passes::optimize(&mut graph).unwrap_or_else(|e| panic!("{name}: {e}"));
    }
}

/// The fuzzer starts from these files.
#[test]
fn stored_fuzz_seeds_are_current() {
    let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/fuzz/seeds/onnx");
    for (name, file) in seeds() {
        let path = folder.join(name);
        if std::env::var_os("UPDATE_SEEDS").is_some() {
            std::fs::create_dir_all(&folder).and_then(|()| std::fs::write(&path, file.bytes())).expect("writable");
        }
        let stored = std::fs::read(&path).unwrap_or_else(|error| panic!("{name}: {error}"));
        assert!(stored == file.bytes(), "{name} differs: run this test once with UPDATE_SEEDS=1");
    }
}

/// Numbers at their limits.
const NUMBERS: [i64; 14] = [0, 1, 2, 3, -1, -2, 8, 255, 256, 65536, 1 << 40, i64::MAX, i64::MIN, i64::MIN + 1];

/// Extents, integers and attributes at their limits, names exchanged, nodes repeated or left out.
#[test]
fn no_changed_number_panics() {
    let seeds = seeds();
    let (mut imported, mut refused) = (0, 0);
    for case in 0..20_000 {
        let mut random = Random::new(case);
        let mut file = random.pick(&seeds).1.clone();
        for _ in 0..=random.below(3) {
            change(&mut file, &mut random);
        }
        match std::panic::catch_unwind(|| is_imported(file.bytes())) {
            Err(_) => panic!("case {case} (its seed) panics"),
            Ok(true) => imported += 1,
            Ok(false) => refused += 1,
        }
    }
    assert!(imported > 1000 && refused > 1000, "{imported} imported, {refused} refused");
}

fn change(file: &mut OnnxFile, random: &mut Random) {
    let node = random.below(file.nodes.len());
    let constant = random.below(file.tensors.len());
    match random.below(8) {
        0 => {
            let tensor = &mut file.tensors[constant];
            if !tensor.dims.is_empty() {
                let axis = random.below(tensor.dims.len());
                tensor.dims[axis] = *random.pick(&NUMBERS);
            }
        }
        1 => file.tensors[constant].dims.push(*random.pick(&NUMBERS)),
        2 | 3 => {
            let tensor = &mut file.tensors[constant];
            if tensor.data_type == 7 && !tensor.raw_data.is_empty() {
                let at = random.below(tensor.raw_data.len() / 8) * 8;
                tensor.raw_data[at..at + 8].copy_from_slice(&random.pick(&NUMBERS).to_le_bytes());
            }
        }
        4 | 5 => {
            let names =
                ["axis", "pads", "strides", "kernel_shape", "axes", "starts", "ends", "group", "dilations", "perm"];
            let name = *random.pick(&names);
            let values: Vec<i64> = (0..random.below(5)).map(|_| *random.pick(&NUMBERS)).collect();
            let new: Attribute =
                if random.below(3) == 0 { int(name, *random.pick(&NUMBERS)) } else { ints(name, &values) };
            file.nodes[node].attribute.insert(0, new);
        }
        6 => {
            let other = file.nodes[random.below(file.nodes.len())].clone();
            let inputs = &mut file.nodes[node].input;
            if !inputs.is_empty() {
                let operand = random.below(inputs.len());
                inputs[operand] = random.pick(&[&other.input[..], &other.output[..]].concat()).clone();
            }
        }
        _ => {
            let op = file.nodes[random.below(file.nodes.len())].op_type.clone();
            file.nodes[node].op_type = op;
        }
    }
}
