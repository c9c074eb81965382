//! A recorded sequence replayed through everything that would run in the vehicle, 20 steps per second.
//!
//! ```text
//! LOG ─► firmware's sensors ─► engine (int8) ─┬► firmware's driver: planner, controller, supervision ─► controls
//!                                  f32 network ┴► a driver of its own ─────────────────────────────────► controls
//! ```
//!
//! The loop is open: the recording goes its way whatever the controls are. Both networks read the same inputs, and each
//! has a driver of its own, so that a difference in one step is in the memory of the later ones as it would be on the
//! road. The format of a log is described at [`log`].

use crate::answer::Answer;
use crate::backends::Backend;
use crate::files::{self, ImageFile};
use crate::points::PixelGrid;
use crate::run::{ModelInfo, Waypoints};
use crate::system;
use firmware::drive::{Driver, Measurements, NetworkInputs, Output, Reading, RouteNode, Status, Step};
use indicatif::ProgressBar;
use log::Log;
use model_compiler::artifact;
use model_compiler::error::Result;
use model_compiler::import::ImportOptions;
use network::{FloatNetwork, IntegerNetwork};
use schemars::JsonSchema;
use sensors::Rig;
use serde::Serialize;
use std::path::PathBuf;

pub mod log;
pub mod network;
pub mod sensors;
mod summary;

pub use summary::{Difference, Summary};

/// Version of the document.
pub const SCHEMA: u32 = 1;
/// Seconds from step to step.
const STEP_S: f64 = 0.05;

/// What to drive.
#[derive(Clone, Debug)]
pub struct Options {
    /// Model image.
    pub image: PathBuf,
    /// Folder of the log.
    pub log: PathBuf,
    /// Checkpoint that the image was compiled from.
    pub model: Option<PathBuf>,
    /// How it is imported.
    pub import: ImportOptions,
    /// Kernels of the engine.
    pub backend: Backend,
}

/// A replayed log.
#[derive(Clone, Debug, PartialEq, Serialize, JsonSchema)]
pub struct DriveReport {
    /// Version of this structure.
    pub schema: u32,
    /// The image.
    pub model: ModelInfo,
    /// The f32 network beside it; absent without one.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub reference: Option<ModelInfo>,
    /// The figures of the whole.
    pub summary: Summary,
    /// Every step, in order.
    pub steps: Vec<DriveStep>,
}

/// One step of 1/20 s.
#[derive(Clone, Debug, PartialEq, Serialize, JsonSchema)]
pub struct DriveStep {
    /// Folder of the step.
    pub name: String,
    /// Seconds since the first step.
    pub time_s: f64,
    /// Measured speed, m/s; `null` where there is none.
    pub speed_mps: Option<f64>,
    /// Goal `[right, forward]`, m, and command 1..=6 that the network was given; `null` where it did not run.
    pub goal_m: Option<[f64; 2]>,
    /// See `goal_m`.
    pub command: Option<u8>,
    /// What the integers do.
    pub int8: Decision,
    /// What the f32 network does; absent without one.
    #[serde(rename = "f32", skip_serializing_if = "Option::is_none")]
    pub float: Option<Decision>,
    /// Mean distance of the waypoints of both, m; `null` where not both gave waypoints in this step.
    pub waypoint_distance_m: Option<f64>,
}

/// Controls of one step, and where they come from.
#[derive(Clone, Debug, PartialEq, Serialize, JsonSchema)]
pub struct Decision {
    /// `driving`, `filling buffers`, `recovering`, or the fault that led to the safe state.
    pub status: String,
    /// The same as a number, as on a bus.
    pub status_code: u8,
    /// −1 (left) to 1 (right).
    pub steer: f64,
    /// 0 to 0.75.
    pub throttle: f64,
    /// 0 to 1.
    pub brake: f64,
    /// Waypoints `[right, forward]`, m, of a network that gives such; `null` where it did not run.
    pub waypoints: Option<Waypoints>,
}

impl Decision {
    pub(crate) fn new(output: Output, answer: Option<&Answer>) -> Self {
        let [steer, throttle, brake] =
            [output.controls.steer, output.controls.throttle, output.controls.brake].map(|value| value.to_num());
        let (status, status_code) = (output.status.to_string(), output.status.code());
        Self { status, status_code, steer, throttle, brake, waypoints: answer.and_then(Answer::waypoints) }
    }

    /// Whether the controls are the controller's.
    pub fn is_driving(&self) -> bool {
        self.status_code == Status::Driving.code()
    }
}

/// A driver with the nodes of the route that it does not hold yet.
struct Seat<'l> {
    driver: Driver,
    ahead: &'l [RouteNode],
}

impl Seat<'_> {
    /// One step; `infer` runs the network where it is asked for.
    fn step(
        &mut self,
        measurements: &Measurements,
        infer: impl FnOnce(&NetworkInputs) -> Result<Answer>,
    ) -> Result<(Decision, Option<NetworkInputs>)> {
        while let [node, rest @ ..] = self.ahead {
            if self.driver.route().push(*node).is_err() {
                break;
            }
            self.ahead = rest;
        }
        match self.driver.step(measurements) {
            Step::Done(output) => Ok((Decision::new(output, None), None)),
            Step::Network(pending) => {
                let inputs = *pending.inputs();
                let answer = infer(&inputs)?;
                // The time that this machine takes says nothing about the vehicle's.
                let output = pending.finish(answer.output(), 0);
                Ok((Decision::new(output, Some(&answer)), Some(inputs)))
            }
        }
    }
}

/// Replays a log.
///
/// # Errors
/// The image is no driving network's, the checkpoint is another network's, or a file of the log is missing or damaged.
pub fn drive(options: &Options, progress: &ProgressBar) -> Result<DriveReport> {
    let file = ImageFile::read(&options.image)?;
    let image = file.parse()?;
    let system = system::of_image(&image)?;
    let maps = image.output(0).and_then(|port| PixelGrid::of_image(&image, port.tensor));
    let profile = system::profile(system, maps);
    let rig = Rig::new(&image, system)?;
    let log = Log::read(&options.log)?;
    let mut integers = IntegerNetwork::new(image, options.backend, profile.answer)?;
    let load = |path: &PathBuf| -> Result<_> {
        let graph = files::load_graph(path, &options.import)?;
        let info = ModelInfo { name: graph.name.clone(), sha256: files::file_sha256(path)? };
        Ok((FloatNetwork::new(graph, profile.answer, &rig)?, info))
    };
    let (float, reference) = options.model.as_ref().map(load).transpose()?.unzip();

    let seat = || Seat { driver: Driver::new(profile), ahead: &log.route };
    let (mut first, mut second) = (seat(), seat());
    progress.set_length(log.frames.len() as u64);
    let mut steps = Vec::new();
    for (index, frame) in log.frames.iter().enumerate() {
        progress.set_message(frame.name.clone());
        let within = |e: model_compiler::error::Error| e.within(format!("step {}", frame.name));
        let sensed = rig.sense(frame).map_err(within)?;
        let infer = |inputs: &NetworkInputs| integers.infer(&sensed.inputs(inputs)?);
        let (int8, inputs) = first.step(&sensed.measurements, infer).map_err(within)?;
        let beside = float.as_ref().map(|network| {
            let infer = |inputs: &NetworkInputs| network.infer(&rig, &sensed.inputs(inputs)?, &image);
            second.step(&sensed.measurements, infer).map(|(decision, _)| decision).map_err(within)
        });
        let beside = beside.transpose()?;
        steps.push(DriveStep {
            name: frame.name.clone(),
            time_s: STEP_S * index as f64,
            speed_mps: match frame.measurements.speed {
                Reading::Value { value, .. } => Some(value.to_num()),
                _ => None,
            },
            goal_m: inputs.map(|inputs| inputs.goal.map(|meters| meters.to_num())).map(|[x, y]: [f64; 2]| [x, 0.0 - y]),
            command: inputs.map(|inputs| inputs.command.code()),
            waypoint_distance_m: beside.as_ref().and_then(|beside| distance(&int8, beside)),
            int8,
            float: beside,
        });
        progress.inc(1);
    }
    let model = ModelInfo { name: image.name().to_owned(), sha256: artifact::hex(&file.sha256()) };
    Ok(DriveReport { schema: SCHEMA, model, reference, summary: Summary::of(&steps), steps })
}

/// Mean distance of the waypoints.
fn distance(a: &Decision, b: &Decision) -> Option<f64> {
    let (a, b) = (a.waypoints.as_ref()?, b.waypoints.as_ref()?);
    let distances = a.iter().zip(b).map(|(a, b)| (a[0] - b[0]).hypot(a[1] - b[1]));
    (!a.is_empty()).then(|| distances.sum::<f64>() / a.len() as f64)
}
