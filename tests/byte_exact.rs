//! The engine's bytes are the f64 model's bytes in every step of every frame, and the image's known answer holds.

use firmware::engine::Engine;
use firmware::image::Image;
use firmware::kernels::Portable;
use firmware::program::{ConstRange, Step};
use host_sim::backends::Backend;
use host_sim::buffers::GuardedArena;
use host_sim::run::ModelInfo;
use host_sim::verify::{Sources, compare};
use indicatif::ProgressBar;
use model_compiler::emit::AlignedBytes;
use model_compiler::frames::Frame;
use model_compiler::import::{ImportOptions, System, import};
use model_compiler::ir::Graph;
use model_compiler::passes::optimize;
use model_compiler::pipeline::{self, Compiled};
use model_compiler::qmodel::QModel;
use model_compiler::quantize::{QuantizeOptions, SkipStages};
use std::collections::BTreeMap;
use tests::build;
use tests::golden::{self, Lbc, Network};

const SYSTEMS: [System; 5] =
    [System::Aim, System::LateFusion, System::TransFuser, System::GeometricFusion, System::Cilrs];

fn assert_byte_exact(compiled: &Compiled, frames: &[Frame], backend: Backend) {
    let bytes = AlignedBytes::from(compiled.image.as_slice());
    let image = Image::parse(&bytes).unwrap_or_else(|e| panic!("{e}"));
    let sources = Sources { image, record: &compiled.record, graph: None, backend };
    let info = ModelInfo { name: compiled.record.model.name.clone(), sha256: String::new() };
    let report = compare(&sources, frames, info, &ProgressBar::hidden()).unwrap_or_else(|e| panic!("{e}"));
    assert!(report.bytes_equal, "{:?}", report.first_difference);
    assert_eq!(report.steps.len(), compiled.record.model.steps.len());
    assert_eq!(report.frames.len(), frames.len());
}

fn assert_self_test_passes(compiled: &Compiled) {
    let bytes = AlignedBytes::from(compiled.image.as_slice());
    let image = Image::parse(&bytes).unwrap_or_else(|e| panic!("{e}"));
    let mut arena = GuardedArena::new(&image);
    let mut engine = Engine::new(image, Portable, arena.poisoned(0)).unwrap_or_else(|e| panic!("{e}"));
    engine.self_test().unwrap_or_else(|e| panic!("{e}"));
}

fn quantized(graph: &Graph, skip: SkipStages) -> QModel {
    build::quantized(graph, &QuantizeOptions { skip, ..Default::default() })
}

/// Both types of skip values, for both targets, on every backend.
fn assert_byte_exact_everywhere(graph: &Graph) {
    for skip in [SkipStages::narrow(), SkipStages::wide()] {
        let model = quantized(graph, skip);
        for target in ["portable", "x86"] {
            let compiled = build::compiled_for(&model, target);
            for backend in Backend::all() {
                assert_byte_exact(&compiled, &build::frames_of(graph), backend);
            }
            assert_self_test_passes(&compiled);
        }
    }
}

#[test]
fn small_networks_are_byte_exact() {
    SYSTEMS.into_iter().for_each(|system| assert_byte_exact_everywhere(&build::small(&Network::small(system))));
}

#[test]
fn small_lbc_is_byte_exact() {
    [false, true].into_iter().for_each(|hack| assert_byte_exact_everywhere(&build::lbc(&Lbc::small(), hack)));
}

/// At half the resolution, which is a quarter of the work.
#[test]
fn full_size_lbc_is_byte_exact() {
    let options = ImportOptions { hack: true, ..Default::default() };
    let mut graph = import("lbc", golden::checkpoint(System::Lbc), &options).unwrap_or_else(|e| panic!("{e}"));
    optimize(&mut graph).unwrap_or_else(|e| panic!("{e}"));
    let calibration = &build::frames_of(&graph)[..1];
    let quantize = QuantizeOptions::default();
    let model = pipeline::quantize_graph(&graph, calibration, &quantize, &mut |_, _, _| {});
    let compiled = build::compiled_for(&model.unwrap_or_else(|e| panic!("{e}")), "x86");
    let fastest = Backend::choose(None).unwrap_or_else(|e| panic!("{e}"));
    assert_byte_exact(&compiled, calibration, fastest);
}

#[test]
fn full_size_networks_are_byte_exact() {
    for system in SYSTEMS {
        let graph = build::graph(golden::checkpoint(system));
        let model = quantized(&graph, SkipStages::narrow());
        let compiled = build::compiled(&model);
        let fastest = Backend::choose(None).unwrap_or_else(|e| panic!("{e}"));
        assert_byte_exact(&compiled, &build::frames_of(&graph), fastest);
        assert_self_test_passes(&compiled);
        if system == System::TransFuser {
            let compiled = build::compiled_for(&model, "x86");
            for backend in Backend::all() {
                assert_byte_exact(&compiled, &build::frames_of(&graph)[..1], backend);
            }
        }
    }
}

/// The ablations of the paper, small.
fn ablations() -> Vec<(&'static str, Network)> {
    let base = Network::small(System::TransFuser);
    vec![
        ("one scale", Network { scales: vec![4], ..base.clone() }),
        ("three scales", Network { scales: vec![2, 3, 4], ..base.clone() }),
        ("one attention layer", Network { layers: 1, ..base.clone() }),
        ("no positional embedding", Network { position: false, ..base.clone() }),
        ("shared transformer", Network { shared: Some(16), ..base }),
    ]
}

#[test]
fn ablations_are_byte_exact() {
    for (what, network) in ablations() {
        println!("{what}");
        let options = ImportOptions { resolution: Some(network.resolution()), ..Default::default() };
        let mut graph = import(what, network.tensors(), &options).unwrap_or_else(|e| panic!("{what}: {e}"));
        optimize(&mut graph).unwrap_or_else(|e| panic!("{what}: {e}"));
        let compiled = build::compiled_for(&quantized(&graph, SkipStages::narrow()), "x86");
        for backend in Backend::all() {
            assert_byte_exact(&compiled, &build::frames_of(&graph), backend);
        }
        assert_self_test_passes(&compiled);
    }
}

#[test]
fn weights_of_a_shared_transformer_are_stored_once() {
    let network = Network { shared: Some(16), ..Network::small(System::TransFuser) };
    let model = quantized(&build::small(&network), SkipStages::narrow());
    let compiled = build::compiled(&model);
    let bytes = AlignedBytes::from(compiled.image.as_slice());
    let image = Image::parse(&bytes).unwrap_or_else(|e| panic!("{e}"));
    let mut ranges: BTreeMap<String, Vec<ConstRange>> = BTreeMap::new();
    for (position, &index) in compiled.record.plan.order.iter().enumerate() {
        let name = &model.steps[index as usize].name;
        let module = name.strip_prefix("encoder.transformer").and_then(|rest| rest.split_once('.'));
        let Some((_, module)) = module.filter(|(_, module)| module.starts_with("blocks.")) else { continue };
        if let Some(Step::Linear(step)) = image.step(position as u16) {
            ranges.entry(module.to_owned()).or_default().push(step.weights);
        }
    }
    assert_eq!(ranges.len(), 2 * 6, "query, key, value, projection and two of the MLP in two layers");
    for (module, ranges) in ranges {
        assert!(ranges.len() == 4 && ranges.iter().all(|range| *range == ranges[0]), "{module}: {ranges:?}");
    }
}
