//! What the boards share: registers, UARTs, counters, the end of a run, and the programs that run on them.
//!
//! A board is a memory map and a start-up; it hands a [`Machine`] to a program of [`program`] and ends with what the
//! program answers.
#![no_std]

pub mod counter;
pub mod image_memory;
pub mod machine;
pub mod program;
pub mod register;
pub mod semihosting;
pub mod uart;

pub use machine::Machine;
