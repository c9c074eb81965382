//! What a board answers.

use crate::actuators::{ActuatorFault, Duties};
use crate::drive::{Controls, Counters, Status};
use crate::update::TargetName;
use crate::waypoint::{MAX_WAYPOINTS, Waypoint};
use core::fmt;
use heapless::Vec;
use serde::{Deserialize, Serialize};

/// A message from a board.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub enum Response<'a> {
    /// To [`super::Request::Identify`].
    #[serde(borrow)]
    Identity(Identity<'a>),
    /// The request was carried out.
    Accepted {
        /// Its sequence number.
        request: u16,
    },
    /// The request was not carried out.
    Refused {
        /// Its sequence number.
        request: u16,
        /// Why.
        reason: Refusal,
    },
    /// A step of the network was run.
    Step(StepReport),
    /// Part of an output of the network.
    Output {
        /// Which output, in the image's order.
        output: u8,
        /// First byte within the output.
        offset: u32,
        /// Bytes.
        bytes: &'a [u8],
    },
    /// To [`super::Request::End`]; also unasked, when the vehicle was stopped for silence.
    Telemetry(Telemetry),
}

/// A board and its image.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Identity<'a> {
    /// [`super::PROTOCOL`] of the board.
    pub protocol: u16,
    /// Name of the board.
    pub board: &'a str,
    /// Name of the model.
    pub model: &'a str,
    /// SHA-256 of the quantized model.
    pub qmodel_digest: [u8; 32],
    /// Digest that names the build of the image.
    pub build_digest: [u8; 32],
    /// Length of the image.
    pub image_bytes: u32,
    /// CRC-32 of the image's header and thereby of all section CRCs.
    pub header_crc: u32,
    /// Revision of the model.
    pub revision: u32,
    /// Target that the image was compiled for.
    pub target: TargetName,
    /// Ticks of the board's clock per second.
    pub hertz: u64,
    /// Ticks that `Image::parse` took.
    pub parse_ticks: u64,
    /// Ticks that `Image::check` took.
    pub check_ticks: u64,
}

/// A step of the network.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct StepReport {
    /// Position in the program.
    pub step: u16,
    /// CRC-32 of the bytes it wrote.
    pub crc: u32,
    /// Ticks of the board's clock that it took.
    pub ticks: u64,
}

/// How a frame ended.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Telemetry {
    /// Number of the frame; of the last one where the vehicle was stopped for silence.
    pub frame: u32,
    /// What the controls are.
    pub status: Status,
    /// What the actuators were told, or would have been.
    pub controls: Controls,
    /// What the actuators were set to; `None` where the frame was not driven but only run through the network.
    pub duties: Option<Result<Duties, ActuatorFault>>,
    /// What the network answered.
    pub answer: Answer,
    /// Ticks of the board's clock that the network's steps took; 0 where it did not run.
    pub network_ticks: u64,
    /// What happened since the drive began.
    pub counters: Counters,
    /// What happened on the line since the board's start.
    pub link: LinkCounters,
    /// Known answers that were met since the board's start.
    pub self_tests: u32,
    /// Deepest stack since the board's start, bytes, where the board tells.
    pub stack_bytes: Option<u32>,
}

/// What a network answered.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub enum Answer {
    /// It did not run, was given up, or is no driving network.
    #[default]
    None,
    /// Waypoints.
    Waypoints(Vec<Waypoint, MAX_WAYPOINTS>),
    /// Points in the image, `[column, row]` in 1/64 pixel.
    ImagePoints(Vec<[i32; 2], MAX_WAYPOINTS>),
    /// Steer, throttle and brake as logistic values in Q15.
    Controls([i16; 3]),
}

/// What happened on the line.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub struct LinkCounters {
    /// Packets received whole.
    pub packets: u32,
    /// Packets received damaged.
    pub damaged: u32,
    /// Packets missing in the sequence, the damaged ones included.
    pub lost: u32,
    /// Packets that came again, or too late; they are left out.
    pub repeated: u32,
    /// Bytes that found the board's buffer full while the network ran.
    pub overflowed: u32,
    /// Frames that were not driven for what was lost in them.
    pub incomplete_frames: u32,
    /// Frames that another one cut off, or that never ended.
    pub abandoned_frames: u32,
}

/// Why a request was not carried out.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub enum Refusal {
    /// There is no image to run: it is damaged, or not for this board.
    NoImage,
    /// A piece or an end of a frame without a begin, or after a loss that cost it.
    NoFrame,
    /// The frame's number is not above the one before.
    OldFrame {
        /// Number of the frame before.
        last: u32,
    },
    /// The known answer was not met yet, and the configuration asks for it.
    Untested,
    /// The known answer was not met.
    SelfTestFailed {
        /// First step that gave other bytes, where one did.
        step: Option<u16>,
    },
    /// The configuration fits no camera, or not this image.
    Configuration,
    /// The network reads nothing of this sensor.
    NoSuchSensor,
    /// A piece that the sensor or input refuses: outside of it, out of order, or not whole.
    Piece,
    /// The network's inputs are not complete.
    InputsMissing,
    /// The image is no driving network's.
    NoDriver,
    /// The route holds as many nodes as it can.
    RouteFull,
    /// This board's program does not end.
    NoHalt,
    /// The new image, or a piece of it.
    Update(UpdateRefusal),
}

impl fmt::Display for Refusal {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::NoImage => f.write_str("the board's image is damaged, or not for this board"),
            Self::NoFrame => f.write_str("no frame was begun, or what was lost cost its begin"),
            Self::OldFrame { last } => write!(f, "the frame's number is not above the last one, {last}"),
            Self::Untested => f.write_str("the board did not meet the image's known answer yet"),
            Self::SelfTestFailed { step: Some(step) } => write!(f, "step {step} does not give the known answer"),
            Self::SelfTestFailed { step: None } => f.write_str("the image has no known answer, or changed"),
            Self::Configuration => f.write_str("no camera of this configuration fills the network's input"),
            Self::NoSuchSensor => f.write_str("the network reads nothing of this sensor"),
            Self::Piece => f.write_str("the piece lies outside of its sensor or input, or out of order"),
            Self::InputsMissing => f.write_str("the network's inputs are not complete"),
            Self::NoDriver => f.write_str("the image is no driving network's"),
            Self::RouteFull => f.write_str("the route is full; nodes that were passed make room"),
            Self::NoHalt => f.write_str("this board's program does not end"),
            Self::Update(refusal) => refusal.fmt(f),
        }
    }
}

impl core::error::Error for Refusal {}

/// Why a new image, or a piece of it, is not taken.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub enum UpdateRefusal {
    /// This board has no memory for a second image.
    NoStore,
    /// It has more bytes than a slot.
    TooLarge {
        /// Bytes of the image.
        found: u32,
        /// Bytes of the slot.
        capacity: u32,
    },
    /// It was compiled for another target.
    ForeignTarget {
        /// The image's.
        found: TargetName,
        /// The board's.
        expected: TargetName,
    },
    /// It needs features or kernels that this board does not have: their bits.
    Features(u64),
    /// It needs more arena than the board has in a memory region.
    Arena {
        /// The region, by position.
        region: u8,
        /// Bytes that it needs.
        needed: u32,
        /// Bytes that are there.
        found: u32,
    },
    /// It has other inputs or outputs than the application needs.
    Interface,
    /// It is older than the image that runs.
    Older {
        /// Its revision.
        found: u32,
        /// That of the image that runs.
        running: u32,
    },
    /// It is the image that runs.
    Running,
    /// What was received differs from what was announced.
    NotAnnounced,
    /// It is damaged, or no image of this format.
    Damaged,
    /// The running image is on trial: it has to meet its known answer first.
    OnTrial,
    /// None was announced.
    NotBegun,
    /// A piece does not continue the one before.
    OutOfOrder {
        /// The byte that is next.
        expected: u32,
    },
    /// A piece ends behind the image.
    TooLong {
        /// Bytes of the image.
        announced: u32,
    },
    /// Bytes are missing.
    Incomplete {
        /// Bytes that came.
        found: u32,
    },
    /// The memory failed.
    Flash,
}

impl fmt::Display for UpdateRefusal {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::NoStore => f.write_str("this board has no memory for a second image"),
            Self::TooLarge { found, capacity } => write!(f, "image of {found} bytes, the slot has room for {capacity}"),
            Self::ForeignTarget { found, expected } => {
                write!(f, "image compiled for target {found}, this board is {expected}")
            }
            Self::Features(bits) => write!(f, "image needs features that this board does not have (bits {bits:#x})"),
            Self::Arena { region, needed, found } => {
                write!(f, "memory region {region}: image needs {needed} bytes of arena, there are {found}")
            }
            Self::Interface => f.write_str("image has other inputs or outputs than the running one"),
            Self::Older { found, running } => {
                write!(f, "image of revision {found} is older than the running {running}")
            }
            Self::Running => f.write_str("this image runs already"),
            Self::NotAnnounced => f.write_str("what was received is not what was announced"),
            Self::Damaged => f.write_str("what was received is damaged, or no image of this format"),
            Self::OnTrial => f.write_str("the running image is on trial and has to meet its known answer first"),
            Self::NotBegun => f.write_str("no image was announced"),
            Self::OutOfOrder { expected } => write!(f, "a piece is out of order: byte {expected} is next"),
            Self::TooLong { announced } => write!(f, "a piece ends behind the {announced} bytes that were announced"),
            Self::Incomplete { found } => write!(f, "only {found} bytes of the image came"),
            Self::Flash => f.write_str("the flash failed"),
        }
    }
}

impl core::error::Error for UpdateRefusal {}
