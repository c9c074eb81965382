//! Damage is noticed: whatever single bit of an image flips, wherever it is cut or lengthened, `Image::parse` or
//! `Image::check` refuses it. The CRCs are left as they are.

use firmware::image::{Image, SectionKind, layout};
use model_compiler::emit::AlignedBytes;
use model_compiler::import::System;
use model_compiler::quantize::QuantizeOptions;
use std::collections::BTreeMap;
use std::ops::Range;
use std::sync::LazyLock;
use tests::build;
use tests::golden::Network;
use tests::random::Random;

/// Seed of the positions outside of header, tables and program.
const SEED: u64 = 0xDA7A;
/// How many of them.
const SAMPLES: usize = 10_000;

/// A small TransFuser with a known answer.
static IMAGE: LazyLock<Vec<u8>> = LazyLock::new(|| {
    let graph = build::small(&Network::small(System::TransFuser));
    build::compiled(&build::quantized(&graph, &QuantizeOptions::default())).image
});

/// Who refused, and how often.
#[derive(Debug, Default)]
struct Refusals(BTreeMap<String, usize>);

impl Refusals {
    fn count(&mut self, who: String) {
        *self.0.entry(who).or_default() += 1;
    }

    fn add(&mut self, other: Self) {
        for (who, count) in other.0 {
            *self.0.entry(who).or_default() += count;
        }
    }

    fn print(&self, title: &str) {
        println!("{title}: {} refused", self.0.values().sum::<usize>());
        for (who, count) in &self.0 {
            println!("  {count:8}  {who}");
        }
    }
}

/// Who refuses these bytes; `None` if nobody does.
fn refused_by(bytes: &[u8]) -> Option<String> {
    match Image::parse(bytes) {
        Err(error) => Some(format!("parse {:?}", error.check)),
        Ok(image) => image.check().err().map(|error| format!("check, {}", error.section.name())),
    }
}

/// Flips each bit in turn and puts it back.
fn flip_all(bits: impl Iterator<Item = usize>) -> Refusals {
    let mut bytes = AlignedBytes::from(IMAGE.as_slice());
    let mut refusals = Refusals::default();
    for bit in bits {
        bytes[bit / 8] ^= 1 << (bit % 8);
        let who = refused_by(&bytes);
        refusals.count(who.unwrap_or_else(|| panic!("bit {} of byte {} flipped: accepted", bit % 8, bit / 8)));
        bytes[bit / 8] ^= 1 << (bit % 8);
    }
    refusals
}

/// [`flip_all`] on two threads.
fn flip_on_two_threads(bits: &[usize]) -> Refusals {
    let (first, second) = bits.split_at(bits.len() / 2);
    std::thread::scope(|scope| {
        let other = scope.spawn(|| flip_all(second.iter().copied()));
        let mut refusals = flip_all(first.iter().copied());
        refusals.add(other.join().expect("no panic in the other half"));
        refusals
    })
}

/// First byte of each section, and the end of the file.
fn section_edges() -> Vec<usize> {
    let bytes = AlignedBytes::from(IMAGE.as_slice());
    let image = Image::parse(&bytes).expect("the image is valid");
    let mut edges = vec![layout::header::BYTES];
    for kind in SectionKind::ALL {
        let length = layout::padded(image.section(kind).len() as u64) as usize;
        edges.push(edges[edges.len() - 1] + length);
    }
    edges
}

/// The bytes of everything in front of the constants.
fn structure() -> Range<usize> {
    0..section_edges()[SectionKind::Constants as usize]
}

#[test]
fn the_image_itself_is_accepted() {
    let bytes = AlignedBytes::from(IMAGE.as_slice());
    assert_eq!(refused_by(&bytes), None);
    assert_eq!(section_edges().last(), Some(&IMAGE.len()));
    println!("{} bytes, {} of them header, tables and program", IMAGE.len(), structure().len());
}

#[test]
fn every_flipped_bit_of_header_tables_and_program_is_refused() {
    let structure = structure();
    let bits: Vec<usize> = (8 * structure.start..8 * structure.end).collect();
    let refusals = flip_on_two_threads(&bits);
    refusals.print("flipped bits of header, tables and program");
    assert_eq!(refusals.0.values().sum::<usize>(), bits.len());
    assert!(refusals.0.keys().all(|who| who.starts_with("parse")), "parse alone notices them: {refusals:?}");
}

#[test]
fn flipped_bits_of_constants_known_answer_and_padding_are_refused() {
    let rest = structure().end..IMAGE.len();
    let mut random = Random::new(SEED);
    let mut bits: Vec<usize> = (0..SAMPLES).map(|_| 8 * rest.start + random.below(8 * rest.len())).collect();
    // The padding is so small that chance would miss it.
    bits.extend(padding().flat_map(|byte| [8 * byte, 8 * byte + 7]));
    let refusals = flip_on_two_threads(&bits);
    refusals.print(&format!("flipped bits elsewhere (seed {SEED:#x})"));
    for who in ["check, constants", "check, known answer", "parse SectionPadding"] {
        assert!(refusals.0.contains_key(who), "{who}: {refusals:?}");
    }
}

/// Bytes that belong to no section's content, behind all tables.
fn padding() -> impl Iterator<Item = usize> {
    let bytes = AlignedBytes::from(IMAGE.as_slice());
    let image = Image::parse(&bytes).expect("the image is valid");
    let edges = section_edges();
    let ranges: Vec<Range<usize>> = [SectionKind::Constants, SectionKind::KnownAnswer]
        .map(|kind| edges[kind as usize] + image.section(kind).len()..edges[kind as usize + 1])
        .to_vec();
    ranges.into_iter().flatten()
}

#[test]
fn every_cut_and_every_addition_is_refused() {
    let edges = section_edges();
    let near = edges.iter().flat_map(|&edge| [edge - 1, edge, edge + 1]);
    let lengths = near.chain(0..=layout::header::BYTES).chain([IMAGE.len() + 16]);
    let mut refusals = Refusals::default();
    for length in lengths.filter(|&length| length != IMAGE.len()) {
        let mut bytes = AlignedBytes::zeroed(length);
        let kept = length.min(IMAGE.len());
        bytes[..kept].copy_from_slice(&IMAGE[..kept]);
        let who = refused_by(&bytes);
        refusals.count(who.unwrap_or_else(|| panic!("{length} of {} bytes: accepted", IMAGE.len())));
    }
    refusals.print("cuts and additions");
}
