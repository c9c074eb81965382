//! Cortex-M55 on Arm's MPS3 board as QEMU's `mps3-an547`: model image and arena lie in the DDR, so that networks of
//! full size run.
#![no_std]

use board_support::counter::SystemCounter;
use board_support::image_memory::ImageMemory;
use board_support::uart::CmsdkUart;
use board_support::{Board, Machine};
use core::slice;
use firmware::kernels::Portable;

/// As the secure state, in which the core starts, sees it.
const UART: usize = 0x5930_3000;
const COUNTER: usize = 0x5810_0000;
const COUNTER_HERTZ: u64 = 32_000_000;
const IMAGE: usize = 0x6000_0000;
const IMAGE_BYTES: u32 = 256 << 20;
const ARENA: usize = 0x7000_0000;
const ARENA_BYTES: usize = 64 << 20;

/// The board.
///
/// # Safety
/// The program runs on this board, and calls this once.
pub unsafe fn board() -> Board<CmsdkUart, SystemCounter, Portable> {
    // SAFETY: the board's first UART and its system counter, each made once.
    let (uart, counter) = unsafe { (CmsdkUart::new(UART), SystemCounter::new(COUNTER, COUNTER_HERTZ)) };
    // SAFETY: both ranges are DDR of the board, apart from each other and from what the linker uses; any bytes are
    // valid, and no other reference to them exists.
    let (images, arena) =
        unsafe { (ImageMemory::new(IMAGE, IMAGE_BYTES), slice::from_raw_parts_mut(ARENA as *mut u8, ARENA_BYTES)) };
    Board { machine: Machine { name: "an547", uart, counter }, images, target: "cortex-m55", kernels: Portable, arena }
}
