//! The byte-for-byte comparison can fail: each of the runtime's named faults is found by `host-sim verify`, at a step
//! of the kind that it spoils. Faults are process-wide, so this file holds one test.

use firmware::fault::{self, Fault};
use firmware::image::Image;
use host_sim::cli::{self, Console};
use model_compiler::emit::AlignedBytes;
use model_compiler::frames::Frame;
use model_compiler::import::System;
use model_compiler::ir::Graph;
use model_compiler::pipeline::{self, Compiled};
use model_compiler::quantize::{QuantizeOptions, SkipStages};
use serde_json::Value;
use std::ffi::OsString;
use std::path::{Path, PathBuf};
use tests::golden::Network;
use tests::{build, commands, every_step};

/// Kinds of step at which a fault may first show: it depends on the network which of them comes first.
fn expected_operators(fault: Fault) -> &'static [&'static str] {
    const WEIGHTED: &[&str] = &["conv2d", "linear", "branch_linear"];
    match fault {
        Fault::TieDown | Fault::TieAwayFromZero | Fault::DoubleRounding | Fault::ClampOrder => &every_step::OPERATORS,
        Fault::PaddingZeroPoint | Fault::LastRow | Fault::LastColumn => &["conv2d"],
        Fault::ResidualZeroPoint => &["conv2d", "linear", "add", "resize_bilinear"],
        Fault::GateOrder | Fault::ResetBeforeBias | Fault::GoalFirstStepOnly => &["waypoint_decoder"],
        Fault::TanhNextEntry => &["waypoint_decoder", "sigmoid"],
        Fault::ExpNextEntry | Fault::SoftmaxMaximum => &["attention", "softmax", "spatial_softmax"],
        Fault::PointAxes => &["spatial_softmax"],
        Fault::LayerNormEpsilon => &["layer_norm"],
        Fault::DepthTail | Fault::MultiplierPlusOne | Fault::ChannelsSwapped => WEIGHTED,
        // Where the bytes in front of the scratch belong to an operand of the same step, the engine refuses to cut
        // overlapping slices; where they belong to another tensor, its next reader gives wrong bytes.
        Fault::ScratchOverlap => &["conv2d", "linear", "branch_linear", "attention", "waypoint_decoder"],
        Fault::ResizeWeights => &["resize_bilinear"],
        Fault::TokenOrder => &["tokens"],
        Fault::MaxPoolPadding => &["max_pool"],
        Fault::PoolSecondMap => &["global_pool"],
        Fault::BoxOffset | Fault::BorderZero => &["copy_box"],
        Fault::ConcatOrder => &["concat"],
        Fault::GatherTransposed => &["gather_sum"],
        Fault::BranchFromZero => &["branch_linear"],
    }
}

#[test]
fn every_fault_is_found_at_a_step_that_it_spoils() {
    let folder = tempfile::tempdir().expect("a temporary folder");
    let subjects = subjects(folder.path());
    for subject in &subjects {
        let outcome = subject.verify();
        assert_eq!(outcome.status, 0, "{}: {}", subject.name, outcome.document);
    }
    println!("{:20} {}", "fault", subjects.iter().map(|s| format!("{:42}", s.name)).collect::<String>());
    let mut missed = Vec::new();
    for fault in Fault::ALL {
        fault::set(Some(fault));
        let outcomes: Vec<Outcome> = subjects.iter().map(Subject::verify).collect();
        fault::set(None);
        let row: String = outcomes.iter().map(|outcome| format!("{:42}", outcome.to_string())).collect();
        println!("{:20} {}", format!("{fault:?}"), row.trim_end());
        for (subject, outcome) in subjects.iter().zip(&outcomes) {
            outcome.assert_consistent(subject, fault);
        }
        if outcomes.iter().all(|outcome| outcome.wrong.is_none()) {
            missed.push(fault);
        }
    }
    assert_eq!(missed, [], "not found on any network");
    assert!(subjects.iter().all(|subject| subject.verify().status == 0), "a fault was left behind");
}

/// A compiled network with its files.
struct Subject {
    name: &'static str,
    image: PathBuf,
    inputs: PathBuf,
}

fn subjects(folder: &Path) -> Vec<Subject> {
    let small = |name, system, skip| {
        let graph = build::small(&Network::small(system));
        let options = QuantizeOptions { skip, ..Default::default() };
        let compiled = build::compiled(&build::quantized(&graph, &options));
        Subject::write(folder, name, &compiled, &graph_frames(&graph))
    };
    vec![
        small("TransFuser, i8 skips", System::TransFuser, SkipStages::narrow()),
        small("TransFuser, i16 skips", System::TransFuser, SkipStages::wide()),
        small("Late Fusion, i8 skips", System::LateFusion, SkipStages::narrow()),
        small("CILRS, i8 skips", System::Cilrs, SkipStages::narrow()),
        Subject::write(folder, "every step", &every_step::compiled(), &every_step::frames(7, 4)),
    ]
}

fn graph_frames(graph: &Graph) -> Vec<Frame> {
    let frames = build::frames_of(graph);
    frames.iter().cloned().chain(frames.iter().map(Frame::mirrored)).collect()
}

impl Subject {
    fn write(folder: &Path, name: &'static str, compiled: &Compiled, frames: &[Frame]) -> Self {
        let subject = Self {
            name,
            image: folder.join(format!("{name}.img")),
            inputs: folder.join(format!("{name}.safetensors")),
        };
        pipeline::write(compiled, &subject.image).unwrap_or_else(|e| panic!("{e}"));
        std::fs::write(&subject.inputs, commands::inputs_file(frames)).unwrap_or_else(|e| panic!("{e}"));
        subject
    }

    /// `host-sim verify IMAGE --inputs FILE --json`.
    fn verify(&self) -> Outcome {
        let arguments = ["host-sim".into(), "verify".into(), self.image.clone().into_os_string()];
        let inputs: [OsString; 5] = [
            "--inputs".into(),
            self.inputs.clone().into_os_string(),
            "--json".into(),
            // The others have no faults.
            "--backend".into(),
            "portable".into(),
        ];
        let (mut out, mut err) = (Vec::new(), Vec::new());
        let status = cli::main(arguments.into_iter().chain(inputs), Console { out: &mut out, err: &mut err });
        let document: Value = serde_json::from_slice(&out).expect("a JSON document");
        let wrong = wrong_step(&document).or_else(|| self.refused_step(&document));
        Outcome { status, document, wrong }
    }

    /// The step at which the engine itself refused to go on: its message begins with `step N:`.
    fn refused_step(&self, document: &Value) -> Option<(String, String)> {
        let message = document["error"]["message"].as_str()?;
        let (place, _) = message.split_once(": the image changed")?;
        let position = place.strip_prefix("step ")?.parse().ok()?;
        let bytes = AlignedBytes::from(std::fs::read(&self.image).expect("the image").as_slice());
        let step = Image::parse(&bytes).expect("a valid image").step(position)?;
        Some((step.name().to_owned(), format!("({place}, refused)")))
    }
}

/// Operator and name of the first step with unequal bytes.
fn wrong_step(document: &Value) -> Option<(String, String)> {
    let position = document["first_difference"]["position"].as_u64()?;
    let step = &document["steps"][position as usize];
    Some((step["op"].as_str()?.to_owned(), step["step"].as_str()?.to_owned()))
}

/// What a verification ended with.
struct Outcome {
    status: u8,
    document: Value,
    /// First wrong step: operator and name.
    wrong: Option<(String, String)>,
}

impl Outcome {
    /// Status, report and error agree with each other and with the fault.
    fn assert_consistent(&self, subject: &Subject, fault: Fault) {
        let context = format!("{fault:?} on {}: {}", subject.name, self.document["error"]);
        let Some((operator, step)) = &self.wrong else {
            assert_eq!(self.status, 0, "{context}");
            return;
        };
        assert_eq!(self.status, 1, "{context}");
        assert!(expected_operators(fault).contains(&operator.as_str()), "{operator} {step}: {context}");
        if !step.ends_with("refused)") {
            assert_eq!(self.document["bytes_equal"], false, "{context}");
            let place = self.document["error"]["where"].as_str().unwrap_or_default();
            assert!(place.contains(step.as_str()), "{step} is not named: {context}");
        }
    }
}

impl std::fmt::Display for Outcome {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        match &self.wrong {
            Some((operator, step)) => {
                let short: String = step.chars().skip(step.chars().count().saturating_sub(24)).collect();
                write!(f, "{operator} {short}")
            }
            None if self.status == 0 => write!(f, "-"),
            None => write!(f, "status {}: {}", self.status, self.document["error"]["message"]),
        }
    }
}
