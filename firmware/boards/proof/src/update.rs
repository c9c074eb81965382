//! The update of the image, over a flash of which nothing is known.

use core::hint::black_box;
use core::ops::Range;
use embedded_storage::nor_flash::{ErrorType, NorFlash, NorFlashErrorKind, ReadNorFlash};
use firmware::image::{CheckProgress, Image};
use firmware::kernels::{Kernels, Portable};
use firmware::update::{Manifest, MappedFlash, Requirements, Slots, Updater, same_interface, select};

/// Answers whatever it holds.
#[derive(Default)]
pub struct Flash {
    bytes: &'static [u8],
    answer: Option<NorFlashErrorKind>,
}

impl Flash {
    fn answer(&self) -> Result<(), NorFlashErrorKind> {
        black_box(self.answer).map_or(Ok(()), Err)
    }
}

impl ErrorType for Flash {
    type Error = NorFlashErrorKind;
}

impl ReadNorFlash for Flash {
    const READ_SIZE: usize = 4;

    fn read(&mut self, _: u32, bytes: &mut [u8]) -> Result<(), NorFlashErrorKind> {
        bytes.iter_mut().zip(self.bytes).for_each(|(to, from)| *to = *from);
        self.answer()
    }

    fn capacity(&self) -> usize {
        black_box(self.bytes.len())
    }
}

impl NorFlash for Flash {
    const WRITE_SIZE: usize = 8;
    const ERASE_SIZE: usize = 4096;

    fn erase(&mut self, from: u32, to: u32) -> Result<(), NorFlashErrorKind> {
        black_box((from, to));
        self.answer()
    }

    fn write(&mut self, offset: u32, bytes: &[u8]) -> Result<(), NorFlashErrorKind> {
        black_box((offset, bytes));
        self.answer()
    }
}

impl MappedFlash for Flash {
    fn mapped(&self, range: Range<u32>) -> Option<&[u8]> {
        black_box(self.bytes).get(range.start as usize..range.end as usize)
    }
}

/// A start, and whatever a host may send after it.
pub fn receive(mut flash: Flash, pieces: &[(u32, &[u8])]) -> Option<()> {
    let [offset_a, offset_b, bytes] = black_box([0; 3]);
    let slots = Slots::new(&flash, [offset_a, offset_b], bytes).ok()?;
    let known = Image::parse(black_box(&[])).ok()?;
    let interface = |image: &Image<'_>| same_interface(image, &known);
    let (target, arenas) = black_box(("", &[]));
    let requirements = Requirements { target, kernels: Portable.supported(), arenas, interface: &interface };
    let mut feed = || {
        black_box(());
    };
    let running = black_box(select(&mut flash, &slots, &requirements, &mut feed)).ok();
    let mut updater = Updater::new(flash, slots, requirements, running);
    let updater = black_box(&mut updater);
    updater.confirm().ok()?;
    updater.begin(&black_box(Manifest::of(&known))).ok()?;
    for (offset, piece) in pieces {
        updater.write(*offset, piece).ok()?;
    }
    while black_box(&mut *updater).finish(black_box(1)).ok()? != CheckProgress::Done {}
    if cfg!(feature = "twin-copy") {
        let mut copy = [0; 8];
        copy.copy_from_slice(pieces.first()?.1);
        black_box(copy);
    }
    Some(())
}
