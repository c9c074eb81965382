//! 64-bit Arm on QEMU's `virt` board: one core, no operating system, memory management unit off. Model image and arena
//! lie in the RAM.
#![no_std]
#![no_main]

use board_support::counter::Counter;
use board_support::image_memory;
use board_support::uart::Pl011;
use board_support::{Machine, program, semihosting};
use core::arch::{asm, global_asm};
use core::slice;
use firmware::kernels::Portable;

const UART: usize = 0x0900_0000;
const IMAGE: usize = 0x5000_0000;
const IMAGE_BYTES: usize = 192 << 20;
const ARENA: usize = 0x4800_0000;
const ARENA_BYTES: usize = 64 << 20;

// Vector registers on, stack, zeroed statics; then Rust.
global_asm!(
    ".section .start, \"ax\"",
    ".global start",
    "start:",
    "mov x0, #(3 << 20)",
    "msr cpacr_el1, x0",
    "isb",
    "ldr x0, =stack_top",
    "mov sp, x0",
    "ldr x0, =bss_start",
    "ldr x1, =bss_end",
    "1: cmp x0, x1",
    "b.hs 2f",
    "stp xzr, xzr, [x0], #16",
    "b 1b",
    "2: bl {main}",
    main = sym main,
);

/// The generic timer.
#[derive(Debug)]
struct GenericTimer;

impl Counter for GenericTimer {
    fn ticks(&mut self) -> u64 {
        let ticks;
        // SAFETY: reads a counter; `isb` keeps the read in its place.
        unsafe { asm!("isb", "mrs {}, cntvct_el0", out(reg) ticks, options(nostack)) };
        ticks
    }

    fn hertz(&self) -> u64 {
        let hertz;
        // SAFETY: reads the rate that the machine states.
        unsafe { asm!("mrs {}, cntfrq_el0", out(reg) hertz, options(nostack, nomem)) };
        hertz
    }
}

extern "C" fn main() -> ! {
    // SAFETY: the board's UART, made once.
    let uart = unsafe { Pl011::new(UART) };
    let mut machine = Machine { name: "virt", uart, counter: GenericTimer };
    // SAFETY: RAM of the board that nothing else uses; this program never writes the image's part.
    let (image, arena) =
        unsafe { (image_memory::stored(IMAGE, IMAGE_BYTES), slice::from_raw_parts_mut(ARENA as *mut u8, ARENA_BYTES)) };
    semihosting::exit(program::self_test::run(&mut machine, image, Portable, arena))
}
