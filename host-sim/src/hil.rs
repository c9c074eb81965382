//! Hardware in the loop: frames go to a board over its serial line, and every byte that comes back is compared with
//! the host's own run of the same image.
//!
//! ```text
//!  frames ──┬─► rows, points, speed, goal ──► line ──► board: sensors, engine, driver ──► line ─┐
//!           │                                                                                   ├─► compare
//!           └─► host's f64 preparation ──► engine on the host's kernels, driver ────────────────┘
//! ```
//!
//! * [`emulator`]: the boards of `firmware/boards` in QEMU; [`serial`]: a real one
//! * [`line`](mod@line): bytes both ways, no wait without an end; [`feeder`]: requests and answers; [`session`]: the conversation
//! * [`pieces`]: the files of a moment as messages; [`expected`]: what must come back; [`compare`]: what did
//! * [`update`]: a new image over the same line
//! * [`report`]: what was found; [`messages`]: what the board's program logged on the way
//!
//! A log is driven ([`drive`](mod@crate::drive)), with the board's own planner, controller and supervision; frames
//! stand alone, with the controller in its fresh state.

use crate::answer::Answer;
use crate::backends::Backend;
use crate::drive::log::Log;
use crate::drive::{self, Decision};
use crate::files::{self, FrameSource, ImageFile};
use crate::run::ModelInfo;
use crate::{drive::sensors::Rig, system};
use compare::{Reference, Unequal};
use emulator::{Board, Emulator};
use expected::Host;
use firmware::drive::Output;
use firmware::image::Image;
use firmware::link::Detail;
use indicatif::ProgressBar;
use line::Line;
use model_compiler::artifact;
use model_compiler::error::{Error, ErrorCode, Result};
use model_compiler::frames::Frame;
use model_compiler::import::ImportOptions;
use pieces::{Reads, Setup};
use report::{BoardInfo, Difference, HilFrame, HilReport, SCHEMA, Spread, StepTimes, Summary, TimeUnit};
use session::{Answered, Introduction, Session, Tolerance};
use std::path::{Path, PathBuf};
use std::time::Duration;

pub mod compare;
pub mod emulator;
pub mod expected;
pub mod feeder;
pub mod line;
pub mod messages;
pub mod pieces;
pub mod report;
pub mod serial;
pub mod session;
pub mod update;

/// Rate of a line unless told otherwise, baud.
pub const DEFAULT_BAUD: u32 = 115_200;
/// A byte on an asynchronous line: start bit, eight bits, stop bit.
const BITS_PER_BYTE: u64 = 10;

/// Where the board is.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Place {
    /// In the emulator.
    Emulated {
        /// Which one.
        board: Board,
        /// Its program; `None`: the one of this source tree.
        program: Option<PathBuf>,
    },
    /// Behind a serial device.
    Port {
        /// Its name.
        device: String,
        /// Its rate.
        baud: u32,
    },
}

/// What the board is fed with.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Feed {
    /// Frames, each by itself.
    Frames {
        /// Where they come from.
        source: FrameSource,
        /// Send the network's inputs as the host prepares them, in place of sensor data.
        crop: bool,
    },
    /// A recorded sequence.
    Log(PathBuf),
}

/// What to run, and where.
#[derive(Clone, Debug)]
pub struct Options {
    /// Model image.
    pub image: PathBuf,
    /// Where the board is.
    pub place: Place,
    /// What it is fed with.
    pub feed: Feed,
    /// Compare every step, and tell what each took.
    pub steps: bool,
    /// Kernels of the host's own run.
    pub backend: Backend,
    /// What the board tolerates.
    pub tolerance: Tolerance,
    /// How long nothing may go either way.
    pub timeout: Duration,
    /// Tell what the emulated program logs.
    pub defmt: bool,
}

/// A board and the line to it. The emulator goes first: its end is the end of the line.
#[derive(Debug)]
struct Connection {
    emulator: Option<Emulator>,
    line: Line,
}

impl Connection {
    fn open(place: &Place, image: &Path) -> Result<Self> {
        match place {
            Place::Emulated { board, program } => {
                let (emulator, line) = Emulator::start(*board, program.as_deref(), image)?;
                Ok(Self { emulator: Some(emulator), line })
            }
            Place::Port { device, baud } => Ok(Self { emulator: None, line: serial::open(device, *baud)? }),
        }
    }
}

/// Runs an image on a board and on the host.
///
/// Files are read, and the host's run of a log is done, before a board is started. A difference is in the report, no
/// error. `say` gets the lines that the board's program logs.
///
/// # Errors
/// Bad files, no board, a board with another image, one that refuses or is silent, a damaged line.
pub fn hil(options: &Options, progress: &ProgressBar, say: &mut dyn FnMut(&str)) -> Result<HilReport> {
    let file = ImageFile::read(&options.image)?;
    let image = file.parse()?;
    let course = Course::prepare(options, image, progress)?;
    progress.set_message("start");
    let mut connection = Connection::open(&options.place, &options.image)?;
    let model = ModelInfo { name: image.name().to_owned(), sha256: artifact::hex(&file.sha256()) };
    let outcome = converse(options, &image, model, course, &mut connection, progress);
    let Some(emulator) = &mut connection.emulator else { return outcome };
    let outcome = outcome.map_err(|error| emulator.explain(error));
    if options.defmt {
        messages::decode(emulator.program(), &emulator.log()?)?.iter().for_each(|line| say(line));
    }
    outcome
}

fn converse(
    options: &Options,
    image: &Image<'_>,
    model: ModelInfo,
    course: Course<'_>,
    connection: &mut Connection,
    progress: &ProgressBar,
) -> Result<HilReport> {
    let (mut session, introduction) = Session::open(&connection.line, image, options.tolerance, options.timeout)?;
    let mut run = Run::new(options, image, model, &introduction);
    match course {
        Course::Frames { frames, folder, host } => {
            run.frames(&frames, folder.as_deref(), *host, &mut session, progress)?
        }
        Course::Log { log, decisions } => run.log(&log, &decisions, &mut session, progress)?,
    }
    if let Some(emulator) = &mut connection.emulator {
        session.halt()?;
        emulator.finish(options.timeout)?;
    }
    Ok(run.into_report())
}

/// What is to be sent, and what it is compared with.
enum Course<'a> {
    Frames { frames: Vec<Frame>, folder: Option<PathBuf>, host: Box<Host<'a>> },
    Log { log: Log, decisions: Vec<Decision> },
}

impl<'a> Course<'a> {
    fn prepare(options: &Options, image: Image<'a>, progress: &ProgressBar) -> Result<Self> {
        match &options.feed {
            Feed::Frames { source, crop } => {
                let format = files::frame_format(&image)?;
                let frames = source.load(&format)?;
                let folder = source.frames.clone().filter(|_| !crop && format.classes.is_none());
                if folder.is_some() {
                    // Sizes that no board's sensors fill are told before one is started.
                    Rig::new(&image, system::of_image(&image)?).map_err(|e| e.with_help(CROP_HELP))?;
                }
                Ok(Self::Frames { frames, folder, host: Box::new(Host::new(image, options.backend)?) })
            }
            Feed::Log(folder) => {
                system::of_image(&image)?;
                let log = Log::read(folder)?;
                let options = drive::Options {
                    image: options.image.clone(),
                    log: folder.clone(),
                    model: None,
                    import: ImportOptions::default(),
                    backend: options.backend,
                };
                let steps = drive::drive(&options, progress)?.steps;
                Ok(Self::Log { log, decisions: steps.into_iter().map(|step| step.int8).collect() })
            }
        }
    }
}

const CROP_HELP: &str = "--crop sends the network's inputs in place of sensor data, of any size";

/// A run under way.
struct Run<'o, 'a> {
    image: &'o Image<'a>,
    detail: Detail,
    hertz: u64,
    report: HilReport,
    /// Of every step, in every frame.
    step_times: Vec<Vec<u64>>,
}

impl<'o, 'a> Run<'o, 'a> {
    fn new(options: &Options, image: &'o Image<'a>, model: ModelInfo, introduction: &Introduction) -> Self {
        let (unit, baud) = match options.place {
            Place::Emulated { .. } => (TimeUnit::Instructions, DEFAULT_BAUD),
            Place::Port { baud, .. } => (TimeUnit::Microseconds, baud),
        };
        let Introduction { board, hertz, parse_ticks, check_ticks } = introduction;
        let [parse, check] = [*parse_ticks, *check_ticks].map(|ticks| unit.of_ticks(ticks, *hertz));
        let report = HilReport {
            schema: SCHEMA,
            model,
            board: BoardInfo { name: board.clone(), hertz: *hertz, parse, check },
            unit,
            baud,
            frames: Vec::new(),
            steps: Vec::new(),
            summary: Summary::default(),
            difference: None,
            failure: None,
        };
        let detail = Detail { outputs: matches!(options.feed, Feed::Frames { .. }), steps: options.steps };
        Self { image, detail, hertz: *hertz, report, step_times: vec![Vec::new(); image.step_count().into()] }
    }

    fn frames(
        &mut self,
        frames: &[Frame],
        folder: Option<&Path>,
        mut host: Host<'_>,
        session: &mut Session<'_>,
        progress: &ProgressBar,
    ) -> Result<()> {
        let reads = Reads::of_image(self.image);
        progress.set_length(frames.len() as u64);
        progress.set_position(0);
        for frame in frames {
            let within = |e: Error| e.within(format!("frame {}", frame.name));
            progress.set_message(frame.name.clone());
            let parcel = match folder {
                Some(folder) => reads.frame(&folder.join(&frame.name), frame)?,
                None => pieces::inputs(&host.inputs(frame).map_err(within)?),
            };
            // Frames stand alone: whoever took them, the next one may be somebody else's.
            let setup = parcel.setup.or(session.setup().unwrap_or_default());
            if session.setup() != Some(setup) {
                session.configure(setup)?;
                session.take_bytes_sent();
            }
            let answered = session.frame(&parcel, self.detail).map_err(within)?;
            let expected = host.run(frame).map_err(within)?;
            let answer = host.answer(&expected.outputs);
            let output = host.output(&parcel.end, answer.as_ref());
            let reference = Reference { image: self.image, expected: &expected, answer: answer.as_ref(), output };
            let first = reference.first_difference(&answered);
            let summary = &mut self.report.summary;
            summary.bytes_compared += answered.outputs.iter().map(|bytes| bytes.len() as u64).sum::<u64>();
            summary.steps_compared += answered.steps.len() as u64;
            let class = answer.is_none().then(|| host.class(&answered.outputs)).flatten();
            if self.add(&frame.name, &answered, class, first, folder.is_some()) {
                break;
            }
            progress.inc(1);
        }
        Ok(())
    }

    fn log(
        &mut self,
        log: &Log,
        decisions: &[Decision],
        session: &mut Session<'_>,
        progress: &ProgressBar,
    ) -> Result<()> {
        let reads = Reads::of_image(self.image);
        let within = |name: &str| format!("step {name}");
        progress.set_length(log.frames.len() as u64);
        progress.set_position(0);
        // One drive has one set of sensors: the first that each of them shows.
        let mut setup = Setup::default();
        for frame in &log.frames {
            setup = setup.or(reads.step(frame).map_err(|e| e.within(within(&frame.name)))?.setup);
            if setup.is_whole() {
                break;
            }
        }
        session.configure(setup)?;
        let mut ahead = log.route.as_slice();
        for (frame, decision) in log.frames.iter().zip(decisions) {
            progress.set_message(frame.name.clone());
            let parcel = reads.step(frame).map_err(|e| e.within(within(&frame.name)))?;
            if !setup.serves(parcel.setup) {
                return Err(changed(&frame.name));
            }
            ahead = session.route(ahead)?;
            session.take_bytes_sent();
            let answered = session.frame(&parcel, self.detail).map_err(|e| e.within(within(&frame.name)))?;
            let first = compare::decisions(&decision_of(&answered), decision);
            if self.add(&frame.name, &answered, None, first, true) {
                break;
            }
            progress.inc(1);
        }
        Ok(())
    }

    /// Takes a frame into the report; whether it ends there.
    fn add(
        &mut self,
        name: &str,
        answered: &Answered,
        class: Option<usize>,
        difference: Option<Unequal>,
        by_sensors: bool,
    ) -> bool {
        let Answered { telemetry, steps, bytes_sent, .. } = answered;
        let unit = self.report.unit;
        for step in steps {
            if let Some(times) = self.step_times.get_mut(usize::from(step.step)) {
                times.push(unit.of_ticks(step.ticks, self.hertz));
            }
        }
        let decision = decision_of(answered);
        let answer = Answer::of_board(&telemetry.answer);
        let ran = telemetry.network_ticks > 0;
        self.report.frames.push(HilFrame {
            name: name.to_owned(),
            equal: difference.is_none(),
            status: decision.status,
            status_code: decision.status_code,
            steer: decision.steer,
            throttle: decision.throttle,
            brake: decision.brake,
            waypoints: decision.waypoints,
            points_px: answer.as_ref().and_then(Answer::points_px),
            top1: class,
            network: ran.then(|| unit.of_ticks(telemetry.network_ticks, self.hertz)),
            bytes_sent: *bytes_sent,
            line_s: (bytes_sent * BITS_PER_BYTE) as f64 / f64::from(self.report.baud),
        });
        let summary = &mut self.report.summary;
        summary.frames += 1;
        summary.equal += usize::from(difference.is_none());
        summary.self_tests = telemetry.self_tests;
        summary.stack_bytes = telemetry.stack_bytes;
        summary.link = telemetry.link.into();
        let Some(Unequal { place, found, expected }) = difference else { return false };
        let message = format!("board and host differ in {place}: found {found}, expected {expected}");
        let error = Error::new(ErrorCode::Check, format!("frame {name}"), message);
        self.report.failure = Some(if by_sensors { error.with_help(DIFFERENCE_HELP) } else { error });
        self.report.difference = Some(Difference { frame: name.to_owned(), place, found, expected });
        true
    }

    fn into_report(mut self) -> HilReport {
        self.report.summary.network = Spread::of(self.report.frames.iter().filter_map(|frame| frame.network));
        let image = self.image;
        let step = |(position, times): (u16, Vec<u64>)| {
            let op = image.step(position).map_or("?", |step| step.name()).to_owned();
            Some(StepTimes { position, op, times: Spread::of(times)? })
        };
        self.report.steps = (0..).zip(self.step_times).filter_map(step).collect();
        self.report
    }
}

const DIFFERENCE_HELP: &str =
    "--steps finds the first step that differs; if none does with --crop, it is the sensors' data and not the network";

fn decision_of(answered: &Answered) -> Decision {
    let telemetry = &answered.telemetry;
    let output = Output { controls: telemetry.controls, status: telemetry.status };
    Decision::new(output, Answer::of_board(&telemetry.answer).as_ref())
}

fn changed(step: &str) -> Error {
    let message = "size of the images, or axes or height of the LiDAR, change within the log";
    Error::new(ErrorCode::Frames, format!("step {step}"), message)
        .with_help("a board is told its sensors once per drive")
}
