//! The f32 reference meets what the original networks gave: waypoints or controls and the means of inner features, at
//! full size, for the graph as imported and as optimized.

use host_sim::controls::ControlOutputs;
use host_sim::statistics::ErrorSums;
use model_compiler::import::{ImportOptions, System, import};
use model_compiler::ir::{Graph, InputKind, ValueId};
use model_compiler::{passes, reference};
use std::collections::BTreeMap;
use tests::golden::{self, Expected, Frame};

/// Meters, m/s, or of a control.
const RESULT_TOLERANCE: f32 = 1e-3;

/// Of the expected mean, or of [`TAP_FLOOR`] times the largest mean of the same tap and frame where that is more: a
/// mean of signed features may cancel to nothing, and then has no relative error.
const TAP_TOLERANCE: f32 = 1e-3;
const TAP_FLOOR: f32 = 1e-2;

fn raw_inputs(graph: &Graph, frame: &Frame) -> Vec<Vec<f32>> {
    let raw = |kind| match kind {
        InputKind::Image => frame.rgb.clone(),
        InputKind::Bev => frame.bev.clone(),
        InputKind::Velocity => vec![frame.velocity],
        InputKind::Goal => frame.target.to_vec(),
        InputKind::BevPoints => frame.bev_points.clone(),
        InputKind::CameraPoints => frame.camera_points.clone(),
        InputKind::Command => vec![frame.command as f32],
    };
    graph.inputs().map(|(_, kind)| raw(kind)).collect()
}

/// Mean over all positions, per channel.
fn spatial_mean(map: &[f32], channels: usize) -> Vec<f32> {
    let positions = (map.len() / channels) as f64;
    let sum = |c: usize| map.iter().skip(c).step_by(channels).map(|&x| f64::from(x)).sum::<f64>();
    (0..channels).map(|c| (sum(c) / positions) as f32).collect()
}

/// Largest error of the channels, as a part of what [`TAP_FLOOR`] says.
fn tap_error(found: &[f32], expected: &[f32]) -> f32 {
    assert_eq!(found.len(), expected.len(), "channels");
    let floor = TAP_FLOOR * expected.iter().fold(0.0_f32, |max, e| max.max(e.abs()));
    let errors = found.iter().zip(expected).map(|(f, e)| (f - e).abs() / e.abs().max(floor));
    errors.fold(0.0, |worst, e| if e > worst || e.is_nan() { e } else { worst })
}

/// False for an error that is not a number.
fn within(error: f32, tolerance: f32) -> bool {
    error <= tolerance
}

/// The outputs of a graph under the names of the stored results.
fn results(graph: &Graph, outputs: &[Vec<f32>]) -> Vec<(&'static str, Vec<f32>)> {
    let names = graph.outputs.iter().map(|&id| graph.value(id).name.as_str());
    let Some(controls) = ControlOutputs::find(names) else { return vec![("waypoints", outputs[0].clone())] };
    let prediction = controls.read(outputs).expect("three controls");
    let stored = |name| if name == "predicted_speed" { "velocity" } else { name };
    prediction.values().map(|(name, value)| (stored(name), vec![value as f32])).collect()
}

/// Runs all frames; prints the worst errors, panics with all that are too large.
fn check(what: &str, graph: &Graph, frames: &[Frame], expected: &Expected) {
    let taps: BTreeMap<ValueId, &str> = expected
        .taps
        .keys()
        .map(|module| {
            (golden::tapped_value(graph, module).unwrap_or_else(|| panic!("{what}: no {module}")), &module[..])
        })
        .collect();
    let mut misses = Vec::new();
    let (mut worst_tap, mut worst_result) = (0.0_f32, 0.0_f32);
    for (i, frame) in frames.iter().enumerate() {
        let mut seen = 0;
        let outputs = reference::run(graph, &raw_inputs(graph, frame), |node, map| {
            let Some(module) = taps.get(&node.output) else { return };
            let means = spatial_mean(map, usize::from(graph.value(node.output).shape.channels));
            let error = tap_error(&means, &expected.taps[*module][i]);
            seen += 1;
            worst_tap = worst_tap.max(error);
            if !within(error, TAP_TOLERANCE) {
                misses.push(format!("frame {i}, {module}: off by {error:.1e}"));
            }
        })
        .unwrap_or_else(|e| panic!("{what}: {e}"));
        assert_eq!(seen, expected.taps.len(), "{what}: every tap is computed");
        let found = results(graph, &outputs);
        assert_eq!(found.len(), expected.results.len(), "{what}: every result is computed");
        for (name, found) in found {
            let result = &expected.results[name][i];
            let mut errors = ErrorSums::default();
            errors.add(result, &found);
            let error = errors.largest_error() as f32;
            worst_result = worst_result.max(error);
            if !within(error, RESULT_TOLERANCE) {
                misses.push(format!("frame {i}: {name} {found:?}, expected {result:?}"));
            }
        }
    }
    println!("{what}: results within {worst_result:.1e}, inner features within {worst_tap:.1e}");
    assert!(misses.is_empty(), "{what}:\n{}", misses.join("\n"));
}

fn meets_the_original(system: System) {
    let (frames, expected) = (golden::frames(), golden::expected(system));
    let mut graph = import(system.name(), golden::checkpoint(system), &ImportOptions::default()).unwrap();
    check(&format!("{}, as imported", system.name()), &graph, &frames, &expected);
    passes::optimize(&mut graph).unwrap();
    check(&format!("{}, optimized", system.name()), &graph, &frames, &expected);
}

#[test]
fn aim_meets_the_original() {
    meets_the_original(System::Aim);
}

#[test]
fn late_fusion_meets_the_original() {
    meets_the_original(System::LateFusion);
}

#[test]
fn transfuser_meets_the_original() {
    meets_the_original(System::TransFuser);
}

#[test]
fn geometric_fusion_meets_the_original() {
    meets_the_original(System::GeometricFusion);
}

#[test]
fn cilrs_meets_the_original() {
    meets_the_original(System::Cilrs);
}
