//! The drive layer: from what the sensors measure to what the actuators are told, around one network.
//!
//! ```
//! use firmware::drive::{Driver, Measurements, NetworkOutput, Output, Position, Reading, Real, Step};
//! use firmware::drive::{Command, RouteNode, System};
//! use firmware::waypoint::Waypoint;
//!
//! let mut driver: Driver = Driver::new(System::TransFuser.profile());
//! let position = Position { north: Real::from_num(30), east: Real::from_num(5) };
//! driver.route().push(RouteNode { position, command: Command::LaneFollow })?;
//!
//! // Twenty times a second:
//! let measurements = Measurements {
//!     camera: Reading::now(()),
//!     lidar: Reading::now(()),
//!     speed: Reading::now(Real::from_num(3.5)),
//!     position: Reading::now(Position::default()),
//!     compass: Reading::now(Real::from_num(0.1)),
//! };
//! # let infer = |goal: [u8; 8], velocity: [u8; 2]| [Waypoint::default(); 4];
//! # let elapsed_ms = || 31;
//! let Output { controls, status } = match driver.step(&measurements) {
//!     Step::Network(pending) => {
//!         let inputs = pending.inputs();
//!         let waypoints = infer(inputs.goal_bytes(), inputs.velocity_bytes()); // start, step, …, waypoints
//!         pending.finish(Ok(NetworkOutput::Waypoints(&waypoints)), elapsed_ms())
//!     }
//!     Step::Done(output) => output,
//! };
//! println!("{status}: steer {}, throttle {}, brake {}", controls.steer, controls.throttle, controls.brake);
//! # Ok::<(), firmware::drive::RouteFull>(())
//! ```
//!
//! # Parts
//!
//! * [`driver`]: one step from end to end, and the safe state.
//! * [`profile`]: the six published systems as data.
//! * [`supervision`]: what counts as a fault, status codes, counters.
//! * [`schedule`]: on which steps the network runs.
//! * [`route`]: which node to head for; [`pose`]: where it is as the vehicle sees it.
//! * [`controller`], [`pid`]: from waypoints to controls; [`projection`]: from image points to waypoints.
//! * [`trigonometry`]: what the others need of it.
//!
//! All numbers are fixed point with 32 fraction bits ([`Real`]); arithmetic saturates, so every input gives a defined
//! output, the same on every machine. Floats serve once, as the first guess of an arctangent.

#![deny(
    clippy::indexing_slicing,
    clippy::arithmetic_side_effects,
    clippy::unwrap_used,
    clippy::expect_used,
    clippy::panic
)]

pub mod controller;
pub mod controls;
pub mod driver;
pub mod pid;
pub mod pose;
pub mod profile;
pub mod projection;
pub mod route;
pub mod schedule;
pub mod supervision;
pub mod trigonometry;

pub use controller::Controller;
pub use controls::Controls;
pub use driver::{Driver, Measurements, NetworkError, NetworkInputs, NetworkOutput, Output, Pending, Step};
pub use pose::{GpsPlane, Point, Position};
pub use profile::{Profile, System};
pub use route::{Command, Planner, RouteFull, RouteNode};
pub use supervision::{Counters, Fault, Reading, Sensor, Status};

/// Number of the drive layer: meters, m/s, radians, shares of an actuator's way. ±2³¹ in steps of 2⁻³².
pub type Real = fixed::types::I32F32;

/// Nodes that a [`Driver`] holds if not told otherwise: some kilometers of a sparse route.
pub const DEFAULT_ROUTE: usize = 128;
