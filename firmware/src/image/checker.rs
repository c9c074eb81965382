//! All bytes of an image against its CRCs, in slices as small as the caller's time allows.

use super::{Image, Section, SectionKind, layout};
use core::fmt;
use crc::{CRC_32_ISO_HDLC, Crc, Table};

static CRC: Crc<u32, Table<1>> = Crc::<u32, Table<1>>::new(&CRC_32_ISO_HDLC);

/// CRC-32 (ISO-HDLC, the one of zip and Ethernet) of some bytes.
pub fn crc32(bytes: &[u8]) -> u32 {
    CRC.checksum(bytes)
}

/// [`crc32`] of bytes that come in parts.
pub(crate) type Digest = crc::Digest<'static, u32, Table<1>>;

/// Of no bytes yet.
pub(crate) fn digest() -> Digest {
    CRC.digest()
}

/// A section is damaged.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub struct CheckError {
    /// The section.
    pub section: SectionKind,
    /// CRC-32 of its bytes.
    pub found: u32,
    /// CRC-32 in the header.
    pub expected: u32,
}

impl fmt::Display for CheckError {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Self { section, found, expected } = self;
        write!(f, "{} section: damaged: CRC {found:08x}, expected {expected:08x}", section.name())
    }
}

impl core::error::Error for CheckError {}

/// How far a check is.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub enum CheckProgress {
    /// Bytes remain.
    Running {
        /// Bytes read so far.
        checked: u32,
    },
    /// Every section agrees with its CRC.
    Done,
}

/// A check under way; see [`Image::check`] for the whole in one call.
#[derive(Debug)]
pub struct Checker<'a> {
    bytes: &'a [u8],
    cursor: Cursor,
}

impl<'a> Checker<'a> {
    /// Begins with the first section (the header's own CRC is checked by `parse`).
    pub fn new(image: &Image<'a>) -> Self {
        Self { bytes: image.bytes, cursor: Cursor::new(image) }
    }

    /// Reads at most `max_bytes` more bytes (at least 1).
    ///
    /// # Errors
    /// The first section that is damaged; calling on after that starts with the next section.
    pub fn advance(&mut self, max_bytes: usize) -> Result<CheckProgress, CheckError> {
        self.cursor.advance(self.bytes, max_bytes)
    }
}

/// Where a check stands, without the image, so that it can wait while the flash is used for something else.
pub(crate) struct Cursor {
    sections: [Section; layout::SECTIONS],
    section: usize,
    /// Bytes of the current section that are read.
    position: usize,
    digest: Digest,
    checked: u32,
}

impl fmt::Debug for Cursor {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("Cursor").field("section", &self.section).field("position", &self.position).finish()
    }
}

impl Cursor {
    pub(crate) fn new(image: &Image<'_>) -> Self {
        Self { sections: image.sections, section: 0, position: 0, digest: digest(), checked: 0 }
    }

    /// Reads on in `bytes`, the whole image.
    pub(crate) fn advance(&mut self, bytes: &[u8], max_bytes: usize) -> Result<CheckProgress, CheckError> {
        let mut budget = max_bytes.max(1);
        while let Some((kind, section)) = SectionKind::ALL.into_iter().zip(self.sections).nth(self.section) {
            let rest = section.padded(bytes).get(self.position..).unwrap_or_default();
            let slice = rest.get(..budget.min(rest.len())).unwrap_or_default();
            self.digest.update(slice);
            self.position = self.position.saturating_add(slice.len());
            self.checked = self.checked.saturating_add(u32::try_from(slice.len()).unwrap_or(u32::MAX));
            budget = budget.saturating_sub(slice.len());
            if slice.len() < rest.len() {
                return Ok(CheckProgress::Running { checked: self.checked });
            }
            self.finish_section(kind, section.crc)?;
        }
        Ok(CheckProgress::Done)
    }

    fn finish_section(&mut self, section: SectionKind, expected: u32) -> Result<(), CheckError> {
        let found = core::mem::replace(&mut self.digest, digest()).finalize();
        self.section = self.section.saturating_add(1);
        self.position = 0;
        if found == expected { Ok(()) } else { Err(CheckError { section, found, expected }) }
    }
}

impl Image<'_> {
    /// Compares every section with its CRC. The self-test of the engine then proves the arithmetic.
    ///
    /// # Errors
    /// The first section that is damaged.
    pub fn check(&self) -> Result<(), CheckError> {
        Checker::new(self).advance(usize::MAX).map(|_| ())
    }
}
