//! throw-away
use host_sim::ablation::Bench;
use model_compiler::frames::Frame;
use model_compiler::import::System;
use model_compiler::quantize::{QuantizeOptions, RangeRule, SkipStages};
use tests::{build, golden};
#[test]
fn experiment() {
    let calibration = build::frames((256, 256));
    let evaluation: Vec<Frame> = calibration.iter().cloned().chain(calibration.iter().map(Frame::mirrored)).collect();
    let bench = Bench::new(build::graph(golden::checkpoint(System::TransFuser)), &calibration, &evaluation).unwrap();
    let base = QuantizeOptions { skip: SkipStages::wide(), ..Default::default() };
    let narrow = QuantizeOptions::default();
    for (name, o) in [
        ("wide", base.clone()),
        ("narrow", narrow.clone()),
        ("wide minmax", QuantizeOptions { ranges: RangeRule::MinMax, ..base.clone() }),
        ("narrow minmax", QuantizeOptions { ranges: RangeRule::MinMax, ..narrow.clone() }),
    ] {
        let f = bench.measure(&o, |_| {}).unwrap();
        println!("{name:20} {:.2} dB {:?} {:?}", f.vector_sqnr_db, f.mean_mm, f.worst_mm);
    }
}
