//! The norm: plain Rust for any target, one operator per file.

pub mod attention;
pub mod conv2d;
pub mod elementwise;
pub mod layer_norm;
pub mod linear;
pub mod pool;
pub mod resize_bilinear;
pub mod tokens;
pub mod waypoint_decoder;
