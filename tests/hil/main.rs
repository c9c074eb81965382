//! `host-sim hil`: the driving computer behind a pseudo-terminal or in the emulator, fed as a user would.

use firmware::link::{MAX_ENCODED, Response, StepReport, decode, encode};
use serde_json::{Value, json};
use std::fs;
use tests::build;
use tests::bundle;
use tests::commands::{Folder, views_file};
use tests::drive_log::Recording;
use tests::golden::{self, Lbc, Network};
use tests::onnx_file::{OnnxFile, int, ints};
use tests::serial_board::{Accident, SerialBoard, faultless};

use model_compiler::import::System;

mod boards;
mod faults;

/// Files of the cameras; all systems but LBC have only the first.
const CAMERAS: [&str; 3] = ["rgb.png", "rgb_left.png", "rgb_right.png"];
/// Height and width of LBC's views: a firmware draws its goal on no others.
const LBC_SIZE: (u16, u16) = (144, 256);

/// The bundled network for a target (`net.img`), and its evaluation frames (`frames`).
fn bundled(target: &str) -> Folder {
    let folder = Folder::default();
    fs::copy(bundle::checkpoint_path(), folder.path("net.safetensors")).expect("the bundled checkpoint");
    for (from, to) in [("calibration", "calib"), ("evaluation", "frames")] {
        for frame in fs::read_dir(bundle::frames_path(from)).expect("the bundled frames").map(|e| e.expect("an entry"))
        {
            let name = frame.file_name().into_string().expect("text");
            for file in fs::read_dir(frame.path()).expect("a frame").map(|e| e.expect("an entry").path()) {
                let leaf = file.file_name().and_then(|leaf| leaf.to_str()).expect("text");
                folder.write(&format!("{to}/{name}/{leaf}"), fs::read(&file).expect("a file of a frame"));
            }
        }
    }
    folder.ok(&format!("model-compiler compile @net.safetensors --calib @calib --target {target} -o @net.img"));
    folder
}

/// A small network (`net.img`) and a log (`log`) whose images are larger than its input.
fn recorded(system: System, steps: usize) -> Folder {
    let (folder, (height, width)) = if system == System::Lbc {
        let folder = Folder::default();
        let network = Lbc { resolution: LBC_SIZE, maps: 4, ..Lbc::small() };
        golden::write_safetensors(&network.tensors(), &folder.path("net.safetensors")).expect("a writable folder");
        folder.write("inputs.safetensors", views_file(&build::views(LBC_SIZE)));
        (folder, LBC_SIZE)
    } else {
        let network = Network::small(system);
        // Of TransFuser the checkpoint tells the size, of the others it is 256×256.
        let size = if system == System::TransFuser { network.resolution() } else { (256, 256) };
        (Folder::of(&network), size)
    };
    let options = if system == System::Lbc { " --temperature 0.1" } else { "" };
    folder.ok(&format!("model-compiler compile @net.safetensors{options} --calib @inputs.safetensors -o @net.img"));
    let cameras = if system == System::Lbc { &CAMERAS[..] } else { &CAMERAS[..1] };
    let image = (u32::from(width) + 14, u32::from(height) + 6);
    Recording { image, cameras, steps, seed: 1 }.write(&folder, "log", |_, _| ());
    folder
}

/// Frame folders (`frames`) of some steps of a log, as if the network had run there.
fn frames_of_log(folder: &Folder, steps: &[usize]) {
    for step in steps {
        let name = format!("{step:04}");
        for file in CAMERAS.into_iter().chain(["lidar.bin"]) {
            if folder.path(&format!("log/frames/{name}/{file}")).exists() {
                folder.write(&format!("frames/{name}/{file}"), folder.read(&format!("log/frames/{name}/{file}")));
            }
        }
        let description = json!({"speed": 3.5, "goal": [1.25, 20.0 + *step as f64], "command": 1 + step % 6});
        folder.write(&format!("frames/{name}/frame.json"), description.to_string());
    }
}

fn board(folder: &Folder) -> SerialBoard {
    SerialBoard::with(&folder.read("net.img"))
}

fn hil(folder: &Folder, board: &SerialBoard, options: &str) -> Value {
    let (status, document) = folder.json(&format!("host-sim hil @net.img --port {} {options} --json", board.device()));
    assert_eq!(status, 0, "{document:#}");
    document
}

fn frames(document: &Value) -> &[Value] {
    document["frames"].as_array().expect("frames")
}

#[test]
fn every_byte_of_the_bundled_frames_is_the_hosts() {
    let folder = bundled("cortex-m4");
    let board = board(&folder);
    let by_sensors = hil(&folder, &board, "--frames @frames --steps");
    let by_inputs = hil(&folder, &board, "--frames @frames --crop");
    let run = folder.json("host-sim run @net.img --frames @frames --json").1;
    for (document, driven) in [(&by_sensors, true), (&by_inputs, false)] {
        assert_eq!(document["summary"]["frames"], frames(&run).len());
        assert_eq!((&document["summary"]["equal"], &document["summary"]["link"]["lost"]), (&3.into(), &0.into()));
        assert_eq!(document["summary"]["bytes_compared"], 3 * 32, "four waypoints of 8 bytes");
        for (found, expected) in frames(document).iter().zip(frames(&run)) {
            assert_eq!((&found["name"], &found["waypoints"]), (&expected["name"], &expected["waypoints"]));
            assert_eq!(found["status"], if driven { "driving" } else { "filling buffers" });
            for control in ["steer", "throttle", "brake"].into_iter().filter(|_| driven) {
                assert_eq!(found[control], expected["controls"][control], "{control}");
            }
        }
    }
    let steps = by_sensors["steps"].as_array().expect("steps").len() as u64;
    assert!(steps > 50 && by_sensors["summary"]["steps_compared"] == 3 * steps, "{steps}");
    assert!(by_inputs["steps"].is_null() && by_inputs["summary"]["steps_compared"] == 0);
    // The one that was asked for; a board that waits tests itself, too.
    assert!(by_sensors["summary"]["self_tests"].as_u64() >= Some(1));
    assert_eq!(by_sensors["unit"], "microseconds");
}

#[test]
fn logs_and_frames_of_every_system_are_the_hosts() {
    for system in System::ALL {
        let folder = recorded(system, 8);
        frames_of_log(&folder, &[2, 5]);
        let board = board(&folder);
        let driven = hil(&folder, &board, "--log @log");
        let expected = folder.json("host-sim drive @net.img --log @log --json").1;
        let steps = expected["steps"].as_array().expect("steps");
        assert_eq!(frames(&driven).len(), steps.len());
        for (found, step) in frames(&driven).iter().zip(steps) {
            for field in ["status", "steer", "throttle", "brake"] {
                assert_eq!(found[field], step["int8"][field], "{system:?}, {}, {field}", step["name"]);
            }
            assert_eq!(found["waypoints"], step["int8"]["waypoints"], "{system:?}, {}", step["name"]);
        }
        assert_eq!(frames(&driven)[7]["status"], "driving", "{system:?}");
        let alone = hil(&folder, &board, "--frames @frames --steps");
        assert_eq!(alone["summary"]["equal"], 2, "{system:?}");
        assert_eq!(alone["summary"]["link"]["lost"], 0, "{system:?}");
    }
}

#[test]
fn raw_inputs_are_the_hosts_and_need_no_size_of_any_sensor() {
    let folder = Folder::of(&Network::small(System::LateFusion));
    folder.ok("model-compiler compile @net.safetensors --calib @inputs.safetensors -o @net.img");
    let document = hil(&folder, &board(&folder), "--inputs @inputs.safetensors --steps --no-self-test");
    assert_eq!(
        (&document["summary"]["equal"], &document["summary"]["frames"]),
        (&golden::frames().len().into(), &golden::frames().len().into())
    );
}

/// A small classifier (`net.img`) with images (`images`).
fn classifier() -> Folder {
    let folder = Folder::default();
    let mut file = OnnxFile::new(13, 11);
    file.input("pixels", &[1, 3, 8, 8]);
    let (conv, dense) = (file.weights("conv", &[8, 3, 3, 3]), file.weights("dense", &[7, 8]));
    file.node("Conv", &["pixels", &conv], "c", &[ints("kernel_shape", &[3, 3]), ints("pads", &[1, 1, 1, 1])]);
    file.node("Relu", &["c"], "r", &[]);
    file.node("GlobalAveragePool", &["r"], "p", &[]);
    file.node("Flatten", &["p"], "f", &[]);
    file.node("Gemm", &["f", &dense], "logits", &[int("transB", 1)]);
    file.output("logits");
    folder.write("net.onnx", file.bytes());
    for number in 0..5_u8 {
        let picture = image::RgbImage::from_fn(8, 8, |x, y| image::Rgb([50 * number, 30 * x as u8, 30 * y as u8]));
        folder.write(&format!("images/{number}.png"), []);
        picture.save(folder.path(&format!("images/{number}.png"))).expect("a writable folder");
    }
    folder.ok("model-compiler compile @net.onnx --calib @images -o @net.img");
    folder
}

#[test]
fn a_classifier_gives_the_hosts_classes() {
    let folder = classifier();
    let document = hil(&folder, &board(&folder), "--frames @images");
    let run = folder.json("host-sim run @net.img --frames @images --json").1;
    assert_eq!(document["summary"]["equal"], 5);
    for (found, expected) in frames(&document).iter().zip(frames(&run)) {
        assert_eq!(found["top1"], expected["top1"]);
    }
    let outcome = folder.run(&format!("host-sim hil @net.img --port {} --log @log", board(&folder).device()));
    assert_eq!(
        (outcome.status, outcome.err.contains("no driving network's set of inputs")),
        (2, true),
        "{}",
        outcome.err
    );
}

#[test]
fn the_table_shows_frames_steps_and_line() {
    let folder = classifier();
    let board = board(&folder);
    let table =
        folder.ok(&format!("host-sim hil @net.img --port {} --baud 9600 --frames @images --steps", board.device()));
    for part in
        ["on board test board", "s at 9600 baud", "class ", "conv2d", "5 of 5 equal", "0 damaged, 0 lost, 0 repeated"]
    {
        assert!(table.contains(part), "{part} in\n{table}");
    }
    let schema = folder.ok("host-sim schema hil");
    assert!(schema.contains("steps_compared") && schema.contains("bytes_sent"), "{schema}");
}

/// A line that changes what certain answers say, and sends them as whole packets.
fn liar(change: impl Fn(&mut Response<'_>, &mut Vec<u8>) + Send + 'static) -> Accident {
    Box::new(move |_, packet| {
        let mut receiver = firmware::link::Receiver::new();
        let whole = packet.iter().filter_map(|byte| receiver.push(*byte).map(|p| p.expect("whole").to_vec())).last();
        let whole = whole.expect("a packet");
        let (sequence, mut response) = decode::<Response<'_>>(&whole).expect("an answer");
        let mut bytes = match &response {
            Response::Output { bytes, .. } => bytes.to_vec(),
            _ => Vec::new(),
        };
        change(&mut response, &mut bytes);
        if let Response::Output { output, offset, .. } = response {
            response = Response::Output { output, offset, bytes: &bytes };
        }
        let mut buffer = [0; MAX_ENCODED];
        encode(sequence, &response, &mut buffer).expect("it fits").to_vec()
    })
}

/// Exit status, standard output and standard error of a run on a board that lies so.
fn lied(folder: &Folder, options: &str, answers: Accident) -> tests::commands::Outcome {
    let board = SerialBoard::start(&folder.read("net.img"), faultless(), answers);
    folder.run(&format!("host-sim hil @net.img --port {} {options}", board.device()))
}

#[test]
fn the_first_difference_is_named_and_fails_the_check() {
    let folder = recorded(System::Aim, 4);
    frames_of_log(&folder, &[1, 2]);
    let wrong_byte = || liar(|_, bytes| bytes.iter_mut().skip(5).take(1).for_each(|byte| *byte ^= 0x40));
    let outcome = lied(&folder, "--frames @frames", wrong_byte());
    assert_eq!(outcome.status, 1, "{}", outcome.err);
    assert!(
        outcome.err.starts_with("error: frame 0001: board and host differ in output `waypoints` (step "),
        "{}",
        outcome.err
    );
    assert!(outcome.err.contains("waypoint_decoder), byte 5: found 0x"), "{}", outcome.err);
    assert!(outcome.out.contains(" NO ") && !outcome.out.contains("0002"), "it ends there:\n{}", outcome.out);
    let wrong_step = liar(|response, _| {
        if let Response::Step(StepReport { step: 3, crc, .. }) = response {
            *crc ^= 1;
        }
    });
    let outcome = lied(&folder, "--frames @frames --steps", wrong_step);
    assert_eq!(outcome.status, 1);
    assert!(outcome.err.contains("differ in step 3 "), "{}", outcome.err);
    let wrong_controls = || {
        liar(|response, _| {
            if let Response::Telemetry(telemetry) = response {
                telemetry.controls.steer += firmware::drive::Real::DELTA;
            }
        })
    };
    let outcome = lied(&folder, "--frames @frames", wrong_controls());
    assert!(outcome.status == 1 && outcome.err.contains("differ in controls"), "{}", outcome.err);
    let outcome = lied(&folder, "--log @log", wrong_controls());
    assert!(
        outcome.status == 1 && outcome.err.contains("frame 0000: board and host differ in steer"),
        "{}",
        outcome.err
    );
    let board = SerialBoard::start(&folder.read("net.img"), faultless(), wrong_byte());
    let (status, document) =
        folder.json(&format!("host-sim hil @net.img --port {} --frames @frames --json", board.device()));
    assert_eq!(
        (status, &document["error"]["code"], &document["difference"]["frame"]),
        (1, &"check".into(), &"0001".into())
    );
}

#[test]
fn a_late_network_is_a_difference_in_status() {
    let folder = recorded(System::Aim, 4);
    frames_of_log(&folder, &[1]);
    let board = board(&folder);
    let outcome =
        folder.run(&format!("host-sim hil @net.img --port {} --frames @frames --budget-ms 0", board.device()));
    assert_eq!(outcome.status, 1, "{}", outcome.err);
    assert!(
        outcome.err.contains("differ in status: found network not done in its step, expected driving"),
        "{}",
        outcome.err
    );
}

#[test]
fn what_is_wrong_with_a_board_is_said_with_its_remedy() {
    let folder = recorded(System::Aim, 4);
    frames_of_log(&folder, &[1]);
    let other = classifier();
    let run = |board: &SerialBoard, options: &str| {
        folder.run(&format!("host-sim hil @net.img --port {} --timeout 1 {options}", board.device()))
    };
    let expect = |outcome: tests::commands::Outcome, parts: &[&str]| {
        assert_eq!((outcome.status, outcome.out.as_str()), (2, ""), "{}", outcome.err);
        assert!(parts.iter().all(|part| outcome.err.contains(part)), "{parts:?} in {}", outcome.err);
    };
    expect(
        run(&board(&other), "--frames @frames"),
        &["the board holds another image: digest of the quantized model", "flash the image"],
    );
    let mut damaged = folder.read("net.img");
    let middle = damaged.len() / 2;
    damaged[middle] ^= 1;
    expect(run(&SerialBoard::with(&damaged), "--frames @frames"), &["the board refuses Identify", "is damaged"]);
    let silent = SerialBoard::start(&folder.read("net.img"), Box::new(|_, _| Vec::new()), faultless());
    expect(run(&silent, "--frames @frames"), &["the board is silent", "--timeout SECONDS"]);
    let noise = SerialBoard::start(&folder.read("net.img"), faultless(), Box::new(|_, _| vec![3, 7, 9, 0]));
    expect(run(&noise, "--frames @frames"), &["no answer of this protocol", "--baud"]);
    let strange = liar(|response, _| {
        if let Response::Identity(identity) = response {
            identity.protocol += 1;
        }
    });
    expect(lied(&folder, "--frames @frames", strange), &["speaks version 2 of the protocol, expected 1"]);
    let header = liar(|response, _| {
        if let Response::Identity(identity) = response {
            identity.header_crc ^= 1;
        }
    });
    expect(lied(&folder, "--frames @frames", header), &["another image: CRC of the header"]);
    expect(
        folder.run("host-sim hil @net.img --port /dev/no-such-device --frames @frames"),
        &["/dev/no-such-device: no serial device at 115200 baud"],
    );
    expect(
        folder.run("host-sim hil @net.img --board virt --program @none --frames @frames"),
        &["@none: the program of board virt is not there", "build it in firmware/boards/virt"],
    );
    expect(folder.run("host-sim hil @net.safetensors --board virt --frames @frames"), &["this is no model image"]);
    folder.write("frames/0001/lidar.bin", [0; 17]);
    fs::remove_file(folder.path("frames/0001/rgb.png")).expect("the file is there");
    expect(run(&board(&folder), "--frames @frames"), &["rgb.png"]);
}

#[test]
fn an_image_for_another_target_is_another_image() {
    let folder = recorded(System::Aim, 4);
    frames_of_log(&folder, &[1]);
    let image = folder.read("net.img");
    folder.ok("model-compiler compile @net.safetensors --calib @inputs.safetensors --target x86 -o @net.img");
    let board = SerialBoard::with(&image);
    let outcome = folder.run(&format!("host-sim hil @net.img --port {} --frames @frames", board.device()));
    assert_eq!(outcome.status, 2);
    assert!(outcome.err.contains("the board holds another image: length"), "{}", outcome.err);
}
