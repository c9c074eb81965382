//! 64-bit Arm on QEMU's `virt` board: one core, no operating system, memory management unit off. Model image and arena
//! lie in the RAM.
#![no_std]

use board_support::counter::Counter;
use board_support::image_memory::ImageMemory;
use board_support::uart::Pl011;
use board_support::{Board, Machine};
use core::arch::{asm, global_asm};
use core::slice;
use firmware::kernels::Portable;

const UART: usize = 0x0900_0000;
const IMAGE: usize = 0x5000_0000;
const IMAGE_BYTES: u32 = 192 << 20;
const ARENA: usize = 0x4800_0000;
const ARENA_BYTES: usize = 64 << 20;

// Vector registers on, stack, zeroed statics, stack painted (see `board_support::stack`); then the program.
global_asm!(
    ".section .start, \"ax\"",
    ".global start",
    "start:",
    "mov x0, #(3 << 20)",
    "msr cpacr_el1, x0",
    "isb",
    "ldr x0, =_stack_start",
    "mov sp, x0",
    "ldr x0, =bss_start",
    "ldr x1, =bss_end",
    "1: cmp x0, x1",
    "b.hs 2f",
    "stp xzr, xzr, [x0], #16",
    "b 1b",
    "2: ldr x0, =_stack_end",
    "ldr x1, =_stack_start",
    "ldr w2, =0xcccccccc",
    "3: cmp x0, x1",
    "b.hs 4f",
    "str w2, [x0], #4",
    "b 3b",
    "4: bl main",
);

/// The generic timer.
#[derive(Debug)]
pub struct GenericTimer;

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

/// The board.
///
/// # Safety
/// The program runs on this board, and calls this once.
pub unsafe fn board() -> Board<Pl011, GenericTimer, Portable> {
    // SAFETY: the board's UART, made once.
    let uart = unsafe { Pl011::new(UART) };
    // SAFETY: both ranges are RAM of the board, apart from each other and from what the linker uses; any bytes are
    // valid, and no other reference to them exists.
    let (images, arena) =
        unsafe { (ImageMemory::new(IMAGE, IMAGE_BYTES), slice::from_raw_parts_mut(ARENA as *mut u8, ARENA_BYTES)) };
    Board {
        machine: Machine { name: "virt", uart, counter: GenericTimer },
        images,
        target: "cortex-a",
        kernels: Portable,
        arena,
    }
}
