//! The driving computer: frames come over the [link](crate::link), rows are cropped and points counted as they arrive,
//! the network runs, the driver decides, the actuators are set, telemetry goes back.
//!
//! A board lends its line, clock and watchdog as a [`Board`], its outputs as an [`Actuate`], and memory, as a
//! [`Computer`]; [`Computer::run`] does the rest and returns where the program is to end. Nothing here waits for anyone: every loop ends by itself, with the
//! budget of the network, or with the packet.
//!
//! # Safe state
//!
//! Full brake, no throttle, the wheels as they are, the enable pin low. A drive is in it
//!
//! * before the first frame, and after a [`Request::Configure`];
//! * in a frame that lost a packet: all that its sensors said is taken for missing
//!   ([`Fault::Missing`]);
//! * when the network exceeds its budget ([`Fault::NetworkOverrun`]): it is given up between
//!   two steps;
//! * when no frame ends for longer than the configuration tolerates ([`Fault::Silence`]);
//! * when a test of image or known answer fails, until the next start;
//! * for every fault of the [driver](crate::drive::driver) itself.
//!
//! Out of it leads the driver's recovery: frames without a fault, one after the other. What happened is counted
//! ([`Counters`](crate::drive::Counters), [`LinkCounters`](crate::link::LinkCounters)) and told with every frame.

#![deny(
    clippy::indexing_slicing,
    clippy::arithmetic_side_effects,
    clippy::unwrap_used,
    clippy::expect_used,
    clippy::panic
)]

mod desk;
mod line;
mod log;
mod network;
mod rig;
mod self_test;
mod store;

pub use line::Line;
pub use rig::{CAMERA_WORDS, MAX_CAMERAS, Memory};
pub use store::{ImageStore, NoStore};

use crate::actuators::Actuate;
use crate::arena::Regions;
use crate::drive::{Controls, Fault, Output, Real, Status};
use crate::engine::{Engine, EngineError};
use crate::image::{CheckError, CheckProgress, Checker, Image, ParseError};
use crate::kernels::Kernels;
use crate::link::{Configuration, Receiver, Refusal, Request, decode};
use core::fmt;
use desk::{Desk, End, Lent};
use rig::Rig;
use self_test::SelfTest;

/// What a board lends.
pub trait Board {
    /// Name in telemetry and logs.
    fn name(&self) -> &str;

    /// A received byte, if there is one; never waits. A line faster than a step of the network needs an interrupt or
    /// DMA that fills a queue, which this reads.
    fn receive(&mut self) -> Option<u8>;

    /// Sends bytes; may wait for the line.
    fn send(&mut self, bytes: &[u8]);

    /// A clock that never stops or wraps.
    fn ticks(&mut self) -> u64;

    /// Ticks per second.
    fn hertz(&self) -> u64;

    /// Tells the watchdog that all is well: called between any two steps of the network, and at least once per byte.
    fn feed_watchdog(&mut self);

    /// Nothing is to do: a board may sleep here until a byte or a tick comes.
    fn wait(&mut self) {}

    /// Deepest stack so far, bytes, where the board can tell.
    fn stack_bytes(&self) -> Option<u32> {
        None
    }

    /// Whether the program may end (under an emulator).
    fn can_halt(&self) -> bool {
        false
    }
}

/// Why [`Computer::run`] returned.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub enum Exit {
    /// The feeder asked the program to end.
    Halt,
    /// The feeder asked the board to start anew, with [`crate::update::select`].
    Restart,
}

/// Why an image cannot be run.
#[derive(Clone, Copy, Debug, PartialEq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub enum StartError {
    /// It is no image, or one with an impossible program.
    Image(ParseError),
    /// A section is damaged.
    Damaged(CheckError),
    /// Arena or kernels do not suffice.
    Engine(EngineError),
    /// A sensor's input has an impossible size.
    Sensors,
}

impl fmt::Display for StartError {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Image(error) => error.fmt(f),
            Self::Damaged(error) => error.fmt(f),
            Self::Engine(error) => error.fmt(f),
            Self::Sensors => f.write_str("an input of the network has a size that its sensor cannot fill"),
        }
    }
}

impl core::error::Error for StartError {}

/// Bytes of an image that are checked between two calls of [`Board::feed_watchdog`].
const CHECKED_AT_ONCE: usize = 4096;

/// What a computer consists of.
#[derive(Debug)]
pub struct Computer<'a, B, A, K, S> {
    /// The image, as memory-mapped flash holds it. One that cannot be run leaves the vehicle in the safe state and
    /// every request refused ([`Refusal::NoImage`]), but for those that bring a new image.
    pub image: &'a [u8],
    /// Backend of the core.
    pub kernels: K,
    /// Memory of the engine: one buffer per memory region of the image, in its order.
    pub arena: Regions<'a>,
    /// Memory of the sensors.
    pub memory: &'a mut Memory,
    /// State of the line.
    pub line: &'a mut Line,
    /// Line, clock, watchdog.
    pub board: &'a mut B,
    /// What moves the vehicle.
    pub actuators: &'a mut A,
    /// Where a new image goes; [`NoStore`] where there is no room for one.
    pub store: &'a mut S,
}

impl<B: Board, A: Actuate, K: Kernels + Copy, S: ImageStore> Computer<'_, B, A, K, S> {
    /// Runs until the feeder ends it. Begins in the safe state.
    pub fn run(self) -> Exit {
        let Self { image, kernels, mut arena, memory, line, board, actuators, store } = self;
        stop(actuators);
        let (image, times) = match start(image, board) {
            Ok(started) => started,
            Err(error) => return refuse_all(error, line, board, store),
        };
        let mut configuration = Configuration::default();
        let mut test = SelfTest::new(image);
        loop {
            let rig = Rig::new(&image, &configuration, memory).or_else(|_| Rig::without_sensors(&image));
            let engine = Engine::new(image, kernels, arena.reborrow()).map_err(StartError::Engine);
            let (rig, engine) = match (rig, engine) {
                (Ok(rig), Ok(engine)) => (rig, engine),
                (Err(_), _) => return refuse_all(StartError::Sensors, line, board, store),
                (_, Err(error)) => return refuse_all(error, line, board, store),
            };
            let Line { receiver, sender } = line;
            let lent = Lent { sender, board, actuators, store, test: &mut test };
            match converse(receiver, Desk::new(configuration, times, engine, rig, lent)) {
                End::Configure(new) => configuration = new,
                End::Exit(exit) => return exit,
            }
            stop(actuators);
        }
    }
}

/// Carries out one request after the other until the drive is over.
fn converse<B: Board, A: Actuate, K: Kernels, S: ImageStore>(
    receiver: &mut Receiver,
    mut desk: Desk<'_, '_, '_, B, A, K, S>,
) -> End {
    loop {
        let Lent { sender, board, .. } = &mut desk.lent;
        board.feed_watchdog();
        let Some(byte) = sender.next_byte(*board) else {
            desk.idle();
            continue;
        };
        desk.hear();
        match receiver.push(byte) {
            None => {}
            Some(Err(_)) => desk.lent.sender.count_damaged(),
            Some(Ok(packet)) => {
                if let Some(end) = desk.handle(packet) {
                    return end;
                }
            }
        }
    }
}

/// Ticks that the start took.
#[derive(Clone, Copy, Debug, Default)]
struct StartTimes {
    parse: u64,
    check: u64,
}

/// Parses and checks an image.
fn start<'i, B: Board>(image: &'i [u8], board: &mut B) -> Result<(Image<'i>, StartTimes), StartError> {
    let begin = board.ticks();
    let image = Image::parse(image).map_err(StartError::Image)?;
    let parsed = board.ticks();
    let mut checker = Checker::new(&image);
    while checker.advance(CHECKED_AT_ONCE).map_err(StartError::Damaged)? != CheckProgress::Done {
        board.feed_watchdog();
    }
    let times = StartTimes { parse: parsed.wrapping_sub(begin), check: board.ticks().wrapping_sub(parsed) };
    log::started(board.name(), &image, times);
    Ok((image, times))
}

/// The safe state outside of a drive.
fn stop<A: Actuate>(actuators: &mut A) {
    let output = Output { controls: Controls::stop(Real::ZERO), status: Status::Fault(Fault::NetworkFailed) };
    // There is nobody to tell yet; the first telemetry tells.
    let _ = actuators.apply(&output);
}

/// Without an image there is only one answer, but to what brings one.
fn refuse_all<B: Board, S: ImageStore>(error: StartError, line: &mut Line, board: &mut B, store: &mut S) -> Exit {
    log::no_image(board.name(), error);
    let Line { receiver, sender } = line;
    loop {
        board.feed_watchdog();
        let Some(byte) = sender.next_byte(board) else {
            board.wait();
            continue;
        };
        let Some(Ok(packet)) = receiver.push(byte) else { continue };
        let Ok((request, message)) = decode::<Request<'_>>(packet) else { continue };
        let exit = match message {
            Request::Halt if board.can_halt() => Some(Exit::Halt),
            Request::Restart => Some(Exit::Restart),
            _ => None,
        };
        let stored = store::carry_out(store, &message, board, B::feed_watchdog);
        let outcome = if exit.is_some() { Ok(()) } else { stored.unwrap_or(Err(Refusal::NoImage)) };
        sender.answer(board, request, outcome);
        if let Some(exit) = exit {
            return exit;
        }
    }
}
