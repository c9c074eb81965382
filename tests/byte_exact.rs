//! The engine's bytes are the f64 model's bytes, step by step.

use firmware::engine::Engine;
use firmware::image::Image;
use firmware::kernels::Portable;
use model_compiler::emit::AlignedBytes;
use model_compiler::frames::Frame;
use model_compiler::import::System;
use model_compiler::integer_reference;
use model_compiler::pipeline::Compiled;
use model_compiler::quantize::{QuantizeOptions, SkipStages};
use tests::build;
use tests::golden::{self, Network};

fn assert_byte_exact(compiled: &Compiled, frame: &Frame) {
    let model = &compiled.record.model;
    let codes: Vec<Vec<f64>> = model
        .inputs
        .iter()
        .map(|port| {
            let kind = port.kind.unwrap();
            let raw: Vec<f64> = frame.raw(kind).unwrap().iter().map(|&v| f64::from(v)).collect();
            integer_reference::encode_input(kind, &raw)
        })
        .collect();
    let mut expected = vec![Vec::new(); model.steps.len()];
    let t = std::time::Instant::now();
    integer_reference::run(model, &codes, |index, step, out| {
        expected[index] = integer_reference::to_bytes(out, model.tensor(step.op.output()).element);
    })
    .unwrap_or_else(|e| panic!("{e}"));
    eprintln!("f64 {:?}", t.elapsed());
    let inputs: Vec<Vec<u8>> = model
        .inputs
        .iter()
        .zip(&codes)
        .map(|(port, c)| integer_reference::to_bytes(c, model.tensor(port.tensor).element))
        .collect();
    let inputs: Vec<&[u8]> = inputs.iter().map(Vec::as_slice).collect();
    let image = AlignedBytes::from(compiled.image.as_slice());
    let image = Image::parse(&image).unwrap();
    let mut arena = AlignedBytes::zeroed(image.arena_bytes() as usize);
    let mut engine = Engine::new(image, Portable, &mut arena).unwrap();
    let t = std::time::Instant::now();
    let mut wrong = Vec::new();
    let mut times = std::collections::BTreeMap::<&str, f64>::new();
    let mut last = std::time::Instant::now();
    engine
        .infer_observed(&inputs, |position, step, bytes| {
            *times.entry(step.name()).or_default() += last.elapsed().as_secs_f64();
            let index = compiled.record.plan.order[position] as usize;
            if expected[index] != bytes {
                wrong.push(format!("{position} {} {}", step.name(), model.steps[index].name));
            }
            last = std::time::Instant::now();
        })
        .unwrap();
    eprintln!("engine {:?} {times:?}", t.elapsed());
    assert!(wrong.is_empty(), "{wrong:#?}");
}

#[test]
fn small_networks_are_byte_exact() {
    for system in [System::Aim, System::LateFusion, System::TransFuser] {
        let graph = build::small(&Network::small(system));
        for skip in [SkipStages::narrow(), SkipStages::wide()] {
            let options = QuantizeOptions { skip, ..Default::default() };
            let compiled = build::compiled(&build::quantized(&graph, &options));
            for frame in build::frames_of(&graph) {
                assert_byte_exact(&compiled, &frame);
            }
        }
    }
}

#[test]
fn full_size_networks_are_byte_exact() {
    for system in [System::Aim, System::LateFusion, System::TransFuser] {
        let graph = build::graph(golden::checkpoint(system));
        let t = std::time::Instant::now();
        let model = build::quantized(&graph, &QuantizeOptions::default());
        eprintln!("quantize {:?}", t.elapsed());
        let compiled = build::compiled(&model);
        for (k, v) in model_compiler::pipeline::summary(&compiled) {
            eprintln!("{k} {v}");
        }
        for frame in build::frames_of(&graph) {
            assert_byte_exact(&compiled, &frame);
        }
    }
}
