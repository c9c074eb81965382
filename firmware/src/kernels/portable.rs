//! The norm: plain Rust for any target, one operator per file.
//!
//! Every kernel returns early, writing nothing, where operands do not have the lengths that their arguments say; an
//! image that passed `Image::parse` never takes that path.

pub mod attention;
mod axis;
pub(super) mod codes;
pub mod concat;
pub mod conv2d;
pub mod copy_box;
pub mod elementwise;
pub mod gather_sum;
pub mod layer_norm;
pub mod linear;
#[cfg(test)]
pub(super) mod oracle;
pub mod pool;
mod product;
pub mod resize_bilinear;
pub mod sigmoid;
pub mod softmax;
pub mod spatial_softmax;
pub mod tokens;
pub mod waypoint_decoder;
mod windows;

pub(crate) use axis::Axis;
#[cfg(target_arch = "x86_64")]
pub(crate) use windows::Windows;
