//! A device with a simulated flash, from the factory through updates and power cuts.

use crate::nor_flash::NorFlash;
use crate::random::Random;
use firmware::image::{CheckProgress, Image, Region, RegionName, TensorRecord, crc32, layout};
use firmware::kernels::{Kernels, Portable};
use firmware::program::{Clamp, Requant, Requantize, Step};
use firmware::tensor::{ElementType, Shape, TensorId};
use firmware::update::{
    CLAIM, CONFIRMED, Manifest, MappedFlash, Refusal, Requirements, SelectError, Selected, Slot, Slots, TRIALS, TRIED,
    UpdateError, Updater, select,
};
use model_compiler::emit::{AlignedBytes, ImageParts, ImagePort, emit};

/// Name of the device's target.
pub const TARGET: &str = "cortex-m4";
/// Bytes of arena of the device.
pub const ARENA: u32 = 64;

/// Parts of a small image: a copy of 16 codes, with `bytes` of constants that nothing reads.
pub fn parts(revision: u32, bytes: usize) -> ImageParts {
    let tensor = |offset| TensorRecord {
        element: ElementType::I8,
        shape: Shape::vector(16),
        region: 0,
        offset,
        bytes: 16,
        first_step: 0,
        last_step: 0,
        in_place_of: None,
    };
    let port = |name: &str, id| ImagePort { name: name.into(), tensor: TensorId(id), scale: 1.0, zero_point: 0 };
    let mut random = Random::new(bytes as u64);
    ImageParts {
        name: "copy".into(),
        tensors: vec![tensor(0), tensor(16)],
        steps: vec![Step::Requantize(Requantize {
            input: TensorId(0),
            output: TensorId(1),
            input_zero_point: 0,
            requant: Requant { multiplier: 1 << 23, shift: 23 },
            zero_point: 0,
            clamp: Clamp { min: -128, max: 127 },
        })],
        constants: (0..bytes).map(|_| random.bits() as u8).collect(),
        inputs: vec![port("x", 0)],
        outputs: vec![port("y", 1)],
        regions: vec![Region { name: RegionName::MAIN, bytes: 32, alignment: 16 }],
        qmodel_digest: [0; 32],
        build_digest: [0; 32],
        target: TARGET.into(),
        revision,
        known_answer: None,
    }
}

/// The image of [`parts`].
///
/// # Panics
/// Never for parts that are valid.
pub fn image(revision: u32, bytes: usize) -> Vec<u8> {
    emit(&parts(revision, bytes)).unwrap_or_else(|e| panic!("{e}"))
}

/// The manifest of an image.
///
/// # Panics
/// It is no image.
pub fn manifest(image: &[u8]) -> Manifest {
    Manifest::of(&Image::parse(&AlignedBytes::from(image)).unwrap_or_else(|e| panic!("{e}")))
}

/// Whether an image has the inputs and outputs that the device's application needs.
pub fn interface(image: &Image<'_>) -> bool {
    image.input(0).is_some_and(|x| x.name == "x") && image.output(0).is_some_and(|y| y.name == "y")
}

/// What the device needs of an image.
pub fn requirements() -> Requirements<'static> {
    Requirements { target: TARGET, kernels: Portable.supported(), arenas: &[ARENA], interface: &interface }
}

/// Two slots, the second with a gap before and behind it.
#[derive(Clone, Debug)]
pub struct Device<const WRITE: usize, const ERASE: usize> {
    /// Its flash.
    pub flash: NorFlash<WRITE, ERASE>,
    /// The slots.
    pub slots: Slots,
    /// What the application needs.
    pub requirements: Requirements<'static>,
}

impl<const WRITE: usize, const ERASE: usize> Device<WRITE, ERASE> {
    /// A device as the factory delivers it: an image in slot A, whose slots have room for `bytes`.
    ///
    /// # Panics
    /// The slots do not fit the flash.
    pub fn new(factory: &[u8], bytes: usize, seed: u64) -> Self {
        let sectors = bytes.div_ceil(ERASE) + 1;
        let mut flash = NorFlash::new(2 * sectors + 2, seed);
        let offset = |sectors: usize| (sectors * ERASE) as u32;
        let slots = Slots::new(&flash, [0, offset(sectors + 1)], offset(sectors)).unwrap_or_else(|e| panic!("{e}"));
        flash.program(0, factory);
        Self { flash, slots, requirements: requirements() }
    }

    /// A start: the image that runs, and its bytes.
    ///
    /// # Errors
    /// None runs.
    ///
    /// # Panics
    /// The power fails.
    pub fn start(&mut self) -> Result<(Selected, Vec<u8>), SelectError> {
        let selected = select(&mut self.flash, &self.slots, &self.requirements, &mut || ())?;
        let bytes = self.flash.mapped(selected.range()).expect("power").to_vec();
        Ok((selected, bytes))
    }

    /// The end that receives images.
    pub fn updater(&mut self, running: Option<Selected>) -> Updater<'static, &mut NorFlash<WRITE, ERASE>> {
        Updater::new(&mut self.flash, self.slots, self.requirements, running)
    }

    /// A start with a self-test that passes, and a whole update in pieces of this size. Fine if the image runs already.
    ///
    /// # Errors
    /// Where the update ends; also after a power cut.
    pub fn update(&mut self, image: &[u8], piece: usize) -> Result<(), UpdateError> {
        let running = select(&mut self.flash, &self.slots, &self.requirements, &mut || ()).ok();
        let mut updater = self.updater(running);
        updater.confirm()?;
        match updater.begin(&manifest(image)) {
            Err(UpdateError::Refused(Refusal::Running)) => return Ok(()),
            begun => begun?,
        }
        for piece in image.chunks(piece) {
            updater.write(updater.received(), piece)?;
        }
        while updater.finish(piece)? != CheckProgress::Done {}
        Ok(())
    }

    /// [`Self::update`], then a start with the new image and its confirmation.
    ///
    /// # Errors
    /// Where the update ends; also after a power cut.
    pub fn update_and_confirm(&mut self, image: &[u8], piece: usize) -> Result<(), UpdateError> {
        self.update(image, piece)?;
        let running = select(&mut self.flash, &self.slots, &self.requirements, &mut || ()).ok();
        self.updater(running).confirm()
    }

    /// What is wrong with the flash, judged from its bytes alone: a slot that looks as if its image could run, although
    /// it is not there whole. `known` are all images that were ever sent. A slot without an image's first bytes cannot
    /// look so, nor can one with a claim and no record, or with a record whose trials are used up.
    pub fn lie(&self, known: &[&[u8]]) -> Option<String> {
        [Slot::A, Slot::B].into_iter().find_map(|slot| {
            let stored = &self.flash.bytes()[self.slots.image_offset(slot) as usize..];
            let record = self.record(slot);
            let looks_so = if record.is_some() { self.may_run(slot) } else { !self.is_claimed(slot) };
            let is_whole = known.iter().any(|image| {
                stored.starts_with(image) && record.is_none_or(|(_, bytes)| bytes as usize == image.len())
            });
            let lies = looks_so && stored.starts_with(&layout::MAGIC) && !is_whole;
            lies.then(|| format!("{slot}: part of an image, and the record {record:?}"))
        })
    }

    /// Distance of the units of a record.
    fn unit() -> usize {
        WRITE.max(16)
    }

    fn record_start(&self, slot: Slot) -> usize {
        (self.slots.image_offset(slot) + self.slots.image_capacity()) as usize
    }

    fn is_claimed(&self, slot: Slot) -> bool {
        self.flash.bytes()[self.record_start(slot)..].starts_with(&CLAIM)
    }

    /// Counter and image bytes of a slot's record, read as the format's page says.
    pub fn record(&self, slot: Slot) -> Option<(u32, u32)> {
        let body = &self.flash.bytes()[self.record_start(slot) + Self::unit()..];
        let word = |n: usize| u32::from_le_bytes(body[4 * n..4 * n + 4].try_into().expect("four bytes"));
        (self.is_claimed(slot) && crc32(&body[..12]) == word(3)).then(|| (word(0), word(1)))
    }

    /// Writes the record of a confirmed image, as the format's page says.
    pub fn write_record(&mut self, slot: Slot, counter: u32, image: &[u8]) {
        let start = self.record_start(slot);
        let body: Vec<u8> = [counter, image.len() as u32, manifest(image).header_crc].map(u32::to_le_bytes).concat();
        let crc = crc32(&body).to_le_bytes();
        let units = [&CLAIM[..], &[&body[..], &crc].concat(), &TRIED, &CONFIRMED];
        for (number, unit) in units.into_iter().enumerate() {
            self.flash.program((start + number * Self::unit()) as u32, unit);
        }
    }

    /// Trials of a slot's image that are used up.
    pub fn trials(&self, slot: Slot) -> usize {
        self.marks(slot).filter(|[tried, _]| *tried != [0xFF; 16]).count()
    }

    /// Whether the image of a slot with a record is confirmed or has a trial left.
    fn may_run(&self, slot: Slot) -> bool {
        self.trials(slot) < usize::from(TRIALS) || self.marks(slot).any(|[_, confirmed]| *confirmed == CONFIRMED)
    }

    /// The units `tried` and `confirmed` of each trial.
    fn marks(&self, slot: Slot) -> impl Iterator<Item = [&[u8]; 2]> {
        let unit = move |n: usize| &self.flash.bytes()[self.record_start(slot) + n * Self::unit()..][..16];
        (0..usize::from(TRIALS)).map(move |trial| [unit(2 + 2 * trial), unit(3 + 2 * trial)])
    }
}
