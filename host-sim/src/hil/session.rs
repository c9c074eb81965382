//! The conversation about one image: who is there, what its sensors are, the known answer, frame after frame.

use super::feeder::Feeder;
use super::line::Line;
use super::pieces::{Parcel, Reads, Setup};
use firmware::drive::RouteNode;
use firmware::image::Image;
use firmware::link::{Configuration, Detail, Identity, PROTOCOL, Refusal, Request, Response, StepReport, Telemetry};
use firmware::sensors::lidar::Axes;
use fixed::types::I16F16;
use model_compiler::artifact;
use model_compiler::error::{Error, ErrorCode, Result};
use std::time::Duration;

/// Bytes of a digest that messages show.
const SHOWN: usize = 8;

/// What a board tolerates.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Tolerance {
    /// Time that a network may take, ms.
    pub budget_ms: u32,
    /// Time from frame to frame, ms; 0: any.
    pub silence_ms: u32,
    /// Whether image and known answer are tested while nothing else is to do.
    pub tests_in_background: bool,
    /// Whether the known answer must be met before the first frame.
    pub needs_self_test: bool,
}

impl Default for Tolerance {
    /// Any time, and the self-test.
    fn default() -> Self {
        Self { budget_ms: u32::MAX, silence_ms: 0, tests_in_background: false, needs_self_test: true }
    }
}

/// What a board says of itself.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Introduction {
    /// Its name.
    pub board: String,
    /// Ticks of its clock per second.
    pub hertz: u64,
    /// Ticks that the image's structure took at the start.
    pub parse_ticks: u64,
    /// Ticks that its bytes took.
    pub check_ticks: u64,
}

/// All that a board answered to a frame.
#[derive(Clone, Debug, PartialEq)]
pub struct Answered {
    /// Bytes of every output.
    pub outputs: Vec<Vec<u8>>,
    /// Every step, where they were asked for.
    pub steps: Vec<StepReport>,
    /// How the frame ended.
    pub telemetry: Telemetry,
    /// Bytes that were sent for it.
    pub bytes_sent: u64,
}

/// A conversation with a board that holds the right image.
#[derive(Debug)]
pub struct Session<'l> {
    feeder: Feeder<'l>,
    reads: Reads,
    tolerance: Tolerance,
    outputs: usize,
    setup: Option<Setup>,
    is_tested: bool,
    /// Number of the next frame.
    number: u32,
}

impl<'l> Session<'l> {
    /// Finds out who is there.
    ///
    /// # Errors
    /// Nobody answers, or a board with another image or of another version.
    pub fn open(
        line: &'l Line,
        image: &Image<'_>,
        tolerance: Tolerance,
        timeout: Duration,
    ) -> Result<(Self, Introduction)> {
        let mut feeder = Feeder::new(line, timeout);
        let packet = feeder.identify()?;
        let Response::Identity(identity) = packet.response() else {
            return Err(Error::new(ErrorCode::Link, line.name(), "the board does not say who it is"));
        };
        check(&identity, image).map_err(|e| e.within(line.name()))?;
        let introduction = Introduction {
            board: identity.board.to_owned(),
            hertz: identity.hertz,
            parse_ticks: identity.parse_ticks,
            check_ticks: identity.check_ticks,
        };
        let (reads, outputs) = (Reads::of_image(image), image.output_count().into());
        Ok((Self { feeder, reads, tolerance, outputs, setup: None, is_tested: false, number: 0 }, introduction))
    }

    /// What the sensors are, as far as it is known.
    pub fn setup(&self) -> Option<Setup> {
        self.setup
    }

    /// Tells the board what its sensors are, and begins a drive; before the first one, the known answer is asked for.
    ///
    /// # Errors
    /// The board refuses or does not answer.
    pub fn configure(&mut self, setup: Setup) -> Result<()> {
        let Tolerance { budget_ms, silence_ms, tests_in_background, needs_self_test } = self.tolerance;
        let (lidar_axes, lidar_height) = setup.lidar.unwrap_or((Axes::Carla, I16F16::lit("2.5")));
        let camera = self.reads.camera(setup);
        let configuration = Configuration {
            camera,
            lidar_axes,
            lidar_height,
            budget_ms,
            silence_ms,
            needs_self_test,
            tests_in_background,
        };
        let what = format!("Configure (images of {}×{})", camera.width, camera.height);
        self.feeder.ask(&Request::Configure(configuration), what)?;
        self.setup = Some(setup);
        if needs_self_test && !self.is_tested {
            self.feeder.ask(&Request::SelfTest, "SelfTest")?;
            self.is_tested = true;
        }
        Ok(())
    }

    /// Sends as many nodes of a route as the board holds; those that remain.
    ///
    /// # Errors
    /// The board refuses for another reason than room, or does not answer.
    pub fn route<'r>(&mut self, mut ahead: &'r [RouteNode]) -> Result<&'r [RouteNode]> {
        while let [node, rest @ ..] = ahead {
            match self.feeder.try_ask(&Request::Route(*node), "Route")? {
                Ok(()) => ahead = rest,
                Err(Refusal::RouteFull) => break,
                Err(reason) => return Err(self.feeder.refused_last(reason)),
            }
        }
        Ok(ahead)
    }

    /// One frame from its begin to its telemetry.
    ///
    /// # Errors
    /// The board refuses a part of it, or does not answer.
    pub fn frame(&mut self, parcel: &Parcel, detail: Detail) -> Result<Answered> {
        let frame = self.number;
        self.number += 1;
        self.feeder.begin_exchange();
        self.feeder.send(&Request::Begin { frame, detail }, "Begin")?;
        for piece in &parcel.pieces {
            self.feeder.send(&piece.request(), piece.name())?;
        }
        self.feeder.send(&Request::End(parcel.end), "End")?;
        let (mut outputs, mut steps) = (vec![Vec::new(); self.outputs], Vec::new());
        loop {
            match self.feeder.receive()?.response() {
                Response::Step(report) => steps.push(report),
                Response::Output { output, offset, bytes } => {
                    let whole = outputs.get_mut(usize::from(output)).filter(|whole| whole.len() == offset as usize);
                    whole.ok_or_else(|| self.feeder.faulty("an output came out of order"))?.extend_from_slice(bytes);
                }
                Response::Telemetry(telemetry) if telemetry.frame == frame => {
                    let bytes_sent = self.feeder.take_bytes_sent();
                    return Ok(Answered { outputs, steps, telemetry, bytes_sent });
                }
                Response::Refused { request, reason } if self.feeder.is_current(request) => {
                    return Err(self.feeder.refused(request, reason));
                }
                // Of an earlier frame that was given up here, or stopped for silence: so is what came before it.
                Response::Telemetry(_) => {
                    outputs.iter_mut().for_each(Vec::clear);
                    steps.clear();
                }
                Response::Refused { .. } | Response::Accepted { .. } | Response::Identity(_) => {}
            }
        }
    }

    /// Ends the board's program.
    ///
    /// # Errors
    /// It does not end.
    pub fn halt(&mut self) -> Result<()> {
        self.feeder.ask(&Request::Halt, "Halt")
    }

    /// Bytes that were sent since the last frame.
    pub fn take_bytes_sent(&mut self) -> u64 {
        self.feeder.take_bytes_sent()
    }
}

/// Whether it is a board of this version that holds this image.
fn check(identity: &Identity<'_>, image: &Image<'_>) -> Result<()> {
    if identity.protocol != PROTOCOL {
        let message = format!("the board speaks version {} of the protocol, expected {PROTOCOL}", identity.protocol);
        return Err(Error::new(ErrorCode::Link, "", message).with_help("build board and host-sim from one version"));
    }
    let bytes = image.bytes();
    let crc = image.header_crc();
    let digest = |digest: &[u8]| format!("{}…", artifact::hex(&digest[..SHOWN]));
    let length = |bytes: usize| format!("{bytes} bytes");
    let facts = [
        ("model", identity.model.to_owned(), image.name().to_owned()),
        ("digest of the quantized model", digest(&identity.qmodel_digest), digest(&image.qmodel_digest())),
        ("digest of the build", digest(&identity.build_digest), digest(&image.build_digest())),
        ("length", length(identity.image_bytes as usize), length(bytes.len())),
        ("CRC of the header", format!("{:08x}", identity.header_crc), format!("{crc:08x}")),
    ];
    match facts.into_iter().find(|(_, found, expected)| found != expected) {
        None => Ok(()),
        Some((what, found, expected)) => {
            let message = format!("the board holds another image: {what} {found}, expected {expected}");
            Err(Error::new(ErrorCode::Link, "", message)
                .with_help("flash the image, or give the one that the board holds"))
        }
    }
}
