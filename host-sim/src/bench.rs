//! Latency of an image: whole inferences and single steps, the backends of the machine side by side in one run.
//!
//! The work of an inference does not depend on its inputs, so seeded ones serve. Steps are timed in inferences of their
//! own, for the clock is read twice per step and would disturb the whole. Backends take turns within every round, so
//! that whatever else the machine does hits all of them alike. Nothing is timed before every backend has given the
//! right bytes in every step.

mod clock;
pub mod figures;
mod memory;
mod tabulation;

use crate::backends::{Backend, BackendKind};
use crate::buffers::GuardedArena;
use crate::files::ImageFile;
use crate::run::ModelInfo;
use clock::{Elapsed, Stopwatch};
use figures::BenchReport;
use firmware::engine::{Engine, EngineError, Progress};
use firmware::image::known_answer::Generator;
use firmware::image::{Image, TensorRecord, crc32};
use firmware::kernels::Kernels;
use indicatif::ProgressBar;
use model_compiler::artifact;
use model_compiler::error::{Error, ErrorCode, Result};
use std::path::PathBuf;
use std::time::Duration;
use tabulation::Tabulation;

/// Time that a measurement may take where nobody says how many rounds: enough for steady medians of small networks.
const DEFAULT_TIME: Duration = Duration::from_secs(10);
/// Bounds on the rounds chosen so.
const DEFAULT_ROUNDS: std::ops::RangeInclusive<u32> = 5..=200;
/// Seed of the inputs of an image without a known answer.
const SEED: u64 = 1;

/// What to measure.
#[derive(Clone, Debug)]
pub struct Options {
    /// The image.
    pub image: PathBuf,
    /// Backends, each once.
    pub backends: Vec<Backend>,
    /// Rounds; as many as fit into some ten seconds if not given.
    pub rounds: Option<u32>,
}

/// Proves that the backends agree, then measures them.
///
/// # Errors
/// The image cannot be read or is refused; [`ErrorCode::Check`] where a backend gives wrong bytes: the first such step
/// is named.
pub fn bench(options: &Options, progress: &ProgressBar) -> Result<BenchReport> {
    let file = ImageFile::read(&options.image)?;
    let mut bench = Bench::new(file.parse()?);
    let expected = bench.expected_crcs()?;
    let mut once = Duration::ZERO;
    progress.set_message("check");
    progress.set_length(options.backends.len() as u64);
    for &backend in &options.backends {
        bench.check(backend, &expected)?;
        once += bench.whole(backend)?.wall;
        progress.inc(1);
    }
    let rounds = options.rounds.unwrap_or_else(|| default_rounds(once));
    let samples = bench.measure(&options.backends, rounds, progress)?;
    // The record is far larger than the image and gives nothing but names: it comes after the look at the memory.
    let peak_memory_bytes = memory::peak_bytes();
    let (record, unnamed) = match file.record(None) {
        Ok(record) => (Some(record), None),
        Err(error) if error.code == ErrorCode::Io => (None, None),
        Err(error) => (None, Some(error)),
    };
    let model = ModelInfo { name: bench.image.name().to_owned(), sha256: artifact::hex(&file.sha256()) };
    let table = Tabulation::new(&bench.image, record.as_ref(), &samples);
    Ok(BenchReport {
        schema: 1,
        model,
        rounds,
        image_bytes: file.flash_bytes(),
        arena_bytes: bench.image.arena_bytes().into(),
        peak_memory_bytes,
        macs: table.macs(),
        backends: table.backends(),
        operators: table.operators(),
        steps: table.steps(),
        unnamed,
    })
}

/// As many rounds as fit, each of a whole inference and one by steps on every backend.
fn default_rounds(once: Duration) -> u32 {
    let rounds = DEFAULT_TIME.as_secs_f64() / (2.0 * once.as_secs_f64()).max(1e-9);
    (rounds as u32).clamp(*DEFAULT_ROUNDS.start(), *DEFAULT_ROUNDS.end())
}

/// Times of one backend.
#[derive(Clone, Debug)]
struct Samples {
    kind: BackendKind,
    whole: Vec<Elapsed>,
    /// By position.
    steps: Vec<Vec<Duration>>,
}

/// An image with its inputs and its arena.
struct Bench<'a> {
    image: Image<'a>,
    inputs: Vec<Vec<u8>>,
    arena: GuardedArena,
}

impl<'a> Bench<'a> {
    fn new(image: Image<'a>) -> Self {
        let seed = image.known_answer().map_or(SEED, |answer| answer.seed());
        let arena = GuardedArena::new(&image);
        Self { image, inputs: seeded_inputs(&image, seed), arena }
    }

    /// CRC of every step's output: the known answer's, or the portable kernels' where the image has none.
    fn expected_crcs(&mut self) -> Result<Vec<u32>> {
        match self.image.known_answer() {
            Some(answer) => Ok((0..self.image.step_count()).filter_map(|step| answer.step_crc(step)).collect()),
            None => self.crcs(Backend::choose(Some(BackendKind::Portable))?),
        }
    }

    fn crcs(&mut self, backend: Backend) -> Result<Vec<u32>> {
        let mut crcs = Vec::new();
        self.infer(backend, |engine, inputs| engine.infer_observed(inputs, |_, _, bytes| crcs.push(crc32(bytes))))?;
        self.arena.check_guards().map_err(|e| e.within(backend.kind().name()))?;
        Ok(crcs)
    }

    fn check(&mut self, backend: Backend, expected: &[u32]) -> Result<()> {
        let found = self.crcs(backend)?;
        let Some(position) = found.iter().zip(expected).position(|(found, expected)| found != expected) else {
            return Ok(());
        };
        let op = self.image.step(position as u16).map_or("", |step| step.name());
        let (name, found, expected) = (backend.kind().name(), found[position], expected[position]);
        let message = format!("{name} gives other bytes: CRC {found:08x}, expected {expected:08x}");
        let error = Error::new(ErrorCode::Check, format!("step {position} {op}"), message);
        Err(error.with_help(format!("host-sim verify --backend {name} shows the first wrong element")))
    }

    /// Rounds over all backends.
    fn measure(&mut self, backends: &[Backend], rounds: u32, progress: &ProgressBar) -> Result<Vec<Samples>> {
        let steps = vec![Vec::with_capacity(rounds as usize); self.image.step_count().into()];
        let empty = |backend: &Backend| Samples { kind: backend.kind(), whole: Vec::new(), steps: steps.clone() };
        let mut samples: Vec<Samples> = backends.iter().map(empty).collect();
        progress.set_message("measure");
        progress.set_length(2 * u64::from(rounds) * backends.len() as u64);
        progress.set_position(0);
        for round in 0..rounds {
            at_stack_depth(round, &mut || {
                for (&backend, samples) in backends.iter().zip(&mut samples) {
                    samples.whole.push(self.whole(backend)?);
                    progress.inc(1);
                }
                for (&backend, samples) in backends.iter().zip(&mut samples) {
                    self.step_by_step(backend, &mut samples.steps)?;
                    progress.inc(1);
                }
                Ok(())
            })?;
        }
        progress.finish_and_clear();
        Ok(samples)
    }

    /// One inference, the copy of its inputs included.
    fn whole(&mut self, backend: Backend) -> Result<Elapsed> {
        self.infer(backend, |engine, inputs| {
            let watch = Stopwatch::start();
            engine.infer(inputs)?;
            Ok(watch.elapsed())
        })
    }

    /// One inference; adds the time of every step.
    fn step_by_step(&mut self, backend: Backend, times: &mut [Vec<Duration>]) -> Result<()> {
        self.infer(backend, |engine, inputs| {
            engine.start(inputs)?;
            for times in times {
                let watch = Stopwatch::start();
                let done = engine.step()? == Progress::Done;
                times.push(watch.elapsed().busy());
                if done {
                    break;
                }
            }
            Ok(())
        })
    }

    fn infer<T>(
        &mut self,
        backend: Backend,
        run: impl FnOnce(&mut Engine<'_, &'static dyn Kernels>, &[&[u8]]) -> std::result::Result<T, EngineError>,
    ) -> Result<T> {
        let inputs: Vec<&[u8]> = self.inputs.iter().map(Vec::as_slice).collect();
        let engine = Engine::new(self.image, backend.kernels(), self.arena.poisoned(0));
        engine
            .and_then(|mut engine| run(&mut engine, &inputs))
            .map_err(|e| Error::new(ErrorCode::Malformed, format!("engine, {}", backend.kind().name()), e.to_string()))
    }
}

/// Runs a round on another part of the stack than its neighbors, within two pages.
///
/// Chance places the stack of a process, and at some places the accumulators of a kernel meet its operands in the cache
/// (equal low bits of the address), which can double a time. Over all rounds such places are few, and the median is of
/// the others.
fn at_stack_depth(round: u32, run: &mut dyn FnMut() -> Result<()>) -> Result<()> {
    /// Blocks of stack that cover two pages.
    const BLOCKS: u32 = 64;
    /// Odd, so that all depths occur, and not small, so that few rounds are spread too.
    const STRIDE: u32 = 27;
    #[inline(never)]
    fn descend(blocks: u32, run: &mut dyn FnMut() -> Result<()>) -> Result<()> {
        let block = std::hint::black_box([0_u8; 64]);
        let result = if blocks == 0 { run() } else { descend(blocks - 1, run) };
        std::hint::black_box(block);
        result
    }
    descend(round.wrapping_mul(STRIDE) % BLOCKS, run)
}

/// The inputs that the rule of the known answer gives for a seed.
fn seeded_inputs(image: &Image<'_>, seed: u64) -> Vec<Vec<u8>> {
    let mut generator = Generator::new(seed);
    let ports = (0..image.input_count()).filter_map(|input| image.input(input));
    let fill = |record: TensorRecord| {
        let mut bytes = vec![0; record.bytes as usize];
        generator.fill(record.element, &mut bytes);
        bytes
    };
    ports.filter_map(|port| image.tensor(port.tensor)).map(fill).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::testing::sample;
    use model_compiler::record::Record;

    fn written_sample() -> (tempfile::TempDir, Options) {
        let folder = tempfile::tempdir().unwrap();
        let image = folder.path().join("sample.img");
        std::fs::write(&image, &*sample().image).unwrap();
        let options = Options { image, backends: Backend::all(), rounds: Some(3) };
        (folder, options)
    }

    #[test]
    fn every_step_of_every_backend_is_measured() {
        let (_folder, options) = written_sample();
        let report = bench(&options, &ProgressBar::hidden()).unwrap();
        assert_eq!((report.rounds, report.macs, report.arena_bytes), (3, 0, 80));
        assert_eq!(report.backends.len(), Backend::all().len());
        assert_eq!(report.steps.iter().map(|s| s.op).collect::<Vec<_>>(), ["max_pool", "average_pool"]);
        assert_eq!(
            report.operators.iter().map(|o| (o.op, o.steps)).collect::<Vec<_>>(),
            [("max_pool", 1), ("average_pool", 1)]
        );
        assert_eq!((report.steps[0].shape, report.steps[0].macs), ([2, 2, 3], None));
        let backends: Vec<&str> = Backend::all().iter().map(|backend| backend.kind().name()).collect();
        for times in report.steps.iter().map(|step| &step.times).chain(report.operators.iter().map(|op| &op.times)) {
            assert_eq!(times.iter().map(|share| share.backend).collect::<Vec<_>>(), backends);
        }
    }

    #[test]
    fn every_round_gives_a_sample() {
        let sample = sample();
        let mut bench = Bench::new(Image::parse(&sample.image).unwrap());
        for samples in bench.measure(&Backend::all(), 4, &ProgressBar::hidden()).unwrap() {
            assert_eq!(samples.whole.len(), 4);
            assert_eq!(samples.steps.iter().map(Vec::len).collect::<Vec<_>>(), [4, 4]);
        }
    }

    #[test]
    fn rounds_run_all_over_two_pages_of_the_stack() {
        let mut places = Vec::new();
        for round in 0..64 {
            let mut here = || {
                let local = std::hint::black_box(0_u8);
                places.push(std::ptr::from_ref(&local).addr());
                Ok(())
            };
            at_stack_depth(round, &mut here).unwrap();
        }
        places.sort_unstable();
        places.dedup();
        assert_eq!(places.len(), 64);
        assert!(places[63] - places[0] >= 8192, "{} bytes", places[63] - places[0]);
    }

    #[test]
    fn names_come_from_the_record_that_belongs_to_the_image() {
        let (folder, options) = written_sample();
        let path = folder.path().join("sample.record");
        let mut record = sample().record;
        let bytes = |record: &Record| artifact::to_bytes(record).unwrap();
        std::fs::write(&path, bytes(&record)).unwrap();
        let report = bench(&options, &ProgressBar::hidden()).unwrap();
        assert_eq!(report.steps.iter().map(|s| s.step.as_str()).collect::<Vec<_>>(), ["pool", "mean"]);
        record.image_sha256[0] ^= 1;
        std::fs::write(&path, bytes(&record)).unwrap();
        let report = bench(&options, &ProgressBar::hidden()).unwrap();
        assert_eq!(report.steps[0].step, "max_pool");
        assert!(report.unnamed.unwrap().message.contains("belongs to another image"));
    }

    #[test]
    fn wrong_bytes_are_found_before_anything_is_timed() {
        let sample = sample();
        let mut bench = Bench::new(Image::parse(&sample.image).unwrap());
        let mut expected = bench.expected_crcs().unwrap();
        let backend = Backend::choose(None).unwrap();
        bench.check(backend, &expected).unwrap();
        expected[1] ^= 1;
        let error = bench.check(backend, &expected).unwrap_err();
        assert_eq!((error.code, error.location.as_str()), (ErrorCode::Check, "step 1 average_pool"));
        assert!(error.message.starts_with(backend.kind().name()), "{error}");
    }

    #[test]
    fn the_default_fits_its_time_but_stays_within_bounds() {
        assert_eq!(default_rounds(Duration::from_millis(500)), 10);
        assert_eq!(default_rounds(Duration::from_secs(60)), 5);
        assert_eq!(default_rounds(Duration::ZERO), 200);
    }
}
