//! Shapes, element types and typed indices.
//!
//! Activations are stored row-major, channel fastest: a feature map is `height × width × channels` (NHWC with batch
//! 1), a token matrix is `tokens × 1 × channels`, a vector is `1 × 1 × channels`.

use serde::{Deserialize, Serialize};

/// Index of a tensor record in the image's tensor table.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub struct TensorId(pub u16);

/// The one widening from a stored index or size to `usize` (all targets have at least 32 bits).
#[inline]
pub const fn index(value: u32) -> usize {
    value as usize
}

/// Height, width, channels of an activation; see the module page for the layout.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, Serialize, Deserialize)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub struct Shape {
    /// Rows of a map; tokens of a token matrix.
    pub height: u16,
    /// Columns of a map.
    pub width: u16,
    /// Channels, fastest in memory.
    pub channels: u16,
}

impl Shape {
    /// A map of `height × width × channels`.
    pub const fn map(height: u16, width: u16, channels: u16) -> Self {
        Self { height, width, channels }
    }

    /// A matrix of `tokens × channels`.
    pub const fn tokens(tokens: u16, channels: u16) -> Self {
        Self { height: tokens, width: 1, channels }
    }

    /// A vector of `channels` values.
    pub const fn vector(channels: u16) -> Self {
        Self { height: 1, width: 1, channels }
    }

    /// Positions (height × width): rows of the matrix that a linear layer sees.
    pub const fn positions(&self) -> u32 {
        self.height as u32 * self.width as u32
    }

    /// Number of elements; `u64` because a hostile shape may exceed `u32`.
    pub const fn elements(&self) -> u64 {
        self.positions() as u64 * self.channels as u64
    }
}

/// Element type of a tensor in the arena.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, Serialize, Deserialize)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
#[repr(u8)]
pub enum ElementType {
    /// Affine 8-bit codes: `real = scale · (code − zero_point)`.
    I8 = 0,
    /// Symmetric 16-bit codes (zero point 0).
    I16 = 1,
    /// Fixed-point words (goal, waypoints: Q16 meters).
    I32 = 2,
    /// Bytes used inside one step only.
    Scratch = 3,
}

impl ElementType {
    /// Bytes of one element.
    pub const fn bytes(self) -> u32 {
        match self {
            Self::I8 | Self::Scratch => 1,
            Self::I16 => 2,
            Self::I32 => 4,
        }
    }

    /// Zero points that an operand of this type may have: any code for 8 bits, 0 otherwise.
    pub const fn zero_points(self) -> core::ops::RangeInclusive<i16> {
        match self {
            Self::I8 => -128..=127,
            Self::I16 | Self::I32 | Self::Scratch => 0..=0,
        }
    }

    /// Codes of an 8- or 16-bit activation; 0 alone for the other types, which hold no codes.
    pub const fn codes(self) -> core::ops::RangeInclusive<i16> {
        match self {
            Self::I8 => -128..=127,
            Self::I16 => i16::MIN..=i16::MAX,
            Self::I32 | Self::Scratch => 0..=0,
        }
    }

    /// The type with this stored code.
    pub const fn from_code(code: u8) -> Option<Self> {
        match code {
            0 => Some(Self::I8),
            1 => Some(Self::I16),
            2 => Some(Self::I32),
            3 => Some(Self::Scratch),
            _ => None,
        }
    }
}

/// Borrowed codes of an activation that may be stored narrow or wide.
#[derive(Clone, Copy, Debug)]
pub enum Codes<'a> {
    /// 8-bit codes.
    I8(&'a [i8]),
    /// 16-bit codes.
    I16(&'a [i16]),
}

/// Mutable counterpart of [`Codes`].
#[derive(Debug)]
pub enum CodesMut<'a> {
    /// 8-bit codes.
    I8(&'a mut [i8]),
    /// 16-bit codes.
    I16(&'a mut [i16]),
}
