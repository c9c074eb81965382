//! Runs the firmware's engine on the host and says how good its numbers are.
//!
//! * [`backends`]: which of the firmware's kernels this machine can run
//! * [`mod@bench`]: latency per step and whole, the backends side by side
//! * [`demo`]: the whole way on the files of the source tree, without arguments
//! * [`run`]: waypoints, [`controls`], [`points`] or classes of frames, int8 from an image or f32 from a checkpoint
//! * [`system`]: which of the published systems a network is; [`answer`]: its output as the firmware's driver takes it
//! * [`verify`]: the engine's bytes against an independent f64 model of the arithmetic, step by step, and beside it the
//!   f32 network: how much precision each step costs
//! * [`attention`]: how often the fusing transformer looks from one sensor to the other, in integers and in f32
//! * [`metrics`]: how well a car drove, from the logs of whole routes
//! * [`mod@drive`]: a recorded sequence through sensors, network, planner and controller, int8 beside f32
//! * [`report`]: what was found, as text, JSON and one HTML page; [`diff`] against an earlier report, [`gates`] for CI,
//!   and where the noise at the output comes from ([`noise`])
//!
//! ```text
//!             ┌► engine (the firmware's own code) ─► bytes of every step ─┐
//! raw inputs ─┼► f64 model, from the build record ─► bytes of every step ─┴► compare: must be equal   (compare)
//!             └► f32 reference, from the checkpoint ► activations ─────────► statistics per step       (statistics)
//! ```
//!
//! [`trace`] takes one frame that way; memory holds one frame at a time, figures are summed over frames.
#![forbid(unsafe_code)]

pub mod ablation;
pub mod answer;
pub mod attention;
pub mod backends;
pub mod bench;
pub mod buffers;
pub mod channels;
pub mod classification;
pub mod cli;
pub mod codes;
pub mod compare;
pub mod controls;
pub mod demo;
pub mod diff;
pub mod drive;
pub mod files;
pub mod footprint;
pub mod gates;
pub mod histogram;
pub mod metrics;
pub mod noise;
pub mod points;
pub mod report;
pub mod run;
pub mod statistics;
pub mod system;
pub mod trace;
pub mod verify;

#[cfg(test)]
mod testing;
