//! Why an update does not go on.

use super::record::TRIALS;
use super::requirements::Refusal;
use core::fmt;
use embedded_storage::nor_flash::NorFlashErrorKind;

/// What was asked of the flash.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub enum FlashOperation {
    /// To read into a buffer.
    Read,
    /// To write; also where the bytes do not read back.
    Write,
    /// To erase.
    Erase,
    /// To show bytes in the address space.
    Map,
}

/// The flash did not do what it was asked.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub struct FlashError {
    /// What was asked.
    pub operation: FlashOperation,
    /// The first byte, from the start of the flash.
    pub offset: u32,
    /// What the driver says.
    pub kind: NorFlashErrorKind,
}

impl fmt::Display for FlashError {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let operation = match self.operation {
            FlashOperation::Read => "read",
            FlashOperation::Write => "write",
            FlashOperation::Erase => "erase",
            FlashOperation::Map => "mapped read",
        };
        let reason = match self.kind {
            NorFlashErrorKind::NotAligned => "not aligned",
            NorFlashErrorKind::OutOfBounds => "out of bounds",
            _ => "failed",
        };
        write!(f, "flash: {operation} at {:#x}: {reason}", self.offset)
    }
}

impl core::error::Error for FlashError {}

/// Why an update does not go on.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub enum UpdateError {
    /// The image is not one for this board. The update is abandoned.
    Refused(Refusal),
    /// The running image is on trial; the other slot holds the only image to fall back to.
    OnTrial,
    /// `write` or `finish` without a `begin` before it, or after an error.
    NotBegun,
    /// A piece does not continue the last one.
    OutOfOrder {
        /// Its offset.
        found: u32,
        /// The next byte to be received.
        expected: u32,
    },
    /// A piece ends behind the announced image.
    TooLong {
        /// The byte behind the piece.
        found: u64,
        /// Bytes of the image.
        announced: u32,
    },
    /// `finish` before all bytes were received.
    Incomplete {
        /// Bytes received.
        found: u32,
        /// Bytes of the image.
        announced: u32,
    },
    /// The flash failed. The update is abandoned.
    Flash(FlashError),
}

impl From<Refusal> for UpdateError {
    fn from(refusal: Refusal) -> Self {
        Self::Refused(refusal)
    }
}

impl From<FlashError> for UpdateError {
    fn from(error: FlashError) -> Self {
        Self::Flash(error)
    }
}

impl fmt::Display for UpdateError {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Refused(refusal) => write!(f, "image refused: {refusal}"),
            Self::OnTrial => {
                write!(f, "the running image is on trial (one of {TRIALS} starts); confirm it before the next update")
            }
            Self::NotBegun => write!(f, "no update was begun"),
            Self::OutOfOrder { found, expected } => write!(f, "piece at byte {found}, expected byte {expected}"),
            Self::TooLong { found, announced } => {
                write!(f, "piece ends at byte {found}, the image was announced with {announced}")
            }
            Self::Incomplete { found, announced } => write!(f, "{found} of {announced} bytes received"),
            Self::Flash(error) => write!(f, "{error}"),
        }
    }
}

impl core::error::Error for UpdateError {}
