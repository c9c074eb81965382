//! Self-test: every byte of the image against its CRCs, then the known answer, step by step.
//!
//! Prints a line per step (position, operator, instructions) and answers whether all bytes were right. The known answer
//! is the f64 model's, so this shows that the board computes what the host's independent model computes.

use crate::board::Bench;
use crate::counter::Counter;
use crate::machine::say;
use crate::stack;
use crate::uart::Uart;
use core::fmt::{self, Write};
use firmware::engine::{Engine, Progress};
use firmware::image::Image;
use firmware::kernels::Kernels;

/// Runs the self-test and answers the exit status: 0 all bytes right, 1 not.
pub fn run<U: Uart, C: Counter, K: Kernels + Copy>(bench: &mut Bench<U, C, K>) -> u8 {
    let outcome = test(bench);
    let verdict = if outcome.is_ok() { "passed" } else { "failed" };
    let (peak, capacity) = (stack::peak_bytes(), stack::capacity_bytes());
    // A UART takes whatever it is given.
    let _ = writeln!(bench.machine, "stack: {peak} of {capacity} bytes\nself-test {verdict}");
    u8::from(outcome.is_err())
}

fn test<U: Uart, C: Counter, K: Kernels + Copy>(bench: &mut Bench<U, C, K>) -> fmt::Result {
    let Bench { machine, image: bytes, kernels, arena, .. } = bench;
    let board = machine.name;
    let image = say(machine, Image::parse(bytes))?;
    writeln!(
        machine,
        "{board}: image {}, {} bytes, arena {} of {} bytes",
        image.name(),
        bytes.len(),
        image.arena_bytes(),
        arena.len()
    )?;
    say(machine, image.check())?;
    let mut engine = say(machine, Engine::new(image, *kernels, &mut **arena))?;
    say(machine, engine.start_self_test())?;
    let mut total = 0;
    for position in 0.. {
        let start = machine.counter.ticks();
        let progress = engine.self_test_step();
        let ticks = machine.counter.ticks() - start;
        let progress = say(machine, progress)?;
        let instructions = machine.counter.instructions(ticks);
        total += instructions;
        let name = image.step(position).map_or("?", |step| step.name());
        writeln!(machine, "{position:4} {name:<18} {instructions:>12}")?;
        if progress == Progress::Done {
            break;
        }
    }
    writeln!(machine, "     {:<18} {total:>12} instructions, the CRC of every output included", "total")
}
