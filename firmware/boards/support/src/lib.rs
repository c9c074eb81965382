//! What the boards share: registers, UARTs, counters, semihosting, and the programs that run on them.
//!
//! A board is a memory map and a start-up; its binaries hand a [`Board`] to a program of [`program`] and end with what
//! the program answers.
#![no_std]

pub mod arena;
pub mod board;
pub mod counter;
pub mod image_memory;
pub mod machine;
pub mod memory_flash;
pub mod mps2;
pub mod program;
pub mod pwm;
pub mod register;
pub mod reset;
pub mod semihosting;
pub mod stack;
pub mod uart;

pub use board::Board;
pub use machine::Machine;

use core::panic::PanicInfo;

/// Status of a run that panicked.
const PANICKED: u8 = 101;

#[panic_handler]
fn panic(_: &PanicInfo<'_>) -> ! {
    semihosting::exit(PANICKED)
}
