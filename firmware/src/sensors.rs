//! Sensor data to network inputs: integers, streaming, straight into the input's bytes.
//!
//! Each part takes what a sensor gives, as it arrives, and writes the codes that the image's input tensor expects into
//! a buffer of the caller. Nothing is stored twice, nothing is allocated, nothing panics, and equal data gives equal
//! bytes on every machine. An `f32` comes as its bits and is taken apart in integers.
//!
//! * [`camera`]: rows of an image, in any order → crop of codes `u8 − 128`; lost rows and frozen images are noticed
//! * [`views`]: which camera is which, where a network reads several
//! * [`lidar`]: points → bird's-eye-view counts 0..=5; motion between capture and now
//! * [`correspondences`]: points → cells of Geometric Fusion
//! * [`heatmap`]: goal → tenth channel of LBC
//! * [`inputs`]: speed, goal and command → fixed point
//!
//! Buffers are `i8` codes; a byte buffer becomes one by `bytemuck::cast_slice_mut`.

// Of every module below; tests may fail by panic.
#![cfg_attr(
    not(test),
    deny(
        clippy::indexing_slicing,
        clippy::arithmetic_side_effects,
        clippy::unwrap_used,
        clippy::expect_used,
        clippy::panic
    )
)]

use core::fmt;

pub mod camera;
pub mod correspondences;
mod float;
pub mod heatmap;
pub mod inputs;
pub mod lidar;
pub mod views;

/// A measured value is NaN or infinite.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub struct NotFinite;

impl fmt::Display for NotFinite {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "a measured value is not finite")
    }
}

impl core::error::Error for NotFinite {}

/// A network input was given with another number of elements than its sensor writes.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub struct InputSize {
    /// Elements given.
    pub found: u32,
    /// Elements of the input.
    pub expected: u32,
}

impl InputSize {
    fn check(found: usize, expected: u64) -> Result<(), Self> {
        if found as u64 == expected {
            return Ok(());
        }
        let saturated = |size: u64| u32::try_from(size).unwrap_or(u32::MAX);
        Err(Self { found: saturated(found as u64), expected: saturated(expected) })
    }
}

impl fmt::Display for InputSize {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "network input: {} elements given, expected {}", self.found, self.expected)
    }
}

impl core::error::Error for InputSize {}
