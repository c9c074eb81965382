//! `host-sim bench` on a whole small network: what it prints, and what it refuses. No test looks at a time.

use firmware::image::{Image, SectionKind};
use host_sim::backends::{Backend, BackendKind};
use model_compiler::emit::{AlignedBytes, reseal};
use model_compiler::import::System;
use serde_json::Value;
use tests::project::Project;

fn of_this_machine() -> Vec<&'static str> {
    Backend::all().iter().map(|backend| backend.kind().name()).collect()
}

#[test]
fn the_table_shows_backends_operators_and_the_slowest_steps() {
    let project = Project::new(System::TransFuser);
    let outcome = project.host_sim("bench net.img --rounds 2 --top 3");
    assert_eq!((outcome.status, outcome.err.as_str()), (0, ""));
    let steps = project.compiled.record.model.steps.len();
    let hidden = format!("… and {} faster steps (--all shows them)", steps - 3);
    for expected in ["2 rounds", "GMAC/s", "operator", "waypoint_decoder", "B arena", hidden.as_str()] {
        assert!(outcome.out.contains(expected), "{expected}:\n{}", outcome.out);
    }
    for name in of_this_machine() {
        assert!(outcome.out.lines().any(|line| line.trim_start().starts_with(name)), "{name}:\n{}", outcome.out);
    }
    let all = project.host_sim("bench net.img --rounds 1 --all --backend portable");
    assert_eq!(all.status, 0, "{}", all.err);
    let names = project.compiled.record.plan.order.iter();
    let names = names.map(|&step| project.compiled.record.model.steps[step as usize].name.as_str());
    let table: Vec<&str> = all.out.lines().skip_while(|line| !line.contains(" shape ")).skip(1).take(steps).collect();
    for (position, (line, name)) in table.iter().zip(names).enumerate() {
        let words: Vec<&str> = line.split_whitespace().collect();
        assert_eq!(words[..2], [position.to_string().as_str(), name], "{line}");
    }
}

#[test]
fn the_document_has_the_same_figures_for_every_step() {
    let project = Project::new(System::TransFuser);
    let (status, report) = project.json("bench net.img --rounds 2 --json");
    assert_eq!((status, &report["schema"], &report["rounds"]), (0, &1.into(), &2.into()), "{report}");
    let digest = model_compiler::artifact::hex(&project.compiled.record.image_sha256);
    assert_eq!(report["model"]["sha256"], digest);
    assert_eq!(report["image_bytes"], project.compiled.image.len());
    assert_eq!(report["arena_bytes"], project.compiled.record.plan.arena_bytes());
    let list = |value: &Value| value.as_array().expect("a list").clone();
    let names = |times: &Value| list(times).iter().map(|time| time["backend"].clone()).collect::<Vec<_>>();
    assert_eq!(names(&report["backends"]), of_this_machine());
    for whole in list(&report["backends"]) {
        for figure in ["median", "min", "p10", "p90"] {
            assert!(whole["wall_ms"][figure].is_f64(), "{whole}");
        }
    }
    let steps = list(&report["steps"]);
    assert_eq!(steps.len(), project.compiled.record.model.steps.len());
    for (position, step) in steps.iter().enumerate() {
        assert_eq!((&step["position"], names(&step["times"])), (&position.into(), of_this_machine_as_values()));
        let multiplies = ["conv2d", "linear", "attention", "waypoint_decoder"].map(Value::from).contains(&step["op"]);
        assert_eq!(step["macs"].is_u64(), multiplies, "{step}");
    }
    let sum = |rows: &[Value]| rows.iter().filter_map(|row| row["macs"].as_u64()).sum::<u64>();
    let operators = list(&report["operators"]);
    assert_eq!(report["macs"], sum(&steps));
    assert_eq!(report["macs"], sum(&operators));
    let counted: u64 = operators.iter().filter_map(|operator| operator["steps"].as_u64()).sum();
    assert_eq!(counted, steps.len() as u64);
    if cfg!(target_os = "linux") {
        assert!(report["peak_memory_bytes"].as_u64() > report["image_bytes"].as_u64(), "{report}");
    }
}

fn of_this_machine_as_values() -> Vec<Value> {
    of_this_machine().into_iter().map(Value::from).collect()
}

#[test]
fn without_its_record_steps_bear_the_names_of_their_operators() {
    let project = Project::new(System::Aim);
    std::fs::copy(project.path("net.img"), project.path("alone.img")).unwrap();
    let (status, report) = project.json("bench alone.img --rounds 1 --json");
    assert_eq!(status, 0);
    assert!(report["steps"].as_array().unwrap().iter().all(|step| step["step"] == step["op"]), "{report}");
    std::fs::write(project.path("alone.record"), b"damaged").unwrap();
    let outcome = project.host_sim("bench alone.img --rounds 1");
    assert_eq!(outcome.status, 0);
    assert!(outcome.err.starts_with("warning: steps bear the names of their operators: "), "{}", outcome.err);
}

#[test]
fn a_wrong_byte_is_exit_status_one_and_names_the_step() {
    let project = Project::new(System::Aim);
    let mut image = project.compiled.image.clone();
    let offset = {
        let aligned = AlignedBytes::from(image.as_slice());
        let constants = Image::parse(&aligned).unwrap().section(SectionKind::Constants).as_ptr().addr();
        constants - aligned.as_ptr().addr()
    };
    // The first constants are the weights of the first convolution.
    image[offset] ^= 0x20;
    reseal(&mut image);
    std::fs::write(project.path("altered.img"), &image).unwrap();
    let outcome = project.host_sim("bench altered.img --backend portable");
    assert_eq!((outcome.status, outcome.out.as_str()), (1, ""));
    assert!(outcome.err.starts_with("error: step 0 conv2d: portable gives other bytes: CRC "), "{}", outcome.err);
    let (status, document) = project.json("bench altered.img --backend portable --json");
    assert_eq!((status, &document["error"]["code"]), (1, &"check".into()));
}

#[test]
fn bad_input_is_exit_status_two_and_says_where() {
    let project = Project::new(System::Aim);
    std::fs::write(project.path("cut.img"), &project.compiled.image[..project.compiled.image.len() / 2]).unwrap();
    let mut cases = vec![
        ("bench nothing.img".to_owned(), "nothing.img: "),
        ("bench inputs.safetensors".to_owned(), "inputs.safetensors: this is no model image"),
        ("bench net.record".to_owned(), "net.record: this is no model image"),
        ("bench cut.img".to_owned(), "cut.img: "),
        ("bench net.img --backend amx".to_owned(), "invalid value 'amx' for '--backend <NAME>'"),
        ("bench net.img --rounds 0".to_owned(), "invalid value '0' for '--rounds <N>'"),
        ("bench net.img --round 3".to_owned(), "'--rounds'"),
        ("bensh net.img".to_owned(), "'bench'"),
        ("bench".to_owned(), "required arguments"),
    ];
    for kind in BackendKind::ALL.into_iter().filter(|kind| kind.detect().is_none()) {
        cases.push((format!("bench net.img --backend {}", kind.name()), "this machine has no "));
    }
    for (command, expected) in cases {
        let outcome = project.host_sim(&command);
        assert_eq!((outcome.status, outcome.out.as_str()), (2, ""), "{command}");
        assert!(outcome.err.contains(expected), "{command}: {}", outcome.err);
        let (status, document) = project.json(&format!("{command} --json"));
        assert_eq!((status, document["error"]["code"].is_string()), (2, true), "{document}");
    }
}
