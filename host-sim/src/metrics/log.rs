//! The log of one drive: what a closed loop writes and [`super::score`] reads.

use super::SCHEMA;
use model_compiler::error::{Error, ErrorCode, Result};
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use std::path::Path;

/// The remedy for a log that is none.
const FORMAT: &str = "`host-sim schema route-log` prints the format";

/// One drive along one route. Positions are in one fixed frame of the map, in meters.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct RouteLog {
    /// Version of this structure.
    pub schema: u32,
    /// Name of the route.
    pub route: String,
    /// Where the route goes, `[x, y]` in m, from start to end; a waypoint every meter or two.
    pub waypoints: Vec<[f64; 2]>,
    /// Where the car was, at every step of the simulation or at some; time grows.
    pub ego: Vec<EgoState>,
    /// What it did wrong, in any order.
    #[serde(default)]
    pub events: Vec<Event>,
}

/// The car at one moment.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct EgoState {
    /// Time, s.
    pub time_s: f64,
    /// `[x, y]`, m.
    pub position_m: [f64; 2],
    /// Speed, m/s; negative in reverse.
    pub speed_mps: f64,
    /// Whether it came here from the state before outside the lanes of the route: more than half a lane width and 1.3 m
    /// off the lane's center, or in a lane of another direction.
    #[serde(default)]
    pub outside_lanes: bool,
}

/// An infraction.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct Event {
    /// When, s.
    pub time_s: f64,
    /// What.
    pub kind: EventKind,
}

/// Kinds of infractions with a factor of their own.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "snake_case")]
pub enum EventKind {
    /// Collision with a pedestrian.
    CollisionPedestrian,
    /// Collision with another vehicle.
    CollisionVehicle,
    /// Collision with anything that does not move.
    CollisionStatic,
    /// Running a red light.
    RedLight,
    /// Running a stop sign.
    StopSign,
}

impl RouteLog {
    /// Reads a log file and checks it.
    ///
    /// # Errors
    /// The file cannot be read, is no such log, or fails [`Self::check`].
    pub fn read(path: &Path) -> Result<Self> {
        let bytes = std::fs::read(path).map_err(|e| Error::io(path, &e))?;
        let log: Self = serde_json::from_slice(&bytes).map_err(|e| {
            let error =
                Error::new(ErrorCode::Malformed, path.display().to_string(), format!("this is no route log: {e}"));
            error.with_help(FORMAT)
        })?;
        log.check().map_err(|e| e.within(path.display()))?;
        Ok(log)
    }

    /// Checks that the log holds a drive along a route.
    ///
    /// # Errors
    /// [`ErrorCode::Malformed`] with the field: another version, a route without length, no state, a number that is not
    /// finite, time that does not grow, an event outside the time of the drive.
    pub fn check(&self) -> Result<()> {
        let refuse =
            |place: String, message: String| Err(Error::new(ErrorCode::Malformed, place, message).with_help(FORMAT));
        if self.schema != SCHEMA {
            return refuse("schema".into(), format!("found version {}, expected {SCHEMA}", self.schema));
        }
        for (index, waypoint) in self.waypoints.iter().enumerate() {
            if !waypoint.iter().all(|value| value.is_finite()) {
                return refuse(format!("waypoints[{index}]"), "its coordinates are not finite".into());
            }
        }
        if self.waypoints.windows(2).all(|pair| pair[0] == pair[1]) {
            let message = format!("found {} waypoints, expected two at different places", self.waypoints.len());
            return refuse("waypoints".into(), message);
        }
        for (index, state) in self.ego.iter().enumerate() {
            let [x, y] = state.position_m;
            if ![state.time_s, x, y, state.speed_mps].into_iter().all(f64::is_finite) {
                return refuse(format!("ego[{index}]"), "its time, position or speed is not finite".into());
            }
        }
        let (Some(first), Some(last)) = (self.ego.first(), self.ego.last()) else {
            return refuse("ego".into(), "the log holds no state of the car, expected at least one".into());
        };
        for (index, pair) in self.ego.windows(2).enumerate() {
            if pair[0].time_s >= pair[1].time_s {
                let message = format!("time is {} s after {} s, expected a later one", pair[1].time_s, pair[0].time_s);
                return refuse(format!("ego[{}]", index + 1), message);
            }
        }
        let drive = first.time_s..=last.time_s;
        match self.events.iter().position(|event| !drive.contains(&event.time_s)) {
            None => Ok(()),
            Some(index) => {
                let (from, to, found) = (first.time_s, last.time_s, self.events[index].time_s);
                refuse(format!("events[{index}]"), format!("it is at {found} s, the drive from {from} s to {to} s"))
            }
        }
    }
}
