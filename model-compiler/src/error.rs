//! The one error of the host tools: what went wrong, where, and what to do about it.

use firmware::image::{Check, CheckError, ParseError};
use std::fmt;

/// Class of an error; the string form is the `code` of the JSON output.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum ErrorCode {
    /// A file or folder could not be read or written.
    Io,
    /// A file is damaged, truncated or not of the expected format.
    Malformed,
    /// A file holds something that is refused for safety (a pickle that calls functions).
    Refused,
    /// Well-formed, but not supported.
    Unsupported,
    /// Tensors are missing, surplus, misshapen or not finite.
    Tensors,
    /// Calibration or evaluation frames are missing or unusable.
    Frames,
    /// A value of the command line or of a target file is out of range.
    Usage,
    /// The model does not fit the target.
    TooBig,
    /// An integer bound of the arithmetic would be exceeded.
    Numeric,
    /// A board does not answer, answers damaged, or refuses.
    Link,
    /// A check ran and failed (unequal bytes, missed gate).
    Check,
}

impl ErrorCode {
    /// Stable name for machines.
    pub fn name(self) -> &'static str {
        match self {
            Self::Io => "io",
            Self::Malformed => "malformed",
            Self::Refused => "refused",
            Self::Unsupported => "unsupported",
            Self::Tensors => "tensors",
            Self::Frames => "frames",
            Self::Usage => "usage",
            Self::TooBig => "too_big",
            Self::Numeric => "numeric",
            Self::Link => "link",
            Self::Check => "check",
        }
    }

    /// Process exit status: 1 for a failed check, 2 for bad input.
    pub fn exit_status(self) -> u8 {
        if self == Self::Check { 1 } else { 2 }
    }
}

/// An error with its place and remedy. Display: `WHERE: MESSAGE` and, on a second line, `help: …`.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Error {
    /// Class.
    pub code: ErrorCode,
    /// File, tensor, node or byte.
    pub location: String,
    /// What was found and what was expected.
    pub message: String,
    /// What to do; may be empty.
    pub help: String,
}

/// Result of the host tools.
pub type Result<T> = std::result::Result<T, Error>;

impl Error {
    /// An error at a place.
    pub fn new(code: ErrorCode, location: impl Into<String>, message: impl Into<String>) -> Self {
        Self { code, location: location.into(), message: message.into(), help: String::new() }
    }

    /// Adds the remedy.
    #[must_use]
    pub fn with_help(mut self, help: impl Into<String>) -> Self {
        self.help = help.into();
        self
    }

    /// Prefixes the place with an outer one (`file: tensor …`).
    #[must_use]
    pub fn within(mut self, outer: impl fmt::Display) -> Self {
        self.location =
            if self.location.is_empty() { outer.to_string() } else { format!("{outer}: {}", self.location) };
        self
    }

    /// A failed file operation.
    pub fn io(path: &std::path::Path, error: &std::io::Error) -> Self {
        let help = match error.kind() {
            std::io::ErrorKind::NotFound => "check the path",
            std::io::ErrorKind::PermissionDenied => "check who may read and write there",
            _ => "",
        };
        Self::new(ErrorCode::Io, path.display().to_string(), error.to_string()).with_help(help)
    }
}

impl From<ParseError> for Error {
    fn from(error: ParseError) -> Self {
        let help = match error.check {
            Check::Format | Check::Features => "compile the model again with the compiler of this version",
            _ => DAMAGED_IMAGE,
        };
        Self::new(ErrorCode::Malformed, "", error.to_string()).with_help(help)
    }
}

impl From<CheckError> for Error {
    fn from(error: CheckError) -> Self {
        Self::new(ErrorCode::Malformed, "", error.to_string()).with_help(DAMAGED_IMAGE)
    }
}

const DAMAGED_IMAGE: &str = "the image is damaged or incomplete: copy it again, or compile the model again";

impl fmt::Display for Error {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        if !self.location.is_empty() {
            write!(f, "{}: ", self.location)?;
        }
        write!(f, "{}", self.message)?;
        if !self.help.is_empty() {
            write!(f, "\n  help: {}", self.help)?;
        }
        Ok(())
    }
}

impl std::error::Error for Error {}
