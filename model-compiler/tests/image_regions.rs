//! An image in two memory regions: it runs like one in a single region, and the engine names the region that is wrong.

#[path = "support/sample_image.rs"]
mod sample_image;

use firmware::arena::Regions;
use firmware::engine::{Engine, EngineError};
use firmware::image::{Image, Region, RegionName};
use firmware::kernels::Portable;
use firmware::tensor::ElementType;
use model_compiler::emit::{AlignedBytes, ImageParts, emit};

fn sample() -> AlignedBytes {
    AlignedBytes::from(emit(&sample_image::parts()).expect("the sample").as_slice())
}

/// The sample with its scratch and every third chain of tensors in a region `fast` of the same size, behind `main`.
fn in_two_regions() -> AlignedBytes {
    let mut parts = sample_image::parts();
    let root = |parts: &ImageParts, mut id: u16| {
        while let Some(operand) = parts.tensors[usize::from(id)].in_place_of {
            id = operand.0;
        }
        id
    };
    for id in 0..parts.tensors.len() as u16 {
        let fast = parts.tensors[usize::from(id)].element == ElementType::Scratch || root(&parts, id) % 3 == 0;
        parts.tensors[usize::from(id)].region = u8::from(fast);
    }
    let fast = RegionName::new("fast").expect("a name");
    parts.regions.push(Region { name: fast, alignment: 64, ..parts.regions[0] });
    AlignedBytes::from(emit(&parts).expect("the sample in two regions").as_slice())
}

#[test]
fn engine_names_the_region_that_is_wrong() {
    let bytes = in_two_regions();
    let image = Image::parse(&bytes).expect("parses");
    let [main, fast] = [0, 1].map(|region| image.region(region).expect("two regions"));
    assert_eq!((image.region(2), image.region_count(), image.arena_alignment()), (None, 2, 64));
    let needed = main.bytes as usize;
    assert_eq!(image.arena_bytes(), 2 * main.bytes);
    let mut memory = AlignedBytes::zeroed(3 * needed + 256);
    let start = memory.as_ptr().align_offset(64);
    let (a, rest) = memory[start..].split_at_mut(needed.next_multiple_of(64));
    let (b, c) = rest.split_at_mut(needed.next_multiple_of(64));
    fn refused(error: EngineError, words: &str, found: Result<Engine<'_, Portable>, EngineError>) {
        assert_eq!(found.map(drop), Err(error));
        assert_eq!(error.to_string(), words);
    }
    let missing = EngineError::RegionMissing(fast.name);
    refused(missing, "arena fast: no buffer was given", Engine::new(image, Portable, &mut *a));
    let surplus = EngineError::RegionCount { found: 3, expected: 2 };
    let words = "3 buffers given, the image has 2 memory regions";
    refused(surplus, words, Engine::new(image, Portable, [&mut *a, &mut *b, &mut *c]));
    let small = EngineError::ArenaTooSmall { region: fast.name, found: main.bytes - 1, needed: main.bytes };
    let words = format!("arena fast: {} bytes, the image needs {needed}", needed - 1);
    refused(small, &words, Engine::new(image, Portable, [&mut *a, &mut b[..needed - 1]]));
    let misaligned = EngineError::ArenaMisaligned { region: fast.name, remainder: 16, alignment: 64 };
    let words = "arena fast: starts 16 bytes behind a multiple of 64";
    refused(misaligned, words, Engine::new(image, Portable, [&mut *a, &mut b[16..]]));
    Engine::new(image, Portable, [a, b]).expect("both fit");
}

#[test]
fn two_regions_give_the_bytes_of_one() {
    let run = |bytes: &AlignedBytes| {
        let image = Image::parse(bytes).expect("parses");
        let given = inputs(&image, 11);
        let slices: Vec<&[u8]> = given.iter().map(Vec::as_slice).collect();
        let mut memory: Vec<AlignedBytes> =
            image.regions().map(|region| AlignedBytes::zeroed((region.bytes + region.alignment) as usize)).collect();
        let aligned = image.regions().zip(&mut memory).map(|(region, buffer)| {
            let start = buffer.as_ptr().align_offset(region.alignment as usize);
            &mut buffer[start..]
        });
        let mut engine = Engine::new(image, Portable, aligned.collect::<Regions<'_>>()).expect("fits");
        let mut steps = Vec::new();
        engine.infer_observed(&slices, |_, _, bytes| steps.push(bytes.to_vec())).expect("runs");
        let outputs = (0..image.output_count()).map(|i| engine.output(i.into()).expect("done").to_vec());
        steps.extend(outputs);
        steps
    };
    assert_eq!(run(&in_two_regions()), run(&sample()));
}

#[test]
fn audit_sees_an_overlap_within_a_region_only() {
    let mut parts = sample_image::parts();
    parts.regions.push(Region { name: RegionName::new("fast").expect("a name"), ..parts.regions[0] });
    // All scratch at the start of the other region: each is live in its own step.
    for scratch in parts.tensors.iter_mut().filter(|tensor| tensor.element == ElementType::Scratch) {
        (scratch.region, scratch.offset) = (1, 0);
    }
    emit(&parts).expect("nothing overlaps there");
    for scratch in parts.tensors.iter_mut().filter(|tensor| tensor.element == ElementType::Scratch) {
        scratch.region = 0;
    }
    let error = emit(&parts).expect_err("overlap");
    assert!(error.message.contains("holds another live tensor"), "{error}");
}

/// Inputs of the sample from one seed.
fn inputs(image: &Image<'_>, seed: u64) -> Vec<Vec<u8>> {
    let mut generator = firmware::image::known_answer::Generator::new(seed);
    let records =
        (0..image.input_count()).map(|i| image.tensor(image.input(i).expect("input").tensor).expect("tensor"));
    records
        .map(|record| {
            let mut bytes = vec![0; record.bytes as usize];
            generator.fill(record.element, &mut bytes);
            bytes
        })
        .collect()
}
