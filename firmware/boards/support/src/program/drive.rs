//! The product: the [driving computer](firmware::computer) on a board.

use crate::board::Board;
use crate::counter::Counter;
use crate::machine::Machine;
use crate::pwm::{Pin, Pwm};
use crate::stack;
use crate::uart::Uart;
use firmware::actuators::Actuators;
use firmware::computer::{self, Exit, Line, Memory, serve};
use firmware::kernels::Kernels;

/// What the computer works with beside arena and stack.
#[derive(Debug)]
pub struct Workspace {
    memory: Memory,
    line: Line,
}

impl Workspace {
    /// Before its first use.
    pub const fn new() -> Self {
        Self { memory: Memory::new(), line: Line::new() }
    }
}

impl Default for Workspace {
    fn default() -> Self {
        Self::new()
    }
}

/// Drives until the feeder ends it.
pub fn run<U: Uart, C: Counter, K: Kernels + Copy>(board: &mut Board<U, C, K>, workspace: &mut Workspace) -> u8 {
    let mut actuators =
        Actuators { steering: Pwm::new(0), throttle: Pwm::new(1), brake: Pwm::new(2), enable: Pin::new(0) };
    let Board { machine, image, kernels, arena, .. } = board;
    let Workspace { memory, line } = workspace;
    match serve(image, *kernels, arena, memory, line, machine, &mut actuators) {
        Exit::Halt => 0,
    }
}

impl<U: Uart, C: Counter> computer::Board for Machine<U, C> {
    fn name(&self) -> &str {
        self.name
    }

    fn receive(&mut self) -> Option<u8> {
        self.uart.receive()
    }

    fn send(&mut self, bytes: &[u8]) {
        bytes.iter().for_each(|byte| self.uart.send(*byte));
    }

    fn ticks(&mut self) -> u64 {
        self.counter.ticks()
    }

    fn hertz(&self) -> u64 {
        self.counter.hertz()
    }

    /// The emulated boards run without one.
    fn feed_watchdog(&mut self) {}

    fn stack_bytes(&self) -> Option<u32> {
        u32::try_from(stack::peak_bytes()).ok()
    }

    fn can_halt(&self) -> bool {
        true
    }
}
