//! What `Image::parse` promises: an image with valid CRCs is refused with a typed error, or it runs to its end without
//! a panic, inside its arena. And each single check is needed for that promise, or named as a second opinion.
//!
//! Checks are switched off process-wide, so the tests take turns.

use firmware::fault;
use firmware::image::{Check, Image, SectionKind, layout};
use host_sim::backends::{Backend, BackendKind};
use model_compiler::emit::{AlignedBytes, ImageParts, assemble, emit, reseal};
use std::collections::BTreeMap;
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::sync::{Mutex, MutexGuard};
use std::time::Instant;
use tests::random::Random;
use tests::trial::{Bench, Verdict, live_ranges_are_true};
use tests::{every_step, mutation, sketch};

/// Seed of the random edits.
const SEED: u64 = 0x5EED;
/// Images with random edits.
const EDITS: usize = 500_000;
const THREADS: usize = 2;

static TURN: Mutex<()> = Mutex::new(());

/// Waits for the other tests of this file.
fn turn() -> MutexGuard<'static, ()> {
    TURN.lock().unwrap_or_else(|poisoned| poisoned.into_inner())
}

/// How trials ended.
#[derive(Debug, Default)]
struct Tally {
    ran: usize,
    too_large: usize,
    refused: BTreeMap<u16, usize>,
}

impl Tally {
    /// Counts a verdict that keeps the promise.
    fn count(&mut self, verdict: Verdict, what: &dyn Fn() -> String) {
        match verdict {
            Verdict::Refused(error) => *self.refused.entry(error.check.number()).or_default() += 1,
            Verdict::Ran => self.ran += 1,
            Verdict::TooLarge => self.too_large += 1,
            Verdict::Failed(error) => panic!("{}: accepted, then: {error}", what()),
        }
    }

    fn add(&mut self, other: Self) {
        self.ran += other.ran;
        self.too_large += other.too_large;
        for (check, count) in other.refused {
            *self.refused.entry(check).or_default() += count;
        }
    }

    fn print(&self, title: &str, start: Instant) {
        let refused: usize = self.refused.values().sum();
        let (ran, too_large, kinds) = (self.ran, self.too_large, self.refused.len());
        let total = refused + ran + too_large;
        println!(
            "{title}: {total} images in {:.1?}: {refused} refused by {kinds} checks, {ran} ran to their end, \
             {too_large} accepted but too large to run here",
            start.elapsed()
        );
    }
}

/// Fills of the constants per accepted image.
const FILLS: usize = 10;

#[test]
fn accepted_images_run_with_any_constants() {
    let _turn = turn();
    let start = Instant::now();
    println!("seed {SEED:#x}");
    let portable = BackendKind::Portable.detect().expect("portable is everywhere");
    let on_x86 = Backend::all().into_iter().map(|backend| ("x86", backend));
    for (target, backend) in [("portable", portable)].into_iter().chain(on_x86) {
        let title = format!("any constants, target {target}, {}", backend.kind().name());
        let mut bench = Bench::of(backend);
        let mut random = Random::new(SEED);
        let mut tally = Tally::default();
        mutation::visit_all(&every_step::parts_for(target), &mut |what, image| {
            let mut image = AlignedBytes::from(image);
            if Image::parse(&image).is_err() {
                return;
            }
            for fill in 0..FILLS {
                fill_constants(&mut image, &mut random);
                let what = || format!("seed {SEED:#x}, {title}, {what}, fill {fill}");
                tally.count(trial(&mut bench, &image, &what), &what);
            }
        });
        tally.print(&title, start);
        assert!(tally.refused.is_empty(), "parse does not read the constants: {tally:?}");
        assert!(tally.ran > 1000 * FILLS, "{tally:?}");
    }
}

/// Sets every word of the constants to an extreme or a random value; each fill prefers another extreme.
fn fill_constants(image: &mut [u8], random: &mut Random) {
    let slot = layout::header::SECTIONS.start + SectionKind::Constants as usize * layout::section::BYTES;
    let word = |at: usize| u32::from_le_bytes([image[at], image[at + 1], image[at + 2], image[at + 3]]) as usize;
    let (offset, length) = (word(slot + layout::section::OFFSET.start), word(slot + layout::section::LENGTH.start));
    let extremes = [0, u32::MAX, 0x7FFF_FFFF, 0x8000_0000, 0x7FFF_7FFF, 0x8000_8000, 0x7F7F_7F7F, 0x8080_8080];
    let preferred = *random.pick(&extremes);
    for word in image[offset..offset + length].chunks_mut(4) {
        let (extreme, any) = (*random.pick(&extremes), random.bits() as u32);
        let value = *random.pick(&[preferred, preferred, extreme, any]);
        word.copy_from_slice(&value.to_le_bytes()[..word.len()]);
    }
    reseal(image);
}

/// A trial in which a panic is the test's failure, with its cause named.
fn trial(bench: &mut Bench, image: &[u8], what: &dyn Fn() -> String) -> Verdict {
    catch_unwind(AssertUnwindSafe(|| bench.trial(image))).unwrap_or_else(|_| panic!("{}: panicked", what()))
}

#[test]
fn images_with_one_changed_field_are_refused_or_run() {
    let _turn = turn();
    let start = Instant::now();
    let mut bench = Bench::default();
    let mut tally = Tally::default();
    let parts = every_step::parts();
    mutation::visit_all(&parts, &mut |what, image| {
        let image = AlignedBytes::from(image);
        let what = || what.to_owned();
        tally.count(trial(&mut bench, &image, &what), &what);
    });
    tally.print("one changed field", start);
    assert!(tally.ran > 100 && tally.refused.len() > 40, "{tally:?}");
}

#[test]
fn images_with_random_edits_are_refused_or_run() {
    let _turn = turn();
    let start = Instant::now();
    println!("seed {SEED:#x}, {EDITS} images on {THREADS} threads");
    let parts = every_step::parts();
    // Each thread has its own form of the image: one memory region, or two.
    let forms: [ImageParts; THREADS] = [parts.clone(), every_step::in_two_regions(parts)];
    let images = forms.map(|parts| emit(&parts).unwrap_or_else(|e| panic!("{e}")));
    let mut tally = Tally::default();
    std::thread::scope(|scope| {
        let run = |(image, seed): (&[u8], u64)| random_edits(image, seed, EDITS / THREADS);
        let work = images.iter().map(Vec::as_slice).zip(SEED..);
        let threads: Vec<_> = work.map(|work| scope.spawn(move || run(work))).collect();
        for thread in threads {
            tally.add(thread.join().expect("the promise holds"));
        }
    });
    tally.print("random edits", start);
    assert!(tally.ran > EDITS / 10 && tally.refused.len() > 40, "{tally:?}");
}

fn random_edits(original: &[u8], seed: u64, count: usize) -> Tally {
    let mut random = Random::new(seed);
    let mut bench = Bench::default();
    let mut tally = Tally::default();
    let mut image = AlignedBytes::from(original);
    for number in 0..count {
        let edits: Vec<Edit> = (0..=random.below(4)).map(|_| Edit::random(&mut random, original)).collect();
        edits.iter().for_each(|edit| edit.apply(&mut image));
        reseal(&mut image);
        let what = || format!("seed {seed:#x}, image {number}, {edits:x?}");
        tally.count(trial(&mut bench, &image, &what), &what);
        image.copy_from_slice(original);
    }
    tally
}

/// One to four bytes set anywhere.
#[derive(Debug)]
struct Edit {
    at: usize,
    bytes: [u8; 4],
    length: usize,
}

impl Edit {
    fn random(random: &mut Random, image: &[u8]) -> Self {
        if random.below(2) == 0 {
            return Self { at: random.below(image.len()), bytes: [random.bits() as u8; 4], length: 1 };
        }
        let at = 4 * random.below(image.len() / 4);
        let old = u32::from_le_bytes([image[at], image[at + 1], image[at + 2], image[at + 3]]);
        let any = random.bits() as u32;
        let small = old ^ (1 << random.below(32));
        let words = [0, 1, u32::MAX, i32::MAX as u32, 1 << 31, old.wrapping_add(1), old.wrapping_sub(1), small, any];
        Self { at, bytes: random.pick(&words).to_le_bytes(), length: 4 }
    }

    fn apply(&self, image: &mut [u8]) {
        image[self.at..self.at + self.length].copy_from_slice(&self.bytes[..self.length]);
    }
}

/// Checks that no image needs alone, with the reason.
const SECOND_OPINIONS: [(Check, &str); 5] = [
    (
        Check::HeaderLength,
        "what a shorter file lacks reads as zero, which the next checks refuse; the message is better",
    ),
    (
        Check::Features,
        "an unknown bit also differs from what the program uses; named first, it says that a runtime is old",
    ),
    (Check::TensorRegion, "a region that is not listed has no bytes, so the tensor also ends outside"),
    (Check::TensorLive, "a false range is also one whose first step does not write or whose last step does not read"),
    (Check::StepReadsScratch, "scratch is live in its own step only, so reading it also reads what holds nothing"),
];

/// What happened to one check's images when it was switched off.
#[derive(Debug, Default)]
struct Consequences {
    /// Images that this check refused first.
    refused: usize,
    /// Of these: another check refused them.
    caught: BTreeMap<String, usize>,
    ran: usize,
    too_large: usize,
    failed: usize,
    panicked: usize,
    /// Accepted, and the tensor table tells an untruth or lets live tensors overlap.
    untrue: usize,
}

impl Consequences {
    /// Accepted images: no other check refuses them.
    fn alone(&self) -> usize {
        self.ran + self.too_large + self.failed + self.panicked
    }

    fn observe(&mut self, check: Check, image: &[u8], bench: &mut Bench) {
        self.refused += 1;
        fault::disable_check(check.number());
        let verdict = catch_unwind(AssertUnwindSafe(|| bench.trial(image)));
        self.untrue += usize::from(Image::parse(image).is_ok_and(|image| !live_ranges_are_true(&image)));
        fault::disable_check(0);
        match verdict {
            Err(_) => {
                self.panicked += 1;
                *bench = Bench::default();
            }
            Ok(Verdict::Ran) => self.ran += 1,
            Ok(Verdict::TooLarge) => self.too_large += 1,
            Ok(Verdict::Failed(_)) => self.failed += 1,
            Ok(Verdict::Refused(error)) => *self.caught.entry(format!("{:?}", error.check)).or_default() += 1,
        }
    }

    fn print(&self, check: Check) {
        let caught: Vec<String> = self.caught.iter().map(|(other, count)| format!("{other} {count}")).collect();
        println!(
            "{:18} {:7} {:6} {:6} {:6} {:6} {:6} {:7}  {}",
            format!("{check:?}"),
            self.refused,
            self.alone(),
            self.failed,
            self.panicked,
            self.untrue,
            self.ran,
            self.too_large,
            caught.join(", ")
        );
    }
}

#[test]
fn every_check_is_needed() {
    /// Images per check that are tried again without it.
    const LIMIT: usize = 400;
    let _turn = turn();
    let mut images: BTreeMap<u16, Vec<AlignedBytes>> = BTreeMap::new();
    let mut bench = Bench::default();
    let mut collect = |image: &[u8]| {
        let image = AlignedBytes::from(image);
        if let Some(check) = Image::parse(&image).err().map(|error| error.check) {
            let known = images.entry(check.number()).or_default();
            if known.len() < LIMIT {
                known.push(image);
            }
        }
    };
    for (check, image) in sketch::refused_by_one_check() {
        let aligned = AlignedBytes::from(image.as_slice());
        assert_eq!(Image::parse(&aligned).map(|_| ()).map_err(|error| error.check), Err(check), "sketch");
        collect(&image);
    }
    mutation::visit_all(&every_step::parts(), &mut |_, image| collect(image));
    println!("check              refused  alone  error  panic untrue    ran too large  caught by another check");
    let hook = std::panic::take_hook();
    std::panic::set_hook(Box::new(|_| ()));
    let mut results = Vec::new();
    for check in Check::ALL.iter().copied() {
        let mut consequences = Consequences::default();
        if check == Check::Misaligned {
            displaced(|image| consequences.observe(check, image, &mut bench));
        }
        for image in images.get(&check.number()).into_iter().flatten() {
            consequences.observe(check, image, &mut bench);
        }
        if check == Check::HeaderLength {
            cut_headers(|image| consequences.observe(check, image, &mut bench));
        }
        consequences.print(check);
        results.push((check, consequences));
    }
    std::panic::set_hook(hook);
    let listed = |check: Check| SECOND_OPINIONS.iter().find(|(listed, _)| *listed == check);
    let unneeded: Vec<Check> = results.iter().filter(|(_, c)| c.alone() == 0).map(|(check, _)| *check).collect();
    for check in &unneeded {
        println!("{check:?}: {}", listed(*check).map_or("no image needs it", |(_, reason)| reason));
    }
    let expected: Vec<Check> = SECOND_OPINIONS.iter().map(|(check, _)| *check).collect();
    assert_eq!(unneeded, expected, "checks that no image needs");
    assert!(results.iter().all(|(_, c)| c.refused > 0), "every check refuses something");
}

/// A good image at addresses that are no multiples of 16.
fn displaced(mut visit: impl FnMut(&[u8])) {
    let image = assemble(&every_step::parts()).unwrap_or_else(|e| panic!("{e}"));
    for shift in [1, 2, 4, 8] {
        let mut memory = AlignedBytes::zeroed(image.len() + 16);
        memory[shift..shift + image.len()].copy_from_slice(&image);
        visit(&memory[shift..shift + image.len()]);
    }
}

/// A good image cut off inside its header.
fn cut_headers(mut visit: impl FnMut(&[u8])) {
    let image = assemble(&every_step::parts()).unwrap_or_else(|e| panic!("{e}"));
    for length in 0..layout::header::BYTES {
        visit(&AlignedBytes::from(&image[..length]));
    }
}

#[test]
fn fuzz_corpus_is_an_accepted_image() {
    let _turn = turn();
    let image = emit(&every_step::parts()).unwrap_or_else(|e| panic!("{e}"));
    let aligned = AlignedBytes::from(image.as_slice());
    let parsed = Image::parse(&aligned).unwrap_or_else(|e| panic!("{e}"));
    assert!(!parsed.section(SectionKind::KnownAnswer).is_empty());
    assert_eq!(Bench::default().trial(&aligned), Verdict::Ran);
    if let Some(folder) = std::env::var_os("FUZZ_CORPUS").map(std::path::PathBuf::from) {
        std::fs::create_dir_all(&folder).unwrap_or_else(|e| panic!("{}: {e}", folder.display()));
        let file = folder.join("every_step");
        std::fs::write(&file, &image).unwrap_or_else(|e| panic!("{}: {e}", file.display()));
    }
}
