//! The product on the Cortex-A.
#![no_std]
#![no_main]

use board_support::program::self_test;
use board_support::semihosting;

#[unsafe(no_mangle)]
extern "C" fn main() -> ! {
    // SAFETY: this is the board, and nothing else takes it.
    let mut board = unsafe { virt::board() };
    semihosting::exit(self_test::run(&mut board))
}
