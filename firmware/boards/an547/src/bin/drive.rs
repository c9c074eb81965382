//! The product on the Cortex-M55.
#![no_std]
#![no_main]

use board_support::program::self_test;
use board_support::semihosting;
use cortex_m_rt::entry;

#[entry]
fn main() -> ! {
    // SAFETY: this is the board, and nothing else takes it.
    let mut board = unsafe { an547::board() };
    semihosting::exit(self_test::run(&mut board))
}
