//! What hardware in the loop found: a frame after the other, and the whole.

use super::emulator;
use crate::report::json;
use crate::run::{ModelInfo, Waypoints};
use firmware::link::LinkCounters;
use model_compiler::error::Error;
use schemars::JsonSchema;
use serde::Serialize;

/// Version of the document.
pub const SCHEMA: u32 = 1;

/// A run on a board.
#[derive(Clone, Debug, PartialEq, Serialize, JsonSchema)]
pub struct HilReport {
    /// Version of this structure.
    pub schema: u32,
    /// The image.
    pub model: ModelInfo,
    /// The board.
    pub board: BoardInfo,
    /// What times are given in.
    pub unit: TimeUnit,
    /// Rate of the line, baud; of an emulated board the one that its times on the line are told for.
    pub baud: u32,
    /// Frames in order, up to the first difference.
    pub frames: Vec<HilFrame>,
    /// Figures of every step, where they were asked for.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    pub steps: Vec<StepTimes>,
    /// The whole.
    pub summary: Summary,
    /// The first difference.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub difference: Option<Difference>,
    /// Why the run failed.
    #[serde(rename = "error", serialize_with = "json::failure", skip_serializing_if = "Option::is_none")]
    #[schemars(with = "Option<json::Failure>")]
    pub failure: Option<Error>,
}

/// A board as it names itself.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, JsonSchema)]
pub struct BoardInfo {
    /// Its name.
    pub name: String,
    /// Ticks of its clock per second.
    pub hertz: u64,
    /// What the start cost: the structure of the image.
    pub parse: Time,
    /// What the start cost: all bytes of the image.
    pub check: Time,
}

/// Instructions or milliseconds.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, JsonSchema)]
#[serde(rename_all = "snake_case")]
pub enum TimeUnit {
    /// Of an emulated board, exactly.
    Instructions,
    /// Of a real one, by its own clock.
    Microseconds,
}

impl TimeUnit {
    /// What so many ticks of a board's clock are.
    pub fn of_ticks(self, ticks: u64, hertz: u64) -> Time {
        let per_second = |unit: u128| (u128::from(ticks) * unit).checked_div(hertz.into()).unwrap_or(0);
        match self {
            Self::Instructions => emulator::instructions(ticks, hertz),
            Self::Microseconds => u64::try_from(per_second(1_000_000)).unwrap_or(u64::MAX),
        }
    }

    /// As people write it.
    pub const fn name(self) -> &'static str {
        match self {
            Self::Instructions => "instructions",
            Self::Microseconds => "µs",
        }
    }
}

/// So many of the report's unit.
pub type Time = u64;

/// One frame on the board.
#[derive(Clone, Debug, PartialEq, Serialize, JsonSchema)]
pub struct HilFrame {
    /// Name of the frame or step.
    pub name: String,
    /// Whether all that was compared is equal.
    pub equal: bool,
    /// What the controls are: `driving`, the fault that led to the safe state, …
    pub status: String,
    /// The same as a number, as on a bus.
    pub status_code: u8,
    /// −1 (left) to 1 (right).
    pub steer: f64,
    /// 0 to 0.75.
    pub throttle: f64,
    /// 0 to 1.
    pub brake: f64,
    /// Waypoints `[right, forward]`, m.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub waypoints: Option<Waypoints>,
    /// Points in the image `[column, row]`, pixels.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub points_px: Option<Vec<[f64; 2]>>,
    /// Class, of a classifier.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub top1: Option<usize>,
    /// What the network took; `null` where it did not run.
    pub network: Option<Time>,
    /// Bytes that were sent for it.
    pub bytes_sent: u64,
    /// Seconds that these take on the line.
    pub line_s: f64,
}

/// What a step took, over all frames.
#[derive(Clone, Debug, PartialEq, Serialize, JsonSchema)]
pub struct StepTimes {
    /// Position in the program.
    pub position: u16,
    /// Its operator.
    pub op: String,
    /// Over all frames.
    #[serde(flatten)]
    pub times: Spread,
}

/// Mean and range.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, JsonSchema)]
pub struct Spread {
    /// Mean.
    pub mean: f64,
    /// Least.
    pub min: Time,
    /// Most.
    pub max: Time,
}

impl Spread {
    /// Of some figures; `None` of none.
    pub fn of(figures: impl IntoIterator<Item = Time>) -> Option<Self> {
        let all: Vec<Time> = figures.into_iter().collect();
        let (min, max) = (*all.iter().min()?, *all.iter().max()?);
        Some(Self { mean: all.iter().map(|&figure| figure as f64).sum::<f64>() / all.len() as f64, min, max })
    }
}

/// The whole run.
#[derive(Clone, Debug, Default, PartialEq, Serialize, JsonSchema)]
pub struct Summary {
    /// Frames that were run.
    pub frames: usize,
    /// Frames that were equal.
    pub equal: usize,
    /// Bytes of outputs that were compared.
    pub bytes_compared: u64,
    /// CRCs of steps that were compared.
    pub steps_compared: u64,
    /// What the network took; `null` where it never ran.
    pub network: Option<Spread>,
    /// Known answers that the board met since its start.
    pub self_tests: u32,
    /// Deepest stack of the board since its start, bytes, where it tells.
    pub stack_bytes: Option<u32>,
    /// What happened on the line since the board's start.
    pub link: LinkFigures,
}

/// What happened on the line.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, JsonSchema)]
#[allow(missing_docs, reason = "see `LinkCounters`")]
pub struct LinkFigures {
    pub packets: u32,
    pub damaged: u32,
    pub lost: u32,
    pub repeated: u32,
    pub overflowed: u32,
    pub incomplete_frames: u32,
    pub abandoned_frames: u32,
}

impl From<LinkCounters> for LinkFigures {
    fn from(counters: LinkCounters) -> Self {
        let LinkCounters { packets, damaged, lost, repeated, overflowed, incomplete_frames, abandoned_frames } =
            counters;
        Self { packets, damaged, lost, repeated, overflowed, incomplete_frames, abandoned_frames }
    }
}

/// Where board and host first differ.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, JsonSchema)]
pub struct Difference {
    /// Frame.
    pub frame: String,
    /// Step (position and operator), byte of an output, or what else.
    pub place: String,
    /// What the board gave.
    pub found: String,
    /// What the host gives.
    pub expected: String,
}
