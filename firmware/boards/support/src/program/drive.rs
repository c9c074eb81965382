//! The product: the [driving computer](firmware::computer) on a board, with two slots for images.

use crate::board::Board;
use crate::counter::Counter;
use crate::machine::Machine;
use crate::pwm::{Pin, Pwm};
use crate::uart::Uart;
use crate::{reset, stack};
use firmware::actuators::Actuators;
use firmware::computer::{self, Computer, Exit, Line, Memory};
use firmware::image::Image;
use firmware::kernels::Kernels;
use firmware::update::{self, Requirements, Updater};

/// Rounds of a pause, some microseconds.
const PAUSE: u32 = 200;

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

/// Drives with the newest image of the two slots until the feeder ends it. Answers the exit status.
pub fn run<U: Uart, C: Counter, K: Kernels + Copy>(board: Board<U, C, K>, workspace: &mut Workspace) -> u8 {
    let Board { mut machine, images, target, kernels, arena } = board;
    let Workspace { memory, line } = workspace;
    let mut flash = images.flash();
    // The board's memory has two halves of whole sectors.
    let Ok(slots) = flash.slots() else { return 2 };
    let arenas = [u32::try_from(arena.len()).unwrap_or(u32::MAX)];
    let requirements = Requirements { target, kernels: kernels.supported(), arenas: &arenas, interface: &|_| true };
    // Without one to run, the computer waits for one.
    let selected = update::select(&mut flash, &slots, &requirements, &mut || {}).ok();
    let image = selected.and_then(|selected| flash.lend(selected.range())).unwrap_or_default();
    let is_known = |new: &Image<'_>| Image::parse(image).map_or(true, |old| update::same_interface(&old, new));
    let requirements = Requirements { interface: &is_known, ..requirements };
    let mut store = Updater::new(flash, slots, requirements, selected);
    let mut actuators =
        Actuators { steering: Pwm::new(0), throttle: Pwm::new(1), brake: Pwm::new(2), enable: Pin::new(0) };
    let arena = arena.into();
    let (board, actuators, store) = (&mut machine, &mut actuators, &mut store);
    match (Computer { image, kernels, arena, memory, line, board, actuators, store }).run() {
        Exit::Halt => 0,
        Exit::Restart => reset::system(),
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

    /// A while without a register: each access to one holds the emulator up, which is to fetch the next byte meanwhile.
    fn wait(&mut self) {
        for _ in 0..PAUSE {
            core::hint::spin_loop();
        }
    }

    fn stack_bytes(&self) -> Option<u32> {
        u32::try_from(stack::peak_bytes()).ok()
    }

    fn can_halt(&self) -> bool {
        true
    }
}
