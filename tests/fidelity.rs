//! How close the integers come to f32: full-size networks, calibrated on the stored frames, evaluated on these and
//! their mirror images.

use host_sim::ablation::{Bench, Fidelity, Variant, variants};
use model_compiler::frames::Frame;
use model_compiler::import::System;
use tests::{build, golden};

/// The stored frames and their mirror images.
fn evaluation(calibration: &[Frame]) -> Vec<Frame> {
    calibration.iter().cloned().chain(calibration.iter().map(Frame::mirrored)).collect()
}

fn print(variant: &Variant, fidelity: &Fidelity) {
    let mm = |v: &[f64]| v.iter().map(|x| format!("{x:6.0}")).collect::<String>();
    println!(
        "{:30} {:6.2} dB   mean mm {}   worst mm {}",
        variant.name,
        fidelity.vector_sqnr_db,
        mm(&fidelity.mean_mm),
        mm(&fidelity.worst_mm)
    );
}

/// SQNR of the global vector with narrow and with wide skip streams, dB.
fn reached(system: System) -> [f64; 2] {
    let tensors = golden::checkpoint(system);
    let calibration = build::frames((256, 256));
    let evaluation = evaluation(&calibration);
    let bench = Bench::new(build::graph(tensors), &calibration, &evaluation).unwrap_or_else(|e| panic!("{e}"));
    let variants = variants();
    [&variants[0], &variants[1]].map(|variant| {
        let fidelity = bench.measure(&variant.quantize, |_| {}).unwrap_or_else(|e| panic!("{e}"));
        print(variant, &fidelity);
        fidelity.vector_sqnr_db
    })
}

#[test]
fn global_vector_of_transfuser_reaches_20_db_with_narrow_and_28_db_with_wide_skip_streams() {
    let reached = reached(System::TransFuser);
    assert!(reached[0] >= 20.0, "8-bit maps: {reached:?}");
    assert!(reached[1] >= 28.0, "16-bit skip streams: {reached:?}");
}

#[test]
fn global_vector_of_geometric_fusion_reaches_19_db_with_narrow_and_21_db_with_wide_skip_streams() {
    let reached = reached(System::GeometricFusion);
    assert!(reached[0] >= 19.0, "8-bit maps: {reached:?}");
    assert!(reached[1] >= 21.0, "16-bit skip streams: {reached:?}");
}
