//! The codes that every call answers, and their words.

use crate::engine::EngineError;
use crate::image::{Check, CheckError, ParseError};
use core::ffi::CStr;

/// What a call answers. A number never changes its meaning; new ones are added at the end.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[repr(i32)]
pub enum Status {
    /// Done.
    Ok = 0,
    /// A pointer is null.
    NullPointer = 1,
    /// A pointer is not aligned as its type, the image (16) or the region (`fw_image_parse` tells) asks for.
    Misaligned = 2,
    /// A length is negative as a signed number, or the memory would wrap around the address space.
    WrongSize = 3,
    /// Engine, image, regions or inputs share memory.
    Overlap = 4,
    /// `fw_engine_init` has not set up this engine, or it failed.
    NotInitialized = 5,
    /// The number of regions differs from the image's.
    RegionCount = 6,
    /// A region has fewer bytes than the image asks for.
    RegionTooSmall = 7,
    /// The bytes are no model image, or a truncated or contradictory one.
    ImageMalformed = 8,
    /// The image is of another format, or needs features that this library does not have.
    ImageUnsupported = 9,
    /// A section of the image does not agree with its CRC.
    ImageDamaged = 10,
    /// The image is no longer what `fw_engine_init` accepted; the inference is abandoned.
    ImageChanged = 11,
    /// The image uses a kernel that this library does not have.
    KernelMissing = 12,
    /// The number of inputs differs from the network's.
    InputCount = 13,
    /// The length of an input differs from the tensor's.
    InputBytes = 14,
    /// The network has no input or output of this index.
    NoSuchPort = 15,
    /// A step was asked for, but no inference was started.
    NotStarted = 16,
    /// An output was asked for before the last step was done.
    NotDone = 17,
    /// The output does not hold waypoints.
    NoWaypoints = 18,
    /// The array is too short for what the call has to write.
    TooShort = 19,
    /// The image holds no known answer, so there is no self-test.
    NoKnownAnswer = 20,
    /// A step of the self-test gave other bytes than the image's known answer.
    WrongAnswer = 21,
}

/// All codes in order of their numbers.
pub(super) const ALL: [Status; 22] = [
    Status::Ok,
    Status::NullPointer,
    Status::Misaligned,
    Status::WrongSize,
    Status::Overlap,
    Status::NotInitialized,
    Status::RegionCount,
    Status::RegionTooSmall,
    Status::ImageMalformed,
    Status::ImageUnsupported,
    Status::ImageDamaged,
    Status::ImageChanged,
    Status::KernelMissing,
    Status::InputCount,
    Status::InputBytes,
    Status::NoSuchPort,
    Status::NotStarted,
    Status::NotDone,
    Status::NoWaypoints,
    Status::TooShort,
    Status::NoKnownAnswer,
    Status::WrongAnswer,
];

impl Status {
    /// What it means, in a few words.
    pub const fn words(self) -> &'static CStr {
        match self {
            Self::Ok => c"done",
            Self::NullPointer => c"a pointer is null",
            Self::Misaligned => c"a pointer is not aligned",
            Self::WrongSize => c"a length exceeds the address space",
            Self::Overlap => c"engine, image, regions or inputs share memory",
            Self::NotInitialized => c"the engine is not initialized",
            Self::RegionCount => c"the number of regions differs from the image's",
            Self::RegionTooSmall => c"a region is smaller than the image asks for",
            Self::ImageMalformed => c"this is no model image, or a damaged one",
            Self::ImageUnsupported => c"the image is of another format or needs features that are missing here",
            Self::ImageDamaged => c"a section of the image does not agree with its CRC",
            Self::ImageChanged => c"the image changed after it was accepted",
            Self::KernelMissing => c"the image uses a kernel that is missing here",
            Self::InputCount => c"the number of inputs differs from the network's",
            Self::InputBytes => c"an input has a wrong length",
            Self::NoSuchPort => c"the network has no input or output of this index",
            Self::NotStarted => c"no inference was started",
            Self::NotDone => c"the inference is not done",
            Self::NoWaypoints => c"the output does not hold waypoints",
            Self::TooShort => c"the array is too short",
            Self::NoKnownAnswer => c"the image holds no known answer",
            Self::WrongAnswer => c"the self-test gave other bytes than the known answer",
        }
    }
}

impl From<ParseError> for Status {
    fn from(error: ParseError) -> Self {
        match error.check {
            Check::Misaligned => Self::Misaligned,
            Check::Format | Check::Features => Self::ImageUnsupported,
            _ => Self::ImageMalformed,
        }
    }
}

impl From<CheckError> for Status {
    fn from(_: CheckError) -> Self {
        Self::ImageDamaged
    }
}

impl From<EngineError> for Status {
    fn from(error: EngineError) -> Self {
        match error {
            EngineError::RegionMissing(_) | EngineError::RegionCount { .. } => Self::RegionCount,
            EngineError::ArenaTooSmall { .. } => Self::RegionTooSmall,
            EngineError::ArenaMisaligned { .. } => Self::Misaligned,
            EngineError::KernelMissing(_) => Self::KernelMissing,
            EngineError::InputCount { .. } => Self::InputCount,
            EngineError::InputBytes { .. } => Self::InputBytes,
            EngineError::NoSuchInput(_) | EngineError::NoSuchOutput(_) => Self::NoSuchPort,
            EngineError::NotStarted => Self::NotStarted,
            EngineError::NotDone => Self::NotDone,
            EngineError::NoWaypoints(_) => Self::NoWaypoints,
            EngineError::NoKnownAnswer => Self::NoKnownAnswer,
            EngineError::WrongAnswer { .. } => Self::WrongAnswer,
            EngineError::ImageChanged { .. } => Self::ImageChanged,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn numbers_are_positions_and_no_words_are_said_twice() {
        for (position, status) in ALL.into_iter().enumerate() {
            assert_eq!(status as usize, position);
            assert!(ALL.iter().take(position).all(|other| other.words() != status.words()), "{status:?}");
        }
    }
}
