//! Cortex-M4F on Arm's MPS2 board as QEMU's `mps2-an386`: the model image lies in the PSRAM, as it would in a memory-mapped
//! flash.
#![no_std]
#![no_main]

use board_support::image_memory::{self, Arena};
use board_support::{mps2, program, semihosting};
use cortex_m::singleton;
use cortex_m_rt::entry;
use firmware::kernels::Portable;

const PSRAM: usize = 0x2100_0000;
const PSRAM_BYTES: usize = 16 << 20;
const ARENA_BYTES: usize = 160 << 10;

#[entry]
fn main() -> ! {
    // SAFETY: this is an MPS2 board, its devices are made once, and nothing here writes its PSRAM.
    let (mut machine, image) = unsafe { (mps2::machine("an386"), image_memory::stored(PSRAM, PSRAM_BYTES)) };
    let arena = singleton!(: Arena<ARENA_BYTES> = Arena([0; ARENA_BYTES]));
    let status = arena.map_or(1, |arena| program::self_test::run(&mut machine, image, Portable, &mut arena.0));
    semihosting::exit(status)
}
