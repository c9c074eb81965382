//! The sample image: accepted, checked, audited and run; no damaged copy is accepted.

#[path = "support/sample_image.rs"]
mod sample_image;

use firmware::engine::{Engine, EngineError, Progress};
use firmware::image::audit::{Array, AuditError, audit};
use firmware::image::{
    Check, CheckProgress, Checker, Image, Region, RegionName, SectionKind, TensorRecord, crc32, layout,
};
use firmware::kernels::{Kernels, Portable, k4n16, plan};
use firmware::program::{Clamp, ConstRange, KernelId, Requant, Requantize, Step};
use firmware::tensor::{ElementType, Shape, TensorId};
use model_compiler::emit::{
    AlignedBytes, ConstantsBuilder, ImageParts, ImagePort, KnownAnswer, assemble, emit, reseal, with_known_answer,
    with_revision,
};
use sample_image::{STEPS, at, ids};

fn sample() -> AlignedBytes {
    AlignedBytes::from(emit(&sample_image::parts()).expect("the sample is valid").as_slice())
}

fn arena_for(image: &Image<'_>) -> AlignedBytes {
    AlignedBytes::zeroed(image.arena_bytes() as usize)
}

/// Bytes before the constants section: what `parse` itself must protect.
fn protected_bytes(image: &Image<'_>) -> usize {
    let constants = image.section(SectionKind::Constants).as_ptr().addr();
    constants - image.bytes().as_ptr().addr()
}

#[test]
fn sample_is_accepted() {
    let bytes = sample();
    let image = Image::parse(&bytes).expect("parses");
    image.check().expect("checks");
    let audit = audit(&image).expect("audits");
    assert!(audit.channels > 0 && audit.accumulator_bits < 32);
    let parts = sample_image::parts();
    assert_eq!(image.name(), parts.name);
    assert_eq!(image.qmodel_digest(), parts.qmodel_digest);
    assert_eq!(image.build_digest(), parts.build_digest);
    assert_eq!((image.target(), image.revision()), (parts.target.as_str(), parts.revision));
    assert_eq!((image.step_count() as usize, image.tensor_count() as usize), (STEPS, parts.tensors.len()));
    for (position, step) in parts.steps.iter().enumerate() {
        assert_eq!(image.step(position as u16).as_ref(), Some(step));
    }
    for (id, record) in parts.tensors.iter().enumerate() {
        assert_eq!(image.tensor(TensorId(id as u16)).as_ref(), Some(record));
    }
    let goal = image.input(3).expect("six inputs");
    assert_eq!((goal.name, goal.tensor.0, goal.scale), ("goal", ids::GOAL, 0.5));
    assert!(image.input(6).is_none() && image.output(5).is_none());
    let names = [0, 1, 2, 3, 4].map(|output| image.output(output).expect("five outputs").name);
    assert_eq!(names, ["waypoints", "probabilities", "gathered", "controls", "points"]);
}

#[test]
fn work_is_the_sum_over_the_steps() {
    let bytes = sample();
    let image = Image::parse(&bytes).expect("parses");
    let work: Vec<u64> = (0..image.step_count()).filter_map(|position| image.step_work(position)).collect();
    assert_eq!((work.len(), work.iter().sum::<u64>()), (STEPS, image.work()));
    assert!(work.iter().all(|&work| work > 0), "{work:?}");
    assert_eq!(image.step_work(image.step_count()), None);
}

#[test]
fn equal_parts_give_equal_bytes() {
    assert_eq!(assemble(&sample_image::parts()), assemble(&sample_image::parts()));
}

#[test]
fn misaligned_base_is_refused() {
    let bytes = sample();
    for shift in 1..16 {
        let mut shifted = AlignedBytes::zeroed(bytes.len() + 16);
        shifted[shift..shift + bytes.len()].copy_from_slice(&bytes);
        let error = Image::parse(&shifted[shift..shift + bytes.len()]).expect_err("misaligned");
        assert_eq!((error.check, error.found), (Check::Misaligned, shift as i64));
    }
}

#[test]
fn every_truncation_is_refused() {
    let bytes = sample();
    for length in 0..bytes.len() {
        let error = Image::parse(&bytes[..length]).expect_err("truncated");
        let expected = if length < layout::header::BYTES { Check::HeaderLength } else { Check::TotalBytes };
        assert_eq!(error.check, expected, "length {length}");
    }
}

#[test]
fn truncation_at_section_edges_is_refused_even_with_a_truthful_length() {
    let bytes = sample();
    let image = Image::parse(&bytes).expect("parses");
    let base = bytes.as_ptr().addr();
    for kind in SectionKind::ALL {
        let start = image.section(kind).as_ptr().addr() - base;
        for edge in [start, start + image.section(kind).len()] {
            for length in [edge - 1, edge, edge + 1] {
                if length >= bytes.len() {
                    continue;
                }
                let mut cut = AlignedBytes::from(&bytes[..length]);
                let total = (length as u32).to_le_bytes();
                if let Some(field) = cut.get_mut(layout::header::TOTAL_BYTES) {
                    field.copy_from_slice(&total);
                }
                reseal(&mut cut);
                let error = Image::parse(&cut).expect_err("truncated");
                println!("{} cut to {length}: {error}", kind.name());
            }
        }
    }
}

#[test]
fn appended_bytes_are_refused() {
    let bytes = sample();
    for extra in [1, 15, 16, 4096] {
        let mut longer = AlignedBytes::zeroed(bytes.len() + extra);
        longer[..bytes.len()].copy_from_slice(&bytes);
        assert_eq!(Image::parse(&longer).expect_err("appended").check, Check::TotalBytes);
        let total = (longer.len() as u32).to_le_bytes();
        longer[layout::header::TOTAL_BYTES].copy_from_slice(&total);
        reseal(&mut longer);
        assert_eq!(Image::parse(&longer).expect_err("appended").check, Check::SectionEnd);
    }
}

#[test]
fn every_flipped_bit_is_refused() {
    let mut bytes = sample();
    let protected = protected_bytes(&Image::parse(&bytes).expect("parses"));
    for byte in 0..bytes.len() {
        // Every bit of what parse reads; one bit per byte of the rest.
        for bit in if byte < protected { 0..8 } else { byte % 8..byte % 8 + 1 } {
            bytes[byte] ^= 1 << bit;
            match Image::parse(&bytes) {
                Ok(_) if byte < protected => panic!("bit {bit} of byte {byte} is not protected"),
                Ok(image) => {
                    let error = image.check().expect_err("damaged");
                    assert!(matches!(error.section, SectionKind::Constants | SectionKind::KnownAnswer));
                }
                Err(error) => assert!(byte < protected || error.check == Check::SectionPadding, "{error}"),
            }
            bytes[byte] ^= 1 << bit;
        }
    }
}

#[test]
fn check_in_slices_equals_check_at_once() {
    let mut bytes = sample();
    for slice in [1, 7, 16, 1000] {
        let image = Image::parse(&bytes).expect("parses");
        let mut checker = Checker::new(&image);
        let mut calls = 0;
        while checker.advance(slice).expect("intact") != CheckProgress::Done {
            calls += 1;
        }
        assert!(calls >= (bytes.len() - layout::header::BYTES) / slice - 1, "{calls} calls of {slice} bytes");
    }
    let last_constant = Image::parse(&bytes).map(|image| protected_bytes(&image)).expect("parses") + 100;
    bytes[last_constant] ^= 1;
    let image = Image::parse(&bytes).expect("constants are not read");
    let mut checker = Checker::new(&image);
    let error = loop {
        match checker.advance(13) {
            Ok(CheckProgress::Running { .. }) => {}
            Ok(CheckProgress::Done) => panic!("damage not found"),
            Err(error) => break error,
        }
    };
    assert_eq!(error.section, SectionKind::Constants);
    assert_eq!(image.check(), Err(error));
}

#[test]
fn audit_refuses_overflow_and_bad_constants() {
    let mut parts = sample_image::parts();
    let Step::Conv2d(conv) = &parts.steps[at::CONV] else { panic!("a convolution") };
    let rescale = conv.rescale.clone();
    let weights = conv.weights;
    let edit = |parts: &ImageParts, at: u32, value: &[u8]| {
        let mut parts = parts.clone();
        parts.constants[at as usize..at as usize + value.len()].copy_from_slice(value);
        let bytes = AlignedBytes::from(assemble(&parts).expect("fits the format").as_slice());
        audit(&Image::parse(&bytes).expect("parses")).expect_err("must be refused")
    };
    let error = edit(&parts, rescale.bias.offset + 4, &i32::MAX.to_le_bytes());
    assert!(matches!(error, AuditError::Accumulator { step: 0, channel: 1, .. }), "{error}");
    for (at, value) in [
        (weights.offset + 3, &[0x80][..]),
        (rescale.multipliers.offset, &[0; 4]),
        (rescale.shifts.offset, &[53]),
        (rescale.shifts.offset, &[0]),
    ] {
        let error = edit(&parts, at, value);
        assert!(matches!(error, AuditError::Constant { step: 0, .. }), "{error}");
    }
    let Step::ResizeBilinear(resize) = &parts.steps[at::RESIZE] else { panic!("a resize") };
    let error = edit(&parts, resize.rows.offset, &2_u16.to_le_bytes());
    assert!(matches!(error, AuditError::Constant { found: 2, .. }), "{error}");
    // The wide layer may exceed 32 bits.
    let Step::Linear(wide) = &mut parts.steps[at::LINEAR_WIDE] else { panic!("a linear layer") };
    let bias = wide.rescale.bias.offset as usize;
    wide.wide = true;
    parts.constants[bias..bias + 4].copy_from_slice(&i32::MAX.to_le_bytes());
    let bytes = AlignedBytes::from(emit(&parts).expect("valid").as_slice());
    audit(&Image::parse(&bytes).expect("parses")).expect("64-bit accumulators");
}

/// The sample with the weights of one layer in blocks of 16 outputs × 4 depth elements.
fn packed_parts() -> ImageParts {
    let mut parts = sample_image::parts();
    let Step::Linear(linear) = &mut parts.steps[at::LINEAR_QUERY] else { panic!("a linear layer") };
    let weights = &parts.constants[linear.weights.offset as usize..][..64];
    let weights: Vec<i8> = weights.iter().map(|weight| weight.cast_signed()).collect();
    let mut packed = vec![0; plan::weight_bytes(KernelId::K4N16, 1, 8, 8) as usize];
    k4n16::pack(&weights, 8, 8, &mut packed);
    let scratch = plan::linear_scratch_bytes(KernelId::K4N16, 8, 8, ElementType::I8);
    linear.kernel = KernelId::K4N16;
    linear.weights = ConstRange { offset: parts.constants.len() as u32, bytes: packed.len() as u32 };
    let record = &mut parts.tensors[usize::from(linear.scratch.expect("scratch").0)];
    (record.offset, record.bytes) = (parts.regions[0].bytes, scratch);
    parts.regions[0].bytes += scratch;
    parts.constants.extend(packed.iter().map(|weight| weight.cast_unsigned()));
    parts
}

#[test]
fn audit_reads_packed_weights() {
    let audited = |parts: &ImageParts| {
        let bytes = AlignedBytes::from(assemble(parts).expect("fits the format").as_slice());
        audit(&Image::parse(&bytes).unwrap_or_else(|e| panic!("{e}")))
    };
    let parts = packed_parts();
    assert_eq!(audited(&parts), audited(&sample_image::parts()), "the same weights");
    let Step::Linear(linear) = &parts.steps[at::LINEAR_QUERY] else { panic!("a linear layer") };
    let block = linear.weights.offset as usize;
    // Compensation of output 1; weight 5 of output 2; what fills up the depth of output 2 to 64.
    for (at, value, array, element) in [
        (block + 4, 1, Array::Compensations, 1),
        (block + 64 + 64 + 9, 0x80, Array::Weights, 2 * 8 + 5),
        (block + 64 + 15 * 64 + 9, 1, Array::WeightPadding, 2 * 8 + 61),
    ] {
        let mut parts = parts.clone();
        parts.constants[at] ^= value;
        if array == Array::Weights {
            parts.constants[at] = value;
        }
        let Err(AuditError::Constant { array: found, element: at, .. }) = audited(&parts) else { panic!("{array:?}") };
        assert_eq!((found, at), (array, element));
    }
}

/// Refuses every kernel.
#[derive(Debug)]
struct NoKernels;

impl Kernels for NoKernels {
    fn supported(&self) -> &'static [KernelId] {
        &[]
    }
}

#[test]
fn engine_refuses_a_bad_arena_and_missing_kernels() {
    let bytes = sample();
    let image = Image::parse(&bytes).expect("parses");
    let needed = image.arena_bytes();
    let mut small = AlignedBytes::zeroed(needed as usize - 1);
    let error = Engine::new(image, Portable, &mut small).expect_err("too small");
    assert_eq!(error, EngineError::ArenaTooSmall { region: RegionName::MAIN, found: needed - 1, needed });
    let mut arena = AlignedBytes::zeroed(needed as usize + 16);
    let error = Engine::new(image, Portable, &mut arena[8..]).expect_err("misaligned");
    assert_eq!(error, EngineError::ArenaMisaligned { region: RegionName::MAIN, remainder: 8, alignment: 16 });
    let error = Engine::new(image, NoKernels, &mut arena).expect_err("no kernels");
    assert_eq!(error, EngineError::KernelMissing(KernelId::Direct));
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

#[test]
fn engine_refuses_wrong_use() {
    let bytes = sample();
    let image = Image::parse(&bytes).expect("parses");
    let mut arena = arena_for(&image);
    let mut engine = Engine::new(image, Portable, &mut arena).expect("fits");
    let given = inputs(&image, 1);
    let mut slices: Vec<&[u8]> = given.iter().map(Vec::as_slice).collect();
    assert_eq!(engine.step(), Err(EngineError::NotStarted));
    assert_eq!(engine.output(0), Err(EngineError::NotDone));
    assert_eq!(engine.start(&slices[..3]), Err(EngineError::InputCount { found: 3, expected: 6 }));
    slices[2] = &[0; 3];
    assert_eq!(engine.start(&slices), Err(EngineError::InputBytes { input: 2, found: 3, expected: 2 }));
    assert_eq!(engine.step(), Err(EngineError::NotStarted));
    slices[2] = &[0; 2];
    engine.start(&slices).expect("right sizes");
    assert_eq!(engine.step(), Ok(Progress::Running { next: 1 }));
    assert_eq!(engine.output(0), Err(EngineError::NotDone));
    engine.infer(&slices).expect("runs");
    assert_eq!(engine.step(), Ok(Progress::Done));
    assert_eq!(engine.output(5), Err(EngineError::NoSuchOutput(5)));
    assert_eq!(engine.output(0).expect("done").len(), 32);
}

#[test]
fn only_pairs_of_q16_meters_are_waypoints() {
    let bytes = sample();
    let image = Image::parse(&bytes).expect("parses");
    let mut arena = arena_for(&image);
    let mut engine = Engine::new(image, Portable, &mut arena).expect("fits");
    let given = inputs(&image, 1);
    engine.infer(&given.iter().map(Vec::as_slice).collect::<Vec<_>>()).expect("runs");
    assert_eq!(engine.waypoints(0).map(|waypoints| waypoints.len()), Ok(4));
    assert_eq!(engine.waypoints(1), Err(EngineError::NoWaypoints(1)), "16-bit probabilities");
    assert_eq!(engine.waypoints(4), Err(EngineError::NoWaypoints(4)), "points in 1/64 pixel");
}

#[test]
fn stepping_restarting_and_observing_give_the_same_bytes() {
    let bytes = sample();
    let image = Image::parse(&bytes).expect("parses");
    let given = inputs(&image, 2);
    let slices: Vec<&[u8]> = given.iter().map(Vec::as_slice).collect();
    let mut arena = arena_for(&image);
    let mut engine = Engine::new(image, Portable, &mut arena).expect("fits");
    let mut seen = Vec::new();
    engine
        .infer_observed(&slices, |position, step, output| {
            seen.push((position, step.name(), crc32(output)));
        })
        .expect("runs");
    assert_eq!(seen.iter().map(|s| s.0).collect::<Vec<_>>(), (0..STEPS).collect::<Vec<_>>());
    assert!(seen.iter().zip(seen.iter().skip(1)).all(|(a, b)| a.2 != b.2), "steps must do something: {seen:?}");
    let expected = engine.output(0).expect("done").to_vec();
    // Abandon an inference over other inputs after every number of steps.
    let other = inputs(&image, 3);
    let other: Vec<&[u8]> = other.iter().map(Vec::as_slice).collect();
    for abandoned in 0..STEPS {
        engine.start(&other).expect("starts");
        for _ in 0..abandoned {
            engine.step().expect("steps");
        }
        engine.start(&slices).expect("starts again");
        let mut steps = 1;
        while engine.step().expect("steps") != Progress::Done {
            steps += 1;
        }
        assert_eq!(steps, STEPS);
        assert_eq!(engine.output(0).expect("done"), expected);
    }
}

#[test]
fn bytes_of_dead_tensors_do_not_matter() {
    let bytes = sample();
    let image = Image::parse(&bytes).expect("parses");
    let given = inputs(&image, 4);
    let slices: Vec<&[u8]> = given.iter().map(Vec::as_slice).collect();
    let records: Vec<TensorRecord> =
        (0..image.tensor_count()).map(|id| image.tensor(TensorId(id)).expect("record")).collect();
    let run = |poison: u8| {
        let mut arena = arena_for(&image);
        arena.fill(poison);
        let mut engine = Engine::new(image, Portable, &mut arena).expect("fits");
        engine.start(&slices).expect("starts");
        for position in 0..STEPS as u16 {
            let kept: Vec<_> =
                records.iter().filter(|r| r.first_step < position.max(1) && r.is_live(position)).collect();
            for (at, byte) in engine.regions_mut().flatten().enumerate() {
                if !kept.iter().any(|r| (u64::from(r.offset)..r.end()).contains(&(at as u64))) {
                    *byte = poison;
                }
            }
            engine.step().expect("steps");
        }
        engine.output(0).expect("done").to_vec()
    };
    assert_eq!(run(0x00), run(0xA5));
}

#[test]
fn known_answer_is_met_and_a_wrong_one_is_named() {
    let bytes = sample();
    let image = Image::parse(&bytes).expect("parses");
    let mut arena = arena_for(&image);
    let mut engine = Engine::new(image, Portable, &mut arena).expect("fits");
    let given = inputs(&image, 42);
    let slices: Vec<&[u8]> = given.iter().map(Vec::as_slice).collect();
    let mut step_crcs = Vec::new();
    engine.infer_observed(&slices, |_, _, output| step_crcs.push(crc32(output))).expect("runs");
    let self_test = |known_answer: Option<&KnownAnswer>| {
        let bytes = AlignedBytes::from(with_known_answer(&bytes, known_answer).expect("fits").as_slice());
        let image = Image::parse(&bytes).expect("parses");
        image.check().expect("sealed");
        let mut arena = arena_for(&image);
        Engine::new(image, Portable, &mut arena).expect("fits").self_test()
    };
    let mut answer = KnownAnswer { seed: 42, step_crcs };
    assert_eq!(self_test(Some(&answer)), Ok(()));
    assert_eq!(self_test(None), Err(EngineError::NoKnownAnswer));
    let expected = answer.step_crcs[11] ^ 1;
    answer.step_crcs[11] = expected;
    assert_eq!(self_test(Some(&answer)), Err(EngineError::WrongAnswer { step: 11, found: expected ^ 1, expected }));
    answer = KnownAnswer { seed: 43, ..answer };
    assert!(matches!(self_test(Some(&answer)), Err(EngineError::WrongAnswer { step: 0, .. })));
}

#[test]
fn changed_memory_never_panics() {
    let original = sample();
    let image = Image::parse(&original).expect("parses");
    let given = inputs(&image, 5);
    let slices: Vec<&[u8]> = given.iter().map(Vec::as_slice).collect();
    let mut refused = 0;
    for byte in layout::header::BYTES..original.len() {
        for pattern in [1 << (byte % 8), 0xFF] {
            let mut bytes = original.clone();
            bytes[byte] ^= pattern;
            let mut arena = arena_for(&image);
            let changed = image.changed_to(&bytes);
            let mut engine = Engine::new(changed, Portable, &mut arena).expect("same header");
            match engine.infer(&slices) {
                Ok(()) => {}
                Err(EngineError::ImageChanged { .. } | EngineError::InputBytes { .. }) => refused += 1,
                Err(error) => panic!("byte {byte}: {error}"),
            }
        }
    }
    assert!(refused > 1000, "only {refused} changes were noticed");
    for length in [0, 100, layout::header::BYTES, original.len() / 2] {
        let mut arena = arena_for(&image);
        let changed = image.changed_to(&original[..length]);
        let mut engine = Engine::new(changed, Portable, &mut arena).expect("same header");
        assert!(engine.infer(&slices).is_err());
        assert!(changed.check().is_err());
        assert!(audit(&changed).is_err());
    }
}

#[test]
fn constants_are_aligned_and_stored_once() {
    let mut builder = ConstantsBuilder::new();
    let table = builder.push(&[1_i16, 2, 3]).expect("fits");
    let weights = builder.push(&[1_i8; 17]).expect("fits");
    let again = builder.push(&[1_i16, 2, 3]).expect("fits");
    let pairs = builder.push(&[[7_u16, 8]]).expect("fits");
    assert_eq!((table.offset, table.bytes), (0, 6));
    assert_eq!((weights.offset, weights.bytes), (16, 17));
    assert_eq!(again, table);
    assert_eq!((pairs.offset, pairs.bytes), (48, 4));
    let section = builder.finish();
    assert_eq!(section.len(), 64);
    assert_eq!(&section[..6], &[1, 0, 2, 0, 3, 0]);
}

#[test]
fn parts_that_do_not_fit_are_refused_by_name() {
    let mut parts = sample_image::parts();
    parts.name = "n".repeat(33);
    assert!(assemble(&parts).expect_err("name").message.contains("32 bytes"));
    parts = sample_image::parts();
    parts.inputs[1].name = "n".repeat(25);
    assert!(assemble(&parts).expect_err("port").message.contains("24 bytes"));
    parts = sample_image::parts();
    parts.target = "t".repeat(17);
    assert!(assemble(&parts).expect_err("target").message.contains("16 bytes"));
    parts = sample_image::parts();
    parts.regions[0].bytes -= 16;
    let error = emit(&parts).expect_err("arena");
    assert!(error.message.contains("outside its memory region"), "{error}");
}

#[test]
fn another_revision_changes_nothing_else() {
    let old = emit(&sample_image::parts()).expect("valid");
    let new = with_revision(&old, 4).expect("an image");
    assert_eq!(new, emit(&ImageParts { revision: 4, ..sample_image::parts() }).expect("valid"));
    assert!(with_revision(&old[..64], 4).is_err());
}

/// The image of the format page.
fn page_example() -> ImageParts {
    let tensor = |offset, first_step| TensorRecord {
        element: ElementType::I8,
        shape: Shape::vector(16),
        region: 0,
        offset,
        bytes: 16,
        first_step,
        last_step: 0,
        in_place_of: None,
    };
    let port = |name: &str, id| ImagePort { name: name.into(), tensor: TensorId(id), scale: 1.0, zero_point: 0 };
    ImageParts {
        name: "copy".into(),
        tensors: vec![tensor(0, 0), tensor(16, 0)],
        steps: vec![Step::Requantize(Requantize {
            input: TensorId(0),
            output: TensorId(1),
            input_zero_point: 0,
            requant: Requant { multiplier: 1 << 23, shift: 23 },
            zero_point: 0,
            clamp: Clamp { min: -128, max: 127 },
        })],
        constants: vec![],
        inputs: vec![port("x", 0)],
        outputs: vec![port("y", 1)],
        regions: vec![Region { name: RegionName::MAIN, bytes: 32, alignment: 16 }],
        qmodel_digest: [0; 32],
        build_digest: [0; 32],
        target: String::new(),
        revision: 0,
        known_answer: None,
    }
}

#[test]
fn format_page_shows_a_real_image() {
    let bytes = emit(&page_example()).expect("valid");
    let lines = bytes.chunks(16).enumerate().map(|(line, chunk)| {
        let hex: Vec<String> = chunk.iter().map(|byte| format!("{byte:02x}")).collect();
        format!("{:04x}  {}\n", line * 16, hex.join(" "))
    });
    let dump: String = lines.collect();
    let page = include_str!("../../firmware/src/image/example.hex");
    assert_eq!(dump, page, "the dump of firmware/src/image/example.hex should be:\n{dump}");
    assert_eq!(bytes, include_bytes!("../../firmware/src/image/example.bin"));
}

#[test]
fn page_example_copies() {
    let bytes = AlignedBytes::from(emit(&page_example()).expect("valid").as_slice());
    let image = Image::parse(&bytes).expect("parses");
    let mut arena = arena_for(&image);
    let mut engine = Engine::new(image, Portable, &mut arena).expect("fits");
    let input: Vec<u8> = (0..16).map(|code| code * 17).collect();
    engine.infer(&[&input]).expect("runs");
    assert_eq!(engine.output(0).expect("done"), input);
}
