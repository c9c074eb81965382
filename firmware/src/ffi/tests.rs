#![allow(clippy::indexing_slicing, clippy::unwrap_used, reason = "a failed test")]

extern crate std;

use super::*;
use core::ffi::CStr;
use core::ptr::{null, null_mut};
use core::slice;
use std::string::String;
use std::vec::Vec;

/// The image of the format page: 16 codes from `x` are copied to `y`; the arena has 32 bytes.
fn image() -> Vec<u128> {
    let page = include_str!("../image/example.hex");
    let bytes: Vec<u8> = page
        .lines()
        .flat_map(|line| line.split_whitespace().skip(1))
        .map(|byte| u8::from_str_radix(byte, 16).unwrap())
        .collect();
    bytes.as_chunks::<16>().0.iter().map(|word| u128::from_le_bytes(*word)).collect()
}

/// An engine with all it uses. The memory is the test's; the engine sees it by pointers only.
struct Bench {
    image: Vec<u128>,
    arena: [u128; 3],
    engine: EngineStorage,
}

impl Bench {
    fn new() -> Self {
        Self { image: image(), arena: [!0; 3], engine: EngineStorage { state: [0; ENGINE_WORDS] } }
    }

    fn init(&mut self, change: impl FnOnce(&mut Init)) -> Status {
        let mut init = Init {
            engine: &raw mut self.engine,
            image: self.image.as_ptr().cast(),
            image_bytes: size_of_val(self.image.as_slice()),
            region: Region { memory: (&raw mut self.arena).cast(), bytes: 32 },
            regions: None,
            region_count: 1,
        };
        change(&mut init);
        let Init { engine, image, image_bytes, region, regions, region_count } = init;
        // SAFETY: what the changes leave unchecked is memory of this bench.
        unsafe { fw_engine_init(engine, image, image_bytes, regions.unwrap_or(&raw const region), region_count) }
    }

    fn message(&mut self) -> String {
        let mut text = [0x7F; 100];
        // SAFETY: engine and text are the bench's.
        assert_eq!(unsafe { fw_engine_explain(&raw mut self.engine, text.as_mut_ptr(), text.len()) }, Status::Ok);
        // SAFETY: the call has ended the text.
        unsafe { CStr::from_ptr(text.as_ptr()) }.to_str().unwrap().into()
    }
}

struct Init {
    engine: *mut EngineStorage,
    image: *const c_void,
    image_bytes: usize,
    region: Region,
    regions: Option<*const Region>,
    region_count: usize,
}

#[test]
fn an_inference_by_pointers_copies_the_input() {
    let mut bench = Bench::new();
    assert_eq!(bench.init(|_| ()), Status::Ok);
    let engine = &raw mut bench.engine;
    let (mut bytes, mut length, mut progress) = (null_mut(), 0, ProgressInfo::default());
    let (mut output, mut output_length) = (null(), 0);
    // SAFETY: every pointer is to a place of this test, and the input's 16 bytes are written before the next call.
    unsafe {
        assert_eq!(fw_output(engine, 0, &raw mut output, &raw mut output_length), Status::NotDone);
        assert_eq!(fw_step(engine, &raw mut progress), Status::NotStarted);
        assert_eq!(fw_input(engine, 0, &raw mut bytes, &raw mut length), Status::Ok);
        assert_eq!(length, 16);
        bytes.write_bytes(0x5A, length);
        assert_eq!(fw_begin(engine), Status::Ok);
        assert_eq!(fw_step(engine, &raw mut progress), Status::Ok);
        assert_eq!(progress, ProgressInfo { done: 1, steps: 1 });
        assert_eq!(fw_output(engine, 0, &raw mut output, &raw mut output_length), Status::Ok);
        assert_eq!(slice::from_raw_parts(output, output_length), [0x5A; 16]);
    }
}

#[test]
fn what_can_be_checked_of_an_engine_is() {
    type Change = fn(&mut Init);
    let cases: &[(Status, Change)] = &[
        (Status::NullPointer, |init| init.engine = null_mut()),
        (Status::NullPointer, |init| init.image = null()),
        (Status::NullPointer, |init| init.regions = Some(null())),
        (Status::NullPointer, |init| init.region.memory = null_mut()),
        (Status::Misaligned, |init| init.engine = init.engine.wrapping_byte_add(4)),
        (Status::Misaligned, |init| init.image = init.image.wrapping_byte_add(8)),
        (Status::Misaligned, |init| init.region.memory = init.region.memory.wrapping_byte_add(8)),
        (Status::Misaligned, |init| init.regions = Some((&raw const init.region).wrapping_byte_add(1))),
        (Status::WrongSize, |init| init.image_bytes = usize::MAX / 2 + 1),
        (Status::WrongSize, |init| init.region.bytes = usize::MAX / 2 + 1),
        (Status::RegionCount, |init| init.region_count = 0),
        (Status::RegionCount, |init| init.region_count = 2),
        (Status::RegionTooSmall, |init| init.region.bytes = 31),
        (Status::ImageMalformed, |init| init.image_bytes -= 16),
        (Status::ImageMalformed, |init| init.image_bytes = 0),
        (Status::Overlap, |init| init.region.memory = init.image.cast_mut()),
        (Status::Overlap, |init| init.region.memory = init.engine.cast()),
        (Status::Overlap, |init| init.image = init.engine.cast()),
    ];
    for (number, (status, change)) in cases.iter().enumerate() {
        let mut bench = Bench::new();
        assert_eq!(bench.init(change), *status, "case {number}");
        // SAFETY: the engine is the bench's, and no pointer is followed before it is known to be set up.
        assert_eq!(unsafe { fw_run(&raw mut bench.engine) }, Status::NotInitialized, "case {number}");
    }
}

#[test]
fn an_engine_that_fails_to_be_set_up_anew_is_none() {
    let mut bench = Bench::new();
    assert_eq!(bench.init(|_| ()), Status::Ok);
    assert_eq!(bench.init(|init| init.region_count = 3), Status::RegionCount);
    // SAFETY: the engine is the bench's.
    assert_eq!(unsafe { fw_begin(&raw mut bench.engine) }, Status::NotInitialized);
}

#[test]
fn inputs_are_counted_measured_and_kept_apart() {
    let mut bench = Bench::new();
    assert_eq!(bench.init(|_| ()), Status::Ok);
    let codes = [3_u8; 16];
    let good = Bytes { data: codes.as_ptr().cast(), bytes: 16 };
    let arena = Bytes { data: (&raw const bench.arena).cast(), bytes: 16 };
    let storage = Bytes { data: (&raw const bench.engine).cast(), bytes: 16 };
    let cases: [(Status, &[Bytes], &str); 6] = [
        (Status::Ok, &[good], ""),
        (Status::InputBytes, &[Bytes { bytes: 15, ..good }], "input 0: 15 bytes given, expected 16"),
        (Status::InputCount, &[good, good], "2 inputs given, the network has 1"),
        (Status::NullPointer, &[Bytes { data: null(), ..good }], ""),
        (Status::Overlap, &[arena], ""),
        (Status::Overlap, &[storage], ""),
    ];
    for (status, inputs, message) in cases {
        // SAFETY: the inputs are the test's, as long as they say.
        assert_eq!(unsafe { fw_start(&raw mut bench.engine, inputs.as_ptr(), inputs.len()) }, status);
        if !message.is_empty() || status == Status::Ok {
            assert_eq!(bench.message(), message);
        }
    }
    // SAFETY: as above; a null list is refused.
    assert_eq!(unsafe { fw_start(&raw mut bench.engine, null(), 0) }, Status::NullPointer);
}

#[test]
fn result_pointers_are_checked_before_anything_is_done() {
    let mut bench = Bench::new();
    assert_eq!(bench.init(|_| ()), Status::Ok);
    let engine = &raw mut bench.engine;
    let (mut bytes, mut length, mut progress) = (null_mut(), 0, ProgressInfo::default());
    // SAFETY: every pointer is null, misaligned, or to a place of this test.
    unsafe {
        assert_eq!(fw_begin(engine), Status::Ok);
        assert_eq!(fw_step(engine, null_mut()), Status::NullPointer);
        assert_eq!(fw_step(engine, (&raw mut progress).wrapping_byte_add(1)), Status::Misaligned);
        assert_eq!(fw_input(engine, 0, &raw mut bytes, null_mut()), Status::NullPointer);
        assert_eq!(fw_input(engine, 0, null_mut(), &raw mut length), Status::NullPointer);
        assert_eq!(fw_step(engine, &raw mut progress), Status::Ok, "the inference is still under way");
        assert_eq!(fw_input(engine, 1, &raw mut bytes, &raw mut length), Status::NoSuchPort);
        assert!(bytes.is_null() && length == 0);
    }
}

#[test]
fn an_image_tells_what_it_is_and_why_it_is_refused() {
    let mut image = image();
    let bytes = size_of_val(image.as_slice());
    let mut text = [0x7F; 80];
    let mut info = core::mem::MaybeUninit::<ImageInfo>::uninit();
    let mut explain = |image: &[u128]| -> String {
        // SAFETY: image and text are the test's.
        unsafe {
            assert_eq!(fw_image_explain(image.as_ptr().cast(), bytes, text.as_mut_ptr(), text.len()), Status::Ok);
            CStr::from_ptr(text.as_ptr()).to_str().unwrap().into()
        }
    };
    // SAFETY: image and info are the test's; `Ok` has filled the info.
    let info = unsafe {
        assert_eq!(fw_image_parse(image.as_ptr().cast(), bytes, info.as_mut_ptr()), Status::Ok);
        info.assume_init()
    };
    assert_eq!((info.steps, info.inputs, info.outputs, info.region_count), (1, 1, 1, 1));
    assert_eq!((info.regions[0].bytes, info.regions[0].alignment), (32, 16));
    assert_eq!(explain(&image), "");
    image[0] ^= 1;
    assert_eq!(explain(&image), "header byte 0: this is not a model image: found 146, expected 147");
    // SAFETY: the image is the test's.
    assert_eq!(unsafe { fw_image_check(image.as_ptr().cast(), bytes) }, Status::ImageMalformed);
}

#[test]
fn every_status_has_words_and_no_other_number() {
    for (code, known) in [(0, "done"), (21, "the self-test gave other bytes than the known answer")] {
        // SAFETY: the words end with a zero and live forever.
        assert_eq!(unsafe { CStr::from_ptr(fw_status_text(code)) }.to_str(), Ok(known));
    }
    for unknown in [-1, 22, i32::MAX] {
        // SAFETY: as above.
        assert_eq!(unsafe { CStr::from_ptr(fw_status_text(unknown)) }.to_str(), Ok("unknown status"));
    }
}
