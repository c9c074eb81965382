//! Outputs of the emulated boards: duty cycles and pins in a block of memory that a debugger sees as `ACTUATORS`, where
//! a real board has the registers of its timers.

use core::convert::Infallible;
use core::sync::atomic::{AtomicU32, Ordering};
use embedded_hal::digital::{self, OutputPin};
use embedded_hal::pwm::{self, SetDutyCycle};

/// Duty cycles, then pins.
#[derive(Debug)]
struct Registers {
    duties: [AtomicU32; 3],
    pins: [AtomicU32; 1],
}

#[unsafe(no_mangle)]
static ACTUATORS: Registers =
    Registers { duties: [const { AtomicU32::new(0) }; 3], pins: [const { AtomicU32::new(0) }; 1] };

/// A channel with duty cycles of 0..=10000.
#[derive(Debug)]
pub struct Pwm(&'static AtomicU32);

impl Pwm {
    /// The channel of this number, 0..3.
    pub const fn new(channel: usize) -> Self {
        Self(&ACTUATORS.duties[channel])
    }
}

impl pwm::ErrorType for Pwm {
    type Error = Infallible;
}

impl SetDutyCycle for Pwm {
    fn max_duty_cycle(&self) -> u16 {
        10_000
    }

    fn set_duty_cycle(&mut self, duty: u16) -> Result<(), Infallible> {
        self.0.store(duty.into(), Ordering::Relaxed);
        Ok(())
    }
}

/// A pin.
#[derive(Debug)]
pub struct Pin(&'static AtomicU32);

impl Pin {
    /// The pin of this number: 0.
    pub const fn new(pin: usize) -> Self {
        Self(&ACTUATORS.pins[pin])
    }
}

impl digital::ErrorType for Pin {
    type Error = Infallible;
}

impl OutputPin for Pin {
    fn set_low(&mut self) -> Result<(), Infallible> {
        self.0.store(0, Ordering::Relaxed);
        Ok(())
    }

    fn set_high(&mut self) -> Result<(), Infallible> {
        self.0.store(1, Ordering::Relaxed);
        Ok(())
    }
}
