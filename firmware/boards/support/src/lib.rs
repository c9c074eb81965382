//! What the boards share: registers, UARTs, counters, the end of a run, and the programs that run on them.
//!
//! A board is a memory map and a start-up; it hands a [`Machine`] to a program of [`program`] and ends with what the
//! program answers.
#![no_std]

pub mod arena;
pub mod counter;
pub mod image_memory;
pub mod machine;
pub mod memory_flash;
pub mod mps2;
pub mod program;
pub mod register;
pub mod semihosting;
pub mod uart;

pub use machine::Machine;

use core::panic::PanicInfo;

/// Status of a run that panicked.
const PANICKED: u8 = 101;

#[panic_handler]
fn panic(_: &PanicInfo<'_>) -> ! {
    semihosting::exit(PANICKED)
}
