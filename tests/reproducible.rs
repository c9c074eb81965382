//! The same inputs give the same bytes, on every run and for every target; and the sizes of the full network.

use firmware::engine::Engine;
use firmware::image::Image;
use firmware::kernels::Portable;
use host_sim::buffers::GuardedArena;
use model_compiler::artifact;
use model_compiler::emit::AlignedBytes;
use model_compiler::frames::Frame;
use model_compiler::import::System;
use model_compiler::integer_reference;
use model_compiler::memory_plan::{PlanOptions, PlanStatus};
use model_compiler::pipeline::{self, Compiled};
use model_compiler::qmodel::QModel;
use model_compiler::quantize::QuantizeOptions;
use model_compiler::target::Target;
use tests::build;
use tests::commands::Folder;
use tests::golden::{self, Network};

const TARGETS: [&str; 6] = ["portable", "x86", "cortex-m4", "cortex-m7", "cortex-m55", "cortex-a"];

fn compiled_for(model: &QModel, target: &Target, options: &PlanOptions) -> Compiled {
    pipeline::compile(model, target, options, &mut |_, _, _| {}).unwrap_or_else(|e| panic!("{}: {e}", target.name))
}

fn input_codes(model: &QModel, frame: &Frame) -> Vec<Vec<f64>> {
    let kinds = model.inputs.iter().map(|port| port.kind.expect("inputs come from sensors"));
    let raw = |kind| frame.raw(kind).unwrap().into_iter().map(f64::from).collect::<Vec<f64>>();
    kinds.map(|kind| integer_reference::encode_input(kind, &raw(kind))).collect()
}

/// All outputs of the engine.
fn outputs(compiled: &Compiled, frame: &Frame) -> Vec<Vec<u8>> {
    let model = &compiled.record.model;
    let codes = input_codes(model, frame);
    let element = |port: &model_compiler::qmodel::Port| model.tensor(port.tensor).element;
    let inputs: Vec<Vec<u8>> =
        model.inputs.iter().zip(&codes).map(|(p, c)| integer_reference::to_bytes(c, element(p))).collect();
    let inputs: Vec<&[u8]> = inputs.iter().map(Vec::as_slice).collect();
    let bytes = AlignedBytes::from(compiled.image.as_slice());
    let image = Image::parse(&bytes).unwrap_or_else(|e| panic!("{e}"));
    let mut arena = GuardedArena::new(&image);
    let mut engine = Engine::new(image, Portable, arena.poisoned(0)).unwrap_or_else(|e| panic!("{e}"));
    engine.infer(&inputs).unwrap_or_else(|e| panic!("{e}"));
    (0..model.outputs.len()).map(|i| engine.output(i).unwrap().to_vec()).collect()
}

/// The same outputs from the f64 model.
fn expected_outputs(model: &QModel, frame: &Frame) -> Vec<Vec<u8>> {
    let values = integer_reference::run(model, &input_codes(model, frame), |_, _, _| ()).unwrap();
    let ports = model.outputs.iter().zip(&values);
    ports.map(|(port, codes)| integer_reference::to_bytes(codes, model.tensor(port.tensor).element)).collect()
}

/// SHA-256 of the quantized model of the small TransFuser. It changes with intent only: when the arithmetic, the choice
/// of scales or the format of the file changes; say so in the change log.
const SMALL_QMODEL: &str = "53bdc27a65de9c4e4832df41d806433e0a85a605edece54399c6e33c34287f17";

#[test]
fn same_inputs_same_files() {
    let folder = Folder::of(&Network::small(System::TransFuser));
    for run in ["a", "b"] {
        let out = |name: &str| format!("@{run}.{name}");
        let frames = "--calib @inputs.safetensors";
        folder.ok(&format!("model-compiler quantize @net.safetensors {frames} -o {}", out("qmodel")));
        folder.ok(&format!("model-compiler compile @net.safetensors {frames} -o {}", out("img")));
    }
    for name in ["qmodel", "img", "record"] {
        assert!(folder.read(&format!("a.{name}")) == folder.read(&format!("b.{name}")), "{name} differs between runs");
    }
    assert_eq!(artifact::hex(&artifact::sha256(&folder.read("a.qmodel"))), SMALL_QMODEL);
}

#[test]
fn images_of_all_targets_give_the_same_output() {
    let graph = build::small(&Network::small(System::TransFuser));
    let model = build::quantized(&graph, &QuantizeOptions::default());
    let frames = build::frames_of(&graph);
    let expected: Vec<_> = frames.iter().map(|frame| expected_outputs(&model, frame)).collect();
    for name in TARGETS {
        let target = Target::find(name).unwrap();
        let compiled = compiled_for(&model, &target, &PlanOptions::for_target(&target));
        for (frame, expected) in frames.iter().zip(&expected) {
            assert!(outputs(&compiled, frame) == *expected, "{name}, {}", frame.name);
        }
    }
}

#[test]
fn every_ablation_is_byte_exact() {
    let small = Network::small(System::TransFuser);
    let networks = [
        ("scales 2-4", Network { scales: vec![2, 3, 4], ..small.clone() }),
        ("scales 3-4", Network { scales: vec![3, 4], ..small.clone() }),
        ("scale 4", Network { scales: vec![4], ..small.clone() }),
        ("no scale", Network { scales: vec![], position: false, ..small.clone() }),
        ("one layer", Network { layers: 1, ..small.clone() }),
        ("four layers", Network { layers: 4, ..small.clone() }),
        ("no positional embedding", Network { position: false, ..small.clone() }),
        ("concatenated goal", Network { gru_inputs: 4, ..small.clone() }),
        ("wide and low", Network { grid: (2, 3), ..small }),
    ];
    for (name, network) in networks {
        let tensors = network.tensors();
        let options =
            model_compiler::import::ImportOptions { resolution: Some(network.resolution()), ..Default::default() };
        let mut graph = model_compiler::import::import(name, tensors, &options).unwrap_or_else(|e| panic!("{e}"));
        model_compiler::passes::optimize(&mut graph).unwrap_or_else(|e| panic!("{name}: {e}"));
        let model = build::quantized(&graph, &QuantizeOptions::default());
        let compiled = build::compiled(&model);
        for frame in build::frames_of(&graph) {
            assert!(outputs(&compiled, &frame) == expected_outputs(&model, &frame), "{name}, {}", frame.name);
        }
    }
}

/// Flash and RAM of the published network: the figures of the README.
#[test]
fn the_published_network_keeps_its_sizes() {
    const KIB: u64 = 1 << 10;
    const MIB: u64 = 1 << 20;
    let model = build::quantized(&build::graph(golden::checkpoint(System::TransFuser)), &QuantizeOptions::default());
    let weights: u64 = model.steps.iter().map(|step| step.op.weight_bytes()).sum();
    let describe = |c: &Compiled| {
        for (key, value) in pipeline::summary(c) {
            println!("{key:>8}  {value}");
        }
    };
    for name in ["portable", "cortex-m4", "cortex-m7", "cortex-m55"] {
        let target = Target::find(name).unwrap();
        let compiled = compiled_for(&model, &target, &PlanOptions::for_target(&target));
        describe(&compiled);
        let plan = &compiled.record.plan;
        assert_eq!(plan.status(), PlanStatus::Optimal, "{name}");
        assert!(plan.arena_bytes() * 100 <= 140 * MIB, "{name}: {} B", plan.arena_bytes());
        assert!(compiled.image.len() as u64 * 100 <= 104 * weights, "{name}: {} B of {weights}", compiled.image.len());
    }
    let target = Target::find("portable").unwrap();
    let apart = PlanOptions { in_place_pooling: false, ..PlanOptions::for_target(&target) };
    let compiled = compiled_for(&model, &target, &apart);
    describe(&compiled);
    assert_eq!(compiled.record.plan.status(), PlanStatus::Optimal);
    // A stem, its pooled map, the other branch's pooled map; goal and velocity.
    assert_eq!(compiled.record.plan.arena_bytes(), MIB + 512 * KIB + 12);
}
