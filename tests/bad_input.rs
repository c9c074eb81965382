//! What can be wrong with what a user gives: exit status 2, and one message that says what, where, and what to do. The
//! messages stand here as users read them.

use firmware::engine::{Engine, EngineError};
use firmware::image::{Image, RegionName, layout};
use firmware::kernels::Portable;
use model_compiler::artifact;
use model_compiler::emit::{AlignedBytes, reseal};
use model_compiler::import::{NamedTensor, NamedTensors, System, TensorData};
use model_compiler::qmodel::QModel;
use model_compiler::record::Record;
use tests::build;
use tests::commands::{self, Folder};
use tests::golden::{self, Network};
use tests::torch_file::{Py, Saved, Storage};

/// A folder with `net.safetensors`, `inputs.safetensors`, `net.qmodel`, `net.img` and `net.record` of a small network.
fn project(system: System) -> Folder {
    let folder = Folder::of(&Network::small(system));
    folder.ok("model-compiler quantize @net.safetensors --calib @inputs.safetensors -o @net.qmodel");
    folder.ok("model-compiler compile @net.qmodel -o @net.img");
    folder
}

const COMPILE: &str = "model-compiler compile @net.safetensors --calib @inputs.safetensors -o @new.img";
const RUN: &str = "host-sim run @net.img --inputs @inputs.safetensors";

/// The command fails with this text on standard error, nothing else is written, and no file appears or changes.
#[track_caller]
fn refused(folder: &Folder, command: &str, expected: &str) {
    let names = folder.names();
    let before: Vec<Vec<u8>> = files(folder, &names);
    let outcome = folder.run(command);
    let expected = format!("error: {expected}\n");
    assert_eq!((outcome.status, outcome.out.as_str(), outcome.err.as_str()), (2, "", expected.as_str()), "{command}");
    assert_eq!(folder.names(), names, "{command}: files");
    assert!(files(folder, &names) == before, "{command}: a file changed");
    if command.starts_with("host-sim") {
        refused_in_json(folder, command);
    }
}

fn files(folder: &Folder, names: &[String]) -> Vec<Vec<u8>> {
    names.iter().filter(|name| folder.path(name).is_file()).map(|name| folder.read(name)).collect()
}

/// The same message as JSON, as one document and nothing else.
#[track_caller]
fn refused_in_json(folder: &Folder, command: &str) {
    let text = folder.run(command).err;
    let (status, document) = folder.json(&format!("{command} --json"));
    let error = document["error"].as_object().expect("an error");
    assert_eq!((status, document.as_object().unwrap().len(), error.len()), (2, 1, 3), "{document}");
    let part = |field: &str| error[field].as_str().expect("text").to_owned();
    let place = folder.shown(&part("where"));
    let message = folder.shown(&part("message")).replace("; help: ", "\n  help: ");
    assert!(!part("code").is_empty());
    if place != "command line" {
        let separator = if place.is_empty() { "" } else { ": " };
        assert_eq!(format!("error: {place}{separator}{message}\n"), text, "{command}");
    }
}

/// An image with changed header bytes, sealed again.
fn image_with(folder: &Folder, at: std::ops::Range<usize>, bytes: &[u8]) -> Vec<u8> {
    let mut image = folder.read("net.img");
    image[at].copy_from_slice(bytes);
    reseal(&mut image);
    image
}

#[test]
fn images_of_another_version_or_damaged() {
    let folder = project(System::Aim);
    let image = folder.read("net.img");
    let features = u64::from_le_bytes(image[layout::header::FEATURES].try_into().unwrap());
    let mut cases = Vec::new();
    let mut case = |bytes: Vec<u8>, message: String| cases.push((bytes, message));
    case(
        image_with(&folder, layout::header::FORMAT, &2_u16.to_le_bytes()),
        "@bad.img: header byte 8: the format version is not the one this runtime reads: found 2, expected 1\n  help: \
         compile the model again with the compiler of this version"
            .into(),
    );
    let unknown = 1_u64 << 40;
    case(
        image_with(&folder, layout::header::FEATURES, &(features | unknown).to_le_bytes()),
        format!(
            "@bad.img: header byte 16: the image needs features that this runtime does not have: found {unknown}, \
             expected 0\n  help: compile the model again with the compiler of this version"
        ),
    );
    let damaged = "help: the image is damaged or incomplete: copy it again, or compile the model again";
    case(
        image[..image.len() - 16].to_vec(),
        format!(
            "@bad.img: image: the file length differs from the header's: found {}, expected {}\n  {damaged}",
            image.len() - 16,
            image.len()
        ),
    );
    case(
        image[..100].to_vec(),
        format!("@bad.img: image: the file is shorter than a header: found 100, expected 384\n  {damaged}"),
    );
    for (bytes, message) in cases {
        folder.write("bad.img", bytes);
        for command in ["host-sim run @bad.img --inputs @inputs.safetensors", "model-compiler inspect @bad.img"] {
            refused(&folder, command, &message);
        }
    }
    let mut flipped = image.clone();
    let constants = image.len() / 2;
    flipped[constants] ^= 1;
    folder.write("bad.img", flipped);
    for command in ["host-sim run @bad.img --inputs @inputs.safetensors", "model-compiler inspect @bad.img"] {
        let outcome = folder.run(command);
        assert_eq!((outcome.status, outcome.out.as_str()), (2, ""), "{}", outcome.err);
        let start = "error: @bad.img: constants section: damaged: CRC ";
        assert!(outcome.err.starts_with(start) && outcome.err.ends_with(&format!("{damaged}\n")), "{}", outcome.err);
    }
    folder.write("bad.img", b"PK\x03\x04");
    refused(
        &folder,
        "host-sim verify @bad.img --inputs @inputs.safetensors",
        "@bad.img: this is no model image\n  help: model-compiler compile makes one: compile MODEL --calib FRAMES -o \
         OUT.img",
    );
}

#[test]
fn arenas_that_do_not_fit() {
    let folder = project(System::Aim);
    let bytes = AlignedBytes::from(folder.read("net.img").as_slice());
    let image = Image::parse(&bytes).unwrap();
    let needed = image.arena_bytes();
    let mut arena = AlignedBytes::zeroed(needed as usize + 16);
    let refusal = |arena: &mut [u8]| Engine::new(image, Portable, arena).map(|_| ()).unwrap_err();
    let error = refusal(&mut arena[..needed as usize - 1]);
    assert_eq!(error, EngineError::ArenaTooSmall { region: RegionName::MAIN, found: needed - 1, needed });
    assert_eq!(error.to_string(), format!("arena main: {} bytes, the image needs {needed}", needed - 1));
    let error = refusal(&mut arena[4..]);
    assert_eq!(error, EngineError::ArenaMisaligned { region: RegionName::MAIN, remainder: 4, alignment: 16 });
    assert_eq!(error.to_string(), "arena main: starts 4 bytes behind a multiple of 16");
    // The image itself must be aligned, too.
    let mut shifted = AlignedBytes::zeroed(bytes.len() + 16);
    shifted[8..8 + bytes.len()].copy_from_slice(&bytes);
    let error = Image::parse(&shifted[8..8 + bytes.len()]).unwrap_err();
    assert_eq!(
        error.to_string(),
        "image: the image must lie at an address that is a multiple of 16: found 8, expected 0"
    );
}

#[test]
fn a_checkpoint_with_wrong_tensors_lists_all_of_them() {
    let folder = project(System::Aim);
    let mut tensors = Network::small(System::Aim).tensors();
    tensors.remove("join.0.bias");
    tensors.insert("extra.weight", NamedTensor { shape: vec![2], data: TensorData::Float(vec![0.0; 2]) });
    tensors.insert("output.bias", NamedTensor { shape: vec![3], data: TensorData::Float(vec![0.0; 3]) });
    let values = |tensors: &mut NamedTensors, name: &str, value: f32| {
        let Some(TensorData::Float(values)) = tensors.get_mut(name).map(|t| &mut t.data) else { panic!("{name}") };
        values[5] = value;
    };
    values(&mut tensors, "join.0.weight", f32::NAN);
    values(&mut tensors, "image_encoder.features.bn1.running_var", -0.5);
    golden::write_safetensors(&tensors, &folder.path("net.safetensors")).unwrap();
    let expected = "@net.safetensors: 5 tensors do not fit the system aim:
  image_encoder.features.bn1.running_var  negative variance at index 5  expected [8]
  join.0.weight                           NaN at index 5                expected [24, 32]
  join.0.bias                             missing                       expected [24]
  output.bias                             found [3]                     expected [2]
  extra.weight                            found [2]                     surplus
  help: the checkpoint must hold exactly the network's tensors; --system overrides the detection";
    refused(&folder, COMPILE, expected);
    refused(&folder, "host-sim run @net.safetensors --inputs @inputs.safetensors", expected);
}

#[test]
fn checkpoints_that_are_attacks_or_no_checkpoints() {
    let folder = project(System::Aim);
    let quantize = "model-compiler quantize @bad.pth --calib @inputs.safetensors -o @new.qmodel";
    let call = Py::Call("os", "system", vec![Py::str("echo never")]);
    let attack = Saved { root: Py::dict([("state_dict", call)]), storages: Vec::new() };
    folder.write("bad.pth", attack.zip());
    refused(
        &folder,
        quantize,
        "@bad.pth: model/data.pkl: byte 19 (GLOBAL): found \"os.system\", which the pickle could call; expected only the names a state dict of tensors needs\n  help: nothing was executed; if you trust the file, load it in Python and save the weights alone: torch.save(model.state_dict(), FILE)",
    );
    let storage = Py::Storage("0".to_owned(), "FloatStorage", 1 << 30, None);
    let claim = Saved {
        root: Py::StateDict(vec![(Py::str("a"), Py::tensor(storage, 0, &[1 << 30], &[1]))]),
        storages: vec![Storage { key: "0".to_owned(), elements: 1 << 30, bytes: vec![0; 16] }],
    };
    folder.write("bad.pth", claim.zip());
    refused(
        &folder,
        quantize,
        "@bad.pth: tensor \"a\": found shape [1073741824], which brings the tensors to 4294967296 bytes in a file of 683, expected at most 16788144\n  help: save contiguous tensors: {name: tensor.contiguous()}",
    );
    folder.write("bad.pth", claim.legacy());
    refused(
        &folder,
        quantize,
        "@bad.pth: byte 343 (storage \"0\"): found 16 bytes before the end, expected 1073741824 elements of 4 bytes\n  help: the file is damaged or incomplete: copy or download it again",
    );
    folder.write("bad.pth", b"");
    refused(
        &folder,
        quantize,
        "@bad.pth: byte 0: found an empty file, expected a torch zip archive (PK), a torch legacy stream (a pickle), safetensors or ONNX\n  help: save the weights with torch.save(model.state_dict(), FILE) or safetensors, and check that the download is complete",
    );
    let whole = folder.read("net.safetensors");
    folder.write("bad.pth", &whole[..whole.len() - 1]);
    refused(
        &folder,
        quantize,
        "@bad.pth: tensor data: found 145271 bytes, expected 145272 as in the header\n  help: the file is damaged or incomplete: copy or download it again",
    );
    folder.write("bad.pth", Saved::state_dict(&[("fc.weight", &[1], &[0.0])]).zip());
    refused(
        &folder,
        quantize,
        "@bad.pth: the tensor names are of no known system (1 tensors: fc.weight, …)\n  help: supported are checkpoints of aim, late_fusion, transfuser, geometric_fusion, cilrs, lbc (versions up to 2021); --system names one",
    );
    folder.write("bad.pth", folder.read("net.img"));
    refused(
        &folder,
        quantize,
        "@bad.pth: byte 0: found a file that begins with \"\\x93DRIVE\\r\\n\", expected a torch zip archive (PK), a torch legacy stream (a pickle), safetensors or ONNX\n  help: save the weights with torch.save(model.state_dict(), FILE) or safetensors, and check that the download is complete",
    );
    folder.write("bad.pth", folder.read("net.qmodel"));
    refused(
        &folder,
        quantize,
        "@bad.pth: this model is quantized already\n  help: model-compiler compile makes an image of it",
    );
}

#[test]
fn calibration_that_is_missing() {
    let folder = project(System::Aim);
    refused(
        &folder,
        "model-compiler compile @net.safetensors -o @new.img",
        "@net.safetensors: this model needs calibration frames\n  help: add --calib FRAMES (a frame directory or a .safetensors file of raw inputs)",
    );
    std::fs::create_dir(folder.path("frames")).unwrap();
    refused(
        &folder,
        "model-compiler compile @net.safetensors --calib @frames -o @new.img",
        "@frames: holds no frame folder\n  help: expected FRAMES/<name>/{rgb.png, rgb_left.png, rgb_right.png (lbc), lidar.bin, frame.json}; give the folder above",
    );
    refused(
        &folder,
        "model-compiler compile @net.safetensors --calib @nowhere -o @new.img",
        "@nowhere: No such file or directory (os error 2)\n  help: frames are a directory FRAMES/<name>/{rgb.png, lidar.bin, frame.json} or a .safetensors file",
    );
    refused(
        &folder,
        "model-compiler compile @net.safetensors --calib @net.img -o @new.img",
        "@net.img: not a safetensors file: header too large\n  help: frames are a frame directory or a .safetensors file of raw network inputs",
    );
    refused(
        &folder,
        "model-compiler compile @net.safetensors --calib @net.safetensors -o @new.img",
        "@net.safetensors: tensor `rgb`: missing; this network needs it\n  help: the file holds: decoder.bias_hh, decoder.bias_ih, decoder.weight_hh, decoder.weight_ih, image_encoder.features.bn1.bias, image_encoder.features.bn1.num_batches_tracked, image_encoder.features.bn1.running_mean, image_encoder.features.bn1.running_var and 86 more",
    );
    refused(
        &folder,
        "host-sim run @net.img --inputs @frames",
        "@frames: --inputs takes a file; a directory goes to --frames",
    );
    refused(
        &folder,
        "host-sim run @net.img --frames @inputs.safetensors",
        "@inputs.safetensors: --frames takes a directory; a file goes to --inputs",
    );
}

#[test]
fn frame_folders_with_damaged_files() {
    let network = Network { grid: (8, 8), layers: 1, ..Network::small(System::TransFuser) };
    let folder = Folder::of(&network);
    let frame = build::frames(network.resolution()).remove(0);
    commands::write_frame(&folder, "frames/a", &frame);
    let run = "host-sim run @net.safetensors --frames @frames";
    folder.ok(run);
    let broken = |file: &str, bytes: &[u8], expected: &str| {
        let file = format!("frames/a/{file}");
        let good = folder.read(&file);
        folder.write(&file, bytes);
        refused(&folder, run, expected);
        refused(&folder, "model-compiler compile @net.safetensors --calib @frames -o @new.img", expected);
        folder.write(&file, good);
    };
    let png = folder.read("frames/a/rgb.png");
    broken(
        "rgb.png",
        b"not an image",
        "@frames/a/rgb.png: no readable image: Format error decoding Png: Invalid PNG signature.\n  help: expected a whole PNG or JPEG file; copy or save it again",
    );
    broken(
        "rgb.png",
        &png[..png.len() / 2],
        "@frames/a/rgb.png: no readable image: unexpected end of file\n  help: expected a whole PNG or JPEG file; copy or save it again",
    );
    let mut small = std::io::Cursor::new(Vec::new());
    image::RgbImage::new(300, 200).write_to(&mut small, image::ImageFormat::Png).unwrap();
    broken(
        "rgb.png",
        small.get_ref(),
        "@frames/a/rgb.png: image is 300×200, the network needs at least 256×256\n  help: images are cropped, never enlarged",
    );
    let lidar = folder.read("frames/a/lidar.bin");
    broken(
        "lidar.bin",
        &lidar[..lidar.len() - 3],
        "@frames/a/lidar.bin: 12797 bytes, expected a multiple of 16 (x, y, z, intensity as f32)\n  help: is it truncated?",
    );
    broken(
        "frame.json",
        b"{\"speed\": 1.5, \"goal\": ",
        "@frames/a/frame.json: not JSON: EOF while parsing a value at line 1 column 23\n  help: fields, as far as the network reads them: \"speed\": m/s, \"goal\": [right_m, forward_m], \"command\": 1..6; optionally \"lidar_axes\", \"lidar_height_m\"",
    );
    broken(
        "frame.json",
        b"{\"goal\": [1, 2]}",
        "@frames/a/frame.json: `speed`: missing, expected a number\n  help: fields, as far as the network reads them: \"speed\": m/s, \"goal\": [right_m, forward_m], \"command\": 1..6; optionally \"lidar_axes\", \"lidar_height_m\"",
    );
    broken(
        "frame.json",
        b"{\"speed\": \"fast\", \"goal\": [1, 2]}",
        "@frames/a/frame.json: `speed`: found \"fast\", expected a number\n  help: fields, as far as the network reads them: \"speed\": m/s, \"goal\": [right_m, forward_m], \"command\": 1..6; optionally \"lidar_axes\", \"lidar_height_m\"",
    );
    broken(
        "frame.json",
        b"{\"speed\": 1, \"goal\": [1]}",
        "@frames/a/frame.json: `goal`: found [1], expected [right_m, forward_m]\n  help: fields, as far as the network reads them: \"speed\": m/s, \"goal\": [right_m, forward_m], \"command\": 1..6; optionally \"lidar_axes\", \"lidar_height_m\"",
    );
    broken(
        "frame.json",
        b"{\"speed\": 1, \"goal\": [1, 2], \"command\": 7}",
        "@frames/a/frame.json: `command`: found 7, expected 1..6\n  help: fields, as far as the network reads them: \"speed\": m/s, \"goal\": [right_m, forward_m], \"command\": 1..6; optionally \"lidar_axes\", \"lidar_height_m\"",
    );
    broken(
        "frame.json",
        b"{\"speed\": 1, \"goal\": [1, 2], \"lidar_axes\": \"ned\"}",
        "@frames/a/frame.json: `lidar_axes`: found \"ned\", expected \"carla\" or \"velodyne\"\n  help: fields, as far as the network reads them: \"speed\": m/s, \"goal\": [right_m, forward_m], \"command\": 1..6; optionally \"lidar_axes\", \"lidar_height_m\"",
    );
    broken(
        "frame.json",
        b"[1, 2]",
        "@frames/a/frame.json: found no JSON object\n  help: fields, as far as the network reads them: \"speed\": m/s, \"goal\": [right_m, forward_m], \"command\": 1..6; optionally \"lidar_axes\", \"lidar_height_m\"",
    );
    std::fs::remove_file(folder.path("frames/a/lidar.bin")).unwrap();
    refused(&folder, run, "@frames/a/lidar.bin: No such file or directory (os error 2)\n  help: check the path");
    folder.write("frames/a/lidar.bin", &lidar);
    std::fs::remove_file(folder.path("frames/a/frame.json")).unwrap();
    refused(&folder, run, "@frames/a/frame.json: No such file or directory (os error 2)\n  help: check the path");
}

#[test]
fn frames_known_from_calibration_are_said_loudly() {
    let folder = project(System::Aim);
    let outcome = folder.run("host-sim verify @net.img --inputs @inputs.safetensors --json");
    assert_eq!(outcome.status, 0);
    assert_eq!(
        outcome.err,
        "warning: 4 of 4 frames are also calibration frames, so figures against f32 flatter: inputs#0, inputs#1, \
         inputs#2, inputs#3\n"
    );
    let document: serde_json::Value = serde_json::from_str(&outcome.out).unwrap();
    assert_eq!(document["calibration_frames"], serde_json::json!(["inputs#0", "inputs#1", "inputs#2", "inputs#3"]));
    assert!(document["frames"].as_array().unwrap().iter().all(|frame| frame["calibration"] == true));
}

#[test]
fn models_too_big_for_the_target() {
    let folder = project(System::Aim);
    let bytes = folder.read("net.img").len();
    let flash = |target: &str, limit: usize| {
        let over = bytes - limit;
        format!(
            "@net.qmodel: target {target}: the image needs {bytes} bytes, {limit} are there: {over} too many\n  help: \
             use a target with more flash (--flash), or a smaller network"
        )
    };
    refused(
        &folder,
        "model-compiler compile @net.qmodel --ram 8K -o @new.img",
        "@net.qmodel: target portable: the arena needs 328876 bytes, 8192 are there: 320684 too many\nat the peak, step 0 (image_encoder.features.relu), these are live:\n  rgb                              196608\n  image_encoder.features.relu      131072\n  scratch                            1176\n  goal                                  8\n  help: use a target with more RAM (--ram), or a smaller network; no plan for this order is smaller",
    );
    refused(&folder, "model-compiler compile @net.qmodel --flash 32K -o @new.img", &flash("portable", 32768));
    folder.write("tiny.toml", "name = 'tiny'\nalignment = 4\nflash = '1K'\n[[regions]]\nname = 'main'\n");
    let tiny = folder.path("tiny.toml").display().to_string();
    refused(&folder, &format!("model-compiler compile @net.qmodel --target {tiny} -o @new.img"), &flash("tiny", 1024));
}

#[test]
fn quantized_models_and_records_that_are_damaged() {
    let folder = project(System::Aim);
    let compile = "model-compiler compile @bad.qmodel -o @new.img";
    let qmodel = folder.read("net.qmodel");
    let changed = |at: usize, value: u8| {
        let mut bytes = qmodel.clone();
        bytes[at] ^= value;
        bytes
    };
    let help = "help: make the file again with model-compiler";
    let damaged =
        format!("@bad.qmodel: the quantized model is truncated or was changed: its digest does not match\n  {help}");
    for bytes in [qmodel[..qmodel.len() - 1].to_vec(), changed(qmodel.len() / 2, 4)] {
        folder.write("bad.qmodel", bytes);
        refused(&folder, compile, &damaged);
        refused(&folder, "model-compiler inspect @bad.qmodel", &damaged);
    }
    folder.write("bad.qmodel", changed(8, 2 ^ 9));
    refused(&folder, compile, &format!("@bad.qmodel: format of the quantized model: found 9, expected 2\n  {help}"));
    folder.write("bad.qmodel", &qmodel[..5]);
    refused(
        &folder,
        compile,
        "@bad.qmodel: byte 0: found a file that begins with \"QMODE\", expected a torch zip archive (PK), a torch legacy stream (a pickle), safetensors or ONNX\n  help: save the weights with torch.save(model.state_dict(), FILE) or safetensors, and check that the download is complete",
    );
    let verify = "host-sim verify @net.img --inputs @inputs.safetensors --record @bad.record";
    refused(
        &folder,
        verify,
        "@bad.record: No such file or directory (os error 2)\n  help: the record is written beside the image; --record FILE names another place",
    );
    let record = folder.read("net.record");
    folder.write("bad.record", &record[..record.len() - 7]);
    let damaged = "@bad.record: the build record is truncated or was changed: its digest does not match";
    refused(&folder, verify, &format!("{damaged}\n  {help}"));
    folder.write("bad.record", &qmodel);
    refused(&folder, verify, &format!("@bad.record: this is not a build record\n  {help}"));
    let mut other: Record = artifact::from_bytes(&record).unwrap();
    let found = artifact::hex(&other.image_sha256[..8]);
    other.image_sha256 = [0x11; 32];
    folder.write("bad.record", artifact::to_bytes(&other).unwrap());
    refused(
        &folder,
        verify,
        &format!(
            "@bad.record: the record belongs to another image: digest of @net.img is {found}…, expected \
             1111111111111111…\n  help: compile again, or keep OUT.img and OUT.record of one build together"
        ),
    );
    std::fs::remove_file(folder.path("net.record")).unwrap();
    refused(
        &folder,
        "host-sim verify @net.img --inputs @inputs.safetensors",
        "@net.record: No such file or directory (os error 2)\n  help: the record is written beside the image; --record FILE names another place",
    );
}

/// A sealed file whose content makes no sense: not what this compiler wrote, but its digest is right.
#[test]
fn quantized_models_that_contradict_themselves() {
    let folder = project(System::Aim);
    let good: QModel = artifact::from_bytes(&folder.read("net.qmodel")).unwrap();
    let steps = good.steps.len();
    type Damage = fn(&mut QModel);
    let damages: [(&str, Damage); 4] = [
        ("a step is missing", |m| drop(m.steps.remove(2))),
        ("a step is there twice", |m| m.steps.push(m.steps[1].clone())),
        ("a tensor has another shape", |m| m.tensors[2].shape.height += 1),
        ("a tensor is missing", |m| drop(m.tensors.pop())),
    ];
    for (what, damage) in damages {
        let mut model = good.clone();
        damage(&mut model);
        folder.write("bad.qmodel", artifact::to_bytes(&model).unwrap());
        let outcome = folder.run("model-compiler compile @bad.qmodel -o @new.img");
        assert_eq!(outcome.status, 2, "{what} of {steps} steps: {}{}", outcome.out, outcome.err);
        assert!(outcome.err.starts_with("error: @bad.qmodel: "), "{what}: {}", outcome.err);
        assert!(!folder.path("new.img").exists() && !folder.path("new.record").exists());
    }
}

#[test]
fn words_of_the_command_line_that_mean_nothing() {
    let folder = project(System::Aim);
    let compile = |options: &str| format!("{COMPILE} {options}");
    refused(
        &folder,
        &compile("--target cortex-m5"),
        "--target: unknown target 'cortex-m5'\n  help: use one of portable, x86, cortex-m4, cortex-m7, cortex-m55, cortex-a, or a file FILE.toml",
    );
    refused(
        &folder,
        &compile("--target nowhere.toml"),
        "nowhere.toml: No such file or directory (os error 2)\n  help: check the path",
    );
    refused(
        &folder,
        &compile("--system autopilot"),
        "--system: unknown system 'autopilot'\n  help: one of aim, late_fusion, transfuser, geometric_fusion, cilrs, lbc",
    );
    refused(
        &folder,
        &compile("--resolution 60x64"),
        "@inputs.safetensors: tensor `rgb`: U8 [4, 3, 256, 256], expected U8 [N, 3, 60, 64]\n  help: --resolution HxW sets the size of a network whose checkpoint does not tell it",
    );
    for (text, expected) in [
        (
            "",
            "@b.toml: TOML parse error at line 1, column 1\n  |\n1 | \n  | ^\nmissing field `name`\n  help: fields: name, alignment, flash, kernels, [[regions]] with name and bytes",
        ),
        (
            "name = 'b'\nalignment = 12\n[[regions]]\nname = 'main'\n",
            "@b.toml: alignment: found 12, expected a power of two from 4 to 4096",
        ),
        (
            "name = 'b'\nalignment = 4\nflash = '2X'\n[[regions]]\nname = 'main'\n",
            "@b.toml: flash: found '2X', expected a number of bytes\n  help: for example 524288, 512K or 2M",
        ),
        (
            "name = 'b'\nalignment = 4\nflesh = 3\n[[regions]]\nname = 'main'\n",
            "@b.toml: TOML parse error at line 3, column 1\n  |\n3 | flesh = 3\n  | ^^^^^\nunknown field `flesh`, expected one of `name`, `alignment`, `flash`, `kernels`, `regions`\n  help: fields: name, alignment, flash, kernels, [[regions]] with name and bytes",
        ),
    ] {
        folder.write("b.toml", text);
        let target = folder.path("b.toml").display().to_string();
        refused(&folder, &compile(&format!("--target {target}")), expected);
    }
    let more = "\n\nFor more information, try '--help'.";
    for (options, expected) in [
        ("--skip i9", "invalid value 'i9' for '--skip <i8|i16|LIST>': found \"i9\", "),
        ("--skip 0,5", "invalid value '0,5' for '--skip <i8|i16|LIST>': found \"0,5\", "),
        ("--resolution 64", "invalid value '64' for '--resolution <HxW>': found \"64\", "),
        ("--ram 1G", "invalid value '1G' for '--ram <BYTES>': found '1G', "),
        ("--fusion-scales 5", "invalid value '5' for '--fusion-scales <N>': "),
        ("--heads 0", "invalid value '0' for '--heads <HEADS>': "),
        ("--max-velocity nan", "invalid value 'nan' for '--max-velocity <M/S>': found \"nan\", "),
        ("--fast", "unexpected argument '--fast' found"),
    ] {
        let outcome = folder.run(&compile(options));
        assert_eq!((outcome.status, outcome.out.as_str()), (2, ""));
        assert!(outcome.err.starts_with(&format!("error: {expected}")), "{options}: {}", outcome.err);
        assert!(outcome.err.ends_with(&format!("{more}\n")), "{options}: {}", outcome.err);
    }
    refused(
        &folder,
        &format!("{RUN} --system autopilot"),
        "--system: unknown system 'autopilot'\n  help: one of aim, late_fusion, transfuser, geometric_fusion, cilrs, lbc",
    );
    refused(
        &folder,
        "host-sim verify @net.img --inputs @inputs.safetensors --min-sqnr 3",
        "gate min_sqnr_db (--min-sqnr): needs the f32 network to compare with\n  help: add --model MODEL",
    );
    let (status, document) = folder.json("host-sim run @net.img --json");
    assert_eq!(
        (status, &document["error"]["code"], &document["error"]["where"]),
        (2, &"usage".into(), &"command line".into())
    );
}

#[test]
fn fusion_scales_of_a_system_that_has_none_to_choose() {
    let folder = project(System::TransFuser);
    refused(
        &folder,
        &format!("{COMPILE} --fusion-scales 2"),
        "@net.safetensors: --fusion-scales has no effect on transfuser\n  help: leave it out; the tensors of other systems tell their scales",
    );
}

#[test]
fn heads_that_do_not_divide_the_channels() {
    let folder = project(System::TransFuser);
    refused(
        &folder,
        &format!("{COMPILE} --heads 3"),
        "@net.safetensors: attention encoder.transformer1.blocks.0.attn.context: 8 channels are not divisible by 3 heads\n  help: --heads sets the number of heads",
    );
}

#[test]
fn outputs_that_cannot_be_written() {
    let folder = project(System::Aim);
    let quantize = "model-compiler quantize @net.safetensors --calib @inputs.safetensors";
    refused(
        &folder,
        &format!("{quantize} -o @nowhere/new.qmodel"),
        "@nowhere/new.qmodel: there is no folder @nowhere\n  help: create it first",
    );
    refused(
        &folder,
        "model-compiler compile @net.qmodel -o @nowhere/new.img",
        "@nowhere/new.img: there is no folder @nowhere\n  help: create it first",
    );
    std::fs::create_dir(folder.path("out.img")).unwrap();
    refused(
        &folder,
        "model-compiler compile @net.qmodel -o @out.img",
        "@out.img: this is a folder, expected the name of a file\n  help: add a file name",
    );
    std::fs::create_dir(folder.path("new.record")).unwrap();
    refused(
        &folder,
        "model-compiler compile @net.qmodel -o @new.img",
        "@new.record: this is a folder, expected the name of a file\n  help: add a file name",
    );
    refused(
        &folder,
        "model-compiler compile @net.qmodel -o @other.record",
        "@other.record: this name is for the record\n  help: give the image another extension, such as .img",
    );
    refused(
        &folder,
        &format!("{quantize} -o @net.safetensors"),
        "@net.safetensors: the output would replace the input\n  help: give it another name",
    );
    refused(
        &folder,
        "model-compiler compile @net.qmodel -o @net.qmodel",
        "@net.qmodel: the output would replace the input\n  help: give it another name",
    );
    refused(
        &folder,
        "model-compiler compile @nothing.pth -o @new2.img",
        "@nothing.pth: No such file or directory (os error 2)\n  help: check the path",
    );
    refused(
        &folder,
        "model-compiler inspect @nothing.pth",
        "@nothing.pth: No such file or directory (os error 2)\n  help: check the path",
    );
    refused(
        &folder,
        "host-sim run @nothing.img --inputs @inputs.safetensors",
        "@nothing.img: No such file or directory (os error 2)\n  help: check the path",
    );
    // A run that fails late leaves the files of an earlier one alone: `refused` compares them.
    let outcome = folder.run("model-compiler compile @net.qmodel --flash 1K -o @net.img");
    assert_eq!(outcome.status, 2);
    refused(
        &folder,
        "model-compiler compile @net.qmodel --flash 1K -o @net.img",
        outcome.err.trim_end().trim_start_matches("error: "),
    );
}
