//! Whenever the power fails during an update, the next start runs the old image or the new one, whole; and the update
//! after that succeeds. Every erase and every write is cut, and then every one of the update that follows.

use firmware::image::crc32;
use firmware::update::{CLAIM, Slot, UpdateError};
use std::ops::Range;
use tests::device::{Device, image};
use tests::nor_flash::{NorFlash, Operation};

/// Seeds of how operations are torn; each cut is tried with every one.
const SEEDS: Range<u64> = 1..9;
const ROOM: usize = 2 << 10;
const PIECE: usize = 100;

/// Where in its life a device is before the update.
#[derive(Clone, Copy, Debug)]
enum Life {
    /// As delivered: slot B has never been used.
    Factory,
    /// The factory's image is in the slot that is written to.
    Updated,
    /// An older image with its record is in the slot that is written to.
    UpdatedTwice,
    /// The slot that is written to holds an image that was given up.
    FellBack,
}

const LIVES: [Life; 4] = [Life::Factory, Life::Updated, Life::UpdatedTwice, Life::FellBack];

/// Images by age; the device runs `OLD` and is to run `NEW`.
struct Images {
    all: [Vec<u8>; 4],
}

impl Images {
    fn new() -> Self {
        Self { all: [image(1, 900), image(2, 500), image(3, 1100), image(4, 800)] }
    }

    fn known(&self) -> Vec<&[u8]> {
        self.all.iter().map(Vec::as_slice).collect()
    }

    fn new_image(&self) -> &[u8] {
        &self.all[3]
    }

    /// A device at this time of its life, and the image that it runs.
    fn device<const WRITE: usize, const ERASE: usize>(&self, life: Life, seed: u64) -> (Device<WRITE, ERASE>, &[u8]) {
        let mut device = Device::new(&self.all[0], ROOM, seed);
        let updates = match life {
            Life::Factory => 0,
            Life::Updated | Life::FellBack => 1,
            Life::UpdatedTwice => 2,
        };
        for image in &self.all[1..=updates] {
            device.update_and_confirm(image, PIECE).unwrap_or_else(|e| panic!("{e}"));
        }
        if let Life::FellBack = life {
            device.update(&self.all[2], PIECE).unwrap_or_else(|e| panic!("{e}"));
            while device.start().is_ok_and(|(selected, _)| selected.is_on_trial()) {}
        }
        let running = if updates == 2 { &self.all[2] } else { &self.all[updates] };
        (device, running)
    }
}

/// What is wrong with a device after a power cut: neither image starts, or the flash does not tell the truth.
fn wrong<const WRITE: usize, const ERASE: usize>(
    device: &Device<WRITE, ERASE>,
    old: &[u8],
    images: &Images,
) -> Option<String> {
    // A copy, since a start uses up a trial.
    let mut copy = device.clone();
    copy.flash.power_on(None);
    let started = match copy.start() {
        Ok((_, bytes)) if bytes == old || bytes == images.new_image() => None,
        Ok((selected, _)) => Some(format!("a mix starts: {selected:?}")),
        Err(error) => Some(error.to_string()),
    };
    started.or_else(|| device.lie(&images.known()))
}

/// Cuts the power at every operation of an update, and at every operation of the one that follows. Answers the number
/// of cuts.
fn sweep<const WRITE: usize, const ERASE: usize>() -> usize {
    let images = Images::new();
    let new = images.new_image();
    let mut cuts = 0;
    for (life, seed) in LIVES.into_iter().flat_map(|life| SEEDS.map(move |seed| (life, seed))) {
        let (fresh, old) = images.device::<WRITE, ERASE>(life, seed);
        for cut in 0.. {
            let place = format!("{WRITE}/{ERASE}, {life:?}, seed {seed}, cut {cut}");
            let mut device = fresh.clone();
            device.flash.power_on(Some(cut));
            let outcome = device.update_and_confirm(new, PIECE);
            if device.flash.has_power() {
                outcome.unwrap_or_else(|e| panic!("{place}: {e}"));
                break;
            }
            cuts += 1;
            assert_eq!(wrong(&device, old, &images), None, "{place}");
            for second in 0.. {
                let place = format!("{place}, second cut {second}");
                let mut device = device.clone();
                device.flash.power_on(Some(second));
                let outcome = device.update_and_confirm(new, PIECE);
                let is_cut = !device.flash.has_power();
                if is_cut {
                    cuts += 1;
                    assert_eq!(wrong(&device, old, &images), None, "{place}");
                    device.flash.power_on(None);
                    device.update_and_confirm(new, PIECE).unwrap_or_else(|e| panic!("{place}: {e}"));
                } else {
                    outcome.unwrap_or_else(|e| panic!("{place}: {e}"));
                }
                let (selected, bytes) = device.start().unwrap_or_else(|e| panic!("{place}: {e}"));
                assert!(bytes == new && !selected.is_on_trial(), "{place}: {selected:?}");
                if !is_cut {
                    break;
                }
            }
        }
    }
    println!("write size {WRITE}, erase size {ERASE}: {cuts} cuts");
    cuts
}

#[test]
fn old_or_new_starts_after_a_cut_anywhere_word_by_word() {
    assert!(sweep::<1, 256>() > 1000);
    assert!(sweep::<4, 512>() > 1000);
}

#[test]
fn old_or_new_starts_after_a_cut_anywhere_in_wider_words() {
    assert!(sweep::<8, 2048>() > 1000);
    assert!(sweep::<16, 256>() > 1000);
    assert!(sweep::<32, 1024>() > 1000);
}

#[test]
fn old_or_new_starts_after_a_cut_anywhere_page_by_page() {
    assert!(sweep::<16, 4096>() > 1000);
    assert!(sweep::<256, 4096>() > 1000);
}

/// A wrong updater, as what it makes of the operations of the right one.
type Mutant = fn(Vec<Operation>, &Device<4, 256>) -> Vec<Operation>;

/// The operations on the image: those between the claim and the body of the record.
fn image_operations(operations: &[Operation]) -> Range<usize> {
    let position = |is_it: fn(&[u8]) -> bool| {
        let of_it = |operation: &Operation| matches!(operation, Operation::Write(_, bytes) if is_it(bytes));
        operations.iter().position(of_it).expect("the record is written")
    };
    let claim = position(|bytes| bytes == CLAIM);
    let body = position(|bytes| bytes.len() == 16 && crc32(&bytes[..12]).to_le_bytes() == bytes[12..]);
    claim + 1..body
}

fn record_first(mut operations: Vec<Operation>, _: &Device<4, 256>) -> Vec<Operation> {
    let image = image_operations(&operations);
    operations[image.start..=image.end].rotate_right(1);
    operations
}

fn old_record_kept_until_the_end(mut operations: Vec<Operation>, _: &Device<4, 256>) -> Vec<Operation> {
    let image = image_operations(&operations);
    // Before the image, the record is erased and the slot claimed.
    operations[image.start - 2..image.end].rotate_left(2);
    operations
}

fn no_claim(mut operations: Vec<Operation>, _: &Device<4, 256>) -> Vec<Operation> {
    let image = image_operations(&operations);
    operations.remove(image.start - 1);
    operations
}

fn into_the_running_slot(mut operations: Vec<Operation>, device: &Device<4, 256>) -> Vec<Operation> {
    let [a, b] = [Slot::A, Slot::B].map(|slot| device.slots.image_offset(slot));
    let other = |at: u32| if at < b { at - a + b } else { at - b + a };
    for n in image_operations(&operations) {
        operations[n] = match operations[n].clone() {
            Operation::Erase(range) => Operation::Erase(other(range.start)..other(range.end - 1) + 1),
            Operation::Write(at, bytes) => Operation::Write(other(at), bytes),
        };
    }
    operations
}

fn without_an_erase(mut operations: Vec<Operation>, _: &Device<4, 256>) -> Vec<Operation> {
    let image = image_operations(&operations);
    let second = image.clone().filter(|n| matches!(operations[*n], Operation::Erase(_))).nth(1);
    operations.remove(second.expect("an image of several sectors"));
    operations
}

/// What is wrong after the first cut that shows it, if any does.
fn caught(life: Life, mutant: Mutant) -> Option<String> {
    let images = Images::new();
    SEEDS.into_iter().find_map(|seed| {
        let (fresh, old) = images.device::<4, 256>(life, seed);
        let mut whole = fresh.clone();
        whole.flash.power_on(None);
        whole.update_and_confirm(images.new_image(), PIECE).unwrap_or_else(|e: UpdateError| panic!("{e}"));
        let operations = mutant(whole.flash.operations().to_vec(), &fresh);
        (0..=operations.len()).find_map(|cut| {
            let mut device = fresh.clone();
            device.flash.power_on(Some(cut));
            replay(&mut device.flash, &operations);
            wrong(&device, old, &images)
        })
    })
}

/// Asks a flash for the same operations again, as a chip that takes no note of words written twice.
fn replay<const WRITE: usize, const ERASE: usize>(flash: &mut NorFlash<WRITE, ERASE>, operations: &[Operation]) {
    use embedded_storage::nor_flash::NorFlash as _;
    for operation in operations {
        let done = match operation {
            Operation::Erase(range) => flash.erase(range.start, range.end),
            Operation::Write(at, bytes) => {
                flash.forgive(*at..*at + bytes.len() as u32);
                flash.write(*at, bytes)
            }
        };
        if done.is_err() {
            return;
        }
    }
}

#[test]
fn wrong_updaters_are_caught() {
    for life in LIVES {
        assert_eq!(caught(life, |operations, _| operations), None, "{life:?}");
        for (name, mutant) in [
            ("record first", record_first as Mutant),
            ("into the running slot", into_the_running_slot),
            ("without an erase", without_an_erase),
        ] {
            // A slot that was never used needs no erase.
            let is_wrong = !(matches!(life, Life::Factory) && name == "without an erase");
            let found = caught(life, mutant);
            println!("{life:?}, {name}: {}", found.as_deref().unwrap_or("nothing wrong"));
            assert_eq!(found.is_some(), is_wrong, "{life:?}, {name}");
        }
    }
    assert!(caught(Life::UpdatedTwice, old_record_kept_until_the_end).is_some());
    assert!(caught(Life::Updated, no_claim).is_some());
}
