//! The receiving end: from the first announcement of an image to its record.

use super::error::UpdateError;
use super::flash::{self, MappedFlash};
use super::record::{self, Body, Record};
use super::requirements::{Manifest, Refusal, Requirements};
use super::select::Selected;
use super::slots::{PAGE, Slot, Slots};
use crate::image::{CheckProgress, Cursor, Image};
use core::fmt;
use embedded_storage::nor_flash::NorFlash;

/// Writes images into the slot that does not run. Every call does bounded work: [`Updater::begin`] erases at most two
/// sectors, [`Updater::write`] erases at most one sector and writes one page per 256 bytes received.
///
/// An error from the flash and a refusal abandon the update; a piece out of order does not. Abandoned or cut off, an
/// update leaves nothing behind that runs, and the next [`Updater::begin`] starts afresh.
pub struct Updater<'a, F> {
    flash: F,
    slots: Slots,
    requirements: Requirements<'a>,
    running: Option<Selected>,
    stage: Stage,
}

/// How far an update is.
#[derive(Debug)]
enum Stage {
    Idle,
    Receiving(Manifest, Buffer),
    Checking(Manifest, Cursor),
}

/// What was received, and the part of it that is not yet written.
#[derive(Debug)]
struct Buffer {
    written: u32,
    page: [u8; PAGE],
    filled: usize,
}

impl Buffer {
    const EMPTY: Self = Self { written: 0, page: [0xFF; PAGE], filled: 0 };

    fn received(&self) -> u32 {
        self.written.saturating_add(self.filled())
    }

    fn filled(&self) -> u32 {
        u32::try_from(self.filled).unwrap_or(u32::MAX)
    }

    /// Takes as much as fits and answers the rest.
    fn fill<'b>(&mut self, bytes: &'b [u8]) -> &'b [u8] {
        let room = self.page.get_mut(self.filled..).unwrap_or_default();
        let taken = room.len().min(bytes.len());
        room.iter_mut().zip(bytes).for_each(|(to, from)| *to = *from);
        self.filled = self.filled.saturating_add(taken);
        bytes.get(taken..).unwrap_or_default()
    }

    /// Writes the page; erases the sector that it begins first.
    fn flush<F: NorFlash>(&mut self, flash: &mut F, slots: &Slots, slot: Slot) -> Result<(), UpdateError> {
        if let Some(sector) = slots.sector(slot, self.written) {
            flash::erase(flash, sector)?;
        }
        let at = slots.image_offset(slot).saturating_add(self.written);
        let whole_words = self.filled.checked_next_multiple_of(F::WRITE_SIZE).unwrap_or(PAGE);
        flash::write(flash, at, self.page.get(..whole_words).unwrap_or_default())?;
        *self = Self { written: self.received(), ..Self::EMPTY };
        Ok(())
    }
}

impl<F> fmt::Debug for Updater<'_, F> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("Updater").field("running", &self.running).field("stage", &self.stage).finish_non_exhaustive()
    }
}

impl<'a, F: MappedFlash> Updater<'a, F> {
    /// Over the slots that [`super::select`] chose from; without a running image, updates go to slot A.
    pub fn new(flash: F, slots: Slots, requirements: Requirements<'a>, running: Option<Selected>) -> Self {
        Self { flash, slots, requirements, running, stage: Stage::Idle }
    }

    /// The image that runs.
    pub fn running(&self) -> Option<&Selected> {
        self.running.as_ref()
    }

    /// The flash.
    pub fn into_flash(self) -> F {
        self.flash
    }

    /// The slot that updates are written to.
    pub fn idle_slot(&self) -> Slot {
        self.running.map_or(Slot::A, |running| running.slot.other())
    }

    /// Bytes received so far: where the next piece starts. 0 where no update is under way.
    pub fn received(&self) -> u32 {
        match &self.stage {
            Stage::Idle => 0,
            Stage::Receiving(_, buffer) => buffer.received(),
            Stage::Checking(manifest, _) => manifest.bytes,
        }
    }

    /// Ends the trial of the running image for good: to be called after its self-test passed. Does nothing for an image
    /// that is not on trial.
    ///
    /// # Errors
    /// The flash failed; the image stays on trial.
    pub fn confirm(&mut self) -> Result<(), UpdateError> {
        let Some(running) = &mut self.running else { return Ok(()) };
        if let Some(trial) = running.trial {
            record::mark_confirmed(&mut self.flash, &self.slots, running.slot, trial)?;
            running.trial = None;
        }
        Ok(())
    }

    /// Begins an update, and abandons one that is under way: what the other slot holds is void from now on.
    ///
    /// # Errors
    /// The running image is on trial, the announced one is not for this board or older than the running one, or the
    /// flash failed. A refusal leaves the flash as it is.
    pub fn begin(&mut self, manifest: &Manifest) -> Result<(), UpdateError> {
        self.abort();
        self.admit(manifest)?;
        let slot = self.idle_slot();
        record::claim(&mut self.flash, &self.slots, slot)?;
        self.stage = Stage::Receiving(*manifest, Buffer::EMPTY);
        Ok(())
    }

    /// What can be said before the first byte.
    fn admit(&self, manifest: &Manifest) -> Result<(), UpdateError> {
        let capacity = self.slots.image_capacity();
        if manifest.bytes > capacity {
            return Err(Refusal::TooLarge { found: manifest.bytes, capacity }.into());
        }
        self.requirements.admit(manifest)?;
        let Some(running) = &self.running else { return Ok(()) };
        if running.is_on_trial() {
            return Err(UpdateError::OnTrial);
        }
        if manifest.revision < running.revision {
            return Err(Refusal::Older { found: manifest.revision, running: running.revision }.into());
        }
        if manifest.header_crc == running.header_crc && manifest.bytes == running.bytes {
            return Err(Refusal::Running.into());
        }
        Ok(())
    }

    /// Takes the next piece of the image, of any size; `offset` is its place in the image.
    ///
    /// # Errors
    /// No update was begun, the piece does not continue the last one or ends behind the image (the update goes on with
    /// the right piece), or the flash failed.
    pub fn write(&mut self, offset: u32, bytes: &[u8]) -> Result<(), UpdateError> {
        let slot = self.idle_slot();
        let Stage::Receiving(manifest, buffer) = &mut self.stage else { return Err(UpdateError::NotBegun) };
        let expected = buffer.received();
        if offset != expected {
            return Err(UpdateError::OutOfOrder { found: offset, expected });
        }
        let (announced, end) = (manifest.bytes, u64::from(offset).saturating_add(bytes.len() as u64));
        if end > u64::from(announced) {
            return Err(UpdateError::TooLong { found: end, announced });
        }
        let mut rest = bytes;
        while !rest.is_empty() {
            rest = buffer.fill(rest);
            if buffer.filled == PAGE || buffer.received() == announced {
                let written = buffer.flush(&mut self.flash, &self.slots, slot);
                if written.is_err() {
                    self.abort();
                    return written;
                }
            }
        }
        Ok(())
    }

    /// Ends an update: reads at most `max_bytes` (at least 1) of the received image back; the first call parses it
    /// instead. To be called until [`CheckProgress::Done`], with which the next start takes the new image on trial.
    ///
    /// # Errors
    /// No update was begun, bytes are missing (the update goes on), the image is damaged, other than announced or not
    /// for this board, or the flash failed.
    pub fn finish(&mut self, max_bytes: usize) -> Result<CheckProgress, UpdateError> {
        let (slot, stage) = (self.idle_slot(), core::mem::replace(&mut self.stage, Stage::Idle));
        match stage {
            Stage::Idle => Err(UpdateError::NotBegun),
            Stage::Receiving(manifest, buffer) if buffer.received() < manifest.bytes => {
                let error = UpdateError::Incomplete { found: buffer.received(), announced: manifest.bytes };
                self.stage = Stage::Receiving(manifest, buffer);
                Err(error)
            }
            Stage::Receiving(manifest, _) => {
                let bytes = flash::mapped(&self.flash, self.slots.image(slot, manifest.bytes))?;
                let image = Image::parse(bytes).map_err(Refusal::Parse)?;
                if Manifest::of(&image) != manifest {
                    return Err(Refusal::NotAnnounced.into());
                }
                self.requirements.accept(&image)?;
                self.stage = Stage::Checking(manifest, Cursor::new(&image));
                Ok(CheckProgress::Running { checked: 0 })
            }
            Stage::Checking(manifest, mut cursor) => {
                let bytes = flash::mapped(&self.flash, self.slots.image(slot, manifest.bytes))?;
                let progress = cursor.advance(bytes, max_bytes).map_err(Refusal::Check)?;
                match progress {
                    CheckProgress::Running { .. } => self.stage = Stage::Checking(manifest, cursor),
                    CheckProgress::Done => self.complete(slot, &manifest)?,
                }
                Ok(progress)
            }
        }
    }

    /// Writes the record that makes the new image the newest.
    fn complete(&mut self, slot: Slot, manifest: &Manifest) -> Result<(), UpdateError> {
        let counter = match Record::read(&mut self.flash, &self.slots, slot.other()) {
            Record::Complete(other, _) => other.counter.wrapping_add(1),
            Record::Unclaimed | Record::Claimed => 1,
        };
        let body = Body { counter, image_bytes: manifest.bytes, header_crc: manifest.header_crc };
        Ok(record::complete(&mut self.flash, &self.slots, slot, body)?)
    }

    /// Abandons an update that is under way. The other slot stays void until the next one is complete.
    pub fn abort(&mut self) {
        self.stage = Stage::Idle;
    }
}
