//! The restart of a board.

/// Starts the board anew.
pub fn system() -> ! {
    #[cfg(target_arch = "arm")]
    {
        use crate::register::Register;

        /// Application interrupt and reset control of any Cortex-M.
        const AIRCR: usize = 0xE000_ED0C;
        const KEY: u32 = 0x05FA << 16;
        const SYSRESETREQ: u32 = 1 << 2;
        // SAFETY: every Cortex-M has this register there.
        unsafe { Register::at(AIRCR) }.write(KEY | SYSRESETREQ);
    }
    // SAFETY: calls the board's firmware (PSCI), which does not return.
    #[cfg(target_arch = "aarch64")]
    unsafe {
        const SYSTEM_RESET: u64 = 0x8400_0009;
        core::arch::asm!("hvc #0", in("x0") SYSTEM_RESET, options(nostack));
    }
    loop {
        core::hint::spin_loop();
    }
}
