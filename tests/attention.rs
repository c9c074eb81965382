//! Attention statistics on a whole small network: the rows are the engine's, and the command tells what it found.

use firmware::engine::Engine;
use firmware::image::Image;
use firmware::kernels::Portable;
use firmware::program::Step;
use firmware::tensor::TensorId;
use host_sim::attention::block::{BlockChoice, IntegerBlock};
use host_sim::attention::integers::Formula;
use host_sim::buffers::GuardedArena;
use host_sim::codes::decode;
use model_compiler::emit::AlignedBytes;
use model_compiler::import::System;
use serde_json::Value;
use std::collections::BTreeMap;
use tests::build;
use tests::golden::Network;
use tests::project::Project;

const LAST: &str = "encoder.transformer4.blocks.1.attn.context";

/// Input bytes of the first stored frame, by port.
fn inputs(project: &Project) -> Vec<Vec<u8>> {
    use model_compiler::integer_reference::{encode_input, to_bytes};
    let model = &project.compiled.record.model;
    let frame = build::frames(Network::small(System::TransFuser).resolution()).swap_remove(0);
    let port = |port: &model_compiler::qmodel::Port| {
        let kind = port.kind.unwrap();
        let raw: Vec<f64> = frame.raw(kind).unwrap().into_iter().map(f64::from).collect();
        to_bytes(&encode_input(kind, &raw), model.tensor(port.tensor).element)
    };
    model.inputs.iter().map(port).collect()
}

#[test]
fn rows_times_values_are_the_context_of_every_block() {
    let project = Project::new(System::TransFuser);
    let bytes = AlignedBytes::from(project.compiled.image.as_slice());
    let image = Image::parse(&bytes).unwrap();
    let inputs = inputs(&project);
    let inputs: Vec<&[u8]> = inputs.iter().map(Vec::as_slice).collect();
    let mut arena = GuardedArena::new(&image);
    let mut engine = Engine::new(image, Portable, arena.poisoned(0)).unwrap();
    let mut written: BTreeMap<TensorId, Vec<i32>> = BTreeMap::new();
    let mut blocks = 0;
    let observe = |_: usize, step: &Step, bytes: &[u8]| {
        let record = image.tensor(step.output()).unwrap();
        let output = decode(bytes, record.element);
        if let Step::Attention(attention) = step {
            let formula = Formula::of(&image, attention).unwrap();
            let operand = |id: TensorId| written[&id].as_slice();
            let map = formula.weights(operand(attention.query), operand(attention.key));
            assert_eq!((map.tokens, map.heads), (8, 4));
            assert!((0..32).all(|row| map.row(row % 4, row / 4).contains(&32767.0)), "the strongest key weighs 1");
            assert_eq!(formula.context(&map, operand(attention.value)), output, "block {blocks}");
            // Rows of other queries do not: the comparison can fail.
            let mut turned = operand(attention.query).to_vec();
            turned.rotate_left(formula.channels);
            let turned = formula.weights(&turned, operand(attention.key));
            assert_ne!(formula.context(&turned, operand(attention.value)), output);
            blocks += 1;
        }
        written.insert(step.output(), output);
    };
    engine.infer_observed(&inputs, observe).unwrap();
    assert_eq!(blocks, 8, "two layers at four scales");
}

#[test]
fn the_default_block_is_the_last_of_the_last_transformer() {
    let project = Project::new(System::TransFuser);
    let bytes = AlignedBytes::from(project.compiled.image.as_slice());
    let image = Image::parse(&bytes).unwrap();
    let find = |choice: &str| IntegerBlock::find(&image, Some(&project.compiled.record), &choice.parse().unwrap());
    assert_eq!(find("last").unwrap().block.name, LAST);
    assert_eq!(find("encoder.transformer2").unwrap().block.name, LAST.replace('4', "2"));
    let unnamed = IntegerBlock::find(&image, None, &BlockChoice::Last).unwrap();
    assert_eq!((unnamed.position, unnamed.block.heads), (find("last").unwrap().position, 4));
    assert!(unnamed.block.name.starts_with("step "));
}

/// The document of a command that must work.
fn document(project: &Project, command: &str) -> Value {
    let (status, document) = project.json(&format!("{command} --json"));
    assert_eq!(status, 0, "{document}");
    document
}

#[test]
fn both_networks_are_counted_and_compared() {
    let project = Project::new(System::TransFuser);
    let both = document(&project, "attention net.img --model net.safetensors --inputs inputs.safetensors --top 3");
    assert_eq!((&both["schema"], &both["block"]), (&1.into(), &LAST.into()));
    assert_eq!((&both["heads"], &both["top"]), (&4.into(), &3.into()));
    assert_eq!(both["queries"]["image"]["tokens"], serde_json::json!([0, 1]));
    assert_eq!(both["queries"]["lidar"]["tokens"], serde_json::json!([5, 7]));
    assert_eq!(both["calibration_frames"].as_array().unwrap().len(), 4);
    // Four frames, four heads, four queries.
    assert_eq!(both["agreement"]["rows"], 64);
    let agreement = both["agreement"]["keys_percent"].as_f64().unwrap();
    assert!((80.0..=100.0).contains(&agreement), "{agreement}: integers and f32 look at the same keys");
    for network in ["int8", "f32"] {
        let statistics = &both[network]["statistics"];
        for sensor in ["image", "lidar"] {
            let percent = |figure: &str| statistics[sensor][figure].as_f64().unwrap();
            assert_eq!(statistics[sensor]["queries"], 8);
            assert!(percent("all_percent") <= percent("any_percent"), "{statistics}");
        }
        // The figures follow from the keys of the frames.
        let keys = |frame: usize| both["frames"][frame][network]["keys"].as_array().unwrap();
        let across = |frame: usize, query: usize| {
            let is_across = |key: &Value| (key.as_u64().unwrap() >= 4) != (query >= 2);
            keys(frame).iter().any(|head| head[query].as_array().unwrap().iter().any(is_across))
        };
        for (sensor, queries) in [("image", [0, 1]), ("lidar", [2, 3])] {
            let count = (0..4).flat_map(|frame| queries.map(|query| across(frame, query))).filter(|&is| is).count();
            assert_eq!(statistics[sensor]["any_percent"], 100.0 * count as f64 / 8.0, "{network} {sensor}");
        }
    }
    // Each network alone gives the same.
    let int8 = document(&project, "attention net.img --inputs inputs.safetensors --top 3");
    assert_eq!((&int8["int8"], &int8["f32"]), (&both["int8"], &Value::Null));
    assert_eq!((&int8["agreement"], &int8["frames"][2]["int8"]), (&Value::Null, &both["frames"][2]["int8"]));
    let float = document(&project, "attention net.safetensors --inputs inputs.safetensors --top 3");
    assert_eq!((&float["f32"], &float["int8"]), (&both["f32"], &Value::Null));
}

#[test]
fn a_missed_agreement_is_exit_status_one() {
    let project = Project::new(System::TransFuser);
    let both = "attention net.img --model net.safetensors --inputs inputs.safetensors";
    let outcome = project.host_sim(&format!("{both} --min-agreement 10"));
    assert!(outcome.status == 0 && outcome.out.contains("gate min_agreement_percent met"), "{}", outcome.out);
    let outcome = project.host_sim(&format!("{both} --top 1 --min-agreement 100"));
    let (status, document) = project.json(&format!("{both} --top 1 --min-agreement 100 --json"));
    assert_eq!((outcome.status, status), (1, 1));
    assert!(outcome.err.contains("error: gate min_agreement_percent: least on frame inputs#"), "{}", outcome.err);
    assert_eq!((&document["error"]["code"], &document["gates"][0]["met"]), (&"check".into(), &false.into()));
}

#[test]
fn every_backend_has_the_same_rows() {
    use host_sim::backends::Backend;
    let project = Project::new(System::TransFuser);
    let of = |backend: Backend| {
        document(
            &project,
            &format!("attention net.img --inputs inputs.safetensors --backend {}", backend.kind().name()),
        )
    };
    let documents: Vec<Value> = Backend::all().into_iter().map(of).collect();
    assert!(documents.iter().all(|document| *document == documents[0]));
}

#[test]
fn people_get_a_table_and_a_page() {
    let project = Project::new(System::TransFuser);
    let folder = project.path("new/out");
    let command = "attention net.img --model net.safetensors --inputs inputs.safetensors --frames-limit 2";
    let outcome = project.host_sim(&format!("{command} --report {}", folder.display()));
    assert_eq!(outcome.status, 0, "{}", outcome.err);
    assert!(outcome.err.starts_with("warning: 2 of 2 frames are also calibration frames"), "{}", outcome.err);
    for expected in [LAST, "4 heads, 2 frames", "image queries: 2 of 2×2 tokens, rows 0", "int8 and f32 agree on"] {
        assert!(outcome.out.contains(expected), "{expected}:\n{}", outcome.out);
    }
    let page = std::fs::read_to_string(folder.join("attention.html")).unwrap();
    assert!(page.contains("<section id=\"cells\">") && page.matches("<image ").count() == 4);
    assert!(!page.contains("http") && page.len() < 1_000_000, "{} B", page.len());
    let written: Value = serde_json::from_slice(&std::fs::read(folder.join("attention.json")).unwrap()).unwrap();
    assert_eq!(written, document(&project, command));
}

#[test]
fn bad_input_is_exit_status_two_and_says_what_to_do() {
    let project = Project::new(System::TransFuser);
    std::fs::copy(project.path("net.img"), project.path("alone.img")).unwrap();
    let inputs = "--inputs inputs.safetensors";
    for (command, expected) in [
        (format!("attention net.img {inputs} --block encoder.transformer5"), "no attention block is called"),
        (format!("attention alone.img {inputs} --block encoder.transformer2"), "without its record have no names"),
        (format!("attention net.img {inputs} --image-rows 0,2"), "expected rows 0 to 1 of the token map"),
        (format!("attention net.img {inputs} --top 5"), "--top: found 5, expected 1 to 4"),
        (format!("attention net.img {inputs} --min-agreement 90"), "needs the integers and the f32 network"),
        (format!("attention net.safetensors --model net.safetensors {inputs}"), "this is no model image"),
        (format!("attention net.img --model net.safetensors --heads 2 {inputs}"), "that the image was compiled from"),
    ] {
        let outcome = project.host_sim(&command);
        assert_eq!((outcome.status, outcome.out.as_str()), (2, ""), "{command}");
        assert!(outcome.err.contains(expected), "{command}: {}", outcome.err);
    }
    assert_eq!(project.host_sim(&format!("attention alone.img {inputs}")).status, 0, "the last block needs no name");
    let aim = Project::new(System::Aim);
    let outcome = aim.host_sim(&format!("attention net.img {inputs}"));
    assert!(
        outcome.status == 2 && outcome.err.contains("net.img: the network has no attention block"),
        "{}",
        outcome.err
    );
    assert!(outcome.err.contains("help: the statistics are about fusing transformers"), "{}", outcome.err);
}

#[test]
fn documents_follow_their_schemas() {
    let project = Project::new(System::TransFuser);
    let schema =
        |name: &str| -> Value { serde_json::from_str(&project.host_sim(&format!("schema {name}")).out).unwrap() };
    for (name, fields) in [
        ("run", &["model", "frames"][..]),
        ("attention", &["agreement", "frames", "queries"]),
        ("score", &["mean", "routes"]),
        ("route-log", &["ego", "events", "waypoints"]),
    ] {
        let schema = schema(name);
        for field in fields {
            assert!(schema["properties"][field]["description"].is_string(), "{name} {field}");
        }
    }
    let document = document(&project, "attention net.img --model net.safetensors --inputs inputs.safetensors");
    let declared = schema("attention");
    for (field, _) in document.as_object().unwrap() {
        assert!(declared["properties"][field].is_object(), "{field}");
    }
}
