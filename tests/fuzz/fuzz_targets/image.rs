//! No bytes with valid CRCs make the parser or the engine panic, or write outside the arena.
//!
//! The CRCs are recomputed first, or no change would ever get past them.
#![no_main]

use firmware::arena::Regions;
use firmware::engine::Engine;
use firmware::image::{Image, layout};
use firmware::kernels::Portable;
use libfuzzer_sys::fuzz_target;
use model_compiler::emit::{AlignedBytes, reseal};

/// Accepted images beyond these are not run: each run is to take microseconds.
const MAX_WORK: u64 = 1 << 20;
const MAX_ARENA: u32 = 1 << 18;
/// Untouched bytes on both sides of each region's arena; a multiple of every alignment.
const GUARD: usize = 4096;

fuzz_target!(|bytes: &[u8]| {
    let mut image = AlignedBytes::from(bytes);
    reseal(&mut image);
    let Ok(image) = Image::parse(&image) else { return };
    image.check().expect("all CRCs are valid");
    if image.work() > MAX_WORK || image.arena_bytes() > MAX_ARENA {
        return;
    }
    run(image);
});

fn run(image: Image<'_>) {
    let size = image.arena_bytes() as usize;
    let mut memory = AlignedBytes::zeroed(size + (2 * layout::REGION_SLOTS + 2) * GUARD);
    memory.fill(0xA5);
    let start = GUARD + memory.as_ptr().align_offset(GUARD);
    let (before, mut rest) = memory.split_at_mut(start);
    let mut guards = vec![before];
    let mut cut = |bytes: usize| {
        let (here, behind) = std::mem::take(&mut rest).split_at_mut(bytes.next_multiple_of(GUARD) + GUARD);
        rest = behind;
        let (arena, guard) = here.split_at_mut(bytes);
        guards.push(guard);
        arena
    };
    let arena: Regions<'_> = image.regions().map(|region| cut(region.bytes as usize)).collect();
    let noise: Vec<u8> = (0..size).map(|i| (i * 167 + (i >> 8)) as u8).collect();
    let records = (0..image.input_count()).map(|i| image.input(i).and_then(|port| image.tensor(port.tensor)));
    let inputs: Vec<&[u8]> = records.map(|record| &noise[..record.expect("a tensor").bytes as usize]).collect();
    let mut engine = Engine::new(image, Portable, arena).expect("the arena fits");
    engine.infer(&inputs).expect("an accepted image runs to its end");
    for output in 0..image.output_count() {
        engine.output(output.into()).expect("an accepted image gives its outputs");
    }
    assert!(guards.iter().all(|guard| guard.iter().all(|byte| *byte == 0xA5)), "wrote outside the arena");
}
