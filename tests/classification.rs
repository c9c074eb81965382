//! Classifiers the whole way: an ONNX file and a folder of labeled images, to classes and their accuracy.

use serde_json::Value;
use tests::commands::Folder;
use tests::onnx_file::{OnnxFile, int, ints};
use tests::random::Random;

const SIDE: u32 = 8;
const IMAGES: usize = 12;
const CLASSES: i64 = 7;
const SEED: u64 = 11;

/// A folder with `net.onnx`, a small network of random weights, `calib/` and, labeled as f32 sees them, `images/`.
fn project() -> Folder {
    let folder = Folder::default();
    let mut file = OnnxFile::new(13, SEED);
    file.input("pixels", &[1, 3, SIDE.into(), SIDE.into()]);
    let (conv, dense) = (file.weights("conv", &[8, 3, 3, 3]), file.weights("dense", &[CLASSES, 8]));
    file.node("Conv", &["pixels", &conv], "c", &[ints("kernel_shape", &[3, 3]), ints("pads", &[1, 1, 1, 1])]);
    file.node("Relu", &["c"], "r", &[]);
    file.node("GlobalAveragePool", &["r"], "p", &[]);
    file.node("Flatten", &["p"], "f", &[]);
    file.node("Gemm", &["f", &dense], "logits", &[int("transB", 1)]);
    file.output("logits");
    folder.write("net.onnx", file.bytes());
    write_images(&folder, "calib", IMAGES, SEED + 1);
    write_images(&folder, "images", IMAGES, SEED + 2);
    let (status, float) = folder.json("host-sim run @net.onnx --frames @images --json");
    assert_eq!(status, 0, "{float}");
    assert!(float.get("accuracy").is_none(), "there are no labels yet");
    let lines = float["frames"].as_array().unwrap().iter().map(|frame| {
        let class = frame["top1"].as_u64().unwrap();
        format!("{},{class},class{class}\n", frame["name"].as_str().unwrap())
    });
    folder.write("images/labels.csv", format!("file,label,name\n{}", lines.collect::<String>()));
    folder
}

/// Images of one random color each with some noise.
fn write_images(folder: &Folder, name: &str, count: usize, seed: u64) {
    let mut random = Random::new(seed);
    let mut levels = |count: usize, below| (0..count).map(|_| random.below(below) as u8).collect::<Vec<u8>>();
    for i in 0..count {
        let color = levels(3, 200);
        let noise = levels((3 * SIDE * SIDE) as usize, 56);
        let pixels: Vec<u8> = noise.iter().zip(color.iter().cycle()).map(|(n, c)| n + c).collect();
        let file = format!("{name}/{i:03}.png");
        folder.write(&file, b"");
        image::save_buffer(folder.path(&file), &pixels, SIDE, SIDE, image::ColorType::Rgb8).unwrap();
    }
}

fn compiled() -> Folder {
    let folder = project();
    folder.ok("model-compiler compile @net.onnx --calib @calib -o @net.img");
    folder
}

#[test]
fn run_gives_logits_classes_and_accuracy() {
    let folder = compiled();
    let (status, float) = folder.json("host-sim run @net.onnx --frames @images --json");
    assert_eq!((status, &float["accuracy"]["top1"]), (0, &1.0.into()), "the labels are what f32 says");
    let (status, int8) = folder.json("host-sim run @net.img --frames @images --json");
    assert_eq!((status, &int8["schema"], &int8["model"]["name"]), (0, &1.into(), &"net".into()));
    let keys = |value: &Value| value.as_object().unwrap().keys().cloned().collect::<Vec<_>>();
    assert_eq!(keys(&int8), ["accuracy", "frames", "model", "schema"]);
    assert_eq!(keys(&int8["frames"][0]), ["label", "logits", "name", "top1", "top5"]);
    assert_eq!(keys(&int8["accuracy"]), ["frames", "interval", "top1", "top5"]);
    let (ints, floats) = (int8["frames"].as_array().unwrap(), float["frames"].as_array().unwrap());
    assert_eq!(ints.len(), IMAGES);
    let logits = |frame: &Value| -> Vec<f64> {
        frame["logits"].as_array().unwrap().iter().map(|v| v.as_f64().unwrap()).collect()
    };
    let largest = floats.iter().flat_map(logits).fold(0.0_f64, |m, v| m.max(v.abs()));
    for (i, f) in ints.iter().zip(floats) {
        assert_eq!((&i["name"], &i["label"]), (&f["name"], &f["top1"]));
        assert!(logits(i).iter().zip(logits(f)).all(|(i, f)| (i - f).abs() < 0.05 * largest), "{i}\n{f}");
    }
}

#[test]
fn run_lists_few_frames_and_sums_up_many() {
    let folder = compiled();
    let text = folder.ok("host-sim run @net.img --frames @images");
    for expected in ["011.png", "class", "right", "top-1", "95 % interval", "of 12 frames, top-5"] {
        assert!(text.contains(expected), "{expected}:\n{text}");
    }
    let text = folder.ok("host-sim run @net.img --frames @images --frames-limit 3");
    assert!(text.contains("of 3 frames") && !text.contains("003.png"), "{text}");
    write_images(&folder, "many", 21, SEED);
    let text = folder.ok("host-sim run @net.img --frames @many");
    assert!(text.contains("21 frames without labels") && !text.contains("000.png"), "{text}");
}

#[test]
fn verify_compares_bytes_classes_and_logits() {
    let folder = compiled();
    let command = "host-sim verify @net.img --model @net.onnx --frames @images";
    let (status, report) = folder.json(&format!("{command} --json"));
    assert_eq!((status, &report["bytes_equal"]), (0, &true.into()), "{report}");
    let found = &report["summary"]["accuracy"];
    let (int8, agreement) = (found["int8"]["top1"].as_f64(), found["agreement"]["share"].as_f64());
    assert_eq!((found["f32"]["top1"].as_f64(), int8), (Some(1.0), agreement), "the labels are what f32 says");
    assert_eq!(found["only_int8_right"], 0);
    let lost = IMAGES as f64 * (1.0 - int8.unwrap());
    assert_eq!(found["only_f32_right"].as_f64(), Some(lost.round()));
    assert!(found["logits_sqnr_db"].as_f64().unwrap() > 25.0, "{found}");
    assert_eq!(report["frames"][0]["reference_top1"], report["frames"][0]["label"]);
    let text = folder.ok(command);
    for expected in ["equal in every step of every frame", "dB SQNR against f32", "top-1 int8", "same class"] {
        assert!(text.contains(expected), "{expected}:\n{text}");
    }
    // Without the f32 network only bytes and the engine's own accuracy are left.
    let (_, alone) = folder.json("host-sim verify @net.img --frames @images --frames-limit 2 --json");
    let found = &alone["summary"]["accuracy"];
    assert!(found["agreement"].is_null() && found["int8"]["frames"] == 2, "{found}");
}

#[test]
fn a_missed_gate_is_exit_status_one() {
    let folder = compiled();
    let labels = (0..IMAGES).map(|i| format!("{i:03}.png,{}\n", CLASSES - 1)).collect::<String>();
    folder.write("images/labels.csv", labels);
    let command = "host-sim verify @net.img --model @net.onnx --frames @images";
    let (_, report) = folder.json(&format!("{command} --json"));
    let top1 = 100.0 * report["summary"]["accuracy"]["int8"]["top1"].as_f64().unwrap();
    assert!(top1 < 99.0, "no class is right everywhere: {top1}");
    let outcome = folder.run(&format!("{command} --min-top1 99"));
    assert_eq!(outcome.status, 1);
    let expected = format!("error: gate min_top1_percent: found {top1:.2} %, expected at least 99 %");
    assert!(outcome.err.contains(&expected), "{}", outcome.err);
    let (status, report) = folder.json(&format!("{command} --min-top1 99 --json"));
    assert_eq!((status, &report["passed"], &report["bytes_equal"]), (1, &false.into(), &true.into()));
    let outcome = folder.run("host-sim verify @net.img --frames @images --min-agreement 90");
    assert_eq!(outcome.status, 2, "{}", outcome.err);
    assert!(outcome.err.contains("--min-agreement") && outcome.err.contains("add --model MODEL"), "{}", outcome.err);
}

#[test]
fn ablation_measures_logits_and_agreement() {
    let folder = project();
    let (status, report) = folder.json("host-sim ablate @net.onnx --calib @calib --frames @images --json");
    assert_eq!(status, 0, "{report}");
    for row in report["variants"].as_array().unwrap() {
        let found = &row["fidelity"]["classes"];
        assert!(found["logits_sqnr_db"].is_f64() && found["agreement"]["share"].is_f64(), "{row}");
    }
    let text = folder.ok("host-sim ablate @net.onnx --calib @calib --frames @images");
    assert!(text.contains("logits dB") && text.contains("without data-aware rounding"), "{text}");
}

#[test]
fn raw_inputs_have_the_networks_own_name() {
    use safetensors::{Dtype, tensor::TensorView};
    let folder = compiled();
    let pixels = vec![7_u8; 2 * 3 * 64];
    let labels = [3_i64, 6].map(i64::to_le_bytes).concat();
    let image = TensorView::new(Dtype::U8, vec![2, 3, 8, 8], &pixels).unwrap();
    let label = TensorView::new(Dtype::I64, vec![2], &labels).unwrap();
    folder.write("in.safetensors", safetensors::serialize([("pixels", image), ("label", label)], None).unwrap());
    let (status, report) = folder.json("host-sim run @net.img --inputs @in.safetensors --json");
    assert_eq!((status, &report["frames"][1]["label"]), (0, &6.into()), "{report}");
    assert_eq!(report["frames"][0]["logits"], report["frames"][1]["logits"], "equal images");
}

#[test]
fn bad_frames_are_exit_status_two_and_say_where() {
    let folder = compiled();
    write_images(&folder, "broken", 1, SEED);
    let bytes = folder.read("broken/000.png");
    folder.write("broken/000.png", &bytes[..bytes.len() / 2]);
    folder.write("nothing/readme.txt", b"");
    write_images(&folder, "labeled", 2, SEED);
    folder.write("large/a.png", b"");
    image::save_buffer(folder.path("large/a.png"), &[0; 12 * 10 * 3], 12, 10, image::ColorType::Rgb8).unwrap();
    for (labels, expected) in [
        ("000.png,0\n", "@labeled/labels.csv: no line for the image 001.png"),
        ("000.png,0\n001.png,7\n", "@labeled/labels.csv: line 2: label 7, the network has classes 0..=6"),
        ("000.png,0\n001.png,1\n002.png,1\n", "@labeled/labels.csv: line 3: no image \"002.png\" in this folder"),
    ] {
        folder.write("labeled/labels.csv", labels);
        let outcome = folder.run("host-sim run @net.img --frames @labeled");
        assert!(outcome.status == 2 && outcome.err.contains(expected), "{}", outcome.err);
    }
    for (command, expected) in [
        ("host-sim run @net.img --frames @nothing", "holds no image (PNG or JPEG)"),
        ("host-sim run @net.img --frames @broken", "@broken/000.png: no readable image"),
        ("host-sim run @net.img --frames @large", "@large/a.png: image is 12×10, the network reads 8×8"),
        ("host-sim run @net.img --frames @large --resize 7", "scaled to 8×7, the network reads 8×8"),
        ("model-compiler compile @net.onnx --calib @large -o @x.img", "--resize PIXELS"),
    ] {
        let outcome = folder.run(command);
        assert!(outcome.status == 2 && outcome.err.contains(expected), "{command}: {}", outcome.err);
    }
    folder.ok("host-sim run @net.img --frames @large --resize 9");
    folder.ok("model-compiler compile @net.onnx --calib @large --resize 10 -o @x.img");
}
