//! Camera rows to codes: the image, perhaps scaled down, cropped at its center, as `u8 − 128`.
//!
//! A [`Camera`] takes the rows of an image as they arrive, whole or in pieces, in any order, and writes into the
//! network's input at once; only what the crop needs is read. [`Camera::finish`] tells which rows never came and
//! whether the camera is frozen. The crop begins at row `(H − h)/2` and column `(W − w)/2` of the scaled image, rounded
//! down: for 400×300 and 256×256 at row 22 and column 72.
//!
//! ```
//! use firmware::sensors::camera::{Camera, CameraLayout, PixelFormat, Scale, FrameStatus};
//! use firmware::tensor::Shape;
//!
//! let map = Shape::map(4, 4, 3);
//! let layout = CameraLayout {
//!     width: 8,
//!     height: 6,
//!     format: PixelFormat::Bgra,
//!     scale: Scale::Full,
//!     map,
//!     first_channel: 0,
//!     frozen_after: 10,
//! };
//! let mut memory = [0; 4];
//! let mut camera = Camera::new(layout, &mut memory).unwrap();
//! let mut input = [0; 4 * 4 * 3];
//! for row in 0..6 {
//!     camera.push(row, 0, &[255; 8 * 4], &mut input).unwrap();
//! }
//! assert_eq!(camera.finish(), Ok(FrameStatus::Live));
//! assert_eq!(input, [127; 48]);
//! ```

use super::InputSize;
use crate::drive::Reading;
use crate::tensor::Shape;
use core::fmt;
use serde::{Deserialize, Serialize};

mod capture;
mod format;
#[cfg(test)]
mod tests;
mod write;

pub use capture::Camera;
pub use format::{PixelFormat, YuvRange};

/// How much smaller than the image its crop is taken. [`Self::Full`] takes the pixels as they are.
///
/// Otherwise a component of a pixel is `R(Σ, 2k)` over the `2^k × 2^k` pixels that it covers, ties up; of YUV formats
/// Y, U and V are averaged before they become RGB. Rows and columns beyond the last whole pixel are left out.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, Serialize, Deserialize)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub enum Scale {
    /// 1:1.
    Full,
    /// Means of 2×2 pixels.
    Half,
    /// Means of 4×4 pixels.
    Quarter,
    /// Means of 8×8 pixels.
    Eighth,
}

/// Most rows of an image that make one row of its crop.
const MAX_BAND: usize = 8;

impl Scale {
    /// Binary logarithm of the side of the square that becomes one pixel.
    const fn bits(self) -> u32 {
        match self {
            Self::Full => 0,
            Self::Half => 1,
            Self::Quarter => 2,
            Self::Eighth => 3,
        }
    }
}

/// A camera and its place in a network input.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct CameraLayout {
    /// Columns of the image.
    pub width: u16,
    /// Rows of the image.
    pub height: u16,
    /// Pixels of the image.
    pub format: PixelFormat,
    /// Reduction before the crop.
    pub scale: Scale,
    /// The network's input: height and width of the crop, and all channels that interleave there.
    pub map: Shape,
    /// First of the three channels that this camera writes ([`super::views::View::first_channel`]); 0 in a map of one
    /// channel, which a grey camera writes.
    pub first_channel: u16,
    /// So many frames, one after the other, each equal to the one before, are a frozen camera; 0: never.
    pub frozen_after: u16,
}

impl CameraLayout {
    /// Rows of the image in memory; of NV12 the rows of U and V follow those of Y.
    pub const fn rows(&self) -> u32 {
        let height = self.height as u32;
        if self.is_planar() { height.saturating_add(height >> 1) } else { height }
    }

    /// Words of memory that a [`Camera`] of this layout needs.
    pub const fn memory_words(&self) -> usize {
        self.progress_words().saturating_add(self.sum_words())
    }

    const fn is_planar(&self) -> bool {
        matches!(self.format, PixelFormat::Nv12(_))
    }

    /// A word per row of the crop and plane.
    const fn progress_words(&self) -> usize {
        (self.map.height as usize) << (self.is_planar() as u32)
    }

    /// A word per column of the crop and component, where pixels are added up.
    const fn sum_words(&self) -> usize {
        match self.scale {
            Scale::Full => 0,
            _ => (self.map.width as usize).saturating_mul(3),
        }
    }

    pub(crate) fn check(&self) -> Result<(), LayoutError> {
        let (found, map) = ([self.width, self.height], self.map);
        let needed = [map.width, map.height].map(|side| u32::from(side) << self.scale.bits());
        if needed.into_iter().zip(found).any(|(needed, found)| needed == 0 || needed > u32::from(found)) {
            return Err(LayoutError::ImageSize { found, needed });
        }
        let is_odd = self.width & 1 == 1 || (self.is_planar() && self.height & 1 == 1);
        if self.format.is_subsampled() && is_odd {
            return Err(LayoutError::OddSize { found });
        }
        let is_grey = map.channels == 1 && self.format == PixelFormat::Grey && self.first_channel == 0;
        let has_three = map.channels.checked_sub(3).is_some_and(|last| self.first_channel <= last);
        if is_grey || has_three {
            return Ok(());
        }
        Err(LayoutError::Channels { first: self.first_channel, map: map.channels })
    }
}

/// Why no camera has a layout.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub enum LayoutError {
    /// The image is smaller than what the crop needs of it, or the crop is empty. Images are never enlarged.
    ImageSize {
        /// Width and height of the image.
        found: [u16; 2],
        /// Width and height that the crop needs.
        needed: [u32; 2],
    },
    /// Pixels that share their chroma come in pairs; here one has no partner.
    OddSize {
        /// Width and height of the image.
        found: [u16; 2],
    },
    /// The camera's channels do not lie in the map.
    Channels {
        /// First channel of the camera.
        first: u16,
        /// Channels of the map.
        map: u16,
    },
    /// Too little memory was lent.
    Memory {
        /// Words lent.
        found: u32,
        /// Words of [`CameraLayout::memory_words`].
        needed: u32,
    },
}

impl fmt::Display for LayoutError {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::ImageSize { found: [width, height], needed: [w, h] } => {
                write!(f, "image is {width}×{height}, the crop needs {w}×{h} and at least one pixel")
            }
            Self::OddSize { found: [width, height] } => {
                write!(f, "image is {width}×{height}, its pixels share chroma in pairs")
            }
            Self::Channels { first, map } => {
                write!(f, "channels {first}.. of a map of {map}: a camera writes three, or grey the only one")
            }
            Self::Memory { found, needed } => write!(f, "memory: {found} words, the camera needs {needed}"),
        }
    }
}

impl core::error::Error for LayoutError {}

/// Why a piece of a row is refused. Nothing of it was written.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub enum CameraError {
    /// The network's input has another size.
    Input(InputSize),
    /// The image has no such row.
    NoSuchRow {
        /// Row given.
        row: u32,
        /// Rows of the image in memory.
        rows: u32,
    },
    /// The piece begins or ends within a pixel (of subsampled formats: a pair).
    SplitPixel {
        /// Row of the piece.
        row: u32,
        /// Bytes of a pixel or pair.
        unit: u8,
    },
    /// A piece before this one is missing.
    Gap {
        /// Row of the piece.
        row: u32,
        /// First column that the row lacks.
        expected: u32,
        /// Column where the piece begins.
        found: u32,
    },
    /// The image ends before its last row that is needed.
    ImageBytes {
        /// Bytes given.
        found: u32,
        /// Row that is not whole.
        row: u32,
    },
}

impl fmt::Display for CameraError {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Input(error) => error.fmt(f),
            Self::NoSuchRow { row, rows } => write!(f, "row {row}: the image has {rows} rows in memory"),
            Self::SplitPixel { row, unit } => write!(f, "row {row}: a piece splits its units of {unit} bytes"),
            Self::Gap { row, expected, found } => {
                write!(f, "row {row}: a piece begins at column {found}, the row lacks column {expected}")
            }
            Self::ImageBytes { found, row } => write!(f, "row {row}: the image ends after {found} bytes"),
        }
    }
}

impl core::error::Error for CameraError {}

impl From<InputSize> for CameraError {
    fn from(error: InputSize) -> Self {
        Self::Input(error)
    }
}

/// Rows of the crop that lack a part. The network's input holds something older there, or Y, U and V that are no colors
/// yet.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub struct MissingRows {
    /// Number of such rows of the crop.
    pub count: u16,
    /// First row of the image that belongs to the first of them.
    pub first: u16,
}

impl fmt::Display for MissingRows {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{} rows of the crop are not whole, the first at row {} of the image", self.count, self.first)
    }
}

impl core::error::Error for MissingRows {}

/// What a whole frame says about its camera.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub enum FrameStatus {
    /// The image changes, or has not stood still for long.
    Live,
    /// The image is equal to the ones before.
    Frozen {
        /// Frames in a row that were equal to the one before.
        repeats: u16,
    },
}

/// What the driver is to know of a frame that ended in this step.
impl From<Result<FrameStatus, MissingRows>> for Reading<()> {
    fn from(frame: Result<FrameStatus, MissingRows>) -> Self {
        match frame {
            Ok(FrameStatus::Live) => Self::now(()),
            Ok(FrameStatus::Frozen { .. }) => Self::Frozen,
            // The input holds rows of several moments.
            Err(MissingRows { .. }) => Self::Missing,
        }
    }
}
