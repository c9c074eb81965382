//! The test of image and known answer: whole at once, or slice by slice while nothing else is to do.

use super::CHECKED_AT_ONCE;
use crate::engine::{Engine, EngineError, Progress};
use crate::image::{CheckProgress, Checker, Image};
use crate::kernels::Kernels;
use crate::link::Refusal;

/// Where the test is.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Phase {
    /// The bytes of the image against its CRCs.
    Image,
    /// Steps of the known answer against theirs.
    KnownAnswer,
}

/// A test that goes round and round.
#[derive(Debug)]
pub(super) struct SelfTest<'i> {
    image: Image<'i>,
    checker: Checker<'i>,
    phase: Phase,
    passed: u32,
    failure: Option<Refusal>,
}

impl<'i> SelfTest<'i> {
    /// Before its first slice.
    pub fn new(image: Image<'i>) -> Self {
        Self { image, checker: Checker::new(&image), phase: Phase::Image, passed: 0, failure: None }
    }

    /// Rounds that ended well.
    pub const fn passed(&self) -> u32 {
        self.passed
    }

    /// Why the image is not to be trusted any more.
    pub const fn failure(&self) -> Option<Refusal> {
        self.failure
    }

    /// Begins the round anew.
    pub fn restart(&mut self) {
        self.checker = Checker::new(&self.image);
        self.phase = Phase::Image;
    }

    /// The next slice: some bytes, or a step of the network. `true` at the end of a round.
    ///
    /// # Errors
    /// [`Refusal::SelfTestFailed`], now and for ever.
    pub fn advance<K: Kernels>(&mut self, engine: &mut Engine<'_, K>) -> Result<bool, Refusal> {
        self.failure.map_or(Ok(()), Err)?;
        let outcome = match self.phase {
            Phase::Image => self.check_bytes(engine),
            Phase::KnownAnswer => self.run_step(engine),
        };
        outcome.inspect_err(|failure| self.failure = Some(*failure))
    }

    fn check_bytes<K: Kernels>(&mut self, engine: &mut Engine<'_, K>) -> Result<bool, Refusal> {
        let progress = self.checker.advance(CHECKED_AT_ONCE).map_err(|_| Refusal::SelfTestFailed { step: None })?;
        if progress == CheckProgress::Done {
            engine.start_self_test().map_err(failed)?;
            self.phase = Phase::KnownAnswer;
        }
        Ok(false)
    }

    fn run_step<K: Kernels>(&mut self, engine: &mut Engine<'_, K>) -> Result<bool, Refusal> {
        match engine.self_test_step() {
            Ok(Progress::Running { .. }) => Ok(false),
            Ok(Progress::Done) => {
                self.passed = self.passed.saturating_add(1);
                self.restart();
                Ok(true)
            }
            // A frame came in between.
            Err(EngineError::NotStarted) => engine.start_self_test().map(|()| false).map_err(failed),
            Err(error) => Err(failed(error)),
        }
    }
}

fn failed(error: EngineError) -> Refusal {
    let step = match error {
        EngineError::WrongAnswer { step, .. } | EngineError::ImageChanged { step } => Some(step),
        _ => None,
    };
    Refusal::SelfTestFailed { step }
}
