//! The driver: measurements in, a request to the network out; the network's answer in, controls out.

use super::controller::Controller;
use super::controls::Controls;
use super::pose::{Point, Position, velocity_code};
use super::profile::{Answer, Profile};
use super::projection::GroundCamera;
use super::route::{Command, Planner};
use super::schedule::{Schedule, Turn};
use super::supervision::{Counters, Fault, Limits, Reading, Sensor, Status, Supervisor};
use super::{DEFAULT_ROUTE, Real};
use crate::waypoint::Waypoint;
use fixed::types::{I8F8, I16F16};
use serde::{Deserialize, Serialize};

/// What the sensors say in one step.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub struct Measurements {
    /// Whether there is an image; its pixels go to the network's input. [`Camera::finish`] says it of each camera
    /// (`Reading::from`): missing rows are [`Reading::Missing`], a frozen image is [`Reading::Frozen`]. Of several
    /// cameras the first that gave no value counts.
    ///
    /// [`Camera::finish`]: crate::sensors::camera::Camera::finish
    pub camera: Reading<()>,
    /// Whether there is a sweep; its histogram goes to the network's input. [`Sweep::finish`] says it
    /// (`Reading::from`): a sweep without a point is [`Reading::Missing`], one without a finite point
    /// [`Reading::NotANumber`].
    ///
    /// [`Sweep::finish`]: crate::sensors::lidar::Sweep::finish
    pub lidar: Reading<()>,
    /// Forward speed, m/s; negative when reversing.
    pub speed: Reading<Real>,
    /// Where the vehicle is.
    pub position: Reading<Position>,
    /// Heading in radians: 0 is north, clockwise.
    pub compass: Reading<Real>,
}

/// Inputs of the network that do not come from camera and LiDAR, as its input tensors hold them.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub struct NetworkInputs {
    /// The next node of the route in the vehicle's frame, meters: `[right, −forward]`. Without meaning for a system
    /// that uses no compass.
    pub goal: [I16F16; 2],
    /// Forward speed, m/s.
    pub velocity: I8F8,
    /// What to do at the next node.
    pub command: Command,
}

impl NetworkInputs {
    /// The goal tensor's bytes.
    pub const fn goal_bytes(&self) -> [u8; 8] {
        let [right, backward] = self.goal;
        let [a, b, c, d] = right.to_le_bytes();
        let [e, f, g, h] = backward.to_le_bytes();
        [a, b, c, d, e, f, g, h]
    }

    /// The velocity tensor's bytes.
    pub const fn velocity_bytes(&self) -> [u8; 2] {
        self.velocity.to_le_bytes()
    }

    /// The command tensor's byte.
    pub const fn command_bytes(&self) -> [u8; 1] {
        [self.command.code()]
    }
}

/// What a network gave.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum NetworkOutput<'a> {
    /// Waypoints ([`crate::waypoint::read`]).
    Waypoints(&'a [Waypoint]),
    /// Points in the image, `[column, row]` in 1/64 pixel.
    ImagePoints(&'a [[i32; 2]]),
    /// Steer, throttle and brake as logistic values in Q15.
    Controls([i16; 3]),
}

/// Why a network gave nothing.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub enum NetworkError {
    /// It was given up because it was not done in time.
    Overrun,
    /// The engine refused.
    Failed,
}

/// What one step tells the actuators, and why.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub struct Output {
    /// For the actuators, in every case.
    pub controls: Controls,
    /// Where they come from.
    pub status: Status,
}

/// What a network's answer comes down to. A copy of it is driven on in steps without a network; nothing changes it.
#[derive(Clone, Copy, Debug)]
enum Plan {
    Points([Point; 2]),
    Controls(Controls),
}

impl Plan {
    fn controls(self, controller: &mut Controller, speed: Real) -> Controls {
        match self {
            Self::Points(points) => controller.step(points, speed),
            Self::Controls(controls) => controls,
        }
    }
}

/// Answer to [`Driver::step`].
#[derive(Debug)]
pub enum Step<'a, const N: usize> {
    /// Run the network now, then call [`Pending::finish`].
    Network(Pending<'a, N>),
    /// The step is done without the network.
    Done(Output),
}

/// A step that waits for the network. Dropped unfinished, it counts as an overrun in the next step.
#[derive(Debug)]
#[must_use = "the step ends with `finish`"]
pub struct Pending<'a, const N: usize> {
    driver: &'a mut Driver<N>,
    inputs: NetworkInputs,
    speed: Real,
}

impl<const N: usize> Pending<'_, N> {
    /// What the network's small inputs are.
    pub const fn inputs(&self) -> &NetworkInputs {
        &self.inputs
    }

    /// Ends the step with what the network gave, `elapsed_ms` after the step began. An answer later than
    /// [`Limits::network_ms`] is not driven: the measurements that it is made of are past.
    ///
    /// Nothing here runs while the network does. A network that never ends leaves the actuators as the step before set
    /// them, so they need a watchdog of their own, which brakes when no controls have come for a few steps.
    pub fn finish(self, output: Result<NetworkOutput<'_>, NetworkError>, elapsed_ms: u16) -> Output {
        let Self { driver, speed, .. } = self;
        driver.awaiting = false;
        let plan = match output {
            Ok(_) if elapsed_ms > driver.profile.limits.network_ms => Err(Fault::NetworkOverrun),
            Ok(output) => plan(&driver.profile.answer, &driver.profile.limits, output),
            Err(NetworkError::Overrun) => Err(Fault::NetworkOverrun),
            Err(NetworkError::Failed) => Err(Fault::NetworkFailed),
        };
        match plan {
            Ok(plan) => driver.drive(plan, speed),
            Err(fault) => driver.stop(fault),
        }
    }
}

/// Drives one vehicle by one network, 20 steps per second, along a route of at most N nodes at a time.
///
/// Every step ends with controls. A fault leads to the safe state at once: full brake, no throttle, the steering as it
/// was last. There the controller forgets its errors and the last waypoints are dropped; after
/// [`Limits::recovery_steps`] steps without a fault, in which the network runs and its answers are examined but not
/// driven, the vehicle is driven again. In recovery too the network runs only where the [schedule](super::schedule)
/// says: between those steps the sweep is not the one that it was trained with.
#[derive(Clone, Debug)]
pub struct Driver<const N: usize = DEFAULT_ROUTE> {
    profile: Profile,
    planner: Planner<N>,
    controller: Controller,
    schedule: Schedule,
    supervisor: Supervisor,
    counters: Counters,
    plan: Option<Plan>,
    steer: Real,
    awaiting: bool,
}

impl<const N: usize> Driver<N> {
    /// A driver before its first step, without a route.
    pub fn new(profile: Profile) -> Self {
        Self {
            profile,
            planner: Planner::new(profile.horizon),
            controller: Controller::new(profile.tuning),
            schedule: Schedule::new(profile.cadence),
            supervisor: Supervisor::default(),
            counters: Counters::default(),
            plan: None,
            steer: Real::ZERO,
            awaiting: false,
        }
    }

    /// The route, to add nodes to.
    pub const fn route(&mut self) -> &mut Planner<N> {
        &mut self.planner
    }

    /// What happened so far.
    pub const fn counters(&self) -> &Counters {
        &self.counters
    }

    /// Begins the next step. The schedule counts the ticks of the vehicle's clock, which the LiDAR turns by: call this
    /// once per tick of [`STEP_MS`](super::schedule::STEP_MS), and [`Self::skip`] for a tick that went by without it.
    pub fn step(&mut self, measurements: &Measurements) -> Step<'_, N> {
        self.counters.steps = self.counters.steps.saturating_add(1);
        let turn = self.schedule.advance();
        if core::mem::take(&mut self.awaiting) {
            return Step::Done(self.stop(Fault::NetworkOverrun));
        }
        let (inputs, speed) = match self.sense(measurements) {
            Ok(sensed) => sensed,
            Err(fault) => return Step::Done(self.stop(fault)),
        };
        match (turn, self.plan) {
            (Turn::Fill, _) => Step::Done(Output { controls: Controls::ZERO, status: Status::Filling }),
            (Turn::Reuse, Some(plan)) => Step::Done(self.drive(plan, speed)),
            (Turn::Reuse, None) => {
                self.supervisor.pass();
                Step::Done(self.safe(Status::Recovering))
            }
            (Turn::Network, _) => {
                self.counters.network_runs = self.counters.network_runs.saturating_add(1);
                self.awaiting = true;
                Step::Network(Pending { driver: self, inputs, speed })
            }
        }
    }

    /// Passes a tick in which no step was possible, for instance because the network of the step before was still
    /// running. No waypoints from before it are driven on: if it was the network's turn, the vehicle brakes until the
    /// next one.
    pub fn skip(&mut self) {
        self.counters.skipped = self.counters.skipped.saturating_add(1);
        self.schedule.advance();
        self.plan = None;
    }

    /// Enters the safe state between two steps, for a fault that is no step's: nothing was received in time, or the
    /// background self-test failed. The schedule stays where it is.
    pub fn halt(&mut self, fault: Fault) -> Output {
        self.stop(fault)
    }

    /// Checks the measurements and follows the route: inputs of the network and the speed.
    fn sense(&mut self, measurements: &Measurements) -> Result<(NetworkInputs, Real), Fault> {
        let Measurements { camera, lidar, speed, position, compass } = *measurements;
        let limits = self.profile.limits;
        camera.recent(Sensor::Camera, limits.camera_ms)?;
        limits.lidar_ms.map_or(Ok(()), |limit_ms| lidar.recent(Sensor::Lidar, limit_ms))?;
        let speed = speed.recent(Sensor::Speed, limits.speed_ms)?;
        if !within(limits.speed, speed) {
            return Err(Fault::Invalid(Sensor::Speed));
        }
        let own = position.recent(Sensor::Position, limits.position_ms)?;
        if !(within(limits.position, own.north) && within(limits.position, own.east)) {
            return Err(Fault::Invalid(Sensor::Position));
        }
        let heading = match (limits.compass_ms, compass, self.profile.substitute_heading) {
            (None, _, _) => Real::ZERO,
            (Some(_), Reading::NotANumber, Some(substitute)) => {
                self.counters.substituted_headings = self.counters.substituted_headings.saturating_add(1);
                substitute
            }
            (Some(limit_ms), _, _) => compass.recent(Sensor::Compass, limit_ms)?,
        };
        let node = self.planner.advance(own).ok_or(Fault::NoRoute)?;
        let goal = Point::seen_from(own, heading, node.position).goal_codes();
        Ok((NetworkInputs { goal, velocity: velocity_code(speed), command: node.command }, speed))
    }

    /// Ends a step without a fault.
    fn drive(&mut self, plan: Plan, speed: Real) -> Output {
        if self.supervisor.pass() {
            return self.safe(Status::Recovering);
        }
        self.plan = Some(plan);
        let controls = plan.controls(&mut self.controller, speed);
        self.steer = controls.steer;
        Output { controls, status: Status::Driving }
    }

    /// Ends a step with a fault.
    fn stop(&mut self, fault: Fault) -> Output {
        self.counters.count(fault);
        self.supervisor.fail(&self.profile.limits);
        self.controller.reset();
        self.plan = None;
        self.safe(Status::Fault(fault))
    }

    fn safe(&mut self, status: Status) -> Output {
        self.counters.safe_steps = self.counters.safe_steps.saturating_add(1);
        Output { controls: Controls::stop(self.steer), status }
    }
}

impl Profile {
    /// Controls of one answer at a speed in m/s, without the steps before: of a controller in its fresh state.
    ///
    /// # Errors
    /// The fault of a [`Driver`]'s step: a speed that the vehicle cannot have, an output that is no possible plan.
    pub fn controls(&self, output: NetworkOutput<'_>, speed: Real) -> Result<Controls, Fault> {
        if !within(self.limits.speed, speed) {
            return Err(Fault::Invalid(Sensor::Speed));
        }
        Ok(plan(&self.answer, &self.limits, output)?.controls(&mut Controller::new(self.tuning), speed))
    }
}

/// What the controller makes of a network's output; the fault if it is none that the system gives.
fn plan(answer: &Answer, limits: &Limits, output: NetworkOutput<'_>) -> Result<Plan, Fault> {
    let points = match (answer, output) {
        (Answer::Waypoints, NetworkOutput::Waypoints([first, second, ..])) => [*first, *second].map(Point::from),
        (Answer::ImagePoints(camera), NetworkOutput::ImagePoints([first, second, ..])) => {
            let ground =
                |camera: &GroundCamera, code| camera.ground(camera.image_point(code)).ok_or(Fault::InvalidOutput);
            [ground(camera, *first)?, ground(camera, *second)?]
        }
        (Answer::Controls, NetworkOutput::Controls(logistic)) => {
            return Ok(Plan::Controls(Controls::from_logistic(logistic).exclusive()));
        }
        _ => return Err(Fault::InvalidOutput),
    };
    let possible = |point: &Point| within(limits.waypoint, point.right) && within(limits.waypoint, point.forward);
    if points.iter().all(possible) { Ok(Plan::Points(points)) } else { Err(Fault::InvalidOutput) }
}

fn within(limit: Real, value: Real) -> bool {
    value.unsigned_abs() <= limit.unsigned_abs()
}

#[cfg(test)]
#[allow(
    clippy::unwrap_used,
    clippy::panic,
    clippy::indexing_slicing,
    clippy::arithmetic_side_effects,
    reason = "what is missing fails the test"
)]
mod tests;
