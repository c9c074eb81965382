//! What a bad line does: the vehicle stops or the feeder says so, nobody stalls, and the next frames are good.

use super::recorded;
use firmware::drive::{Fault, Sensor, Status};
use firmware::image::Image;
use firmware::link::{Detail, Telemetry};
use host_sim::drive::log::Log;
use host_sim::hil::pieces::{Parcel, Reads, Setup};
use host_sim::hil::serial;
use host_sim::hil::session::{Answered, Session, Tolerance};
use model_compiler::emit::AlignedBytes;
use model_compiler::error::Result;
use model_compiler::import::System;
use std::thread;
use std::time::{Duration, Instant};
use tests::serial_board::{Accident, SerialBoard, faultless};

const TIMEOUT: Duration = Duration::from_millis(1500);
/// Packets before the first frame: Identify, Configure, and the nodes that the board holds and one more.
const BEFORE: usize = 2 + 129;
const DETAIL: Detail = Detail { outputs: true, steps: false };

/// A log's steps, driven on a board behind a line with accidents.
struct Drive {
    parcels: Vec<Parcel>,
    log: Log,
    image: Vec<u8>,
}

impl Drive {
    fn new() -> Self {
        let folder = recorded(System::LateFusion, 6);
        let image = folder.read("net.img");
        let bytes = AlignedBytes::from(image.as_slice());
        let reads = Reads::of_image(&Image::parse(&bytes).expect("an image"));
        let log = Log::read(&folder.path("log")).expect("a log");
        let parcels = log.frames.iter().map(|frame| reads.step(frame).expect("a step")).collect();
        Self { parcels, log, image }
    }

    /// What each frame gave; `pause` is called before each.
    fn run(
        &self,
        tolerance: Tolerance,
        requests: Accident,
        answers: Accident,
        mut pause: impl FnMut(usize),
    ) -> Vec<Result<Telemetry>> {
        let board = SerialBoard::start(&self.image, requests, answers);
        let line = serial::open(board.device(), 115_200).expect("a serial device");
        let bytes = AlignedBytes::from(self.image.as_slice());
        let image = Image::parse(&bytes).expect("an image");
        let (mut session, _) = Session::open(&line, &image, tolerance, TIMEOUT).expect("a board");
        let setup = self.parcels.iter().fold(Setup::default(), |setup, parcel| setup.or(parcel.setup));
        session.configure(setup).expect("a configuration");
        session.route(&self.log.route).expect("a route");
        let frame = |(index, parcel): (usize, &Parcel)| {
            pause(index);
            session.frame(parcel, DETAIL).map(|Answered { telemetry, .. }| telemetry)
        };
        self.parcels.iter().enumerate().map(frame).collect()
    }

    /// The same with an accident to a packet of a frame: by its number behind the frame's begin.
    fn with_accident(&self, frame: usize, packet: usize, happen: fn(&mut Vec<u8>)) -> Vec<Result<Telemetry>> {
        let before: usize = self.parcels[..frame].iter().map(|parcel| parcel.pieces.len() + 2).sum();
        let hit = BEFORE + before + packet;
        let requests = move |number, mut bytes: Vec<u8>| {
            if number == hit {
                happen(&mut bytes);
            }
            bytes
        };
        self.run(QUICK, Box::new(requests), faultless(), |_| ())
    }

    /// Number of the end of a frame.
    fn end(&self, frame: usize) -> usize {
        self.parcels[frame].pieces.len() + 1
    }
}

const QUICK: Tolerance =
    Tolerance { budget_ms: u32::MAX, silence_ms: 0, tests_in_background: false, needs_self_test: false };

fn statuses(frames: &[Result<Telemetry>]) -> Vec<Status> {
    frames.iter().map(|frame| frame.as_ref().unwrap_or_else(|e| panic!("{e}")).status).collect()
}

/// A drive in which the third frame is lost: the safe state at once, then recovery.
fn assert_third_is_missing(frames: &[Result<Telemetry>]) -> Telemetry {
    let missing = Status::Fault(Fault::Missing(Sensor::Camera));
    let expected =
        [Status::Filling, Status::Driving, missing, Status::Recovering, Status::Recovering, Status::Recovering];
    assert_eq!(statuses(frames), expected);
    let stopped = frames[2].as_ref().expect("telemetry");
    assert_eq!((stopped.controls.throttle.to_num::<f64>(), stopped.controls.brake.to_num::<f64>()), (0.0, 1.0));
    frames[5].clone().expect("telemetry")
}

#[test]
fn a_good_line_loses_nothing() {
    let frames = Drive::new().run(QUICK, faultless(), faultless(), |_| ());
    assert_eq!(statuses(&frames)[1..], [Status::Driving; 5]);
    let link = frames[5].as_ref().expect("telemetry").link;
    assert_eq!(
        (link.damaged, link.lost, link.repeated, link.incomplete_frames, link.abandoned_frames),
        (0, 0, 0, 0, 0)
    );
}

#[test]
fn a_lost_a_damaged_and_a_cut_piece_cost_their_frame_and_no_other() {
    let drive = Drive::new();
    for (happen, damaged, lost) in [
        ((|bytes| bytes.clear()) as fn(&mut Vec<u8>), 0, 1),
        (|bytes| bytes[9] ^= 0x10, 1, 1),
        // Without its end a packet runs into the next one.
        (|bytes| bytes.truncate(bytes.len() - 1), 1, 2),
        // Cut within a block of COBS.
        (|bytes| drop(bytes.drain(20..60)), 1, 1),
    ] {
        for packet in [1, 40, drive.end(2) - 2] {
            let link = assert_third_is_missing(&drive.with_accident(2, packet, happen)).link;
            assert_eq!((link.damaged, link.lost, link.incomplete_frames), (damaged, lost, 1), "packet {packet}");
        }
    }
}

#[test]
fn a_packet_that_comes_twice_is_taken_once() {
    let drive = Drive::new();
    for packet in [0, 1, drive.end(2)] {
        let frames = drive.with_accident(2, packet, |bytes| *bytes = bytes.repeat(2));
        assert_eq!(statuses(&frames)[1..], [Status::Driving; 5], "packet {packet}");
        let link = frames[5].as_ref().expect("telemetry").link;
        assert_eq!((link.repeated, link.lost, link.incomplete_frames), (1, 0, 0));
    }
}

#[test]
fn a_lost_begin_is_refused_and_the_drive_goes_on() {
    let frames = Drive::new().with_accident(2, 0, Vec::clear);
    let error = frames[2].as_ref().expect_err("no frame was begun");
    assert!(error.message.contains("no frame was begun"), "{error}");
    let last = frames[5].as_ref().expect("telemetry");
    // The tick went by without a step; what follows is driven on.
    assert_eq!((last.status, last.counters.skipped, last.link.lost), (Status::Driving, 1, 1));
}

#[test]
fn a_lost_end_is_a_bounded_wait_and_an_abandoned_frame() {
    let drive = Drive::new();
    let begin = Instant::now();
    let frames = drive.with_accident(2, drive.end(2), Vec::clear);
    let error = frames[2].as_ref().expect_err("nobody answers");
    assert!(error.message.contains("the board is silent") && error.message.ends_with("after End"), "{error}");
    let last = frames[5].as_ref().expect("telemetry");
    assert_eq!((last.status, last.link.abandoned_frames, last.link.lost), (Status::Driving, 1, 1));
    assert!(begin.elapsed() < 10 * TIMEOUT);
}

#[test]
fn silence_stops_the_vehicle() {
    let tolerance = Tolerance { silence_ms: 400, ..QUICK };
    let pause = |frame| thread::sleep(if frame == 3 { Duration::from_millis(900) } else { Duration::ZERO });
    let frames = Drive::new().run(tolerance, faultless(), faultless(), pause);
    assert_eq!(statuses(&frames)[1..3], [Status::Driving; 2]);
    assert_eq!(statuses(&frames)[3..], [Status::Recovering; 3]);
    let counters = frames[3].as_ref().expect("telemetry").counters;
    assert!((1..=2).contains(&counters.silences), "{counters:?}");
}

#[test]
fn a_delay_changes_nothing() {
    let delay = |number: usize, bytes: Vec<u8>| {
        thread::sleep(if number % 500 == 7 { Duration::from_millis(300) } else { Duration::ZERO });
        bytes
    };
    let frames = Drive::new().run(QUICK, Box::new(delay), faultless(), |_| ());
    assert_eq!(statuses(&frames)[1..], [Status::Driving; 5]);
}

#[test]
fn answers_that_are_lost_or_damaged_are_told() {
    let drive = Drive::new();
    // Before the third frame's answers: one per request, telemetry of the first, output and telemetry of the second.
    let answer = BEFORE + 1 + 2;
    for (happen, expected) in [
        ((|bytes| bytes[2] ^= 0x10) as fn(&mut Vec<u8>), "an answer is damaged: packet with a wrong CRC"),
        (|bytes| bytes.clear(), "answers were lost on the line"),
    ] {
        let answers = move |number, mut bytes: Vec<u8>| {
            if number == answer {
                happen(&mut bytes);
            }
            bytes
        };
        let frames = drive.run(QUICK, faultless(), Box::new(answers), |_| ());
        let error = frames[2].as_ref().expect_err("not all of the answer came");
        assert!(error.message.contains(expected), "{error}");
        assert_eq!(error.code.exit_status(), 2);
    }
}
