//! No content of a flash and no host make a start or an update panic; whatever a start takes is a whole image.
#![no_main]

use embedded_storage::nor_flash::{ErrorType, NorFlash, NorFlashErrorKind, ReadNorFlash};
use embedded_storage::nor_flash::{check_erase, check_read, check_write};
use firmware::image::{CheckProgress, Image, crc32};
use firmware::kernels::{Kernels, Portable};
use firmware::update::{CLAIM, Manifest, MappedFlash, Requirements, Slots, TRIALS, Updater, select};
use libfuzzer_sys::arbitrary::{Result, Unstructured};
use libfuzzer_sys::fuzz_target;
use model_compiler::emit::{AlignedBytes, reseal};
use std::ops::Range;

const SECTOR: usize = 512;
const UNIT: usize = 16;
const IMAGE: usize = 4 * SECTOR;
const SLOT: usize = IMAGE + SECTOR;

/// Refuses some of what it is asked.
struct Flash {
    bytes: AlignedBytes,
    failing: Vec<bool>,
}

impl Flash {
    fn answer(&mut self) -> std::result::Result<(), NorFlashErrorKind> {
        if self.failing.pop().unwrap_or_default() { Err(NorFlashErrorKind::Other) } else { Ok(()) }
    }
}

impl ErrorType for Flash {
    type Error = NorFlashErrorKind;
}

impl ReadNorFlash for Flash {
    const READ_SIZE: usize = 4;

    fn read(&mut self, offset: u32, bytes: &mut [u8]) -> std::result::Result<(), NorFlashErrorKind> {
        check_read(self, offset, bytes.len()).expect("reads are aligned and inside");
        bytes.copy_from_slice(&self.bytes[offset as usize..][..bytes.len()]);
        self.answer()
    }

    fn capacity(&self) -> usize {
        self.bytes.len()
    }
}

impl NorFlash for Flash {
    const WRITE_SIZE: usize = 8;
    const ERASE_SIZE: usize = SECTOR;

    fn erase(&mut self, from: u32, to: u32) -> std::result::Result<(), NorFlashErrorKind> {
        check_erase(self, from, to).expect("erases are aligned and inside");
        self.answer()?;
        self.bytes[from as usize..to as usize].fill(0xFF);
        Ok(())
    }

    fn write(&mut self, offset: u32, bytes: &[u8]) -> std::result::Result<(), NorFlashErrorKind> {
        check_write(self, offset, bytes.len()).expect("writes are aligned and inside");
        self.answer()?;
        self.bytes[offset as usize..].iter_mut().zip(bytes).for_each(|(stored, byte)| *stored &= byte);
        Ok(())
    }
}

impl MappedFlash for Flash {
    fn mapped(&self, range: Range<u32>) -> Option<&[u8]> {
        self.bytes.get(range.start as usize..range.end as usize)
    }
}

/// What a slot holds: an image with valid CRCs or anything, and a record that may be one.
fn fill(u: &mut Unstructured<'_>, slot: &mut [u8]) -> Result<()> {
    let length = u.arbitrary_len::<u8>()?.min(IMAGE);
    let image = u.bytes(length)?;
    slot[..image.len()].copy_from_slice(image);
    if u.arbitrary()? {
        reseal(&mut slot[..image.len()]);
    }
    for unit in slot[IMAGE..].chunks_mut(UNIT).take(2 + 2 * usize::from(TRIALS)) {
        if u.arbitrary()? {
            u.fill_buffer(unit)?;
        }
    }
    if u.arbitrary()? {
        let header_crc = slot.get(380..384).unwrap_or_default().to_vec();
        let body =
            [&u.arbitrary::<u32>()?.to_le_bytes()[..], &(image.len() as u32).to_le_bytes(), &header_crc].concat();
        let record = [&CLAIM[..], &body, &crc32(&body).to_le_bytes()].concat();
        slot[IMAGE..][..record.len()].copy_from_slice(&record);
    }
    Ok(())
}

/// What a host sends.
fn receive(u: &mut Unstructured<'_>, mut flash: Flash, slots: Slots) -> Result<()> {
    let requirements =
        Requirements { target: "", kernels: Portable.supported(), arenas: &[1 << 16], interface: &|_| true };
    let running = select(&mut flash, &slots, &requirements, &mut || ()).ok();
    if let Some(running) = &running {
        let image = Image::parse(flash.mapped(running.range()).expect("it lies in the flash")).expect("it is an image");
        image.check().expect("every byte was checked");
    }
    let length = u.arbitrary_len::<u8>()?.min(IMAGE);
    let sent = AlignedBytes::from(u.bytes(length)?);
    let Ok(image) = Image::parse(&sent) else { return Ok(()) };
    let mut updater = Updater::new(flash, slots, requirements, running);
    let _ = updater.confirm();
    let _ = updater.begin(&Manifest::of(&image));
    while u.arbitrary()? {
        let start = updater.received() as usize;
        let end = (start + usize::from(u.arbitrary::<u16>()?)).min(sent.len());
        let _ = updater.write(u.arbitrary::<Option<u32>>()?.unwrap_or(start as u32), &sent[start..end]);
    }
    while matches!(updater.finish(usize::from(u.arbitrary::<u16>()?)), Ok(CheckProgress::Running { .. })) {}
    Ok(())
}

fuzz_target!(|bytes: &[u8]| {
    let mut u = Unstructured::new(bytes);
    let mut stored = AlignedBytes::zeroed(2 * SLOT);
    stored.fill(0xFF);
    let (a, b) = stored.split_at_mut(SLOT);
    if fill(&mut u, a).and_then(|()| fill(&mut u, b)).is_ok() {
        let flash = Flash { bytes: stored, failing: u.arbitrary().unwrap_or_default() };
        let slots = Slots::new(&flash, [0, SLOT as u32], SLOT as u32).expect("they fit");
        let _ = receive(&mut u, flash, slots);
    }
});
