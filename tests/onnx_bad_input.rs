//! What can be wrong with an ONNX file: exit status 2 and one message, as users read it.

use std::fmt::Write as _;
use tests::commands::Folder;
use tests::onnx_file::{Attribute, INT64, OnnxFile, Tensor, int, ints, text};

const SEED: u64 = 3;
const REPAIR: &str = "\n  help: export the model again, or repair it";

/// Image, convolution, global pool, linear layer.
fn small() -> OnnxFile {
    let mut file = OnnxFile::new(13, SEED);
    file.input("image", &[0, 3, 8, 8]).output("logits");
    let names = [file.weights("w", &[4, 3, 3, 3]), file.weights("fc", &[4, 5])];
    file.node("Conv", &["image", &names[0]], "c", &[]).node("GlobalAveragePool", &["c"], "p", &[]);
    file.node("Flatten", &["p"], "flat", &[]).node("MatMul", &["flat", &names[1]], "logits", &[]);
    file
}

/// `quantize` fails with this text and writes nothing; `@` is the folder.
#[track_caller]
fn refused_with(folder: &Folder, bytes: &[u8], options: &str, expected: &str) {
    folder.write("net.onnx", bytes);
    let names = folder.names();
    let outcome = folder.run(&format!("model-compiler quantize @net.onnx{options} -o @out.qmodel"));
    let expected = format!("error: {expected}\n");
    assert_eq!((outcome.status, outcome.out.as_str(), outcome.err.as_str()), (2, "", expected.as_str()));
    assert_eq!(folder.names(), names);
}

#[track_caller]
fn refused(file: &OnnxFile, expected: &str) {
    refused_with(&Folder::default(), &file.bytes(), "", &format!("@net.onnx: {expected}"));
}

/// The small file with one change.
fn changed(change: impl FnOnce(&mut OnnxFile)) -> OnnxFile {
    let mut file = small();
    change(&mut file);
    file
}

#[test]
fn the_small_file_itself_is_sound() {
    let folder = Folder::default();
    let expected = "@net.onnx: this model needs calibration frames\n  help: add --calib FRAMES (a frame directory or a .safetensors file of raw inputs)";
    refused_with(&folder, &small().bytes(), "", expected);
    refused_with(&folder, &small().bytes(), " --resolution 8x8 --mean 0.5 --std 0.25,0.5,1 --scale 1/255", expected);
    let text = folder.ok("model-compiler inspect @net.onnx");
    for part in ["ONNX model  opset 13", "producer    tests", "2 tensors, 128 values", "float n×3×8×8", "MatMul"] {
        assert!(text.contains(part), "no {part:?} in:\n{text}");
    }
}

#[test]
fn unsupported_operators_are_listed_together() {
    let file = changed(|f| {
        f.nodes[1].op_type = "LSTM".into();
        f.nodes[1].name = "rnn".into();
        f.nodes[3].op_type = "FusedMatMul".into();
        f.nodes[3].domain = "com.microsoft".into();
    });
    let folder = Folder::default();
    folder.write("net.onnx", file.bytes());
    let outcome = folder.run("model-compiler quantize @net.onnx -o @out.qmodel");
    assert_eq!(outcome.status, 2);
    let expected = "error: @net.onnx: found 2 problems:
  LSTM rnn: this operator is not supported (it reads c)
  com.microsoft.FusedMatMul logits: this operator is not supported (it reads flat, fc)
  help: supported are Add, AveragePool, BatchNormalization, Cast, Clip, ";
    assert!(outcome.err.starts_with(expected), "{}", outcome.err);
}

#[test]
fn names_that_do_not_fit() {
    refused(
        &changed(|f| f.nodes[0].input[1] = "nothing".into()),
        &format!("Conv c: reads nothing, which no node, input or initializer gives{REPAIR}"),
    );
    refused(
        &changed(|f| f.nodes.swap(0, 1)),
        &format!("GlobalAveragePool p: reads c before Conv c writes it; ONNX's nodes are in topological order{REPAIR}"),
    );
    refused(
        &changed(|f| f.nodes[1].input[0] = "flat".into()),
        &format!(
            "GlobalAveragePool p: reads flat before Flatten flat writes it; ONNX's nodes are in topological order{REPAIR}"
        ),
    );
    refused(
        &changed(|f| f.nodes[2].output[0] = "p".into()),
        &format!(
            "found 2 problems:\n  Flatten p: writes p, which has a value already\n  MatMul logits: reads flat, which no node, input or initializer gives{REPAIR}"
        ),
    );
    refused(&changed(|f| _ = f.output("other")), "output other: no node writes it");
    refused(
        &changed(|f| f.tensors.push(Tensor::floats("w", &[1], &[0.0]))),
        "initializer w: found it twice\n  help: the file is damaged or incomplete: copy or download it again",
    );
    refused(
        &changed(|f| {
            f.node("MaxPool", &["c"], "m", &[ints("kernel_shape", &[2, 2])]).output("indices");
            f.nodes[4].output.push("indices".into());
        }),
        "MaxPool m: its output indices is read, expected only the first output\n  help: export the model for inference, without additional outputs",
    );
}

#[test]
fn shapes_and_values_that_do_not_fit() {
    refused(
        &changed(|f| _ = std::mem::replace(&mut f.tensors[0], Tensor::floats("w", &[4, 2, 3, 3], &[0.5; 72]))),
        &format!("Conv c: input channels: found 2, expected 3{REPAIR}"),
    );
    refused(
        &changed(|f| _ = std::mem::replace(&mut f.tensors[1], Tensor::floats("fc", &[6, 5], &[0.5; 30]))),
        "MatMul logits: operand flat: found 1×4, made by Flatten flat of a map 1×4×1×1, expected 1×6",
    );
    refused(
        &changed(|f| f.tensors[0].raw_data[8..12].copy_from_slice(&f32::NAN.to_le_bytes())),
        "Conv c: tensor w: NaN at index 2\n  help: the file is damaged, or the network was not trained to its end",
    );
    refused(
        &changed(|f| f.tensors[0] = Tensor::integers("w", &[4, 3, 3, 3], &[1; 108])),
        "Conv c: tensor w: found integer elements, expected floating\n  help: the file is damaged, or the network was not trained to its end",
    );
    refused(
        &changed(|f| f.tensors[0].dims[0] = 5),
        "tensor w: found 432 bytes, expected 135 elements of type float\n  help: the file is damaged or incomplete: copy or download it again",
    );
    refused(
        &changed(|f| f.nodes[0].attribute = vec![ints("pads", &[1, 1])]),
        &format!("Conv c: pads: found [1, 1], expected four numbers from 0 to 65535{REPAIR}"),
    );
    refused(
        &changed(|f| f.nodes[0].attribute = vec![int("group", 0)]),
        &format!("Conv c: group: expected 1 to 65535{REPAIR}"),
    );
    refused(
        &changed(|f| f.nodes[2].attribute = vec![int("axis", 5)]),
        &format!("Flatten flat: found axis 5, expected one of a tensor of rank 4{REPAIR}"),
    );
    refused(&changed(|f| f.nodes[0].attribute = vec![text("auto_pad", "SOME")]), "Conv c: auto_pad \"SOME\"");
}

#[test]
fn pools_whose_divisor_changes_are_refused_by_name() {
    let pool = |attributes: &[Attribute]| changed(|f| _ = f.node("AveragePool", &["c"], "a", attributes));
    refused(
        &pool(&[ints("kernel_shape", &[3, 3]), ints("pads", &[1; 4])]),
        "AveragePool a: padding [1, 1, 1, 1] with count_include_pad 0, where the divisor changes\n  help: set count_include_pad to 1 (then zeros are averaged), or leave the padding out",
    );
    refused(
        &pool(&[ints("kernel_shape", &[3, 3]), ints("strides", &[2, 2]), int("ceil_mode", 1)]),
        "AveragePool a: ceil_mode lets windows reach beyond the map, where the divisor changes\n  help: set ceil_mode to 0, or choose a size that the stride divides",
    );
}

#[test]
fn a_flattened_map_needs_a_matrix() {
    refused(
        &changed(|f| {
            f.node("Flatten", &["c"], "rows", &[]).node("Relu", &["rows"], "r", &[]).output("r");
        }),
        "output r: found 1×144, made by Flatten rows of a map 1×4×6×6, expected a map or a vector",
    );
}

#[test]
fn inputs_that_are_no_single_image() {
    let with = |dims: &[i64]| {
        let mut file = OnnxFile::new(13, SEED);
        file.input("image", dims).output("y").node("Relu", &["image"], "y", &[]);
        file
    };
    refused(
        &with(&[8, 3, 8, 8]),
        "input image: found a batch of 8, expected 1\n  help: export the network with a batch of 1 or a dynamic batch",
    );
    refused(&with(&[1, 3, 0, 0]), "input image: found a dynamic height or width\n  help: say it with --resolution HxW");
    refused(
        &with(&[1, 8, 8, 3]),
        "input image: found 8 channels, expected 3 or 1\n  help: images are RGB or grey; export N×C×H×W, channels before rows",
    );
    refused(
        &with(&[1, 8]),
        "input image: found 2 dimensions, expected an image N×C×H×W\n  help: export the network with the shape of its input",
    );
    refused(
        changed(|f| _ = f.input("speed", &[1])).clone().input("goal", &[2]),
        "found 3 inputs (image, speed, goal), expected one image\n  help: export a network that reads one image and nothing else",
    );
    let mut integers = OnnxFile::new(13, SEED);
    integers.typed_input("image", INT64, &[1, 3, 8, 8]).output("y").node("Relu", &["image"], "y", &[]);
    refused(
        &integers,
        "input image: found elements of type int64, expected float\n  help: export the network with a floating input; images are normalized on the device",
    );
}

#[test]
fn options_that_do_not_fit() {
    let folder = Folder::default();
    let bytes = small().bytes();
    for (options, expected) in [
        (
            " --resolution 9x8",
            "@net.onnx: input image: found a fixed size of 8 pixels, but --resolution says 9\n  help: leave --resolution out, or export the network with a dynamic size",
        ),
        (" --system aim", "@net.onnx: --system has no effect on an ONNX file\n  help: leave --system out"),
        (
            " --fusion-scales 4",
            "@net.onnx: --fusion-scales has no effect on an ONNX file\n  help: leave --fusion-scales out",
        ),
        (" --hack", "@net.onnx: --hack has no effect on an ONNX file\n  help: leave --hack out"),
        (" --temperature 1", "@net.onnx: --temperature has no effect on an ONNX file\n  help: leave --temperature out"),
        (" --heads 4", "@net.onnx: --heads has no effect on an ONNX file\n  help: leave --heads out"),
        (
            " --mean 1,2 --std 1",
            "@net.onnx: input image: --mean: found 2 values for 3 channels\n  help: give one value per channel, or one for all",
        ),
    ] {
        refused_with(&folder, &bytes, options, expected);
    }
    for (options, expected) in [
        (" --mean 1", "the following required arguments were not provided"),
        (" --mean 1 --std 0", "found \"0\", expected a positive number"),
        (" --mean 1 --std 1 --scale 1/0", "found \"0\", expected a positive number"),
    ] {
        let outcome = folder.run(&format!("model-compiler quantize @net.onnx{options} -o @out.qmodel"));
        assert!(outcome.status == 2 && outcome.err.contains(expected), "{}", outcome.err);
    }
}

#[test]
fn versions_out_of_range() {
    for (opset, range) in [(6, "7 to 20"), (21, "7 to 20")] {
        refused(
            &changed(|f| f.opset = opset),
            &format!(
                "found opset {opset}, expected {range}\n  help: export the model with an opset of 7 to 20, such as 17"
            ),
        );
    }
}

#[test]
fn truncated_files_are_refused_at_every_byte() {
    let folder = Folder::default();
    let bytes = small().bytes();
    let mut messages = String::new();
    for length in 2..bytes.len() {
        folder.write("net.onnx", &bytes[..length]);
        let outcome = folder.run("model-compiler inspect @net.onnx");
        assert_eq!(outcome.status, 2, "{length} bytes: {}{}", outcome.out, outcome.err);
        assert!(outcome.err.starts_with("error: @net.onnx: "), "{length} bytes: {}", outcome.err);
        let _ = writeln!(messages, "{}", outcome.err);
    }
    assert!(messages.contains("expected an ONNX message\n  help: the file is damaged or incomplete"), "{messages}");
}

#[test]
fn external_data() {
    let folder = Folder::default();
    let file = |entries: &[(&str, &str)]| changed(|f| f.tensors[0] = f.tensors[0].clone().external(entries)).bytes();
    folder.write("weights.bin", [0; 440]);
    let copy = "\n  help: copy the model together with its data files, or save it as one file";
    let needs = "@net.onnx: this model needs calibration frames\n  help: add --calib FRAMES (a frame directory or a .safetensors file of raw inputs)";
    refused_with(&folder, &file(&[("location", "weights.bin"), ("offset", "8"), ("length", "432")]), "", needs);
    refused_with(
        &folder,
        &file(&[("location", "weights.bin"), ("offset", "16"), ("length", "432")]),
        "",
        &format!(
            "@net.onnx: tensor w: external data in @weights.bin: found 440 bytes, expected 432 at offset 16{copy}"
        ),
    );
    refused_with(
        &folder,
        &file(&[("location", "../weights.bin")]),
        "",
        &format!(
            "@net.onnx: tensor w: external data in \"../weights.bin\", expected a file in the model's folder{copy}"
        ),
    );
    refused_with(
        &folder,
        &file(&[("location", "none.bin")]),
        "",
        &format!("@net.onnx: tensor w: external data in @none.bin: No such file or directory (os error 2){copy}"),
    );
}

#[test]
fn normalization_is_no_option_of_a_checkpoint() {
    let folder = Folder::of(&tests::golden::Network::small(model_compiler::import::System::Aim));
    let outcome = folder.run("model-compiler quantize @net.safetensors --mean 0 --std 1 -o @out.qmodel");
    assert_eq!(
        (outcome.status, outcome.err.as_str()),
        (
            2,
            "error: @net.safetensors: --mean, --std and --scale have no effect on a checkpoint\n  help: leave them out; the normalization belongs to the system\n"
        )
    );
}
