//! The end of a run under an emulator or debugger (Arm semihosting, operation `SYS_EXIT_EXTENDED`).

use core::arch::asm;

const SYS_EXIT_EXTENDED: usize = 0x20;
const APPLICATION_EXIT: usize = 0x20026;

/// Ends the run with this status. Without emulator or debugger the core stops here.
pub fn exit(status: u8) -> ! {
    let block = [APPLICATION_EXIT, usize::from(status)];
    // SAFETY: the host reads two words at `block`, which lives until it has; nothing else is touched.
    #[cfg(target_arch = "arm")]
    unsafe {
        asm!("bkpt 0xab", inout("r0") SYS_EXIT_EXTENDED => _, in("r1") block.as_ptr(), options(nostack));
    }
    // SAFETY: the host reads two words at `block`, which lives until it has; nothing else is touched.
    #[cfg(target_arch = "aarch64")]
    unsafe {
        asm!("hlt 0xf000", inout("x0") SYS_EXIT_EXTENDED => _, in("x1") block.as_ptr(), options(nostack));
    }
    loop {
        core::hint::spin_loop();
    }
}
