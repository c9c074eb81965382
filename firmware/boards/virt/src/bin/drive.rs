//! The product on the Cortex-A.
#![no_std]
#![no_main]

use board_support::program::drive::{self, Workspace};
use board_support::semihosting;

static mut WORKSPACE: Workspace = Workspace::new();

#[unsafe(no_mangle)]
extern "C" fn main() -> ! {
    // SAFETY: this is the board, and nothing else takes it.
    let board = unsafe { virt::board() };
    // SAFETY: the only reference ever, since `main` runs once.
    let workspace = unsafe { &mut *&raw mut WORKSPACE };
    semihosting::exit(drive::run(board, workspace))
}
