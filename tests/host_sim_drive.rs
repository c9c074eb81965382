//! `host-sim drive`: a recorded sequence through sensors, network, planner and controller, as a user runs it.

use model_compiler::import::System;
use serde_json::{Value, json};
use tests::agent::{Agent, Rules};
use tests::commands::Folder;
use tests::drive_log::Recording;
use tests::golden::Network;

const STEPS: usize = 16;

/// A compiled small network (`net.safetensors`, `net.img`) and a log (`log`) whose images are larger than its input.
fn project(system: System, change: impl Fn(usize, &mut Value)) -> Folder {
    let network = Network::small(system);
    let folder = Folder::of(&network);
    folder.ok("model-compiler compile @net.safetensors --calib @inputs.safetensors -o @net.img");
    // Of TransFuser the checkpoint tells the size, of the others it is 256×256.
    let (height, width) = if system == System::TransFuser { network.resolution() } else { (256, 256) };
    let image = (u32::from(width) + 14, u32::from(height) + 6);
    Recording { image, steps: STEPS, seed: 1 }.write(&folder, "log", change);
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
                let expected = agent.step(points, number(&step["speed_mps"]));
                let found = ["steer", "throttle", "brake"].map(|name| number(&decision[name]));
                let expected = [expected.steer, expected.throttle, f64::from(u8::from(expected.brake))];
                let close = found.iter().zip(expected).all(|(f, e)| (f - e).abs() < 1e-4);
                assert!(close, "{network}, step {index}: {found:?} instead of {expected:?}");
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

/// The firmware's sensors and the host's preparation of frames are two programs.
#[test]
fn waypoints_are_those_of_the_same_frames_in_a_directory() {
    for system in [System::TransFuser, System::LateFusion, System::Aim] {
        let folder = project(system, |_, _| ());
        let document = drive(&folder, "");
        let mut expected = Vec::new();
        for step in steps(&document).iter().filter(|step| step["goal_m"].is_array()) {
            let name = step["name"].as_str().expect("a name");
            for file in ["rgb.png", "lidar.bin"] {
                folder.write(&format!("frames/{name}/{file}"), folder.read(&format!("log/frames/{name}/{file}")));
            }
            let description = json!({"speed": step["speed_mps"], "goal": step["goal_m"]});
            folder.write(&format!("frames/{name}/frame.json"), description.to_string());
            expected.push((name, &step["int8"]["waypoints"]));
        }
        let (status, run) = folder.json("host-sim run @net.img --frames @frames --json");
        assert_eq!(status, 0, "{run}");
        let frames = run["frames"].as_array().expect("frames");
        let found: Vec<_> = frames.iter().map(|f| (f["name"].as_str().expect("a name"), &f["waypoints"])).collect();
        assert_eq!(found, expected, "{system:?}");
    }
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
    let outcome = folder.run("host-sim drive @net.img --log @log --model @net.safetensors --resolution 64x64");
    assert!(outcome.err.contains("its input `rgb` is 64×64×3, the image's 256×256×3"), "{}", outcome.err);
}
