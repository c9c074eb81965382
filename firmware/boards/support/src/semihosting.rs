//! Services of an emulator or debugger (Arm semihosting): the command line, and the end of the run.

use core::arch::asm;
use core::str;

const SYS_GET_CMDLINE: usize = 0x15;
const SYS_EXIT_EXTENDED: usize = 0x20;
const APPLICATION_EXIT: usize = 0x20026;

/// The command line that the run was started with: under QEMU the path of the program and what `-append` says. `None`
/// where it is no text or longer than `memory`.
pub fn command_line(memory: &mut [u8]) -> Option<&str> {
    let mut block = [memory.as_mut_ptr().expose_provenance(), memory.len()];
    // SAFETY: the block names memory of this length, which nothing else refers to; the host writes no more than that.
    let failed = unsafe { call(SYS_GET_CMDLINE, &mut block) };
    let [_, bytes] = block;
    (failed == 0).then_some(memory.get(..bytes)?).and_then(|text| str::from_utf8(text).ok())
}

/// Ends the run with this status. Without emulator or debugger the core stops here.
pub fn exit(status: u8) -> ! {
    // SAFETY: nothing but the two words is read.
    unsafe { call(SYS_EXIT_EXTENDED, &mut [APPLICATION_EXIT, usize::from(status)]) };
    loop {
        core::hint::spin_loop();
    }
}

/// Asks the host for an operation; answers what the host answers.
///
/// # Safety
/// Whatever the operation reads or writes through the block is there for it.
unsafe fn call(operation: usize, block: &mut [usize; 2]) -> usize {
    let answer;
    // SAFETY: the host reads and writes the block, which is borrowed, and what the caller vouches for.
    #[cfg(target_arch = "arm")]
    unsafe {
        asm!("bkpt 0xab", inout("r0") operation => answer, in("r1") block.as_mut_ptr(), options(nostack));
    }
    // SAFETY: the host reads and writes the block, which is borrowed, and what the caller vouches for.
    #[cfg(target_arch = "aarch64")]
    unsafe {
        asm!("hlt 0xf000", inout("x0") operation => answer, in("x1") block.as_mut_ptr(), options(nostack));
    }
    answer
}

#[cfg(feature = "defmt")]
use defmt_semihosting as _;

/// No board here enables an interrupt, and each runs one core: nothing can come between.
#[cfg(feature = "defmt")]
mod critical_section_of_one_core {
    struct OneCore;

    critical_section::set_impl!(OneCore);

    // SAFETY: one core without interrupts runs one section at a time.
    unsafe impl critical_section::Impl for OneCore {
        unsafe fn acquire() -> critical_section::RawRestoreState {}

        unsafe fn release((): critical_section::RawRestoreState) {}
    }
}
