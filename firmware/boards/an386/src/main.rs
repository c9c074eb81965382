//! Cortex-M4F on Arm's MPS2 board as QEMU's `mps2-an386`: the model image lies in the PSRAM, as it would in a memory-mapped
//! flash.
#![no_std]
#![no_main]

use board_support::counter::CmsdkTimer;
use board_support::image_memory::{self, Arena};
use board_support::uart::CmsdkUart;
use board_support::{Machine, program, semihosting};
use core::panic::PanicInfo;
use cortex_m::singleton;
use cortex_m_rt::entry;
use firmware::kernels::Portable;

const UART: usize = 0x4000_4000;
const TIMER: usize = 0x4000_0000;
const TIMER_HERTZ: u64 = 25_000_000;
const PSRAM: usize = 0x2100_0000;
const PSRAM_BYTES: usize = 16 << 20;
const ARENA_BYTES: usize = 160 << 10;

#[entry]
fn main() -> ! {
    // SAFETY: the board's first UART and timer, each made once.
    let (uart, counter) = unsafe { (CmsdkUart::new(UART), CmsdkTimer::new(TIMER, TIMER_HERTZ)) };
    let mut machine = Machine { name: "an386", uart, counter };
    // SAFETY: the board has 16 MiB of PSRAM here; this program never writes them.
    let image = unsafe { image_memory::stored(PSRAM, PSRAM_BYTES) };
    let arena = singleton!(: Arena<ARENA_BYTES> = Arena([0; ARENA_BYTES]));
    let status = arena.map_or(1, |arena| program::self_test::run(&mut machine, image, Portable, &mut arena.0));
    semihosting::exit(status)
}

#[panic_handler]
fn panic(_: &PanicInfo<'_>) -> ! {
    semihosting::exit(101)
}
