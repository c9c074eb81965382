//! The driving computer on a line of which every byte is possible.

use core::convert::Infallible;
use core::hint::black_box;
use embedded_hal::digital::{self, OutputPin};
use embedded_hal::pwm::{self, SetDutyCycle};
use firmware::actuators::Actuators;
use firmware::computer::{Board, Computer, Exit, ImageStore, Line, Memory};
use firmware::image::CheckProgress;
use firmware::kernels::Portable;
use firmware::link::UpdateRefusal;
use firmware::update::Manifest;

struct Unknown;

impl Board for Unknown {
    fn name(&self) -> &str {
        black_box("unknown")
    }

    fn receive(&mut self) -> Option<u8> {
        black_box(None)
    }

    fn send(&mut self, bytes: &[u8]) {
        black_box(bytes);
    }

    fn ticks(&mut self) -> u64 {
        black_box(0)
    }

    fn hertz(&self) -> u64 {
        black_box(0)
    }

    fn feed_watchdog(&mut self) {}

    fn stack_bytes(&self) -> Option<u32> {
        black_box(None)
    }

    fn can_halt(&self) -> bool {
        black_box(false)
    }
}

struct Output;

impl pwm::ErrorType for Output {
    type Error = Infallible;
}

impl digital::ErrorType for Output {
    type Error = Infallible;
}

impl SetDutyCycle for Output {
    fn max_duty_cycle(&self) -> u16 {
        black_box(0)
    }

    fn set_duty_cycle(&mut self, duty: u16) -> Result<(), Infallible> {
        black_box(duty);
        Ok(())
    }
}

impl OutputPin for Output {
    fn set_low(&mut self) -> Result<(), Infallible> {
        black_box(());
        Ok(())
    }

    fn set_high(&mut self) -> Result<(), Infallible> {
        black_box(());
        Ok(())
    }
}

/// A store that may say anything; the real one is in `update`.
struct Store;

impl ImageStore for Store {
    fn begin(&mut self, manifest: &Manifest) -> Result<(), UpdateRefusal> {
        black_box(manifest);
        black_box(Ok(()))
    }

    fn write(&mut self, offset: u32, bytes: &[u8]) -> Result<(), UpdateRefusal> {
        black_box((offset, bytes));
        black_box(Ok(()))
    }

    fn finish(&mut self, max_bytes: usize) -> Result<CheckProgress, UpdateRefusal> {
        black_box(max_bytes);
        black_box(Ok(CheckProgress::Done))
    }

    fn confirm(&mut self) -> Result<(), UpdateRefusal> {
        black_box(Ok(()))
    }
}

/// Whatever the line, the clock, the image and the arena are.
pub fn compute(image: &[u8], arena: [&mut [u8]; 2]) -> bool {
    let (mut memory, mut line) = (Memory::new(), Line::new());
    let mut actuators = Actuators { steering: Output, throttle: Output, brake: Output, enable: Output };
    let computer = Computer {
        image,
        kernels: Portable,
        arena: arena.into(),
        memory: black_box(&mut memory),
        line: black_box(&mut line),
        board: &mut Unknown,
        actuators: black_box(&mut actuators),
        store: &mut Store,
    };
    computer.run() == Exit::Halt
}
