//! `host-sim drive`: a recorded sequence through sensors, network, planner and controller, as a user runs it.

use model_compiler::import::System;
use serde_json::{Value, json};
use tests::agent::{Agent, Decision, Rules, ground};
use tests::build;
use tests::commands::{Folder, views_file};
use tests::drive_log::Recording;
use tests::golden::{self, Lbc, Network};

const STEPS: usize = 16;
/// Files of the cameras; all systems but LBC have only the first.
const CAMERAS: [&str; 3] = ["rgb.png", "rgb_left.png", "rgb_right.png"];
/// Height and width of LBC's views: a firmware draws its goal on no others.
const LBC_SIZE: (u16, u16) = (144, 256);
/// Draws the first points of LBC's small network away from the middle of the image, below the horizon.
const SHARP: &str = " --temperature 0.1";

/// A compiled small network (`net.safetensors`, `net.img`) and a log (`log`) whose images are larger than its input.
fn project(system: System, change: impl Fn(usize, &mut Value)) -> Folder {
    let (folder, (height, width)) = match system {
        System::Lbc => (lbc(), LBC_SIZE),
        // Of TransFuser the checkpoint tells the size, of the others it is 256×256.
        _ => {
            let network = Network::small(system);
            (Folder::of(&network), if system == System::TransFuser { network.resolution() } else { (256, 256) })
        }
    };
    let options = if system == System::Lbc { SHARP } else { "" };
    folder.ok(&format!("model-compiler compile @net.safetensors{options} --calib @inputs.safetensors -o @net.img"));
    let image = (u32::from(width) + 14, u32::from(height) + 6);
    let cameras = if system == System::Lbc { &CAMERAS[..] } else { &CAMERAS[..1] };
    Recording { image, cameras, steps: STEPS, seed: 1 }.write(&folder, "log", change);
    folder
}

/// A folder with a small network of LBC and its inputs.
fn lbc() -> Folder {
    let folder = Folder::default();
    let network = Lbc { resolution: LBC_SIZE, maps: 4, ..Lbc::small() };
    golden::write_safetensors(&network.tensors(), &folder.path("net.safetensors")).expect("a writable folder");
    folder.write("inputs.safetensors", views_file(&build::views(LBC_SIZE)));
    folder
}

fn drive(folder: &Folder, options: &str) -> Value {
    let (status, document) = folder.json(&format!("host-sim drive @net.img --log @log --json{options}"));
    assert_eq!(status, 0, "{document}");
    document
}

fn steps(document: &Value) -> &[Value] {
    document["steps"].as_array().expect("steps")
}

fn number(value: &Value) -> f64 {
    value.as_f64().unwrap_or_else(|| panic!("a number in place of {value}"))
}

fn pair(value: &Value) -> [f64; 2] {
    [number(&value[0]), number(&value[1])]
}

fn controls(value: &Value) -> [f64; 3] {
    ["steer", "throttle", "brake"].map(|name| number(&value[name]))
}

fn assert_follows(decision: &Value, expected: Decision) {
    let expected = [expected.steer, expected.throttle, f64::from(u8::from(expected.brake))];
    let close = controls(decision).into_iter().zip(expected).all(|(f, e)| (f - e).abs() < 1e-4);
    assert!(close, "{decision} instead of {expected:?}");
}

#[test]
fn controls_follow_from_the_waypoints_of_each_network() {
    let folder = project(System::TransFuser, |_, _| ());
    let document = drive(&folder, " --model @net.safetensors");
    assert_eq!(steps(&document).len(), STEPS);
    for network in ["int8", "f32"] {
        let mut agent = Agent::new(Rules::TRANSFUSER);
        let mut points = [[0.0; 2]; 2];
        for (index, step) in steps(&document).iter().enumerate() {
            let decision = &step[network];
            assert_eq!(decision["status"], if index == 0 { "filling buffers" } else { "driving" }, "step {index}");
            let runs = index > 0 && (index <= 4 || index % 2 == 0);
            assert_eq!(decision["waypoints"].is_array(), runs, "step {index}: {decision}");
            assert_eq!(step["goal_m"].is_array(), runs);
            if runs {
                points = [0, 1].map(|k| pair(&decision["waypoints"][k]));
            }
            if index > 0 {
                assert_follows(decision, agent.step(points, number(&step["speed_mps"])));
            }
        }
    }
    let summary = &document["summary"];
    assert_eq!((&summary["steps"], &summary["driven"], &summary["safe"]), (&16.into(), &15.into(), &0.into()));
    let distances: Vec<f64> = steps(&document).iter().filter_map(|step| step["waypoint_distance_m"].as_f64()).collect();
    assert_eq!(distances.len(), 4 + 5);
    let mean = distances.iter().sum::<f64>() / 9.0;
    assert!((number(&summary["difference"]["mean_waypoint_distance_m"]) - mean).abs() < 1e-12);
    assert!(mean > 0.0, "int8 and f32 are never equal");
}

/// Puts the frames of those steps in which the network ran into a frame directory, and gives each step with what
/// `host-sim run` says of its frame.
fn run_frames<'d>(folder: &Folder, document: &'d Value) -> Vec<(&'d Value, Value)> {
    let ran: Vec<&Value> = steps(document).iter().filter(|step| step["goal_m"].is_array()).collect();
    for step in &ran {
        let name = step["name"].as_str().expect("a name");
        for file in CAMERAS.into_iter().chain(["lidar.bin"]) {
            if folder.path(&format!("log/frames/{name}/{file}")).exists() {
                folder.write(&format!("frames/{name}/{file}"), folder.read(&format!("log/frames/{name}/{file}")));
            }
        }
        let description = json!({"speed": step["speed_mps"], "goal": step["goal_m"], "command": step["command"]});
        folder.write(&format!("frames/{name}/frame.json"), description.to_string());
    }
    let (status, run) = folder.json("host-sim run @net.img --frames @frames --json");
    assert_eq!(status, 0, "{run}");
    let frames = run["frames"].as_array().expect("frames");
    assert_eq!(frames.len(), ran.len());
    ran.into_iter()
        .zip(frames.iter().cloned())
        .inspect(|(step, frame)| assert_eq!(step["name"], frame["name"]))
        .collect()
}

/// The firmware's sensors and the host's preparation of frames are two programs.
#[test]
fn waypoints_are_those_of_the_same_frames_in_a_directory() {
    for system in [System::TransFuser, System::LateFusion, System::Aim] {
        let folder = project(system, |_, _| ());
        let document = drive(&folder, "");
        let rules = if system == System::TransFuser { Rules::TRANSFUSER } else { Rules::BASELINES };
        for (index, (step, frame)) in run_frames(&folder, &document).iter().enumerate() {
            assert_eq!(frame["waypoints"], step["int8"]["waypoints"], "{system:?}, {}", step["name"]);
            if index == 0 {
                let [alone, driven] = [&frame["controls"], &step["int8"]].map(controls);
                assert_eq!(alone, driven, "{system:?}: the controller has nothing to remember yet");
            }
            let points = [0, 1].map(|k| pair(&frame["waypoints"][k]));
            assert_follows(&frame["controls"], Agent::new(rules).step(points, number(&step["speed_mps"])));
        }
    }
}

#[test]
fn without_a_speed_a_frame_has_waypoints_and_no_controls() {
    let folder = project(System::Aim, |_, _| ());
    let document = drive(&folder, "");
    let whole = run_frames(&folder, &document);
    let goal = |frame: &str| json!({"goal": steps(&document)[frame.parse::<usize>().expect("a number")]["goal_m"]});
    let mut fast = goal("0002");
    fast["speed"] = "fast".into();
    folder.write("frames/0001/frame.json", goal("0001").to_string());
    folder.write("frames/0002/frame.json", fast.to_string());
    let (status, run) = folder.json("host-sim run @net.img --frames @frames --json");
    assert_eq!(status, 0, "{run}");
    for (index, (_, frame)) in whole.iter().enumerate() {
        let found = &run["frames"][index];
        assert_eq!(found["waypoints"], frame["waypoints"]);
        assert_eq!(found["controls"], if index < 2 { Value::Null } else { frame["controls"].clone() });
    }
    let table = folder.ok("host-sim run @net.img --frames @frames");
    assert!(table.contains("controls of a controller in its fresh state"), "{table}");
    assert!(table.lines().any(|line| line.trim().starts_with("0002") && line.trim().ends_with('–')), "{table}");
}

/// The network gives its controls itself; the agent lets throttle and brake exclude each other.
#[test]
fn controls_of_cilrs_are_those_of_the_same_frames_in_a_directory() {
    let folder = project(System::Cilrs, |_, _| ());
    let document = drive(&folder, " --model @net.safetensors");
    assert_eq!(document["summary"]["driven"], 15);
    let ran = run_frames(&folder, &document);
    assert_eq!(ran.len(), STEPS - 1);
    for (step, frame) in &ran {
        assert_eq!(step["command"], 3);
        let [steer, throttle, brake] = controls(&frame["controls"]);
        let brake = if brake < 0.05 || throttle > brake { 0.0 } else { brake };
        assert_eq!(controls(&step["int8"]), [steer, throttle, brake], "{}", step["name"]);
        let apart = controls(&step["int8"]).into_iter().zip(controls(&step["f32"])).map(|(i, f)| (i - f).abs());
        assert!(apart.take(2).all(|apart| apart < 0.1), "{step}");
        assert!(step["int8"]["waypoints"].is_null() && step["waypoint_distance_m"].is_null(), "{step}");
    }
}

#[test]
fn lbc_drives_to_the_ground_that_its_points_show() {
    let folder = project(System::Lbc, |_, _| ());
    let document = drive(&folder, &format!(" --model @net.safetensors{SHARP}"));
    let mut agent = Agent::new(Rules::BASELINES);
    for (step, frame) in run_frames(&folder, &document) {
        let [first, second] = [0, 1].map(|k| ground(pair(&frame["points"][k])));
        let (Some(first), Some(second)) = (first, second) else { panic!("above the horizon: {frame}") };
        let speed = number(&step["speed_mps"]);
        assert_follows(&frame["controls"], Agent::new(Rules::BASELINES).step([first, second], speed));
        assert_follows(&step["int8"], agent.step([first, second], speed));
    }
    assert_eq!((&document["summary"]["driven"], &document["summary"]["difference"]["steps"]), (&15.into(), &15.into()));
}

#[test]
fn goal_and_command_are_those_of_the_next_node() {
    let folder = project(System::Aim, |_, _| ());
    for (index, step) in steps(&drive(&folder, "")).iter().enumerate().skip(1) {
        // Within 4 m of the second node it is reached, and the third is next; at the start it is 4 m and a little away.
        let travel = 0.2 * index as f64;
        let own = [travel, 0.002 * travel * travel];
        let node = 8.0_f64;
        let (north, east) = (node - own[0], 0.002 * node * node - own[1]);
        let heading = (0.004 * travel).atan();
        let expected = [-heading.sin() * north + heading.cos() * east, heading.cos() * north + heading.sin() * east];
        let found = pair(&step["goal_m"]);
        assert!((found[0] - expected[0]).hypot(found[1] - expected[1]) < 1e-3, "step {index}: {found:?}, {expected:?}");
        assert_eq!(step["command"], 3);
    }
}

#[test]
fn a_missing_sensor_stops_the_vehicle_until_it_has_recovered() {
    let missing = |step: usize, frame: &mut Value| {
        if step == 3 {
            frame["missing"] = json!(["lidar"]);
        }
    };
    let folder = project(System::LateFusion, missing);
    std::fs::remove_file(folder.path("log/frames/0003/lidar.bin")).expect("the file is there");
    let document = drive(&folder, "");
    for (index, step) in steps(&document).iter().enumerate() {
        let status = match index {
            0 => "filling buffers",
            3 => "LiDAR missing",
            4..=13 => "recovering",
            _ => "driving",
        };
        let decision = &step["int8"];
        assert_eq!(decision["status"], status, "step {index}");
        if (3..=13).contains(&index) {
            assert_eq!((number(&decision["throttle"]), number(&decision["brake"])), (0.0, 1.0), "step {index}");
            assert_eq!(decision["steer"], steps(&document)[2]["int8"]["steer"], "the steering is held");
        }
    }
    assert_eq!((&document["summary"]["safe"], &document["summary"]["driven"]), (&11.into(), &4.into()));
}

#[test]
fn a_sweep_without_points_stops_the_vehicle() {
    let folder = project(System::LateFusion, |_, _| ());
    folder.write("log/frames/0003/lidar.bin", []);
    let document = drive(&folder, "");
    assert_eq!(steps(&document)[3]["int8"]["status"], "LiDAR missing");
}

#[test]
fn only_transfuser_drives_on_without_a_compass() {
    let blind = |step: usize, frame: &mut Value| {
        if step == 5 {
            frame["compass"] = Value::Null;
        }
    };
    for (system, status) in [(System::TransFuser, "driving"), (System::Aim, "compass invalid")] {
        let document = drive(&project(system, blind), "");
        assert_eq!(steps(&document)[5]["int8"]["status"], status, "{system:?}");
    }
}

#[test]
fn satellite_coordinates_are_positions() {
    let gps = |_: usize, frame: &mut Value| {
        let meters = pair(&frame["position"]);
        frame["gps"] = json!([meters[0] / 111_324.606_627_86, meters[1] / 111_319.490_945]);
        frame.as_object_mut().expect("an object").remove("position");
    };
    let (by_meters, by_gps) = (project(System::Aim, |_, _| ()), project(System::Aim, gps));
    let (by_meters, by_gps) = (drive(&by_meters, ""), drive(&by_gps, ""));
    for (a, b) in steps(&by_meters).iter().zip(steps(&by_gps)).skip(1) {
        let (a, b) = (pair(&a["goal_m"]), pair(&b["goal_m"]));
        assert!((a[0] - b[0]).hypot(a[1] - b[1]) < 1e-3, "{a:?}, {b:?}");
    }
}

#[test]
fn geometric_fusion_reads_its_cells_from_the_points() {
    let document = drive(&project(System::GeometricFusion, |_, _| ()), " --model @net.safetensors");
    assert_eq!(document["summary"]["driven"], 15);
    assert_eq!(document["summary"]["difference"]["steps"], 15);
}

#[test]
fn the_page_and_the_table_show_every_step() {
    let folder = project(System::Aim, |_, _| ());
    let table = folder.ok("host-sim drive @net.img --log @log --model @net.safetensors --report @out");
    assert!(table.contains("f32: steer") && table.contains("16 steps, 15 driven, 0 in the safe state"), "{table}");
    let page = String::from_utf8(folder.read("out/drive.html")).expect("text");
    for index in 0..STEPS {
        assert!(table.contains(&format!("{index:04} ")) && page.contains(&format!("{index:04}")), "step {index}");
    }
    for part in ["Steer", "Throttle", "Brake", "class=\"engine\"", "class=\"reference\"", "filling buffers"] {
        assert!(page.contains(part), "{part}");
    }
    assert!(!page.contains("http"), "the page holds everything that it shows");
    let document: Value = serde_json::from_slice(&folder.read("out/drive.json")).expect("JSON");
    assert_eq!(document, drive(&folder, " --model @net.safetensors"));
    assert!(folder.ok("host-sim schema drive").contains("waypoint_distance_m"));
}

#[test]
fn what_is_wrong_with_a_log_is_said_with_its_place() {
    let folder = project(System::LateFusion, |_, _| ());
    let original = |file: &str| folder.read(&format!("log/{file}"));
    let frame = "frames/0002/frame.json";
    let description = |change: &dyn Fn(&mut Value)| {
        let mut json: Value = serde_json::from_slice(&original(frame)).expect("JSON");
        change(&mut json);
        json.to_string().into_bytes()
    };
    let cases: [(&str, Vec<u8>, &str); 10] = [
        ("route.json", b"[]".to_vec(), "error: @log/route.json: this is no route: "),
        ("route.json", br#"{"nodes": [[0, 1]], "commands": []}"#.to_vec(), "found 1 nodes and 0 commands"),
        ("route.json", br#"{"nodes": [[0, 1]], "commands": [7]}"#.to_vec(), "`commands[0]`: found 7, expected 1..6"),
        (frame, b"{".to_vec(), "error: @log/frames/0002/frame.json: not JSON"),
        (frame, description(&|json| json["speed"] = "fast".into()), "`speed`: found \"fast\", expected m/s"),
        (
            frame,
            description(&|json| json["gps"] = 3.into()),
            "`gps`: found 3, expected [latitude, longitude] in degrees",
        ),
        (frame, description(&|json| json["missing"] = json!(["radar"])), "`missing`: found [\"radar\"], expected"),
        (frame, description(&|json| json["lidar_axes"] = 1.into()), "`lidar_axes`: found 1, expected"),
        ("frames/0002/lidar.bin", vec![0; 17], "step 0002: @log/frames/0002/lidar.bin: 17 bytes"),
        ("frames/0002/rgb.png", b"PNG".to_vec(), "step 0002: @log/frames/0002/rgb.png: no readable image"),
    ];
    for (file, bytes, expected) in cases {
        let kept = original(file);
        folder.write(&format!("log/{file}"), bytes);
        let outcome = folder.run("host-sim drive @net.img --log @log --report @out");
        assert_eq!((outcome.status, outcome.out.as_str()), (2, ""), "{file}");
        assert!(outcome.err.contains(expected), "{file}: {} instead of {expected}", outcome.err);
        assert!(!folder.path("out").exists(), "nothing half-written");
        folder.write(&format!("log/{file}"), kept);
    }
    let outcome = folder.run("host-sim drive @net.safetensors --log @log");
    assert_eq!((outcome.status, outcome.err.contains("this is no model image")), (2, true), "{}", outcome.err);
    let other = Folder::of(&Network::small(System::TransFuser));
    folder.write("other.safetensors", other.read("net.safetensors"));
    let outcome = folder.run("host-sim drive @net.img --log @log --model @other.safetensors");
    assert!(outcome.err.contains("it reads `velocity`, which the image does not"), "{}", outcome.err);
    let lbc = golden::write_safetensors(&Lbc::small().tensors(), &folder.path("lbc.safetensors"));
    lbc.expect("a writable folder");
    folder.write("views.safetensors", views_file(&build::views((48, 64))));
    folder.ok("model-compiler compile @lbc.safetensors --resolution 48x64 --calib @views.safetensors -o @lbc.img");
    let outcome = folder.run("host-sim drive @lbc.img --log @log");
    assert!(outcome.err.contains("it is 48×64×10, the goal is drawn on 144×256×10"), "{}", outcome.err);
    let outcome = folder.run("host-sim drive @net.img --log @log --model @net.safetensors --resolution 64x64");
    assert!(outcome.err.contains("its input `rgb` is 64×64×3, the image's 256×256×3"), "{}", outcome.err);
}
