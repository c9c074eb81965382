//! Runtime for quantized driving networks: `no_std`, no heap, no float, no panic after validation.
#![no_std]
#![deny(unsafe_code)]

#[cfg(not(target_endian = "little"))]
compile_error!("model images are little-endian and executed in place");

pub mod arena;
pub mod engine;
pub mod fault;
pub mod fixed_point;
pub mod image;
pub mod kernels;
pub mod ops;
pub mod program;
pub mod tensor;
