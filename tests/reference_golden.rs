//! The f32 reference meets what the original networks gave: waypoints, controls or points (with the statistics of their
//! logits) and the means of inner features, at full size, for the graph as imported and as optimized.

use host_sim::controls::ControlOutputs;
use host_sim::points::{self, PixelGrid};
use host_sim::statistics::ErrorSums;
use model_compiler::import::{ImportOptions, System, import};
use model_compiler::ir::{Graph, InputKind, ValueId};
use model_compiler::{passes, reference};
use std::collections::BTreeMap;
use tests::build;
use tests::commands::{self, Folder};
use tests::golden::{self, Expected, Frame};

/// Meters, m/s, of a control, of a point's −1..1, or of logits of order 1.
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
        InputKind::Views => frame.views.clone(),
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

fn largest_error(found: &[f32], expected: &[f32]) -> f32 {
    assert_eq!(found.len(), expected.len());
    let mut errors = ErrorSums::default();
    errors.add(expected, found);
    errors.largest_error() as f32
}

/// False for an error that is not a number.
fn within(error: f32, tolerance: f32) -> bool {
    error <= tolerance
}

/// Mean and standard deviation over all positions, per channel.
fn statistics(map: &[f32], channels: usize) -> [Vec<f32>; 2] {
    let mean = spatial_mean(map, channels);
    let deviation = |c: usize| {
        let squares = map.iter().skip(c).step_by(channels).map(|&x| (f64::from(x) - f64::from(mean[c])).powi(2));
        (squares.sum::<f64>() / ((map.len() / channels) as f64 - 1.0)).sqrt() as f32
    };
    let deviation = (0..channels).map(deviation).collect();
    [mean, deviation]
}

/// What a graph gives, under the names of the stored results. `logits`: what its points are made of.
fn results(graph: &Graph, outputs: &[Vec<f32>], logits: &[f32]) -> Vec<(&'static str, Vec<f32>)> {
    if let Some(grid) = PixelGrid::of_graph(graph) {
        let points = grid.points(&outputs[0]);
        let [mean, deviation] = statistics(logits, points.len());
        let points = points.as_flattened().iter().map(|&v| v as f32).collect();
        return vec![("points", points), ("logits_mean", mean), ("logits_std", deviation)];
    }
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
        let (mut seen, mut logits) = (0, Vec::new());
        let outputs = reference::run(graph, &raw_inputs(graph, frame), |node, map| {
            if points::logits(graph) == Some(node.output) {
                logits = map.to_vec();
            }
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
        let found = results(graph, &outputs, &logits);
        assert_eq!(found.len(), expected.results.len(), "{what}: every result is computed");
        for (name, found) in found {
            let result = &expected.results[name][i];
            let error = largest_error(&found, result);
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

#[test]
fn lbc_meets_the_original() {
    meets_the_original(System::Lbc);
}

/// The same through the command line, from files.
#[test]
fn lbc_meets_the_original_through_host_sim() {
    let folder = Folder::default();
    golden::write_safetensors(&golden::checkpoint(System::Lbc), &folder.path("lbc.safetensors")).unwrap();
    folder.write("inputs.safetensors", commands::views_file(&build::views((144, 256))));
    let (status, report) =
        folder.json("host-sim run @lbc.safetensors --inputs @inputs.safetensors --frames-limit 2 --json");
    assert_eq!(status, 0);
    for (i, expected) in golden::expected(System::Lbc).results["points"].iter().take(2).enumerate() {
        let points = report["frames"][i]["points"].as_array().expect("points");
        let values = points.iter().flat_map(|point| point.as_array().expect("a pair")).filter_map(|v| v.as_f64());
        let points: Vec<f32> = values.map(|v| v as f32).collect();
        let error = largest_error(&points, expected);
        assert!(within(error, RESULT_TOLERANCE), "frame {i}: {points:?}, expected {expected:?}");
    }
}
