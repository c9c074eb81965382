//! What a feeder asks of a board.

use crate::drive::schedule::STEP_MS;
use crate::drive::{Measurements, NetworkInputs, RouteNode};
use crate::sensors::camera::{PixelFormat, Scale};
use crate::sensors::lidar::Axes;
use crate::sensors::views::View;
use crate::update::Manifest;
use fixed::types::I16F16;
use serde::{Deserialize, Serialize};

/// A message to a board.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub enum Request<'a> {
    /// Who is there: [`super::Response::Identity`].
    Identify,
    /// What the sensors are and what is tolerated. Ends a drive under way: everything begins anew.
    Configure(Configuration),
    /// Runs the image's known answer now.
    SelfTest,
    /// The next node of the route.
    Route(RouteNode),
    /// A frame begins. A frame under way is given up; numbers that were left out count as ticks without a frame.
    Begin {
        /// Number of the frame: ticks of the vehicle's clock.
        frame: u32,
        /// What to report beside the telemetry.
        detail: Detail,
    },
    /// Part of a row of a camera's image, see [`crate::sensors::camera::Camera::push`].
    Row {
        /// Which camera.
        view: View,
        /// Row of the image in memory.
        row: u16,
        /// First byte within the row.
        offset: u32,
        /// Bytes of pixels, at most [`super::MAX_PIECE`].
        bytes: &'a [u8],
    },
    /// Points of the LiDAR: x, y, z as little-endian f32 each, a multiple of 12 bytes, at most [`super::MAX_PIECE`].
    Points(&'a [u8]),
    /// Part of a network input as the network reads it, in order from offset 0; takes the place of the sensor that
    /// would fill it.
    Input {
        /// Which input, in the image's order.
        input: u8,
        /// First byte within the input.
        offset: u32,
        /// Bytes, at most [`super::MAX_PIECE`].
        bytes: &'a [u8],
    },
    /// The frame is complete: [`super::Response::Telemetry`].
    End(End),
    /// A new image is to come; it is refused before a byte is erased if it is not for this board.
    Announce(Manifest),
    /// The next piece of the new image.
    Piece {
        /// Its first byte within the image.
        offset: u32,
        /// Bytes, at most [`super::MAX_PIECE`].
        bytes: &'a [u8],
    },
    /// The new image is whole: checks it and makes it the one of the next start.
    Install,
    /// Starts the board anew, on trial with a new image.
    Restart,
    /// Where a board's program can end (under an emulator), it ends.
    Halt,
}

/// What to report of a frame beside its telemetry.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct Detail {
    /// The bytes of every output.
    pub outputs: bool,
    /// CRC and time of every step.
    pub steps: bool,
}

/// What a complete frame is for.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub enum End {
    /// The network runs on exactly these values, and the controller answers from a fresh state. `None`: all inputs came
    /// as [`Request::Input`].
    Infer(Option<NetworkInputs>),
    /// A step of the drive. What is said of camera and LiDAR counts where this frame brought nothing of theirs.
    Drive(Measurements),
}

/// A camera as the board is to know it; all cameras of a vehicle are alike.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct CameraSetup {
    /// Columns of the image.
    pub width: u16,
    /// Rows of the image.
    pub height: u16,
    /// Pixels of the image.
    pub format: PixelFormat,
    /// Reduction before the crop.
    pub scale: Scale,
    /// Equal frames in a row that tell of a frozen camera; 0: never.
    pub frozen_after: u16,
}

/// What the sensors are and what is tolerated.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Configuration {
    /// The cameras.
    pub camera: CameraSetup,
    /// Axes of the LiDAR.
    pub lidar_axes: Axes,
    /// The LiDAR's height above ground, meters.
    pub lidar_height: I16F16,
    /// Time that a network may take, milliseconds; then it is given up.
    pub budget_ms: u32,
    /// Time from frame to frame that is tolerated in a drive, milliseconds; then the vehicle brakes. 0: any.
    pub silence_ms: u32,
    /// Whether frames are refused until the known answer was met.
    pub needs_self_test: bool,
    /// Whether image and known answer are tested again and again while nothing else is to do.
    pub tests_in_background: bool,
}

impl Default for Configuration {
    /// The published sensors, an answer within its step, four missed steps, every test.
    fn default() -> Self {
        let camera =
            CameraSetup { width: 400, height: 300, format: PixelFormat::Rgb, scale: Scale::Full, frozen_after: 40 };
        const HEIGHT: I16F16 = I16F16::lit("2.5");
        Self {
            camera,
            lidar_axes: Axes::Carla,
            lidar_height: HEIGHT,
            budget_ms: STEP_MS.into(),
            silence_ms: u32::from(STEP_MS).saturating_mul(4),
            needs_self_test: true,
            tests_in_background: true,
        }
    }
}
