//! Where requests are carried out.

use super::line::{Order, Sender};
use super::log;
use super::network::{Network, network_output};
use super::rig::{Rig, Sensed};
use super::self_test::SelfTest;
use super::store::{self, ImageStore};
use super::{Board, Exit, StartTimes};
use crate::actuators::Actuate;
use crate::drive::{Controls, Driver, Fault, Measurements, NetworkError, NetworkInputs, Output, Reading, Real};
use crate::drive::{Status, Step};
use crate::engine::{Engine, Progress};
use crate::image::crc32;
use crate::kernels::Kernels;
use crate::link::{self, Answer, Configuration, Detail, Identity, MAX_PIECE, PROTOCOL, Refusal, Request, Response};
use crate::link::{StepReport, Telemetry};

/// Most ticks without a frame that the schedule is told one by one; of more it is told as many, even or odd.
const MAX_SKIPPED: u32 = 64;

/// How long nothing must have come before a slice of the test is run, milliseconds.
const QUIET_MS: u64 = 20;
/// The same, while a new image is coming.
const QUIET_UPDATE_MS: u64 = 10_000;

/// Why a drive ends.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) enum End {
    Configure(Configuration),
    Exit(Exit),
}

/// A frame under way.
#[derive(Clone, Copy, Debug)]
struct Frame {
    number: u32,
    detail: Detail,
    /// Packets were lost since its begin.
    is_incomplete: bool,
    /// A piece of it was refused already; the feeder need not hear it again.
    is_refused: bool,
}

/// What outlives a drive.
pub(super) struct Lent<'i, 'm, B, A, S> {
    pub sender: &'m mut Sender,
    pub board: &'m mut B,
    pub actuators: &'m mut A,
    pub store: &'m mut S,
    pub test: &'m mut SelfTest<'i>,
}

/// All that a drive consists of.
pub(super) struct Desk<'i, 'a, 'm, B, A, K, S> {
    pub lent: Lent<'i, 'm, B, A, S>,
    engine: Engine<'a, K>,
    rig: Rig<'m>,
    network: Option<Network>,
    driver: Driver,
    configuration: Configuration,
    times: StartTimes,
    frame: Option<Frame>,
    last_frame: Option<u32>,
    /// When the last byte came.
    last_byte: u64,
    /// A new image was announced and is not installed yet.
    is_updating: bool,
    /// When the last frame of a drive ended, or the vehicle was last stopped for silence.
    last_end: Option<u64>,
    /// A piece without a frame was refused already.
    is_refused: bool,
}

impl<'i, 'a, 'm, B: Board, A: Actuate, K: Kernels, S: ImageStore> Desk<'i, 'a, 'm, B, A, K, S> {
    /// A drive before its first frame.
    pub fn new(
        configuration: Configuration,
        times: StartTimes,
        engine: Engine<'a, K>,
        rig: Rig<'m>,
        lent: Lent<'i, 'm, B, A, S>,
    ) -> Self {
        let network = Network::of_image(engine.image());
        // An image that drives nothing is never driven.
        let profile = network.map_or(crate::drive::System::TransFuser.profile(), |network| network.profile);
        Self {
            lent,
            engine,
            rig,
            network,
            driver: Driver::new(profile),
            configuration,
            times,
            frame: None,
            last_frame: None,
            last_byte: 0,
            is_updating: false,
            last_end: None,
            is_refused: false,
        }
    }

    /// A byte was received.
    pub fn hear(&mut self) {
        self.last_byte = self.lent.board.ticks();
    }

    /// Nothing was received: watches the silence, tests a slice.
    pub fn idle(&mut self) {
        self.watch_silence();
        // A slice may take as long as a step of the network: not in the middle of a conversation.
        let quiet_ms = if self.is_updating { QUIET_UPDATE_MS } else { QUIET_MS };
        let quiet = quiet_ms.saturating_mul(self.lent.board.hertz()) / 1000;
        if self.lent.board.ticks().wrapping_sub(self.last_byte) < quiet {
            self.lent.board.wait();
            return;
        }
        let is_wanted = self.configuration.tests_in_background
            || (self.configuration.needs_self_test && self.lent.test.passed() == 0);
        // The arena holds the inputs of a frame under way.
        if self.frame.is_some() || !is_wanted || self.lent.test.failure().is_some() {
            self.lent.board.wait();
            return;
        }
        match self.lent.test.advance(&mut self.engine) {
            Ok(false) => {}
            // Where that fails, the image stays on trial, and the next round tries again.
            Ok(true) => drop(self.lent.store.confirm()),
            Err(reason) => {
                log::self_test_failed(reason);
                if self.last_end.is_some() {
                    let output = self.driver.halt(Fault::NetworkFailed);
                    self.finish(self.last_frame.unwrap_or(0), output, Answer::None, 0);
                }
            }
        }
    }

    /// Carries out what a packet asks for. `Some`: the drive is over.
    pub fn handle(&mut self, packet: &[u8]) -> Option<End> {
        let (sequence, request) = match link::decode::<Request<'_>>(packet) {
            Ok(decoded) => decoded,
            Err(_) => {
                self.lent.sender.count_damaged();
                return None;
            }
        };
        match self.lent.sender.note(sequence, request == Request::Identify) {
            Order::Next => {}
            Order::AfterLoss => {
                if let Some(frame) = &mut self.frame {
                    frame.is_incomplete = true;
                }
            }
            Order::Repeated => return None,
        }
        let mut end = None;
        let outcome = match request {
            Request::Identify => {
                self.identify();
                return None;
            }
            Request::Configure(configuration) => Rig::check(self.engine.image(), &configuration).map(|()| {
                end = Some(End::Configure(configuration));
            }),
            Request::SelfTest => self.self_test(),
            Request::Route(node) => self.driver.route().push(node).map_err(|_| Refusal::RouteFull),
            Request::Restart => {
                end = Some(End::Exit(Exit::Restart));
                Ok(())
            }
            Request::Halt if self.lent.board.can_halt() => {
                end = Some(End::Exit(Exit::Halt));
                Ok(())
            }
            Request::Halt => Err(Refusal::NoHalt),
            Request::Announce(_) | Request::Piece { .. } | Request::Install => {
                let Lent { sender, board, store, .. } = &mut self.lent;
                let between = |board: &mut B| {
                    board.feed_watchdog();
                    sender.take_in(board);
                };
                let outcome = store::carry_out(*store, &request, *board, between).unwrap_or(Ok(()));
                self.is_updating = outcome.is_ok() && !matches!(request, Request::Install);
                outcome
            }
            Request::Begin { frame, detail } => return self.silently(sequence, |desk| desk.begin(frame, detail)),
            Request::Row { view, row, offset, bytes } => {
                return self
                    .silently(sequence, |desk| desk.piece(|rig, engine| rig.row(engine, view, row, offset, bytes)));
            }
            Request::Points(bytes) => {
                return self.silently(sequence, |desk| desk.piece(|rig, engine| rig.points(engine, bytes)));
            }
            Request::Input { input, offset, bytes } => {
                return self
                    .silently(sequence, |desk| desk.piece(|rig, engine| rig.piece(engine, input, offset, bytes)));
            }
            Request::End(what) => {
                if let Err(reason) = self.end(what) {
                    self.refuse(sequence, reason);
                }
                self.watch_silence();
                return None;
            }
        };
        self.lent.sender.answer(self.lent.board, sequence, outcome);
        end
    }

    fn refuse(&mut self, request: u16, reason: Refusal) {
        self.lent.sender.answer(self.lent.board, request, Err(reason));
    }

    /// Carries out what is not answered, but for its first refusal.
    fn silently(&mut self, request: u16, carry_out: impl FnOnce(&mut Self) -> Result<(), Refusal>) -> Option<End> {
        if let Err(reason) = carry_out(self) {
            let is_refused = self.frame.as_mut().map_or(&mut self.is_refused, |frame| &mut frame.is_refused);
            if !core::mem::replace(is_refused, true) {
                self.refuse(request, reason);
            }
        }
        self.watch_silence();
        None
    }

    fn identify(&mut self) {
        let image = *self.engine.image();
        let bytes = image.bytes();
        let identity = |board| Identity {
            protocol: PROTOCOL,
            board,
            model: image.name(),
            qmodel_digest: image.qmodel_digest(),
            build_digest: image.build_digest(),
            image_bytes: u32::try_from(bytes.len()).unwrap_or(u32::MAX),
            header_crc: image.header_crc(),
            revision: image.revision(),
            target: image.target().into(),
            hertz: self.lent.board.hertz(),
            parse_ticks: self.times.parse,
            check_ticks: self.times.check,
        };
        // The name is copied, since the board lends it and sends the message.
        let mut name = heapless::String::<32>::new();
        let whole = self.lent.board.name();
        let _ = name.push_str(whole.get(..whole.len().min(32)).unwrap_or_default());
        let message = Response::Identity(identity(&name));
        self.lent.sender.send(self.lent.board, &message);
    }

    /// Image and known answer, whole.
    fn self_test(&mut self) -> Result<(), Refusal> {
        self.abandon();
        self.lent.test.restart();
        while !self.lent.test.advance(&mut self.engine)? {
            self.lent.board.feed_watchdog();
            self.lent.sender.take_in(self.lent.board);
        }
        self.lent.store.confirm().map_err(Refusal::Update)
    }

    fn abandon(&mut self) {
        if self.frame.take().is_some() {
            let counter = &mut self.lent.sender.counters.abandoned_frames;
            *counter = counter.saturating_add(1);
        }
    }

    fn begin(&mut self, number: u32, detail: Detail) -> Result<(), Refusal> {
        self.abandon();
        self.lent.test.failure().map_or(Ok(()), Err)?;
        if self.configuration.needs_self_test && self.lent.test.passed() == 0 {
            return Err(Refusal::Untested);
        }
        if let Some(last) = self.last_frame.filter(|last| *last >= number) {
            return Err(Refusal::OldFrame { last });
        }
        let missed = self.last_frame.map_or(0, |last| number.wrapping_sub(last).wrapping_sub(1));
        let told = if missed > MAX_SKIPPED { MAX_SKIPPED | (missed & 1) } else { missed };
        (0..told).for_each(|_| self.driver.skip());
        self.last_frame = Some(number);
        self.frame = Some(Frame { number, detail, is_incomplete: false, is_refused: false });
        self.is_refused = false;
        self.rig.begin(&mut self.engine);
        Ok(())
    }

    fn piece(
        &mut self,
        take: impl FnOnce(&mut Rig<'m>, &mut Engine<'a, K>) -> Result<(), Refusal>,
    ) -> Result<(), Refusal> {
        let frame = self.frame.as_mut().ok_or(Refusal::NoFrame)?;
        let outcome = take(&mut self.rig, &mut self.engine);
        frame.is_incomplete |= outcome.is_err();
        outcome
    }

    fn end(&mut self, what: link::End) -> Result<(), Refusal> {
        let frame = self.frame.take().ok_or(Refusal::NoFrame)?;
        let mut sensed = self.rig.finish();
        if frame.is_incomplete {
            let counter = &mut self.lent.sender.counters.incomplete_frames;
            *counter = counter.saturating_add(1);
            sensed = Sensed { camera: Some(Reading::Missing), lidar: Some(Reading::Missing) };
        }
        match what {
            link::End::Infer(small) => self.infer_once(&frame, small.as_ref()),
            link::End::Drive(measurements) => self.drive(&frame, sensed, measurements),
        }
    }

    /// The network on exactly what came; the controller in its fresh state.
    fn infer_once(&mut self, frame: &Frame, small: Option<&NetworkInputs>) -> Result<(), Refusal> {
        if frame.is_incomplete || !self.rig.complete(&mut self.engine, small) {
            return Err(Refusal::InputsMissing);
        }
        let (outcome, ticks) =
            infer(&mut self.engine, self.lent.board, self.lent.sender, self.configuration.budget_ms, frame.detail);
        let answer = match (outcome, &self.network) {
            (Ok(()), Some(network)) => network.answer(&self.engine),
            _ => Answer::None,
        };
        let stopped = |fault| Output { controls: Controls::stop(Real::ZERO), status: Status::Fault(fault) };
        let output = match (outcome, &self.network, small) {
            (Err(NetworkError::Overrun), ..) => stopped(Fault::NetworkOverrun),
            (Err(NetworkError::Failed), ..) => stopped(Fault::NetworkFailed),
            (Ok(()), Some(network), Some(small)) => {
                let output = network_output(&answer).map_err(|_| Fault::NetworkFailed);
                let controls = output.and_then(|output| network.profile.controls(output, Real::from(small.velocity)));
                controls.map_or_else(stopped, |controls| Output { controls, status: Status::Driving })
            }
            (Ok(()), ..) => Output { controls: Controls::ZERO, status: Status::Filling },
        };
        self.send_outputs(frame.detail, outcome);
        self.report(frame.number, output, None, answer, ticks);
        Ok(())
    }

    /// A step of the drive.
    fn drive(&mut self, frame: &Frame, sensed: Sensed, told: Measurements) -> Result<(), Refusal> {
        let Some(network) = self.network else { return Err(Refusal::NoDriver) };
        let measurements =
            Measurements { camera: worse(told.camera, sensed.camera), lidar: worse(told.lidar, sensed.lidar), ..told };
        let pending = match self.driver.step(&measurements) {
            Step::Network(pending) => pending,
            Step::Done(output) => {
                self.finish(frame.number, output, Answer::None, 0);
                return Ok(());
            }
        };
        let mut ran = (Err(NetworkError::Failed), 0);
        if self.rig.complete(&mut self.engine, Some(pending.inputs())) {
            ran =
                infer(&mut self.engine, self.lent.board, self.lent.sender, self.configuration.budget_ms, frame.detail);
        }
        let (outcome, ticks) = ran;
        let answer = outcome.map_or(Answer::None, |()| network.answer(&self.engine));
        // The budget alone says what is late.
        let output = pending.finish(outcome.and_then(|()| network_output(&answer)), 0);
        self.send_outputs(frame.detail, outcome);
        self.finish(frame.number, output, answer, ticks);
        Ok(())
    }

    fn send_outputs(&mut self, detail: Detail, outcome: Result<(), NetworkError>) {
        if !detail.outputs || outcome.is_err() {
            return;
        }
        for output in 0..self.engine.image().output_count() {
            let bytes = self.engine.output(output.into()).unwrap_or_default();
            let mut offset = 0_u32;
            for bytes in bytes.chunks(MAX_PIECE) {
                self.lent.sender.send(self.lent.board, &Response::Output { output, offset, bytes });
                offset = offset.saturating_add(MAX_PIECE as u32);
            }
        }
    }

    /// Ends a frame of the drive: actuators and telemetry.
    fn finish(&mut self, frame: u32, output: Output, answer: Answer, ticks: u64) {
        let duties = self.lent.actuators.apply(&output);
        self.last_end = Some(self.lent.board.ticks());
        self.report(frame, output, Some(duties), answer, ticks);
    }

    fn report(
        &mut self,
        frame: u32,
        output: Output,
        duties: Option<Result<crate::actuators::Duties, crate::actuators::ActuatorFault>>,
        answer: Answer,
        network_ticks: u64,
    ) {
        log::ended(frame, output.status, network_ticks);
        let telemetry = Telemetry {
            frame,
            status: output.status,
            controls: output.controls,
            duties,
            answer,
            network_ticks,
            counters: *self.driver.counters(),
            link: self.lent.sender.counters,
            self_tests: self.lent.test.passed(),
            stack_bytes: self.lent.board.stack_bytes(),
        };
        self.lent.sender.send(self.lent.board, &Response::Telemetry(telemetry));
    }

    /// Stops the vehicle if no frame of its drive ended for too long.
    fn watch_silence(&mut self) {
        let Some(last) = self.last_end.filter(|_| self.configuration.silence_ms > 0) else { return };
        let limit = u64::from(self.configuration.silence_ms).saturating_mul(self.lent.board.hertz()) / 1000;
        if self.lent.board.ticks().wrapping_sub(last) > limit {
            let output = self.driver.halt(Fault::Silence);
            self.finish(self.last_frame.unwrap_or(0), output, Answer::None, 0);
        }
    }
}

/// Runs the network under its budget. Ticks are those of its steps alone.
fn infer<K: Kernels, B: Board>(
    engine: &mut Engine<'_, K>,
    board: &mut B,
    sender: &mut Sender,
    budget_ms: u32,
    detail: Detail,
) -> (Result<(), NetworkError>, u64) {
    let budget = u64::from(budget_ms).saturating_mul(board.hertz()) / 1000;
    let mut spent = 0_u64;
    engine.begin();
    loop {
        let begin = board.ticks();
        let mut report = StepReport { step: 0, crc: 0, ticks: 0 };
        let progress = engine.step_observed(|position, _, written| {
            report.step = u16::try_from(position).unwrap_or(u16::MAX);
            report.ticks = board.ticks().wrapping_sub(begin);
            report.crc = if detail.steps { crc32(written) } else { 0 };
        });
        spent = spent.saturating_add(report.ticks);
        board.feed_watchdog();
        sender.take_in(board);
        if detail.steps && progress.is_ok() {
            log::step(&report);
            sender.send(board, &Response::Step(report));
        }
        match progress {
            Err(_) => return (Err(NetworkError::Failed), spent),
            Ok(_) if spent > budget => return (Err(NetworkError::Overrun), spent),
            Ok(Progress::Done) => return (Ok(()), spent),
            Ok(Progress::Running { .. }) => {}
        }
    }
}

/// What the driver is to know: what the frame brought, if it brought anything, unless the feeder knows worse.
fn worse(told: Reading<()>, sensed: Option<Reading<()>>) -> Reading<()> {
    match (told, sensed) {
        (Reading::Value { .. }, Some(sensed @ (Reading::Missing | Reading::NotANumber | Reading::Frozen))) => sensed,
        (told, _) => told,
    }
}
