//! The whole way on the command line: small networks from checkpoint to waypoints, and what each command prints.

use model_compiler::import::System;
use serde_json::Value;
use tests::build;
use tests::commands::{self, Folder};
use tests::golden::{self, Network};

/// A folder with a network's checkpoint, inputs and image.
fn compiled(network: &Network) -> Folder {
    let folder = Folder::of(network);
    folder.ok("model-compiler compile @net.safetensors --calib @inputs.safetensors -o @net.img");
    folder
}

fn assert_holds(text: &str, parts: &[&str]) {
    for part in parts {
        assert!(text.contains(part), "no {part:?} in:\n{text}");
    }
}

fn waypoints(document: &Value, frame: usize) -> Vec<f64> {
    let pairs = document["frames"][frame]["waypoints"].as_array().expect("waypoints");
    let values: Vec<f64> = pairs.iter().flat_map(|p| p.as_array().expect("a pair")).filter_map(Value::as_f64).collect();
    assert_eq!((pairs.len(), values.len()), (4, 8), "{document}");
    values
}

#[test]
fn every_container_and_every_way_gives_the_same_image() {
    let network = Network::small(System::Aim);
    let folder = Folder::of(&network);
    let saved = commands::torch(&network.tensors());
    folder.write("net.pth", saved.zip());
    folder.write("net.pt", saved.legacy());
    let printed = folder.ok("model-compiler compile @net.safetensors --calib @inputs.safetensors -o @direct.img");
    assert_holds(
        &printed,
        &["model  net (aim)", "target  portable", "of int8 weights", ": optimal", "written  @direct.img"],
    );
    let expected = (folder.read("direct.img"), folder.read("direct.record"));
    for extension in ["safetensors", "pth", "pt"] {
        let quantize = format!("model-compiler quantize @net.{extension} --calib @inputs.safetensors -o @net.qmodel");
        assert_holds(&folder.ok(&quantize), &["@net.qmodel: ", " steps, ", " B\n"]);
        folder.ok("model-compiler compile @net.qmodel -o @two.img");
        folder.ok(&format!("model-compiler compile @net.{extension} --calib @inputs.safetensors -o @one.img"));
        for image in ["one", "two"] {
            let found = (folder.read(&format!("{image}.img")), folder.read(&format!("{image}.record")));
            assert!(found == expected, "{image} step from .{extension} gives other bytes");
        }
    }
    // Nothing temporary is left.
    let stems = ["direct", "inputs", "net", "one", "two"];
    assert!(folder.names().iter().all(|name| stems.contains(&name.split('.').next().unwrap())), "{:?}", folder.names());
}

#[test]
fn inspect_tells_what_is_in_every_file() {
    let folder = compiled(&Network::small(System::TransFuser));
    folder.ok("model-compiler quantize @net.safetensors --calib @inputs.safetensors -o @net.qmodel");
    let inspect = |file: &str| folder.ok(&format!("model-compiler inspect @{file}"));
    let tensors = ["checkpoint  safetensors", "system      transfuser", "encoder.transformer4.blocks.1.mlp.2.weight"];
    assert_holds(&inspect("net.safetensors"), &tensors);
    assert_holds(&inspect("net.safetensors"), &["[1, 8, 32]", "[32, 128]", "tensors     "]);
    let steps = ["quantized model  net (transfuser)", "skip_stages", "attention", "layer_norm", "headroom bits"];
    assert_holds(&inspect("net.qmodel"), &steps);
    assert_holds(&inspect("net.record"), &["build record     image ", "target           portable", ": optimal\n"]);
    let image = inspect("net.img");
    assert_holds(&image, &["model image  net", "all section CRCs match", "constants", "program"]);
    assert_holds(&image, &["velocity", "waypoints", "waypoint_decoder", "live bytes", "largest live sum "]);
    let digest = model_compiler::artifact::hex(&model_compiler::artifact::sha256(&folder.read("net.img")));
    assert_holds(&image, &[&format!("sha256       {digest}")]);
}

#[test]
fn run_prints_waypoints_of_image_and_checkpoint() {
    let folder = compiled(&Network::small(System::TransFuser));
    let text = folder.ok("host-sim run @net.img --inputs @inputs.safetensors");
    assert_holds(&text, &["waypoints in meters", "right 1", "forward 4", "inputs#0", "inputs#3"]);
    let (status, int8) = folder.json("host-sim run @net.img --inputs @inputs.safetensors --json");
    assert_eq!(status, 0);
    let (status, float) = folder.json("host-sim run @net.safetensors --inputs @inputs.safetensors --json");
    assert_eq!(status, 0);
    for (document, file) in [(&int8, "net.img"), (&float, "net.safetensors")] {
        let digest = model_compiler::artifact::hex(&model_compiler::artifact::sha256(&folder.read(file)));
        let model = serde_json::json!({"name": "net", "sha256": digest});
        assert_eq!((&document["schema"], &document["model"]), (&1.into(), &model));
        assert_eq!(document["frames"].as_array().unwrap().len(), 4);
        assert_eq!(document["frames"][2]["name"], "inputs#2");
    }
    let span = |w: &[f64]| w.iter().fold(0.0_f64, |m, v| m.max(v.abs()));
    for frame in 0..4 {
        let (int8, float) = (waypoints(&int8, frame), waypoints(&float, frame));
        let close = int8.iter().zip(&float).all(|(i, f)| (i - f).abs() < 0.2 * span(&float));
        assert!(span(&float) > 0.0 && close, "int8 {int8:?}, f32 {float:?}");
    }
    // What the table shows is what the document holds.
    let row: Vec<&str> = text.lines().find(|l| l.contains("inputs#1")).unwrap().split_whitespace().skip(1).collect();
    let controls = ["steer", "throttle", "brake"].map(|name| int8["frames"][1]["controls"][name].as_f64().unwrap());
    let shown: Vec<f64> = waypoints(&int8, 1).into_iter().chain(controls).collect();
    assert_eq!(row, shown.iter().map(|value| format!("{value:.3}")).collect::<Vec<_>>());
}

#[test]
fn run_of_a_published_network_gives_the_original_controls() {
    let folder = Folder::default();
    golden::write_safetensors(&golden::checkpoint(System::Cilrs), &folder.path("net.safetensors")).unwrap();
    let inputs = golden::path("inputs.safetensors").display().to_string();
    let (status, document) = folder.json(&format!("host-sim run @net.safetensors --inputs {inputs} --json"));
    assert_eq!(status, 0, "{document}");
    let expected = golden::expected(System::Cilrs).results;
    for (i, frame) in document["frames"].as_array().expect("frames").iter().enumerate() {
        let controls = ["steer", "throttle", "brake"].map(|name| (name, &frame["controls"][name]));
        for (name, found) in controls.into_iter().chain([("velocity", &frame["predicted_speed"])]) {
            let error = (found.as_f64().expect("a number") - f64::from(expected[name][i][0])).abs();
            assert!(error < 1e-3, "frame {i}, {name}: {found}, expected {}", expected[name][i][0]);
        }
    }
}

#[test]
fn verify_shows_every_step_and_gates_its_noise() {
    let folder = compiled(&Network::small(System::LateFusion));
    let command = "host-sim verify @net.img --model @net.safetensors --inputs @inputs.safetensors --mirror";
    let outcome = folder.run(&format!("{command} --min-sqnr 1"));
    assert_eq!(outcome.status, 0, "{}", outcome.err);
    let columns = ["step", "op", "shape", "type", "local dB", "SQNR dB", "cosine", "max LSB", "clip ppm", "headroom"];
    assert_holds(&outcome.out, &columns);
    assert_holds(&outcome.out, &["equal in every step of every frame", "waypoint 4", "lower bound ", "flash "]);
    assert_eq!(outcome.out.lines().filter(|line| line.ends_with("yes")).count(), step_count(&folder));
    assert_eq!(
        outcome.err,
        "warning: 4 of 8 frames are also calibration frames, so figures against f32 flatter: inputs#0, inputs#1, \
         inputs#2, inputs#3\n"
    );
    let missed = folder.run(&format!("{command} --min-sqnr 90"));
    let table = |out: &str| out.lines().filter(|line| !line.starts_with("gate ")).collect::<Vec<_>>().join("\n");
    let same = table(&missed.out) == table(&outcome.out);
    assert_eq!((missed.status, same), (1, true), "the report is printed all the same");
    assert_holds(&outcome.out, &["gate min_sqnr_db met"]);
    assert_holds(&missed.out, &["gate min_sqnr_db MISSED"]);
    assert_holds(&missed.err, &["\nerror: gate min_sqnr_db: step ", "expected at least 90 dB"]);
    let (status, document) = folder.json(&format!("{command} --min-sqnr 90 --json"));
    assert_eq!((status, &document["passed"], &document["bytes_equal"]), (1, &false.into(), &true.into()));
    assert_eq!((&document["error"]["code"], &document["schema"]), (&"check".into(), &1.into()));
    assert_eq!(document["calibration_frames"].as_array().unwrap().len(), 4);
}

fn step_count(folder: &Folder) -> usize {
    let text = folder.ok("model-compiler inspect @net.img");
    let line = text.lines().find(|line| line.starts_with("steps ")).expect("the number of steps");
    line.split_whitespace().nth(1).unwrap().parse().unwrap()
}

/// Frame folders give a LiDAR histogram of 256×256, so the network has the published resolution but few channels.
#[test]
fn frame_folders_calibrate_run_and_verify() {
    let network = Network { grid: (8, 8), layers: 1, ..Network::small(System::TransFuser) };
    let folder = Folder::of(&network);
    for (i, frame) in build::frames(network.resolution()).iter().enumerate() {
        commands::write_frame(&folder, &format!("{}/f{i}", if i < 3 { "train" } else { "test" }), frame);
    }
    folder.write("test/.hidden/note", b"folders that begin with a dot are no frames");
    folder.ok("model-compiler compile @net.safetensors --calib @train --target cortex-m7 -o @net.img");
    let verify = "host-sim verify @net.img --model @net.safetensors";
    let text = folder.ok(&format!("{verify} --frames @test"));
    assert_holds(&text, &["net for cortex-m7, 1 frames", "equal in every step of every frame", "waypoint 4"]);
    let outcome = folder.run(&format!("{verify} --frames @train"));
    assert_eq!((outcome.status, outcome.err.contains("3 of 3 frames are also calibration frames")), (0, true));
    let (status, document) = folder.json("host-sim run @net.img --frames @test --json");
    assert_eq!((status, &document["frames"][0]["name"]), (0, &"f3".into()));
    let image = waypoints(&document, 0);
    let (_, document) = folder.json(&format!("{verify} --frames @test --json"));
    assert_eq!(waypoints(&document, 0), image, "run and verify agree");
    let (_, document) = folder.json("host-sim run @net.safetensors --frames @test --json");
    assert_eq!(waypoints(&document, 0).len(), 8);
}

#[test]
fn geometric_fusion_reads_frame_folders_and_any_number_of_fused_stages() {
    let network = Network { grid: (8, 8), ..Network::small(System::GeometricFusion) };
    let folder = Folder::of(&network);
    let [all, four, two] = ["", " --fusion-scales 4", " --fusion-scales 2"].map(|options| proven(&folder, options, ""));
    assert!(all == four && all != two);
    for (i, frame) in build::frames(network.resolution()).iter().enumerate() {
        commands::write_frame(&folder, &format!("{}/f{i}", if i < 3 { "train" } else { "test" }), frame);
    }
    folder.ok("model-compiler compile @net.safetensors --calib @train -o @net.img");
    let (status, document) = folder.json("host-sim verify @net.img --model @net.safetensors --frames @test --json");
    assert_eq!((status, &document["bytes_equal"]), (0, &true.into()));
    let verified = waypoints(&document, 0);
    let (_, document) = folder.json("host-sim run @net.img --frames @test --json");
    assert_eq!(waypoints(&document, 0), verified, "the image alone tells how its frames are prepared");
}

/// Quantizes with options and returns the digest of the file; then proves the bytes of its image.
fn proven(folder: &Folder, options: &str, compile_options: &str) -> Vec<u8> {
    let frames = "--calib @inputs.safetensors";
    folder.ok(&format!("model-compiler quantize @net.safetensors {frames}{options} -o @o.qmodel"));
    folder.ok(&format!("model-compiler compile @o.qmodel{compile_options} -o @o.img"));
    let outcome = folder.run("host-sim verify @o.img --inputs @inputs.safetensors");
    assert_eq!(outcome.status, 0, "{options}: {}", outcome.err);
    folder.read("o.qmodel")
}

#[test]
fn every_option_of_the_quantizer_changes_the_model_and_stays_byte_exact() {
    let folder = Folder::of(&Network::small(System::TransFuser));
    let options = [
        "",
        " --skip i16",
        " --skip 0",
        " --skip 1,2",
        " --ranges minmax",
        " --no-bias-correction",
        " --max-velocity 30",
        " --heads 2",
    ];
    let models: Vec<Vec<u8>> = options.iter().map(|options| proven(&folder, options, "")).collect();
    for (i, model) in models.iter().enumerate() {
        let twin = models[..i].iter().position(|other| other == model);
        assert_eq!(twin, None, "{:?} makes no difference", options[i]);
    }
    for same in [" --skip i8", " --ranges mse", " --heads 4", " --system transfuser --resolution 64x64"] {
        assert!(proven(&folder, same, "") == models[0], "{same} is the default");
    }
    assert!(proven(&folder, " --skip 4,3,2,1,0,0", "") == models[1], "all stages are i16");
    let (_, f32_4) = folder.json("host-sim run @net.safetensors --inputs @inputs.safetensors --json");
    let (_, f32_2) = folder.json("host-sim run @net.safetensors --inputs @inputs.safetensors --heads 2 --json");
    assert_ne!(waypoints(&f32_4, 0), waypoints(&f32_2, 0));
}

#[test]
fn options_of_the_target_change_the_plan_only() {
    // With a wide stem, as the published network has it, the pools after the stems are the peak.
    let small = Network::small(System::TransFuser);
    let folder = Folder::of(&Network { stem: 64, widths: [64, 16, 24, 32], ..small });
    let arena = |options: &str| -> u64 {
        proven(&folder, "", options);
        let text = folder.ok("model-compiler inspect @o.img");
        let line = text.lines().find(|line| line.starts_with("arena  ")).expect("the arena");
        line.split_whitespace().nth(1).unwrap().parse().unwrap()
    };
    let smallest = arena("");
    assert!(arena(" --no-in-place-pooling") > smallest);
    assert_eq!(arena(&format!(" --ram {smallest} --flash 8M")), smallest, "just enough is enough");
    folder.write("board.toml", "name = 'board'\nalignment = 128\n[[regions]]\nname = 'main'\nbytes = '1M'\n");
    let aligned = arena(&format!(" --target {}", folder.path("board.toml").display()));
    assert!(aligned > smallest && aligned % 128 == 0, "{aligned}");
    let offsets = folder.ok("model-compiler inspect @o.record");
    assert_holds(&offsets, &["target           board"]);
    assert_holds(&folder.ok("model-compiler inspect @o.img"), &["target       board\n", "revision     0\n"]);
    proven(&folder, "", " --revision 7");
    assert_holds(&folder.ok("model-compiler inspect @o.img"), &["target       portable\n", "revision     7\n"]);
}

#[test]
fn a_quantized_model_needs_no_frames_and_says_so() {
    let folder = Folder::of(&Network::small(System::Aim));
    folder.ok("model-compiler quantize @net.safetensors --calib @inputs.safetensors -o @net.qmodel");
    let outcome = folder.run("model-compiler compile @net.qmodel --calib @inputs.safetensors -o @net.img");
    assert_eq!(outcome.status, 0);
    assert_eq!(outcome.err, "warning: @net.qmodel is quantized already; --calib has no effect\n");
}

#[test]
fn help_and_version_are_results() {
    let folder = Folder::default();
    for program in ["model-compiler", "host-sim"] {
        assert_holds(&folder.ok(&format!("{program} --help")), &["Usage: ", "Examples:", "Commands:"]);
        assert_holds(&folder.ok(&format!("{program} --version")), &[program, env!("CARGO_PKG_VERSION")]);
    }
    assert_holds(
        &folder.ok("model-compiler compile --help"),
        &["--calib", "--target", "--ram", "--no-in-place-pooling"],
    );
    assert_holds(&folder.ok("host-sim verify --help"), &["--min-sqnr", "--mirror", "--record", "--json"]);
    assert_holds(&folder.ok("host-sim bench --help"), &["--rounds", "--backend", "avx512-vnni", "taskset"]);
}

#[test]
fn every_shell_gets_a_script_that_knows_the_commands() {
    let folder = Folder::default();
    for shell in ["bash", "elvish", "fish", "powershell", "zsh"] {
        let script = folder.ok(&format!("model-compiler completions {shell}"));
        assert_holds(&script, &["model-compiler", "quantize", "calib", "no-in-place-pooling"]);
        let script = folder.ok(&format!("host-sim completions {shell}"));
        assert_holds(&script, &["host-sim", "verify", "min-sqnr", "bench"]);
    }
    for program in ["model-compiler", "host-sim"] {
        let outcome = folder.run(&format!("{program} completions tcl"));
        assert_eq!((outcome.status, outcome.out.as_str()), (2, ""));
        assert_holds(&outcome.err, &["invalid value 'tcl'", "powershell"]);
    }
}

#[test]
fn what_was_meant_is_suggested() {
    let folder = Folder::default();
    for (command, meant) in [
        ("model-compiler inspcet @net.img", "'inspect'"),
        ("model-compiler compile @net.qmodel --tagret cortex-m7 -o @net.img", "'--target'"),
        ("host-sim verfy @net.img", "'verify'"),
        ("host-sim run @net.img --frame @frames", "'--frames'"),
    ] {
        let outcome = folder.run(command);
        assert_eq!((outcome.status, outcome.out.as_str()), (2, ""), "{command}");
        assert!(outcome.err.contains("similar") && outcome.err.contains(meant), "{command}: {}", outcome.err);
    }
}
