//! Checks on the Cortex-M55, for the bench and for tests: see [`board_support::program::check`].
#![no_std]
#![no_main]

use board_support::program::check;
use board_support::semihosting;
use cortex_m_rt::entry;

#[entry]
fn main() -> ! {
    // SAFETY: this is the board, and nothing else takes it.
    let mut bench = unsafe { an547::board() }.bench();
    semihosting::exit(check::run(&mut bench))
}
