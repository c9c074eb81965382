//! Random small classifiers through the whole chain: passes, quantizer, planner, image, engine. The engine's bytes are
//! the f64 model's in every step on every backend, and the numbers stay close to f32.

use firmware::engine::Engine;
use firmware::image::Image;
use firmware::kernels::Portable;
use host_sim::backends::Backend;
use host_sim::report::VerifyReport;
use host_sim::run::ModelInfo;
use host_sim::verify::{Sources, compare};
use indicatif::ProgressBar;
use model_compiler::emit::AlignedBytes;
use model_compiler::ir::Graph;
use model_compiler::passes::{PassOptions, optimize_with};
use model_compiler::pipeline::{self, Compiled};
use model_compiler::quantize::{QuantizeOptions, RangeRule, SkipStages};
use std::collections::BTreeMap;
use tests::{build, random_graph};

/// Networks, one per seed from 0 on.
const NETWORKS: u64 = 200;
const FRAMES: usize = 8;
/// Least SQNR that a step alone leaves, and that is left of the whole way to it: a few decibels below the worst seen,
/// far above what a wrong scale or operand gives.
const LOCAL_FLOOR_DB: f64 = 28.0;
const FLOOR_DB: f64 = 15.0;

/// Operators that must occur.
const OPERATORS: [&str; 12] = [
    "conv2d",
    "linear",
    "max_pool",
    "average_pool",
    "global_pool",
    "add",
    "requantize",
    "resize_bilinear",
    "copy_box",
    "concat",
    "softmax",
    "gather_sum",
];

/// A network of a seed, compiled with options that alternate.
fn compiled(seed: u64) -> (Graph, Compiled) {
    let mut graph = random_graph::graph(seed);
    let passes = PassOptions { fuse_residual: !seed.is_multiple_of(5) };
    optimize_with(&mut graph, passes).unwrap_or_else(|e| panic!("seed {seed}: {e}"));
    let frames = random_graph::frames(&graph, seed, FRAMES);
    let skip = if seed.is_multiple_of(2) { SkipStages::narrow() } else { SkipStages::wide() };
    let ranges = if seed.is_multiple_of(3) { RangeRule::MinMax } else { RangeRule::Mse };
    let options = QuantizeOptions { skip, ranges, ..Default::default() };
    let model = pipeline::quantize_graph(&graph, &frames, &options, &mut |_, _, _| ());
    (graph, build::compiled(&model.unwrap_or_else(|e| panic!("seed {seed}: {e}"))))
}

/// All steps on the calibration frames, whose values the ranges hold.
fn verified(seed: u64, graph: &Graph, compiled: &Compiled, backend: Backend) -> VerifyReport {
    let bytes = AlignedBytes::from(compiled.image.as_slice());
    let image = Image::parse(&bytes).unwrap_or_else(|e| panic!("seed {seed}: {e}"));
    let mut arena = AlignedBytes::zeroed(image.arena_bytes() as usize);
    let mut engine = Engine::new(image, Portable, &mut arena).unwrap_or_else(|e| panic!("seed {seed}: {e}"));
    engine.self_test().unwrap_or_else(|e| panic!("seed {seed}: {e}"));
    let sources = Sources { image, record: &compiled.record, graph: Some(graph), backend };
    let info = ModelInfo { name: compiled.record.model.name.clone(), sha256: String::new() };
    let frames = random_graph::frames(graph, seed, FRAMES);
    compare(&sources, &frames, info, &ProgressBar::hidden()).unwrap_or_else(|e| panic!("seed {seed}: {e}"))
}

#[test]
fn random_networks_are_byte_exact_and_close_to_f32() {
    let mut steps: BTreeMap<String, usize> = BTreeMap::new();
    let (mut worst_local, mut worst) = (f64::INFINITY, f64::INFINITY);
    for seed in 0..NETWORKS {
        let (graph, compiled) = compiled(seed);
        for backend in Backend::all() {
            let report = verified(seed, &graph, &compiled, backend);
            assert!(report.bytes_equal, "seed {seed}: {:?}", report.first_difference);
            for step in &report.steps {
                *steps.entry(step.op.to_string()).or_default() += 1;
                let (local, all) = (step.local_sqnr_db.unwrap_or(f64::INFINITY), step.sqnr_db.unwrap_or(f64::NAN));
                assert!(local >= LOCAL_FLOOR_DB, "seed {seed}, step {}: {local} dB alone", step.step);
                assert!(all >= FLOOR_DB, "seed {seed}, step {}: {all} dB", step.step);
                (worst_local, worst) = (worst_local.min(local), worst.min(all));
            }
        }
    }
    println!("{NETWORKS} networks, steps {steps:?}: at least {worst_local:.1} dB per step, {worst:.1} dB in all");
    assert!(OPERATORS.iter().all(|operator| steps.contains_key(*operator)), "{steps:?}");
}
