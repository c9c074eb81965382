//! The demo: it runs, its files are what their generator gives, and its network fits a microcontroller.

use host_sim::cli::{self, Console};
use host_sim::demo::Bundle;
use model_compiler::error::Result;
use model_compiler::frames::{self, Frame, FrameFormat};
use model_compiler::import::{ImportOptions, NamedTensors, checkpoint};
use model_compiler::ir::Graph;
use model_compiler::memory_plan::PlanOptions;
use model_compiler::passes::PassOptions;
use model_compiler::pipeline;
use model_compiler::quantize::QuantizeOptions;
use model_compiler::reference;
use model_compiler::target::Target;
use std::ops::Range;
use std::path::Path;
use tests::bundle;

const PARAMETERS: u64 = 1_360_594;
/// Of 256 KiB: the rest is for stack and sensor buffers.
const MAX_ARENA_BYTES: u64 = 240 * 1024;
/// Every file of the checkpoint's folder and of the frames.
const MAX_CHECKPOINT_BYTES: u64 = 6_000_000;

fn graph() -> Graph {
    let (import, passes) = (ImportOptions::default(), PassOptions::default());
    pipeline::load_graph(&bundle::checkpoint_path(), &import, &passes).unwrap_or_else(|e| panic!("{e}"))
}

fn stored_frames(graph: &Graph, set: &str) -> Vec<Frame> {
    frames::load(&bundle::frames_path(set), &FrameFormat::of_graph(graph)).unwrap_or_else(|e| panic!("{e}"))
}

/// Exit status and standard output.
fn host_sim(arguments: &[&str]) -> (u8, String) {
    let (mut out, mut err) = (Vec::new(), Vec::new());
    let arguments = ["host-sim"].iter().chain(arguments).map(Into::into);
    let status = cli::main(arguments, Console { out: &mut out, err: &mut err });
    print!("{}", String::from_utf8_lossy(&err));
    (status, String::from_utf8(out).unwrap())
}

#[test]
fn the_demo_runs_verifies_every_byte_and_leaves_its_files() {
    let folder = tempfile::tempdir().unwrap();
    let out = folder.path().join("new/demo");
    let (status, text) = host_sim(&["--out", out.to_str().unwrap()]);
    println!("{text}");
    assert_eq!(status, 0);
    for expected in ["untrained", "cortex-m7", "equal in every step of every frame", "pooled vector", "waypoint 4"] {
        assert!(text.contains(expected), "{expected} in\n{text}");
    }
    assert!(text.contains(out.to_str().unwrap()), "says where the files lie:\n{text}");
    let report: serde_json::Value = serde_json::from_slice(&std::fs::read(out.join("report.json")).unwrap()).unwrap();
    assert_eq!((&report["bytes_equal"], &report["untrained"]), (&true.into(), &true.into()));
    assert!(report["noise"]["shares"].as_array().unwrap().len() > 100, "{}", report["noise"]);
    let page = std::fs::read_to_string(out.join("report.html")).unwrap();
    for expected in
        ["Untrained network", "✓ Passed", "Where the noise comes from", "scene-3 (mirrored)", "data:image/png"]
    {
        assert!(page.contains(expected), "{expected}");
    }
    assert!(page.len() < 3_000_000 && !page.contains("http"), "{} B", page.len());
    assert_eq!(report["frames"].as_array().unwrap().len(), 6, "three frames and their mirror images");
    assert_eq!(report["calibration_frames"], serde_json::json!([]), "evaluation frames are not calibration frames");
    for step in report["steps"].as_array().unwrap() {
        println!("{:6.1} dB  {} {}", step["sqnr_db"].as_f64().unwrap_or(f64::INFINITY), step["op"], step["step"]);
        assert_eq!(step["bytes_equal"], true);
    }
    let files = ["demo.img", "demo.record"].map(|name| out.join(name));
    let (image, record) = (files[0].to_str().unwrap(), files[1].to_str().unwrap());
    let frames = bundle::frames_path("evaluation");
    let again = host_sim(&["verify", image, "--record", record, "--frames", frames.to_str().unwrap()]);
    assert_eq!(again.0, 0, "{}", again.1);
}

#[test]
fn the_stored_checkpoint_is_the_generated_one() {
    let path = bundle::checkpoint_path();
    assert!(std::fs::metadata(&path).unwrap().len() < MAX_CHECKPOINT_BYTES);
    let stored: NamedTensors = checkpoint::read(&path).unwrap().into();
    let generated = bundle::checkpoint().unwrap();
    let names = |tensors: &NamedTensors| tensors.iter().map(|(name, _)| name.to_owned()).collect::<Vec<_>>();
    assert_eq!(names(&stored), names(&generated));
    for (name, tensor) in stored.iter() {
        assert!(Some(tensor) == generated.get(name), "{name}");
    }
    assert_eq!(graph().parameters(), PARAMETERS);
}

#[test]
fn the_stored_frames_are_the_rendered_ones() {
    let graph = graph();
    let check = |set: &str, seeds: Range<u64>| {
        let stored = stored_frames(&graph, set);
        let rendered: Vec<Frame> = seeds.map(bundle::frame).collect();
        assert_eq!(stored.len(), rendered.len(), "{set}");
        for (stored, rendered) in stored.iter().zip(&rendered) {
            assert!(stored == rendered, "{set}/{}", stored.name);
        }
    };
    check("calibration", bundle::CALIBRATION);
    check("evaluation", bundle::EVALUATION);
}

#[test]
fn activations_are_those_of_a_trained_network() {
    let graph = graph();
    let inputs = pipeline::raw_inputs(&graph, &stored_frames(&graph, "evaluation")).unwrap();
    for frame in &inputs {
        reference::run(&graph, frame, |node, values| {
            let power = values.iter().map(|v| f64::from(*v).powi(2)).sum::<f64>() / values.len() as f64;
            let bounds = if node.name == "bev" { 0.001..1.0 } else { 0.05..300.0 };
            assert!(bounds.contains(&power.sqrt()), "{}: root mean square {}", node.name, power.sqrt());
        })
        .unwrap();
    }
}

#[test]
fn the_arena_fits_a_microcontroller() -> Result<()> {
    let graph = graph();
    let frames = stored_frames(&graph, "calibration");
    let model = pipeline::quantize_graph(&graph, &frames, &QuantizeOptions::default(), &mut |_, _, _| {})?;
    for name in ["cortex-m4", "cortex-m7"] {
        let target = Target::find(name)?.with_limits(Some(MAX_ARENA_BYTES), Some(2 << 20));
        let compiled = pipeline::compile(&model, &target, &PlanOptions::for_target(&target), &mut |_, _, _| {})?;
        let plan = &compiled.record.plan;
        println!("{name}: arena {} B, {} MACs", plan.arena_bytes(), graph.macs());
        assert!(plan.arena_bytes() <= MAX_ARENA_BYTES);
    }
    Ok(())
}

#[test]
fn the_demo_finds_its_files_in_this_tree() {
    let bundle = Bundle::of_sources().unwrap();
    assert_eq!(bundle.checkpoint().canonicalize().unwrap(), bundle::checkpoint_path().canonicalize().unwrap());
    assert!(Bundle::in_workspace(Path::new("elsewhere")).is_err());
}
