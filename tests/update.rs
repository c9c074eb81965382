//! Updates in the field: the life of a device, what an update refuses, and what it does when the flash fails.

use firmware::image::layout::header;
use firmware::image::{Check, CheckProgress, Image};
use firmware::program::KernelId;
use firmware::update::{
    Manifest, Refusal, Requirements, Slot, Slots, SlotsError, TRIALS, Unusable, UpdateError, same_interface,
};
use model_compiler::emit::{AlignedBytes, ImageParts, emit, reseal};
use tests::device::{ARENA, Device, TARGET, image, manifest, parts, requirements};
use tests::nor_flash::{NorFlash, Operation};
use tests::random::Random;

type Small = Device<8, 512>;

const ROOM: usize = 4096;

fn device(factory: &[u8]) -> Small {
    Device::new(factory, ROOM, 1)
}

/// The slot and the bytes that a start runs.
fn started(device: &mut Small) -> (Slot, Vec<u8>) {
    let (selected, bytes) = device.start().unwrap_or_else(|e| panic!("{e}"));
    (selected.slot(), bytes)
}

/// Why an update to an image is refused on a device that has run its factory's.
fn refusal(device: &mut Small, image: &[u8]) -> Refusal {
    match device.update(image, 100) {
        Err(UpdateError::Refused(refusal)) => refusal,
        other => panic!("{other:?}"),
    }
}

#[test]
fn a_device_lives_through_updates() {
    let images: Vec<Vec<u8>> = (0..5).map(|n| image(n, 1000 + 300 * n as usize)).collect();
    let mut device = device(&images[0]);
    assert_eq!(started(&mut device), (Slot::A, images[0].clone()));
    for (n, image) in images.iter().enumerate().skip(1) {
        device.update_and_confirm(image, 100).unwrap_or_else(|e| panic!("{e}"));
        let slot = if n % 2 == 0 { Slot::A } else { Slot::B };
        assert_eq!(started(&mut device), (slot, image.clone()));
        assert_eq!(device.record(slot), Some((n as u32, image.len() as u32)));
    }
    assert_eq!(device.record(Slot::B), Some((3, images[3].len() as u32)), "the old image stays until the next update");
}

#[test]
fn pieces_may_have_any_size() {
    let seed = 7;
    let mut random = Random::new(seed);
    let new = image(1, 2100);
    for round in 0..50 {
        let mut device = device(&image(0, 100));
        let running = device.start().ok().map(|(selected, _)| selected);
        let mut updater = device.updater(running);
        updater.begin(&manifest(&new)).unwrap_or_else(|e| panic!("{e}"));
        let mut at = 0;
        while at < new.len() {
            let end = (at + random.below(700)).min(new.len());
            updater.write(at as u32, &new[at..end]).unwrap_or_else(|e| panic!("seed {seed}, round {round}: {e}"));
            at = end;
            assert_eq!(updater.received(), at as u32);
        }
        while updater.finish(1 + random.below(900)).unwrap_or_else(|e| panic!("seed {seed}: {e}"))
            != CheckProgress::Done
        {}
        assert_eq!(started(&mut device), (Slot::B, new.clone()), "seed {seed}, round {round}");
    }
}

#[test]
fn work_per_call_is_bounded() {
    let new = image(1, 3000);
    let mut device = device(&image(0, 100));
    device.flash.power_on(None);
    let running = device.start().ok().map(|(selected, _)| selected);
    let mut updater = device.updater(running);
    updater.begin(&manifest(&new)).unwrap();
    for piece in new.chunks(64) {
        updater.write(updater.received(), piece).unwrap();
    }
    // The first call parses, the next ones read 64 bytes each: more than the file has, as sections are padded.
    let calls = (0..).take_while(|_| updater.finish(64).unwrap() != CheckProgress::Done).count();
    assert!(calls >= (new.len() - header::BYTES) / 64, "{calls}");
    assert!(size_of_val(&updater) <= 512, "{} bytes", size_of_val(&updater));
    let flash = updater.into_flash();
    // A claim (erase and write), 256 bytes per write, 512 per sector, the record.
    assert_eq!(flash.operations().len(), 2 + new.len().div_ceil(256) + new.len().div_ceil(512) + 1);
}

#[test]
fn an_image_that_is_not_confirmed_is_given_up() {
    let (old, new) = (image(4, 200), image(5, 700));
    let mut device = device(&old);
    device.update(&new, 100).unwrap();
    for trial in 1..=TRIALS {
        let (selected, bytes) = device.start().unwrap();
        assert!(selected.is_on_trial() && bytes == new);
        assert_eq!(device.trials(Slot::B), usize::from(trial));
        let refused = device.updater(Some(selected)).begin(&manifest(&image(6, 50)));
        assert_eq!(refused, Err(UpdateError::OnTrial), "the old image is the only one to fall back to");
    }
    for _ in 0..3 {
        let (selected, bytes) = device.start().unwrap();
        assert!(!selected.is_on_trial() && bytes == old);
    }
    // And again, this time for good; an older revision than the one that failed will do.
    device.update_and_confirm(&image(4, 900), 100).unwrap();
    assert_eq!(started(&mut device).1, image(4, 900));
}

#[test]
fn a_confirmed_image_is_tried_no_more() {
    let mut device = device(&image(0, 200));
    device.update_and_confirm(&image(1, 200), 100).unwrap();
    for _ in 0..5 {
        let (selected, _) = device.start().unwrap();
        assert!(!selected.is_on_trial());
        device.updater(Some(selected)).confirm().unwrap();
    }
    assert_eq!(device.trials(Slot::B), 1);
}

#[test]
fn a_foreign_image_is_refused_before_a_sector_is_erased() {
    let changed = |change: fn(&mut ImageParts)| {
        let mut parts = parts(5, 500);
        change(&mut parts);
        emit(&parts).unwrap_or_else(|e| panic!("{e}"))
    };
    let cases = [
        (changed(|p| p.target = "cortex-m7".into()), "compiled for target cortex-m7, this is cortex-m4"),
        (changed(|p| p.target.clear()), "compiled for target unknown, this is cortex-m4"),
        (changed(|p| p.regions[0].bytes = 80), "memory region 0: needs 80 bytes of arena, there are 64"),
        (changed(|p| p.revision = 3), "revision 3 is older than the running 4"),
        (changed(|p| p.constants = vec![0; ROOM]), "the slot has room for 4096"),
    ];
    let mut device = device(&image(4, 200));
    let before = device.flash.bytes().to_vec();
    for (image, words) in cases {
        let text = UpdateError::from(refusal(&mut device, &image)).to_string();
        assert!(text.starts_with("image refused: ") && text.ends_with(words), "{text}");
        assert!(device.flash.bytes() == before, "{words}");
    }
    let running = device.start().ok().map(|(selected, _)| selected);
    let mut updater = device.updater(running);
    assert_eq!(updater.begin(&manifest(&image(4, 200))), Err(Refusal::Running.into()));
    let newer = Manifest { features: 1 << 63, ..manifest(&image(5, 200)) };
    assert_eq!(updater.begin(&newer), Err(Refusal::Features(1 << 63).into()));
    let other_kernel = Manifest { features: KernelId::K4N16.feature(), ..newer };
    let m4 = Requirements { kernels: &[KernelId::Direct], ..requirements() };
    assert_eq!(m4.admit(&other_kernel), Err(Refusal::KernelMissing(KernelId::K4N16)));
    assert_eq!(m4.admit(&manifest(&image(0, 0))), Ok(()));
    assert_eq!(ARENA, 64);
}

#[test]
fn the_same_revision_is_accepted_if_the_image_differs() {
    let mut device = device(&image(4, 200));
    device.update_and_confirm(&image(4, 201), 100).unwrap();
    assert_eq!(started(&mut device).1, image(4, 201));
}

#[test]
fn another_interface_is_refused_when_the_image_is_there() {
    let mut parts = parts(5, 500);
    parts.outputs[0].name = "z".into();
    let other = emit(&parts).unwrap();
    let mut device = device(&image(4, 200));
    assert_eq!(refusal(&mut device, &other), Refusal::Interface);
    assert_eq!(started(&mut device), (Slot::A, image(4, 200)));
}

#[test]
fn interfaces_are_compared_port_by_port() {
    let aligned = |parts: &ImageParts| AlignedBytes::from(emit(parts).unwrap_or_else(|e| panic!("{e}")).as_slice());
    let base = aligned(&parts(0, 100));
    let base = Image::parse(&base).unwrap();
    let same = aligned(&parts(9, 700));
    assert!(same_interface(&base, &Image::parse(&same).unwrap()));
    let changes: [fn(&mut ImageParts); 4] = [
        |p| p.inputs[0].name = "X".into(),
        |p| p.outputs[0].scale = 0.5,
        |p| p.inputs[0].zero_point = 1,
        |p| p.outputs.push(p.inputs[0].clone()),
    ];
    for (number, change) in changes.into_iter().enumerate() {
        let mut parts = parts(0, 100);
        change(&mut parts);
        let other = aligned(&parts);
        let other = Image::parse(&other).unwrap();
        assert!(!same_interface(&base, &other) && !same_interface(&other, &base), "change {number}");
    }
}

#[test]
fn damage_on_the_way_is_refused() {
    let (old, new) = (image(0, 300), image(1, 900));
    let mut device = device(&old);
    for at in (0..new.len()).step_by(7) {
        let running = device.start().ok().map(|(selected, _)| selected);
        let mut updater = device.updater(running);
        updater.begin(&manifest(&new)).unwrap();
        let mut damaged = new.clone();
        damaged[at] ^= 0x10;
        updater.write(0, &damaged).unwrap();
        let outcome = (0..100).find_map(|_| updater.finish(100).map_or_else(Some, |_| None));
        assert!(
            matches!(outcome, Some(UpdateError::Refused(Refusal::Parse(_) | Refusal::Check(_)))),
            "{at}: {outcome:?}"
        );
        assert_eq!(updater.finish(100), Err(UpdateError::NotBegun));
        assert_eq!(started(&mut device), (Slot::A, old.clone()));
    }
    // A good image, but not the announced one.
    let mut other = new.clone();
    other[header::BUILD_DIGEST.start] = 1;
    reseal(&mut other);
    let running = device.start().ok().map(|(selected, _)| selected);
    let mut updater = device.updater(running);
    updater.begin(&manifest(&new)).unwrap();
    updater.write(0, &other).unwrap();
    assert_eq!(updater.finish(100), Err(Refusal::NotAnnounced.into()));
}

#[test]
fn pieces_out_of_order_do_not_end_the_update() {
    let new = image(1, 900);
    let mut device = device(&image(0, 300));
    let running = device.start().ok().map(|(selected, _)| selected);
    let mut updater = device.updater(running);
    assert_eq!(updater.write(0, &new), Err(UpdateError::NotBegun));
    assert_eq!(updater.finish(1), Err(UpdateError::NotBegun));
    updater.begin(&manifest(&new)).unwrap();
    updater.write(0, &new[..300]).unwrap();
    for found in [0, 299, 301] {
        assert_eq!(updater.write(found, &new[..10]), Err(UpdateError::OutOfOrder { found, expected: 300 }));
    }
    let announced = new.len() as u32;
    let long = [&new[300..], &[0]].concat();
    assert_eq!(updater.write(300, &long), Err(UpdateError::TooLong { found: u64::from(announced) + 1, announced }));
    assert_eq!(updater.finish(1), Err(UpdateError::Incomplete { found: 300, announced }));
    updater.write(300, &new[300..]).unwrap();
    while updater.finish(1000).unwrap() != CheckProgress::Done {}
    assert_eq!(updater.finish(1000), Err(UpdateError::NotBegun));
    assert_eq!(started(&mut device), (Slot::B, new));
}

#[test]
fn an_update_can_be_begun_anew_at_any_time() {
    let (first, second) = (image(1, 900), image(2, 1500));
    let mut device = device(&image(0, 300));
    for received in (0..=first.len()).step_by(100) {
        let running = device.start().ok().map(|(selected, _)| selected);
        let mut updater = device.updater(running);
        updater.begin(&manifest(&first)).unwrap();
        updater.write(0, &first[..received]).unwrap();
        updater.abort();
        assert_eq!(started(&mut device), (Slot::A, image(0, 300)), "{received}");
    }
    device.update(&first, 100).unwrap();
    // The first one was never started: the second takes its place.
    let mut updater = Small::clone(&device);
    let factory = Small::new(&image(0, 300), ROOM, 1).start().unwrap().0;
    let mut updater = updater.updater(Some(factory));
    updater.begin(&manifest(&second)).unwrap();
    updater.write(0, &second).unwrap();
    while updater.finish(1000).unwrap() != CheckProgress::Done {}
    device.flash = updater.into_flash().clone();
    assert_eq!(started(&mut device), (Slot::B, second));
}

#[test]
fn what_was_never_finished_does_not_pass_for_the_factorys() {
    let (old, running, other) = (image(1, 300), image(2, 400), image(3, 500));
    let mut updated = device(&old);
    updated.update_and_confirm(&running, 100).unwrap();
    let selected = updated.start().unwrap().0;
    let mut updater = updated.updater(Some(selected));
    updater.begin(&manifest(&other)).unwrap();
    updater.write(0, &other).unwrap();
    for cut in 0..4 {
        let mut device = updated.clone();
        device.flash.power_on(Some(cut));
        let begun = device.updater(Some(selected)).begin(&manifest(&other));
        assert_eq!(begun.is_ok(), cut == 3, "an image's header, the record, the claim: three operations");
        device.flash.power_on(None);
        assert_eq!(device.lie(&[&old, &running, &other]), None);
        // The image that ran is lost, too.
        device.flash.flip(device.slots.image_offset(Slot::B), 1);
        assert!(device.start().is_err(), "cut {cut}");
    }
}

#[test]
fn the_newest_record_wins_and_counters_wrap() {
    let (a, b) = (image(1, 100), image(1, 200));
    for (counter_a, counter_b, newest) in [
        (1, 2, Slot::B),
        (2, 1, Slot::A),
        (u32::MAX, 0, Slot::B),
        (0, u32::MAX, Slot::A),
        (i32::MAX as u32, 1 << 31, Slot::B),
    ] {
        let mut device = device(&a);
        device.flash.program(device.slots.image_offset(Slot::B), &b);
        device.write_record(Slot::A, counter_a, &a);
        device.write_record(Slot::B, counter_b, &b);
        assert_eq!(started(&mut device).0, newest, "{counter_a}, {counter_b}");
        device.update_and_confirm(&image(2, 300), 100).unwrap();
        let (slot, bytes) = started(&mut device);
        assert_eq!((slot, bytes), (newest.other(), image(2, 300)));
        let newest_counter = if newest == Slot::A { counter_a } else { counter_b };
        assert_eq!(device.record(slot).map(|record| record.0), Some(newest_counter.wrapping_add(1)));
    }
}

#[test]
fn a_damaged_image_gives_way_to_the_other() {
    let (old, new) = (image(0, 300), image(1, 900));
    let mut updated = device(&old);
    updated.update_and_confirm(&new, 100).unwrap();
    let b = updated.slots.image_offset(Slot::B);
    for at in (0..new.len() as u32).step_by(11) {
        let mut device = updated.clone();
        device.flash.flip(b + at, 0x40);
        assert_eq!(started(&mut device), (Slot::A, old.clone()), "byte {at}");
        device.update_and_confirm(&new, 500).unwrap();
        assert_eq!(started(&mut device), (Slot::B, new.clone()), "byte {at}");
    }
    // Also where another image lies there than the record tells of.
    let other = image(1, 904);
    assert_eq!(other.len(), new.len());
    updated.flash.program(b, &other);
    assert_eq!(started(&mut updated), (Slot::A, old));
}

#[test]
fn without_any_image_the_start_says_why_and_an_update_helps() {
    let (old, new) = (image(3, 300), image(1, 900));
    let mut device = device(&old);
    device.flash.flip(4, 0xFF);
    let error = device.start().unwrap_err();
    assert_eq!((error.a, error.b), (Unusable::Empty, Unusable::Empty));
    device.flash.flip(4, 0xFF);
    device.flash.flip(header::NAME.start as u32, 1);
    let error = device.start().unwrap_err();
    assert!(matches!(error.a, Unusable::Refused(Refusal::Parse(parse)) if parse.check == Check::HeaderCrc), "{error}");
    let text = "no image to run: slot A: header byte 380: the header is damaged (CRC): ";
    assert!(error.to_string().starts_with(text) && error.to_string().ends_with("; slot B: empty"), "{error}");
    device.update_and_confirm(&new, 100).unwrap();
    assert_eq!(started(&mut device), (Slot::A, new));
}

#[test]
fn an_image_for_another_firmware_does_not_start() {
    let (old, new) = (image(0, 300), image(1, 900));
    let mut device = device(&old);
    device.update_and_confirm(&new, 100).unwrap();
    // A firmware whose application needs another network.
    device.requirements.interface = &|_| false;
    let error = device.start().unwrap_err();
    assert_eq!((error.a, error.b), (Refusal::Interface.into(), Refusal::Interface.into()));
    device.requirements = Requirements { target: "cortex-m55", ..requirements() };
    assert!(device.start().unwrap_err().to_string().contains(&format!("target {TARGET}, this is cortex-m55")));
}

#[test]
fn every_error_of_the_flash_is_told_and_the_next_update_succeeds() {
    let (old, new) = (image(0, 300), image(1, 900));
    let mut counted = device(&old);
    counted.flash.power_on(None);
    counted.update_and_confirm(&new, 100).unwrap();
    for operation in 0..counted.flash.operations().len() {
        for silent in [false, true] {
            let mut device = device(&old);
            device.flash.fail(operation, silent);
            let outcome = device.update(&new, 100).and_then(|()| {
                let (selected, bytes) = device.start().unwrap_or_else(|e| panic!("{e}"));
                assert_eq!(selected.is_on_trial(), bytes == new);
                device.updater(Some(selected)).confirm().map(|()| bytes)
            });
            match outcome {
                Err(UpdateError::Flash(_) | UpdateError::Refused(Refusal::Parse(_) | Refusal::Check(_))) => {}
                // A trial that could not be marked is none: the old image starts once more.
                Ok(bytes) if bytes == old => {}
                // A blank sector needs no erase.
                Ok(_) => assert!(silent && matches!(counted.flash.operations()[operation], Operation::Erase(_))),
                Err(other) => panic!("operation {operation}, silent {silent}: {other}"),
            }
            let (selected, bytes) = device.start().unwrap_or_else(|e| panic!("operation {operation}: {e}"));
            assert!(bytes == old || bytes == new, "operation {operation}, {selected:?}");
            device.update_and_confirm(&new, 100).unwrap_or_else(|e| panic!("operation {operation}: {e}"));
            assert_eq!(started(&mut device).1, new);
        }
    }
}

#[test]
fn slots_that_do_not_fit_are_refused_by_name() {
    fn refused<const WRITE: usize, const ERASE: usize>(offsets: [u32; 2], bytes: u32) -> String {
        let flash = NorFlash::<WRITE, ERASE>::new(16, 0);
        Slots::new(&flash, offsets, bytes).expect_err("does not fit").to_string()
    }
    assert_eq!(refused::<512, 4096>([0, 8192], 8192), SlotsError::UnitSize(512).to_string());
    assert_eq!(refused::<256, 1024>([0, 8192], 8192), SlotsError::EraseSize(1024).to_string());
    assert_eq!(refused::<8, 128>([0, 256], 256), SlotsError::EraseSize(128).to_string());
    assert_eq!(refused::<8, 512>([0, 100], 1024), "slots: 0x64 is no multiple of the erase size, 0x200");
    assert_eq!(refused::<8, 512>([0, 512], 512), "slots: 512 bytes each, at least 1024 are needed");
    assert_eq!(refused::<8, 512>([1024, 512], 1024), "the slots overlap");
    assert_eq!(refused::<8, 512>([0, 4096], 4608), "the slots overlap");
    assert_eq!(refused::<8, 512>([0, 4096], 4096 + 512), "the slots overlap");
    assert_eq!(refused::<8, 512>([0, 5120], 4096), "a slot ends at byte 9216, the flash has 8192");
}
