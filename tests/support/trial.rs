//! One image, whatever it holds, through parser and engine: what happened to it.

use firmware::arena::Regions;
use firmware::engine::{Engine, EngineError};
use firmware::image::{Check, Image, ParseError, Region, layout};
use firmware::kernels::{Kernels, Portable};
use firmware::tensor::TensorId;
use host_sim::backends::{Backend, BackendKind};
use model_compiler::emit::AlignedBytes;

/// Accepted images beyond these limits are not run; `parse` bounds both, but not by what a test has time and memory
/// for.
const MAX_WORK: u64 = 1 << 24;
const MAX_ARENA: usize = 1 << 22;
/// Largest arena alignment, and the size of the guards on both sides of the arena.
const GUARD: usize = 4096;
const GUARD_BYTE: u8 = 0xA5;

/// The end of a trial.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Verdict {
    /// `parse` refused the image.
    Refused(ParseError),
    /// The engine took it, ran it to the end and gave all outputs.
    Ran,
    /// The engine refused it, before or during the run.
    Failed(EngineError),
    /// Accepted, but too large for a test.
    TooLarge,
}

impl Verdict {
    /// The check that refused the image.
    pub fn check(&self) -> Option<Check> {
        match self {
            Self::Refused(error) => Some(error.check),
            _ => None,
        }
    }
}

/// A backend and memory for trials, used again and again.
#[derive(Debug)]
pub struct Bench {
    backend: Backend,
    memory: AlignedBytes,
    noise: Vec<u8>,
}

impl Default for Bench {
    fn default() -> Self {
        Self::of(BackendKind::Portable.detect().expect("portable is everywhere"))
    }
}

impl Bench {
    /// Trials on a backend.
    pub fn of(backend: Backend) -> Self {
        let mut memory = AlignedBytes::zeroed(MAX_ARENA + (2 * layout::REGION_SLOTS + 2) * GUARD);
        memory.fill(GUARD_BYTE);
        let noise = (0..MAX_ARENA).map(|i| (i * 167 + (i >> 8)) as u8).collect();
        Self { backend, memory, noise }
    }

    /// Parses and runs an image on inputs that use all codes.
    ///
    /// # Panics
    /// The engine wrote outside its arena or changed the image.
    pub fn trial(&mut self, bytes: &[u8]) -> Verdict {
        match Image::parse(bytes) {
            Err(error) => Verdict::Refused(error),
            Ok(image) => self.run(image),
        }
    }

    fn run(&mut self, image: Image<'_>) -> Verdict {
        if image.arena_bytes() as usize > MAX_ARENA {
            let refused = Engine::new(image, Portable, buffers(&image, &mut self.memory[..MAX_ARENA])).err();
            assert!(matches!(refused, Some(EngineError::ArenaTooSmall { .. })), "{refused:?}");
            return Verdict::TooLarge;
        }
        if image.work() > MAX_WORK {
            return Verdict::TooLarge;
        }
        let kernels = self.backend.kernels();
        let verdict = match infer(image, kernels, buffers(&image, &mut self.memory), &self.noise) {
            Ok(()) => Verdict::Ran,
            Err(error) => Verdict::Failed(error),
        };
        let (guard, mut rest) = first_guard(&mut self.memory);
        let intact = |bytes: &[u8]| bytes.iter().all(|byte| *byte == GUARD_BYTE);
        assert!(intact(guard), "wrote in front of the arena");
        for region in image.regions() {
            let (arena, guard) = cut(&mut rest, &region);
            arena.fill(GUARD_BYTE);
            assert!(intact(guard), "wrote behind the arena of region {}", region.name);
        }
        verdict
    }
}

/// A buffer per region of an image, with a guard on both sides of each; too small where memory is short.
fn buffers<'m>(image: &Image<'_>, memory: &'m mut [u8]) -> Regions<'m> {
    let (_, mut rest) = first_guard(memory);
    image.regions().map(|region| cut(&mut rest, &region).0).collect()
}

/// The first guard, and the rest from a multiple of every alignment on.
fn first_guard(memory: &mut [u8]) -> (&mut [u8], &mut [u8]) {
    let start = GUARD + memory.as_ptr().align_offset(GUARD);
    let (guard, rest) = memory.split_at_mut(start);
    (&mut guard[start - GUARD..], rest)
}

/// The arena of the next region and the guard behind it, to the next multiple of every alignment.
fn cut<'m>(rest: &mut &'m mut [u8], region: &Region) -> (&'m mut [u8], &'m mut [u8]) {
    let size = region.bytes as usize;
    let end = (size.next_multiple_of(GUARD) + GUARD).min(rest.len());
    let (here, behind) = std::mem::take(rest).split_at_mut(end);
    *rest = behind;
    here.split_at_mut(size.min(end))
}

/// A whole inference, and every output read.
fn infer(image: Image<'_>, kernels: &dyn Kernels, arena: Regions<'_>, noise: &[u8]) -> Result<(), EngineError> {
    let input = |number| {
        let record = image.input(number).and_then(|port| image.tensor(port.tensor));
        record.and_then(|record| noise.get(..record.bytes as usize)).unwrap_or_default()
    };
    let inputs: Vec<&[u8]> = (0..image.input_count()).map(input).collect();
    let mut engine = Engine::new(image, kernels, arena)?;
    engine.infer(&inputs)?;
    (0..image.output_count()).try_for_each(|number| engine.output(number.into()).map(|_| ()))
}

/// Whether the tensor table tells the truth, judged from the program alone: each tensor is written once, live from its
/// writer to its last reader, and shares no byte with another that is live unless it takes over its memory.
pub fn live_ranges_are_true(image: &Image<'_>) -> bool {
    let steps: Vec<_> =
        (0..image.step_count()).filter_map(|position| Some((position, image.step(position)?))).collect();
    let last = image.step_count().saturating_sub(1);
    let ports = |count: u8, port: &dyn Fn(u8) -> Option<TensorId>| (0..count).filter_map(port).collect::<Vec<_>>();
    let inputs = ports(image.input_count(), &|i| image.input(i).map(|port| port.tensor));
    let outputs = ports(image.output_count(), &|i| image.output(i).map(|port| port.tensor));
    let range = |id: TensorId| {
        let written: Vec<u16> = steps
            .iter()
            .filter(|(_, step)| step.output() == id || step.scratch() == Some(id))
            .map(|(position, _)| *position)
            .chain(inputs.contains(&id).then_some(0))
            .collect();
        let read = steps.iter().filter(|(_, step)| step.reads().contains(&Some(id))).map(|(position, _)| *position);
        let end = read.chain(written.iter().copied()).chain(outputs.contains(&id).then_some(last)).max();
        (written.len() == 1).then_some((*written.first()?, end?))
    };
    let ids = (0..image.tensor_count()).map(TensorId);
    let told = ids.clone().all(|id| image.tensor(id).is_some_and(|r| range(id) == Some((r.first_step, r.last_step))));
    told && !matches!(firmware::image::audit::audit(image), Err(firmware::image::audit::AuditError::Overlap { .. }))
}
