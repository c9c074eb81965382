//! Checks on the Cortex-A, for the bench and for tests: see [`board_support::program::check`].
#![no_std]
#![no_main]

use board_support::program::check;
use board_support::semihosting;

#[unsafe(no_mangle)]
extern "C" fn main() -> ! {
    // SAFETY: this is the board, and nothing else takes it.
    let mut bench = unsafe { virt::board() }.bench();
    semihosting::exit(check::run(&mut bench))
}
