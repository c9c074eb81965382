//! Measure: what parse, check and every step cost in instructions, whether that depends on the inputs, and how deep the
//! stack goes.
//!
//! The network runs over inputs that are all zero, all at their lowest, all at their highest, over seeded noise, and
//! over the frames that lie behind the image. Each step prints the fewest and the most instructions that it took.
//! Under `-icount shift=6` these are exact, up to one where the counter's tick is no divisor of 64 ns.

use crate::board::Bench;
use crate::counter::Counter;
use crate::machine::{Machine, say};
use crate::stack::Mark;
use crate::uart::Uart;
use core::fmt::{self, Write};
use firmware::engine::{Engine, EngineError, Progress};
use firmware::image::known_answer::Generator;
use firmware::image::{CheckError, Image, ParseError};
use firmware::kernels::Kernels;
use firmware::tensor::ElementType;

/// Steps of the longest network that is measured.
const MAX_STEPS: usize = 512;
/// Seeds of the noise.
const SEEDS: [u64; 3] = [1, 2, 3];

/// Fewest and most instructions.
#[derive(Clone, Copy)]
struct Span {
    min: u64,
    max: u64,
}

impl Span {
    const NONE: Self = Self { min: u64::MAX, max: 0 };

    fn add(&mut self, instructions: u64) {
        *self = Self { min: self.min.min(instructions), max: self.max.max(instructions) };
    }
}

impl fmt::Display for Span {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{:>12} {:>12} {:>8}", self.min, self.max, self.max.saturating_sub(self.min))
    }
}

/// What a run of the network is given.
#[derive(Clone, Copy)]
enum Inputs<'a> {
    Zero,
    Lowest,
    Highest,
    Noise(u64),
    /// The bytes of all inputs, in header order.
    Frame(&'a [u8]),
}

/// Measures and answers the exit status: 0 measured, 1 the image or a step was refused.
pub fn run<U: Uart, C: Counter, K: Kernels + Copy>(bench: &mut Bench<U, C, K>) -> u8 {
    u8::from(measure(bench).is_err())
}

fn measure<U: Uart, C: Counter, K: Kernels + Copy>(bench: &mut Bench<U, C, K>) -> fmt::Result {
    let Bench { machine, image: bytes, behind, kernels, arena } = bench;
    let name = machine.name;
    let mark = Mark::new();
    let (parsed, parse_ticks) = timed(machine, || parse(bytes));
    let image = say(machine, parsed)?;
    let parse_stack = mark.depth_bytes();
    let mark = Mark::new();
    let (checked, check_ticks) = timed(machine, || check(&image));
    say(machine, checked)?;
    let check_stack = mark.depth_bytes();

    let mut engine = say(machine, Engine::new(image, *kernels, &mut **arena))?;
    let frame_bytes = frame_bytes(&image).ok_or(fmt::Error)?;
    let frames = behind.strip_prefix(b"FRAMES\0\0").and_then(|frames| frames.split_first_chunk());
    let (count, frames) = frames.map_or((0, &[][..]), |(count, frames)| (u32::from_le_bytes(*count), frames));
    let frames = frames.chunks_exact(frame_bytes).take(usize::try_from(count).unwrap_or(0));
    let made = [Inputs::Zero, Inputs::Lowest, Inputs::Highest].into_iter().chain(SEEDS.map(Inputs::Noise));

    let mut steps = [Span::NONE; MAX_STEPS];
    let mut whole = Span::NONE;
    let mark = Mark::new();
    let mut runs = 0;
    for inputs in made.chain(frames.map(Inputs::Frame)) {
        say(machine, fill(&mut engine, &image, inputs))?;
        let (mut total, mut progress) = (0, Progress::Running { next: 0 });
        for span in steps.iter_mut().take(image.step_count().into()) {
            let (done, ticks) = timed(machine, || step(&mut engine));
            progress = say(machine, done)?;
            span.add(machine.counter.instructions(ticks));
            total += ticks;
        }
        if progress != Progress::Done {
            writeln!(machine, "{name}: more than {MAX_STEPS} steps")?;
            return Err(fmt::Error);
        }
        whole.add(machine.counter.instructions(total));
        runs += 1;
    }
    let step_stack = mark.depth_bytes();

    writeln!(machine, "{name}: image {}, {runs} runs, {count} of them over frames", image.name())?;
    writeln!(machine, "step operator            instructions      at most   spread")?;
    for (position, span) in (0..image.step_count()).zip(&steps) {
        let name = image.step(position).map_or("?", |step| step.name());
        writeln!(machine, "{position:4} {name:<18} {span}")?;
    }
    writeln!(machine, "     {:<18} {whole}", "network")?;
    for (name, ticks) in [("parse", parse_ticks), ("check", check_ticks)] {
        let instructions = machine.counter.instructions(ticks);
        writeln!(machine, "     {name:<18} {instructions:>12}")?;
    }
    writeln!(machine, "stack: parse {parse_stack}, check {check_stack}, step {step_stack} bytes")
}

/// What `work` answers, and its ticks.
fn timed<U: Uart, C: Counter, T>(machine: &mut Machine<U, C>, work: impl FnOnce() -> T) -> (T, u64) {
    let start = machine.counter.ticks();
    let answer = work();
    (answer, machine.counter.ticks() - start)
}

// Functions of their own, so that the linked program has a symbol whose depth of stack can be bounded.

#[inline(never)]
fn parse(bytes: &[u8]) -> Result<Image<'_>, ParseError> {
    Image::parse(bytes)
}

#[inline(never)]
fn check(image: &Image<'_>) -> Result<(), CheckError> {
    image.check()
}

#[inline(never)]
fn step<K: Kernels>(engine: &mut Engine<'_, K>) -> Result<Progress, EngineError> {
    engine.step()
}

/// Bytes of all inputs; `None` where there is none.
fn frame_bytes(image: &Image<'_>) -> Option<usize> {
    let bytes = (0..image.input_count()).map(|input| Some(image.tensor(image.input(input)?.tensor)?.bytes));
    bytes.sum::<Option<u32>>().and_then(|bytes| usize::try_from(bytes).ok()).filter(|bytes| *bytes > 0)
}

/// Fills the inputs and begins.
fn fill<K: Kernels>(engine: &mut Engine<'_, K>, image: &Image<'_>, inputs: Inputs<'_>) -> Result<(), EngineError> {
    let mut generator = Generator::new(if let Inputs::Noise(seed) = inputs { seed } else { 0 });
    let mut frame = if let Inputs::Frame(frame) = inputs { frame } else { &[] };
    for number in 0..image.input_count() {
        let record = image.input(number).and_then(|port| image.tensor(port.tensor));
        let element = record.map_or(ElementType::I8, |record| record.element);
        let bytes = engine.input_mut(number.into())?;
        match inputs {
            Inputs::Zero => bytes.fill(0),
            Inputs::Lowest => fill_with(bytes, element, -1 << 23, i16::MIN, i8::MIN),
            Inputs::Highest => fill_with(bytes, element, (1 << 23) - 1, i16::MAX, i8::MAX),
            Inputs::Noise(_) => generator.fill(element, bytes),
            Inputs::Frame(_) => {
                let (own, rest) = frame.split_at_checked(bytes.len()).unwrap_or_default();
                bytes.iter_mut().zip(own).for_each(|(to, from)| *to = *from);
                frame = rest;
            }
        }
    }
    engine.begin();
    Ok(())
}

/// One code everywhere, of the input's type (32-bit ones are Q16 meters, ±128 m).
fn fill_with(bytes: &mut [u8], element: ElementType, word: i32, half_word: i16, byte: i8) {
    match element {
        ElementType::I32 => bytes.as_chunks_mut().0.iter_mut().for_each(|code| *code = word.to_le_bytes()),
        ElementType::I16 => bytes.as_chunks_mut().0.iter_mut().for_each(|code| *code = half_word.to_le_bytes()),
        ElementType::I8 | ElementType::Scratch => bytes.fill(byte.cast_unsigned()),
    }
}
