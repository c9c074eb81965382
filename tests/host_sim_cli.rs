//! The command line of host-sim on a whole small network: files in, exit status and output as a user sees them.

use model_compiler::artifact;
use model_compiler::import::System;
use model_compiler::pipeline::{self, Compiled};
use serde_json::Value;
use tests::agent::{Agent, Rules};
use tests::golden;
use tests::project::Project;

fn waypoints(document: &Value, frame: usize, field: &str) -> Vec<f64> {
    let pairs = document["frames"][frame][field].as_array().expect("waypoints");
    pairs.iter().flat_map(|pair| pair.as_array().unwrap()).map(|v| v.as_f64().unwrap()).collect()
}

#[test]
fn run_gives_waypoints_of_an_image_and_of_its_checkpoint() {
    let project = Project::new(System::LateFusion);
    let (status, int8) = project.json("run net.img --inputs inputs.safetensors --json");
    assert_eq!(status, 0, "{int8}");
    let (status, float) = project.json("run net.safetensors --inputs inputs.safetensors --json");
    assert_eq!(status, 0, "{float}");
    assert_eq!(int8["schema"], 1);
    assert_eq!(int8["model"]["sha256"], artifact::hex(&project.compiled.record.image_sha256));
    assert_eq!(float["model"]["name"], "net");
    assert_eq!(int8["frames"].as_array().unwrap().len(), float["frames"].as_array().unwrap().len());
    for frame in 0..2 {
        assert_eq!(int8["frames"][frame]["name"], format!("inputs#{frame}"));
        for document in [&int8, &float] {
            let points = waypoints(document, frame, "waypoints");
            let speed = f64::from(golden::frames()[frame].velocity);
            let expected = Agent::new(Rules::BASELINES).step([0, 2].map(|k| [points[k], points[k + 1]]), speed);
            let expected = [expected.steer, expected.throttle, f64::from(u8::from(expected.brake))];
            let found = ["steer", "throttle", "brake"].map(|name| &document["frames"][frame]["controls"][name]);
            let close = |(f, e): (&Value, f64)| (f.as_f64().unwrap() - e).abs() < 1e-4;
            assert!(found.into_iter().zip(expected).all(close), "{found:?} instead of {expected:?}");
        }
        let (int8, float) = (waypoints(&int8, frame, "waypoints"), waypoints(&float, frame, "waypoints"));
        assert_eq!(int8.len(), 8);
        let largest = float.iter().fold(0.0_f64, |m, v| m.max(v.abs()));
        for (i, f) in int8.iter().zip(&float) {
            assert!((i - f).abs() < 0.2 * largest, "int8 {int8:?}, f32 {float:?}");
        }
    }
    let table = project.host_sim("run net.img --inputs inputs.safetensors");
    for part in ["forward 4", "steer", "throttle", "brake", "inputs#0"] {
        assert!(table.out.contains(part), "{part}: {}", table.out);
    }
    assert_eq!(table.err, "");
}

/// Steer, throttle, brake and predicted speed of a frame.
fn controls(document: &Value, frame: usize) -> Vec<f64> {
    let frame = &document["frames"][frame];
    let controls = ["steer", "throttle", "brake"].map(|name| &frame["controls"][name]);
    controls.into_iter().chain([&frame["predicted_speed"]]).map(|value| value.as_f64().unwrap()).collect()
}

#[test]
fn run_gives_controls_of_an_image_and_of_its_checkpoint() {
    let project = Project::new(System::Cilrs);
    let (status, int8) = project.json("run net.img --inputs inputs.safetensors --json");
    assert_eq!(status, 0, "{int8}");
    let (status, float) = project.json("run net.safetensors --inputs inputs.safetensors --json");
    assert_eq!(status, 0, "{float}");
    for frame in 0..4 {
        let (int8, float) = (controls(&int8, frame), controls(&float, frame));
        assert!(int8.iter().zip(&float).all(|(i, f)| (i - f).abs() < 0.1), "int8 {int8:?}, f32 {float:?}");
        // Codes of Q15: steer by 2, throttle by 3/4, brake as it is.
        let codes = [int8[0] * 16384.0, int8[1] * 131_072.0 / 3.0, int8[2] * 32768.0];
        assert!(codes.iter().all(|code| code.fract() == 0.0), "{codes:?}");
    }
    let table = project.host_sim("run net.img --inputs inputs.safetensors");
    assert!(table.out.contains("throttle") && table.out.contains("speed, m/s"), "{}", table.out);
}

#[test]
fn a_network_of_controls_is_verified_by_their_errors() {
    let project = Project::new(System::Cilrs);
    let gate = project.path("gates.toml");
    std::fs::write(&gate, "max_control_error = 0.1\nmin_output_sqnr_db = 20").unwrap();
    let command =
        format!("verify net.img --model net.safetensors --inputs inputs.safetensors --gate {}", gate.display());
    let (status, report) = project.json(&format!("{command} --json"));
    assert_eq!((status, &report["bytes_equal"]), (0, &true.into()), "{report}");
    let errors = report["summary"]["control_error"].as_array().unwrap();
    let names: Vec<_> = errors.iter().map(|error| error["name"].as_str().unwrap()).collect();
    assert_eq!(names, ["steer", "throttle", "brake", "predicted_speed"]);
    assert!(errors.iter().all(|error| error["max"].as_f64().unwrap() >= error["mean"].as_f64().unwrap()));
    assert!(report["frames"][3]["reference_control"]["controls"]["brake"].is_f64(), "{report}");
    assert_eq!(report["summary"]["waypoint_error_mm"].as_array().unwrap().len(), 0);
    let text = project.host_sim(&format!("{command} --report {}", project.path("page").display()));
    assert!(text.out.contains("steer") && text.out.contains("off on average"), "{}", text.out);
    let page = std::fs::read_to_string(project.path("page").join("report.html")).unwrap();
    assert!(page.contains("id=\"controls\"") && page.contains("Control error"));
    let ablation = project.host_sim("ablate net.safetensors --calib inputs.safetensors --inputs inputs.safetensors");
    assert!(ablation.out.contains("worst throttle"), "{}{}", ablation.out, ablation.err);
    let bench = project.host_sim("bench net.img --rounds 1");
    assert!(bench.status == 0 && bench.out.contains("branch_linear"), "{}{}", bench.out, bench.err);
    std::fs::write(&gate, "max_control_error = 0").unwrap();
    assert_eq!(project.host_sim(&command).status, 1);
}

#[test]
fn verify_proves_bytes_and_measures_every_step() {
    let project = Project::new(System::TransFuser);
    let (status, report) =
        project.json("verify net.img --model net.safetensors --inputs inputs.safetensors --mirror --json");
    assert_eq!((status, &report["passed"], &report["bytes_equal"]), (0, &true.into(), &true.into()), "{report}");
    let steps = report["steps"].as_array().unwrap();
    assert_eq!(steps.len(), project.compiled.record.model.steps.len());
    for step in steps {
        assert_eq!(step["bytes_equal"], true);
        let measured = step["cosine"].is_f64() && step["max_error_lsb"].is_f64();
        assert!(measured, "a step without a counterpart in the f32 network: {step}");
    }
    // The frames of the file are the calibration frames; their mirror images are not.
    let frames = report["frames"].as_array().unwrap();
    let known = report["calibration_frames"].as_array().unwrap();
    assert_eq!((frames.len(), known.len()), (8, 4));
    assert_eq!(frames[4]["calibration"], false);
    assert_eq!(report["summary"]["waypoint_error_mm"].as_array().unwrap().len(), 4);
    assert_eq!(report["summary"]["flash_bytes"], project.compiled.image.len());
}

#[test]
fn verify_speaks_to_people() {
    let project = Project::new(System::Aim);
    let outcome = project.host_sim("verify net.img --model net.safetensors --inputs inputs.safetensors --min-sqnr 0");
    assert_eq!(outcome.status, 0, "{}", outcome.err);
    assert!(outcome.err.starts_with("warning: 4 of 4 frames are also calibration frames"), "{}", outcome.err);
    for expected in ["SQNR dB", "equal in every step of every frame", "waypoint 4", "arena", "flash"] {
        assert!(outcome.out.contains(expected), "{expected}:\n{}", outcome.out);
    }
    // Without the f32 network only bytes are compared.
    let bytes_only = project.host_sim("verify net.img --inputs inputs.safetensors");
    assert!(bytes_only.status == 0 && !bytes_only.out.contains("waypoint 1"), "{}", bytes_only.out);
}

#[test]
fn a_missed_gate_is_exit_status_one_and_names_the_step() {
    let project = Project::new(System::Aim);
    let command = "verify net.img --model net.safetensors --inputs inputs.safetensors --min-sqnr 200";
    let outcome = project.host_sim(command);
    assert_eq!(outcome.status, 1);
    assert!(
        outcome.err.contains("error: gate min_sqnr_db: step ") && outcome.err.contains("expected at least 200 dB"),
        "{}",
        outcome.err
    );
    let (status, report) = project.json(&format!("{command} --json"));
    assert_eq!((status, &report["passed"], &report["bytes_equal"]), (1, &false.into(), &true.into()));
    assert_eq!(report["error"]["code"], "check");
}

#[test]
fn one_altered_weight_is_found_and_named() {
    use firmware::image::{Image, SectionKind};
    use model_compiler::emit::{AlignedBytes, reseal};
    let project = Project::new(System::Aim);
    let Compiled { mut image, mut record } = project.compiled.clone();
    let offset = {
        let aligned = AlignedBytes::from(image.as_slice());
        let constants = Image::parse(&aligned).unwrap().section(SectionKind::Constants).as_ptr().addr();
        constants - aligned.as_ptr().addr()
    };
    // The first constants are the weights of the first convolution.
    image[offset] ^= 0x20;
    reseal(&mut image);
    record.image_sha256 = artifact::sha256(&image);
    pipeline::write(&Compiled { image, record }, &project.path("altered.img")).unwrap();
    let outcome = project.host_sim("verify altered.img --inputs inputs.safetensors");
    assert_eq!(outcome.status, 1, "{}", outcome.out);
    let first = &project.compiled.record.model;
    let first = &first.steps[project.compiled.record.plan.order[0] as usize].name;
    assert!(outcome.err.contains(&format!("step 0 {first}: the engine differs from the f64 model")), "{}", outcome.err);
    let (status, report) = project.json("verify altered.img --inputs inputs.safetensors --json");
    assert_eq!((status, &report["first_difference"]["position"]), (1, &0.into()));
    assert_ne!(report["first_difference"]["found"], report["first_difference"]["expected"]);
}

#[test]
fn bad_input_is_exit_status_two_and_says_where() {
    let project = Project::new(System::Aim);
    std::fs::write(project.path("empty.img"), b"").unwrap();
    std::fs::create_dir(project.path("frames")).unwrap();
    let cases = [
        ("run nothing.img --inputs inputs.safetensors", "nothing.img: "),
        ("run net.img --inputs nothing.safetensors", "nothing.safetensors: "),
        ("run net.img --frames frames", "holds no frame folder"),
        ("run net.img --inputs frames", "--inputs takes a file"),
        ("run net.img --frames inputs.safetensors", "--frames takes a directory"),
        ("run net.img --inputs net.safetensors", "tensor `rgb`: missing"),
        ("verify empty.img --inputs inputs.safetensors", "this is no model image"),
        ("verify net.img --record net.img --inputs inputs.safetensors", "this is not a build record"),
        ("verify net.img --inputs inputs.safetensors --min-sqnr 3", "needs the f32 network"),
        (
            "verify net.img --model net.safetensors --resolution 64x64 --inputs inputs.safetensors",
            "give the checkpoint that the image was compiled from",
        ),
        ("verify net.img", "required arguments"),
    ];
    for (command, expected) in cases {
        let outcome = project.host_sim(command);
        assert_eq!((outcome.status, outcome.out.as_str()), (2, ""), "{command}");
        assert!(outcome.err.contains(expected), "{command}: {}", outcome.err);
        let (status, document) = project.json(&format!("{command} --json"));
        assert_eq!(status, 2);
        let error = &document["error"];
        assert!(error["code"].is_string() && error["message"].is_string() && error["where"].is_string(), "{document}");
    }
}
