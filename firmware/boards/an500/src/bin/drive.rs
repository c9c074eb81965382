//! The product on the Cortex-M7.
#![no_std]
#![no_main]

use board_support::program::drive::{self, Workspace};
use board_support::semihosting;
use cortex_m_rt::entry;

static mut WORKSPACE: Workspace = Workspace::new();

#[entry]
fn main() -> ! {
    // SAFETY: this is the board, and nothing else takes it.
    let board = unsafe { an500::board() };
    // SAFETY: the only reference ever, since `main` runs once.
    let workspace = unsafe { &mut *&raw mut WORKSPACE };
    semihosting::exit(drive::run(board, workspace))
}
