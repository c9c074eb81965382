//! Cortex-M55 on Arm's MPS3 board as QEMU's `mps3-an547`: model image and arena lie in the DDR, so that networks of full
//! size run.
#![no_std]
#![no_main]

use board_support::counter::SystemCounter;
use board_support::image_memory;
use board_support::uart::CmsdkUart;
use board_support::{Machine, program, semihosting};
use core::slice;
use cortex_m_rt::entry;
use firmware::kernels::Portable;

/// As the secure state, in which the core starts, sees it.
const UART: usize = 0x5930_3000;
const COUNTER: usize = 0x5810_0000;
const COUNTER_HERTZ: u64 = 32_000_000;
const IMAGE: usize = 0x6000_0000;
const IMAGE_BYTES: usize = 256 << 20;
const ARENA: usize = 0x7000_0000;
const ARENA_BYTES: usize = 64 << 20;

#[entry]
fn main() -> ! {
    // SAFETY: the board's first UART and its system counter, each made once.
    let (uart, counter) = unsafe { (CmsdkUart::new(UART), SystemCounter::new(COUNTER, COUNTER_HERTZ)) };
    let mut machine = Machine { name: "an547", uart, counter };
    // SAFETY: DDR of the board that nothing else uses; this program never writes the image's part.
    let (image, arena) =
        unsafe { (image_memory::stored(IMAGE, IMAGE_BYTES), slice::from_raw_parts_mut(ARENA as *mut u8, ARENA_BYTES)) };
    semihosting::exit(program::self_test::run(&mut machine, image, Portable, arena))
}
