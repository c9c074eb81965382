//! Whether the vehicle may be driven: what is measured must be there, recent and possible.

use super::Real;
use super::schedule::STEP_MS;
use core::fmt;
use serde::{Deserialize, Serialize};

/// One measurement as it reaches a step.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub enum Reading<T> {
    /// The sensor has said nothing yet, or no longer answers.
    Missing,
    /// The sensor answers, but with no number (a NaN).
    NotANumber,
    /// The sensor answers, but has said the same for longer than it can be true.
    Frozen,
    /// A value.
    Value {
        /// What was measured; `()` where the data go to the network by another way.
        value: T,
        /// Milliseconds since then.
        age_ms: u16,
    },
}

impl<T> Reading<T> {
    /// A value measured in this step.
    pub const fn now(value: T) -> Self {
        Self::Value { value, age_ms: 0 }
    }

    /// The value, if it is there and at most `limit_ms` old.
    pub(super) fn recent(self, sensor: Sensor, limit_ms: u16) -> Result<T, Fault> {
        match self {
            Self::Missing => Err(Fault::Missing(sensor)),
            Self::NotANumber => Err(Fault::Invalid(sensor)),
            Self::Frozen => Err(Fault::Frozen(sensor)),
            Self::Value { age_ms, .. } if age_ms > limit_ms => Err(Fault::Stale(sensor)),
            Self::Value { value, .. } => Ok(value),
        }
    }
}

/// What is supervised.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
#[repr(u8)]
pub enum Sensor {
    /// The image, or all images.
    Camera = 0,
    /// The LiDAR sweep.
    Lidar = 1,
    /// Speed over ground.
    Speed = 2,
    /// Place on the map.
    Position = 3,
    /// Heading.
    Compass = 4,
}

impl fmt::Display for Sensor {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            Self::Camera => "camera",
            Self::Lidar => "LiDAR",
            Self::Speed => "speed",
            Self::Position => "position",
            Self::Compass => "compass",
        })
    }
}

/// Why the vehicle is not driven.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub enum Fault {
    /// A sensor that the network needs says nothing.
    Missing(Sensor),
    /// The sensor's last measurement is too old.
    Stale(Sensor),
    /// The measurement is no number, or none that the vehicle can have.
    Invalid(Sensor),
    /// The sensor says the same again and again.
    Frozen(Sensor),
    /// There is no route.
    NoRoute,
    /// The network was not done in its step.
    NetworkOverrun,
    /// The network was refused or its image changed.
    NetworkFailed,
    /// The network's output is no possible plan: too few waypoints, too far ones, points above the horizon.
    InvalidOutput,
    /// Nothing came in time: the link or whoever feeds it is silent.
    Silence,
}

impl Fault {
    /// A number for logs and buses: the kind in steps of 16, plus the sensor.
    pub const fn code(self) -> u8 {
        match self {
            Self::Missing(sensor) => 0x10 | sensor as u8,
            Self::Stale(sensor) => 0x20 | sensor as u8,
            Self::Invalid(sensor) => 0x30 | sensor as u8,
            Self::NoRoute => 0x40,
            Self::NetworkOverrun => 0x50,
            Self::NetworkFailed => 0x60,
            Self::InvalidOutput => 0x70,
            Self::Frozen(sensor) => 0x80 | sensor as u8,
            Self::Silence => 0x90,
        }
    }
}

impl fmt::Display for Fault {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Missing(sensor) => write!(f, "{sensor} missing"),
            Self::Stale(sensor) => write!(f, "{sensor} too old"),
            Self::Invalid(sensor) => write!(f, "{sensor} invalid"),
            Self::Frozen(sensor) => write!(f, "{sensor} frozen"),
            Self::NoRoute => f.write_str("no route"),
            Self::NetworkOverrun => f.write_str("network not done in its step"),
            Self::NetworkFailed => f.write_str("network failed"),
            Self::InvalidOutput => f.write_str("network output invalid"),
            Self::Silence => f.write_str("nothing received in time"),
        }
    }
}

/// What the controls of a step are.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub enum Status {
    /// The controller's answer to the network.
    Driving,
    /// Zero: the first step fills buffers.
    Filling,
    /// The safe state, without a new fault: the vehicle is driven again when enough such steps have passed and the
    /// network has run in its turn.
    Recovering,
    /// The safe state, for this reason.
    Fault(Fault),
}

impl Status {
    /// A number for logs and buses: 0, 1, 2, or [`Fault::code`].
    pub const fn code(self) -> u8 {
        match self {
            Self::Driving => 0,
            Self::Filling => 1,
            Self::Recovering => 2,
            Self::Fault(fault) => fault.code(),
        }
    }
}

impl fmt::Display for Status {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Driving => f.write_str("driving"),
            Self::Filling => f.write_str("filling buffers"),
            Self::Recovering => f.write_str("recovering"),
            Self::Fault(fault) => fault.fmt(f),
        }
    }
}

/// What is still acceptable. A measurement older than its limit is too old.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Limits {
    /// Age of the image, milliseconds.
    pub camera_ms: u16,
    /// Age of the sweep, milliseconds; `None` for a system that reads none.
    pub lidar_ms: Option<u16>,
    /// Age of the speed, milliseconds.
    pub speed_ms: u16,
    /// Age of the position, milliseconds.
    pub position_ms: u16,
    /// Age of the heading, milliseconds; `None` for a system that steers by none.
    pub compass_ms: Option<u16>,
    /// From the begin of a step to the network's answer, milliseconds.
    pub network_ms: u16,
    /// Largest speed in either direction, m/s.
    pub speed: Real,
    /// Largest coordinate of the vehicle, meters.
    pub position: Real,
    /// Largest coordinate of a waypoint, meters.
    pub waypoint: Real,
    /// Steps without a fault after which the safe state ends.
    pub recovery_steps: u8,
}

impl Limits {
    /// Camera, LiDAR and compass: two missed steps of a fast sensor and four of a slow one; an answer within its step;
    /// no faster than 100 m/s, within 32 km of the map's origin, waypoints within the 128 m that the decoder can feed
    /// back; half a second of recovery.
    pub const CAMERA_AND_LIDAR: Self = Self {
        camera_ms: FAST_MS,
        lidar_ms: Some(FAST_MS),
        speed_ms: FAST_MS,
        position_ms: SLOW_MS,
        compass_ms: Some(SLOW_MS),
        network_ms: STEP_MS,
        speed: Real::lit("100"),
        position: Real::lit("32000"),
        waypoint: Real::lit("128"),
        recovery_steps: 10,
    };
    /// The same without a LiDAR.
    pub const CAMERA: Self = Self { lidar_ms: None, ..Self::CAMERA_AND_LIDAR };
    /// The same without LiDAR and compass.
    pub const CAMERA_WITHOUT_COMPASS: Self = Self { compass_ms: None, ..Self::CAMERA };
}

const FAST_MS: u16 = 2 * STEP_MS;
const SLOW_MS: u16 = 4 * STEP_MS;

/// How often what happened, since the start; the counts stop at their largest value.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub struct Counters {
    /// Steps.
    pub steps: u32,
    /// Ticks that passed without a step.
    pub skipped: u32,
    /// Steps for which the network was asked.
    pub network_runs: u32,
    /// Steps in the safe state, recovery included.
    pub safe_steps: u32,
    /// Compasses without a number for which the system has a substitute.
    pub substituted_headings: u32,
    /// [`Fault::Missing`].
    pub missing: u32,
    /// [`Fault::Stale`].
    pub stale: u32,
    /// [`Fault::Invalid`].
    pub invalid: u32,
    /// [`Fault::Frozen`].
    pub frozen: u32,
    /// [`Fault::NoRoute`].
    pub no_route: u32,
    /// [`Fault::NetworkOverrun`].
    pub overruns: u32,
    /// [`Fault::NetworkFailed`].
    pub network_failures: u32,
    /// [`Fault::InvalidOutput`].
    pub invalid_outputs: u32,
    /// [`Fault::Silence`].
    pub silences: u32,
}

impl Counters {
    /// One more fault of its kind.
    pub(super) fn count(&mut self, fault: Fault) {
        let counter = match fault {
            Fault::Missing(_) => &mut self.missing,
            Fault::Stale(_) => &mut self.stale,
            Fault::Invalid(_) => &mut self.invalid,
            Fault::Frozen(_) => &mut self.frozen,
            Fault::NoRoute => &mut self.no_route,
            Fault::NetworkOverrun => &mut self.overruns,
            Fault::NetworkFailed => &mut self.network_failures,
            Fault::InvalidOutput => &mut self.invalid_outputs,
            Fault::Silence => &mut self.silences,
        };
        *counter = counter.saturating_add(1);
    }
}

/// The way into the safe state and out of it: in at the first fault, out after the recovery steps without one.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Supervisor {
    remaining: u8,
}

impl Supervisor {
    /// A fault: the safe state begins, or begins anew.
    pub fn fail(&mut self, limits: &Limits) {
        self.remaining = limits.recovery_steps.max(1);
    }

    /// A step without a fault. Whether it still belongs to the safe state.
    pub fn pass(&mut self) -> bool {
        let safe = self.remaining > 0;
        self.remaining = self.remaining.saturating_sub(1);
        safe
    }
}
