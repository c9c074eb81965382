//! How close the integers come to f32: the full-size TransFuser, calibrated on the stored frames, evaluated on these and
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

#[test]
fn global_vector_reaches_20_db_with_narrow_and_28_db_with_wide_skip_streams() {
    let tensors = golden::checkpoint(System::TransFuser);
    let calibration = build::frames((256, 256));
    let evaluation = evaluation(&calibration);
    let mut reached = Vec::new();
    let bench = Bench::new(build::graph(tensors), &calibration, &evaluation).unwrap_or_else(|e| panic!("{e}"));
    for variant in &variants()[..2] {
        let fidelity = bench.measure(&variant.quantize, |_| {}).unwrap_or_else(|e| panic!("{e}"));
        print(variant, &fidelity);
        reached.push(fidelity.vector_sqnr_db);
    }
    assert!(reached[0] >= 20.0, "8-bit maps: {reached:?}");
    assert!(reached[1] >= 28.0, "16-bit skip streams: {reached:?}");
}
