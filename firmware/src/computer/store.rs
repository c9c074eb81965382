//! Where a new image goes.

use super::{Board, CHECKED_AT_ONCE};
use crate::image::CheckProgress;
use crate::link::{Refusal, Request, UpdateRefusal};
use crate::update::{Manifest, MappedFlash, UpdateError, Updater};

/// Memory that a new image can be written to while the old one runs.
pub trait ImageStore {
    /// An image is announced.
    ///
    /// # Errors
    /// It is not wanted.
    fn begin(&mut self, manifest: &Manifest) -> Result<(), UpdateRefusal>;

    /// The next piece of it.
    ///
    /// # Errors
    /// It does not continue the one before, or the memory failed.
    fn write(&mut self, offset: u32, bytes: &[u8]) -> Result<(), UpdateRefusal>;

    /// Checks some of it, and at the end makes it the one of the next start.
    ///
    /// # Errors
    /// It is not whole, damaged, or not one for this board.
    fn finish(&mut self, max_bytes: usize) -> Result<CheckProgress, UpdateRefusal>;

    /// The running image met its known answer.
    ///
    /// # Errors
    /// The memory failed.
    fn confirm(&mut self) -> Result<(), UpdateRefusal>;
}

impl<F: MappedFlash> ImageStore for Updater<'_, F> {
    fn begin(&mut self, manifest: &Manifest) -> Result<(), UpdateRefusal> {
        Ok(self.begin(manifest)?)
    }

    fn write(&mut self, offset: u32, bytes: &[u8]) -> Result<(), UpdateRefusal> {
        Ok(self.write(offset, bytes)?)
    }

    fn finish(&mut self, max_bytes: usize) -> Result<CheckProgress, UpdateRefusal> {
        Ok(self.finish(max_bytes)?)
    }

    fn confirm(&mut self) -> Result<(), UpdateRefusal> {
        Ok(self.confirm()?)
    }
}

/// No such memory: every update is refused.
#[derive(Clone, Copy, Debug, Default)]
pub struct NoStore;

impl ImageStore for NoStore {
    fn begin(&mut self, _: &Manifest) -> Result<(), UpdateRefusal> {
        Err(UpdateRefusal::NoStore)
    }

    fn write(&mut self, _: u32, _: &[u8]) -> Result<(), UpdateRefusal> {
        Err(UpdateRefusal::NoStore)
    }

    fn finish(&mut self, _: usize) -> Result<CheckProgress, UpdateRefusal> {
        Err(UpdateRefusal::NoStore)
    }

    fn confirm(&mut self) -> Result<(), UpdateRefusal> {
        Ok(())
    }
}

impl From<UpdateError> for UpdateRefusal {
    fn from(error: UpdateError) -> Self {
        use crate::update::Refusal;
        match error {
            UpdateError::Refused(Refusal::TooLarge { found, capacity }) => Self::TooLarge { found, capacity },
            UpdateError::Refused(Refusal::ForeignTarget { found, expected }) => Self::ForeignTarget { found, expected },
            UpdateError::Refused(Refusal::Features(bits)) => Self::Features(bits),
            UpdateError::Refused(Refusal::KernelMissing(kernel)) => Self::Features(kernel.feature()),
            UpdateError::Refused(Refusal::Arena { region, needed, found }) => Self::Arena { region, needed, found },
            UpdateError::Refused(Refusal::Interface) => Self::Interface,
            UpdateError::Refused(Refusal::Older { found, running }) => Self::Older { found, running },
            UpdateError::Refused(Refusal::Running) => Self::Running,
            UpdateError::Refused(Refusal::NotAnnounced) => Self::NotAnnounced,
            UpdateError::Refused(Refusal::Parse(_) | Refusal::Check(_)) => Self::Damaged,
            UpdateError::OnTrial => Self::OnTrial,
            UpdateError::NotBegun => Self::NotBegun,
            UpdateError::OutOfOrder { expected, .. } => Self::OutOfOrder { expected },
            UpdateError::TooLong { announced, .. } => Self::TooLong { announced },
            UpdateError::Incomplete { found, .. } => Self::Incomplete { found },
            UpdateError::Flash(_) => Self::Flash,
        }
    }
}

/// Carries out what a request asks of the store; `None` where it asks nothing of it. `between` is called while long
/// work goes on.
pub(super) fn carry_out<S: ImageStore, B: Board>(
    store: &mut S,
    request: &Request<'_>,
    board: &mut B,
    mut between: impl FnMut(&mut B),
) -> Option<Result<(), Refusal>> {
    let outcome = match request {
        Request::Announce(manifest) => store.begin(manifest),
        Request::Piece { offset, bytes } => store.write(*offset, bytes),
        Request::Install => loop {
            match store.finish(CHECKED_AT_ONCE) {
                Ok(CheckProgress::Done) => break Ok(()),
                Ok(CheckProgress::Running { .. }) => between(board),
                Err(refusal) => break Err(refusal),
            }
        },
        _ => return None,
    };
    Some(outcome.map_err(Refusal::Update))
}
