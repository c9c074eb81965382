//! Cortex-M4F on Arm's MPS2 board as QEMU's `mps2-an386`: the model image lies in the PSRAM, as it would in a
//! memory-mapped flash.
#![no_std]

use board_support::arena::Arena;
use board_support::counter::CmsdkTimer;
use board_support::image_memory::ImageMemory;
use board_support::uart::CmsdkUart;
use board_support::{Board, mps2};
use firmware::kernels::Portable;

const PSRAM: usize = 0x2100_0000;
const PSRAM_BYTES: u32 = 16 << 20;
const ARENA_BYTES: usize = 160 << 10;

static mut ARENA: Arena<ARENA_BYTES> = Arena([0; ARENA_BYTES]);

/// The board.
///
/// # Safety
/// The program runs on this board, and calls this once.
pub unsafe fn board() -> Board<CmsdkUart, CmsdkTimer, Portable> {
    // SAFETY: this is an MPS2 board, its devices and its PSRAM are taken once.
    let (machine, images) = unsafe { (mps2::machine("an386"), ImageMemory::new(PSRAM, PSRAM_BYTES)) };
    // SAFETY: the only reference ever, since this is called once.
    let arena = unsafe { &mut *&raw mut ARENA };
    Board { machine, images, target: "cortex-m4", kernels: Portable, arena: &mut arena.0 }
}
