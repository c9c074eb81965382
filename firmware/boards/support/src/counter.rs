//! Counters of time. Under QEMU's `-icount shift=6` every instruction takes 64 ns of virtual time, so that they count
//! instructions exactly.

use crate::register::Register;

/// Nanoseconds of virtual time per instruction under `-icount shift=6`.
pub const NANOSECONDS_PER_INSTRUCTION: u64 = 64;

/// Something that counts up at a fixed rate.
pub trait Counter {
    /// Ticks since some moment; wraps at no time that matters.
    fn ticks(&mut self) -> u64;

    /// Ticks per second.
    fn hertz(&self) -> u64;

    /// Instructions that so many ticks stand for under `-icount shift=6`.
    fn instructions(&self, ticks: u64) -> u64 {
        let unit = self.hertz() * NANOSECONDS_PER_INSTRUCTION;
        (u128::from(ticks) * 1_000_000_000 + u128::from(unit / 2)).checked_div(unit.into()).unwrap_or(0) as u64
    }
}

/// APB timer of the Cortex-M System Design Kit (Arm DDI 0479, section 4.4): 32 bits downward, extended to 64 by reads
/// that are less than a round (172 s at 25 MHz) apart.
#[derive(Debug)]
pub struct CmsdkTimer {
    value: Register,
    hertz: u64,
    last: u32,
    ticks: u64,
}

impl CmsdkTimer {
    /// Starts the timer.
    ///
    /// # Safety
    /// Such a timer lies at this address, and nothing else drives it.
    pub unsafe fn new(base: usize, hertz: u64) -> Self {
        // SAFETY: registers of the timer that the caller vouches for.
        let [control, value, reload] = unsafe { [Register::at(base), Register::at(base + 4), Register::at(base + 8)] };
        reload.write(u32::MAX);
        value.write(u32::MAX);
        control.write(1);
        Self { value, hertz, last: u32::MAX, ticks: 0 }
    }
}

impl Counter for CmsdkTimer {
    fn ticks(&mut self) -> u64 {
        let now = self.value.read();
        self.ticks += u64::from(self.last.wrapping_sub(now));
        self.last = now;
        self.ticks
    }

    fn hertz(&self) -> u64 {
        self.hertz
    }
}

/// System counter of the SSE-300 subsystem (Arm 101773): 64 bits upward.
#[derive(Debug)]
pub struct SystemCounter {
    low: Register,
    high: Register,
    hertz: u64,
}

impl SystemCounter {
    /// Enables the counter.
    ///
    /// # Safety
    /// Such a counter's control frame lies at this address, and nothing else drives it.
    pub unsafe fn new(base: usize, hertz: u64) -> Self {
        // SAFETY: registers of the counter that the caller vouches for.
        let [control, low, high] = unsafe { [Register::at(base), Register::at(base + 8), Register::at(base + 12)] };
        control.write(1);
        Self { low, high, hertz }
    }
}

impl Counter for SystemCounter {
    fn ticks(&mut self) -> u64 {
        loop {
            let (high, low) = (self.high.read(), self.low.read());
            if high == self.high.read() {
                return u64::from(high) << 32 | u64::from(low);
            }
        }
    }

    fn hertz(&self) -> u64 {
        self.hertz
    }
}
