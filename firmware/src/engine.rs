//! The engine: runs a parsed image in the caller's memory, one step at a time.
//!
//! [`Engine::start`] copies the inputs into the arena, each [`Engine::step`] runs one operator to its end, and after
//! [`Progress::Done`] the outputs can be read. Between two steps the caller may do anything else: feed a watchdog,
//! leave its time slot, or abandon the inference by calling `start` again.
//!
//! Nothing here panics. Every step is decoded and checked again before it runs ([`crate::ops`]), so an image that
//! changed after `parse` (a flash fault) gives [`EngineError::ImageChanged`] or, where the change is a mere number, a
//! wrong number; it never leads outside that memory.

#![deny(
    clippy::indexing_slicing,
    clippy::arithmetic_side_effects,
    clippy::unwrap_used,
    clippy::expect_used,
    clippy::panic
)]

use crate::arena::Regions;
use crate::image::{Image, Region, RegionName, known_answer};
use crate::kernels::Kernels;
use crate::ops;
use crate::program::{KernelId, Step};
use crate::tensor::{ElementType, TensorId, index};
use crate::waypoint::{self, MAX_WAYPOINTS, Waypoint};
use core::fmt;

/// Why the engine refuses.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub enum EngineError {
    /// No buffer was given for this region of the image.
    RegionMissing(RegionName),
    /// More buffers were given than the image has regions.
    RegionCount {
        /// Buffers given.
        found: u32,
        /// Regions of the image.
        expected: u32,
    },
    /// A buffer has fewer bytes than the image needs.
    ArenaTooSmall {
        /// Its region.
        region: RegionName,
        /// Bytes of the buffer.
        found: u32,
        /// Bytes that the image needs.
        needed: u32,
    },
    /// A buffer does not start at a multiple of its region's alignment.
    ArenaMisaligned {
        /// Its region.
        region: RegionName,
        /// Bytes behind the last such multiple.
        remainder: u32,
        /// Alignment that the image asks for.
        alignment: u32,
    },
    /// The image uses a kernel that this backend does not have.
    KernelMissing(KernelId),
    /// The number of inputs differs from the image's.
    InputCount {
        /// Inputs given.
        found: u32,
        /// Inputs of the network.
        expected: u32,
    },
    /// An input has a wrong length.
    InputBytes {
        /// Which input, in header order.
        input: u8,
        /// Bytes given.
        found: u32,
        /// Bytes of the tensor.
        expected: u32,
    },
    /// The network has no input of this index.
    NoSuchInput(u32),
    /// `step` or `self_test_step` without a `start` before it.
    NotStarted,
    /// An output was asked for before the last step was done.
    NotDone,
    /// The network has no output of this index.
    NoSuchOutput(u32),
    /// This output does not hold waypoints.
    NoWaypoints(u8),
    /// The image has no known answer.
    NoKnownAnswer,
    /// A step of the known answer gave other bytes.
    WrongAnswer {
        /// Position of the first such step.
        step: u16,
        /// CRC-32 of the bytes it wrote.
        found: u32,
        /// CRC-32 in the image.
        expected: u32,
    },
    /// The image is no longer what `parse` accepted.
    ImageChanged {
        /// The step at which it was noticed.
        step: u16,
    },
}

impl fmt::Display for EngineError {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::RegionMissing(region) => write!(f, "arena {region}: no buffer was given"),
            Self::RegionCount { found, expected } => {
                write!(f, "{found} buffers given, the image has {expected} memory regions")
            }
            Self::ArenaTooSmall { region, found, needed } => {
                write!(f, "arena {region}: {found} bytes, the image needs {needed}")
            }
            Self::ArenaMisaligned { region, remainder, alignment } => {
                write!(f, "arena {region}: starts {remainder} bytes behind a multiple of {alignment}")
            }
            Self::KernelMissing(kernel) => write!(f, "the image uses kernel {kernel:?}, which this backend lacks"),
            Self::InputCount { found, expected } => write!(f, "{found} inputs given, the network has {expected}"),
            Self::InputBytes { input, found, expected } => {
                write!(f, "input {input}: {found} bytes given, expected {expected}")
            }
            Self::NoSuchInput(index) => write!(f, "the network has no input {index}"),
            Self::NotStarted => write!(f, "no inference was started"),
            Self::NotDone => write!(f, "the inference is not done"),
            Self::NoSuchOutput(index) => write!(f, "the network has no output {index}"),
            Self::NoWaypoints(output) => write!(f, "output {output} does not hold waypoints"),
            Self::NoKnownAnswer => write!(f, "the image holds no known answer"),
            Self::WrongAnswer { step, found, expected } => {
                write!(f, "step {step}: self-test gave CRC {found:08x}, expected {expected:08x}")
            }
            Self::ImageChanged { step } => write!(f, "step {step}: the image changed after it was checked"),
        }
    }
}

impl core::error::Error for EngineError {}

/// How far an inference is.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub enum Progress {
    /// Steps remain.
    Running {
        /// Position of the next one.
        next: u16,
    },
    /// The outputs can be read.
    Done,
}

/// A parsed image, a backend and memory. `'a` is the shorter of the lives of image and memory.
#[derive(Debug)]
pub struct Engine<'a, K> {
    image: Image<'a>,
    kernels: K,
    regions: Regions<'a>,
    /// `None` before the first `start` and after an error.
    progress: Option<Progress>,
}

impl<'a, K: Kernels> Engine<'a, K> {
    /// `arena` is a buffer, or an array of them: one per region of the image, in its order ([`Image::regions`]). The
    /// engine takes the first bytes of each; whatever they hold is overwritten before it is read.
    ///
    /// # Errors
    /// A buffer is missing, surplus, too small or misaligned, or the image uses a kernel that the backend does not
    /// support.
    pub fn new(image: Image<'a>, kernels: K, arena: impl Into<Regions<'a>>) -> Result<Self, EngineError> {
        let regions = take_regions(&image, arena.into())?;
        for kernel in KernelId::ALL {
            if image.features() & kernel.feature() != 0 && !kernels.supported().contains(kernel) {
                return Err(EngineError::KernelMissing(*kernel));
            }
        }
        Ok(Self { image, kernels, regions, progress: None })
    }

    /// The image.
    pub fn image(&self) -> &Image<'a> {
        &self.image
    }

    /// Begins an inference: copies the inputs (little-endian element bytes, in header order) into the arena. Abandons
    /// an inference that is under way.
    ///
    /// # Errors
    /// A wrong number of inputs or a wrong length of one; [`EngineError::ImageChanged`].
    pub fn start(&mut self, inputs: &[&[u8]]) -> Result<(), EngineError> {
        self.progress = None;
        if inputs.len() != usize::from(self.image.input_count()) {
            let found = u32::try_from(inputs.len()).unwrap_or(u32::MAX);
            return Err(EngineError::InputCount { found, expected: self.image.input_count().into() });
        }
        for (input, given) in (0_u8..).zip(inputs) {
            let slot = self.input_slot(input)?;
            let expected = u32::try_from(slot.len()).unwrap_or(u32::MAX);
            if slot.len() != given.len() {
                let found = u32::try_from(given.len()).unwrap_or(u32::MAX);
                return Err(EngineError::InputBytes { input, found, expected });
            }
            slot.copy_from_slice(given);
        }
        self.begin();
        Ok(())
    }

    /// The bytes of an input, to be filled in place as a sensor delivers; [`Self::begin`] then starts without a copy.
    /// Abandons an inference that is under way. Inputs keep their bytes until the next inference begins, which
    /// overwrites them: each must be filled anew for every inference.
    ///
    /// # Errors
    /// [`EngineError::NoSuchInput`], [`EngineError::ImageChanged`].
    pub fn input_mut(&mut self, input: usize) -> Result<&mut [u8], EngineError> {
        self.progress = None;
        let missing = EngineError::NoSuchInput(u32::try_from(input).unwrap_or(u32::MAX));
        let number = u8::try_from(input).ok().filter(|number| *number < self.image.input_count()).ok_or(missing)?;
        self.input_slot(number)
    }

    /// Begins an inference over what was written to the inputs ([`Self::input_mut`]).
    pub fn begin(&mut self) {
        self.progress = Some(Progress::Running { next: 0 });
    }

    /// Runs the next step to its end; after the last one it does nothing and answers `Done` again.
    ///
    /// # Errors
    /// [`EngineError::NotStarted`]; [`EngineError::ImageChanged`], after which the inference must be started anew.
    pub fn step(&mut self) -> Result<Progress, EngineError> {
        self.step_observed(|_, _, _| ())
    }

    /// As [`Self::step`]; `observe` sees the step with its position and output bytes right after it ran.
    ///
    /// # Errors
    /// As [`Self::step`].
    pub fn step_observed(&mut self, observe: impl FnOnce(usize, &Step, &[u8])) -> Result<Progress, EngineError> {
        if let Progress::Running { next } = self.progress.ok_or(EngineError::NotStarted)? {
            let step = self.run(next)?;
            observe(next.into(), &step, self.written(next, &step)?);
        }
        self.progress.ok_or(EngineError::NotStarted)
    }

    /// A whole inference.
    ///
    /// # Errors
    /// Those of [`Self::start`] and [`Self::step`].
    pub fn infer(&mut self, inputs: &[&[u8]]) -> Result<(), EngineError> {
        self.infer_observed(inputs, |_, _, _| ())
    }

    /// A whole inference; `observe` sees each step with its position and output bytes right after it ran.
    ///
    /// # Errors
    /// Those of [`Self::start`] and [`Self::step`].
    pub fn infer_observed(
        &mut self,
        inputs: &[&[u8]],
        mut observe: impl FnMut(usize, &Step, &[u8]),
    ) -> Result<(), EngineError> {
        self.start(inputs)?;
        while self.step_observed(&mut observe)? != Progress::Done {}
        Ok(())
    }

    /// The bytes of an output, after [`Progress::Done`].
    ///
    /// # Errors
    /// [`EngineError::NotDone`], [`EngineError::NoSuchOutput`], [`EngineError::ImageChanged`].
    pub fn output(&self, output: usize) -> Result<&[u8], EngineError> {
        if self.progress != Some(Progress::Done) {
            return Err(EngineError::NotDone);
        }
        let missing = EngineError::NoSuchOutput(u32::try_from(output).unwrap_or(u32::MAX));
        let number = u8::try_from(output).ok().filter(|number| *number < self.image.output_count()).ok_or(missing)?;
        let changed = EngineError::ImageChanged { step: self.image.step_count() };
        let port = self.image.output(number).ok_or(changed)?;
        self.tensor(port.tensor).ok_or(changed)
    }

    /// The waypoints of an output, after [`Progress::Done`].
    ///
    /// # Errors
    /// As [`Self::output`]; [`EngineError::NoWaypoints`] where the output holds something else than pairs of Q16
    /// meters.
    pub fn waypoints(&self, output: usize) -> Result<heapless::Vec<Waypoint, MAX_WAYPOINTS>, EngineError> {
        let bytes = self.output(output)?;
        let number = u8::try_from(output).unwrap_or(u8::MAX);
        let port = self.image.output(number).filter(|port| port.scale.to_bits() == waypoint::SCALE_BITS);
        let record = port.and_then(|port| self.image.tensor(port.tensor));
        let is_waypoints = record.is_some_and(|r| r.element == ElementType::I32 && r.shape.channels == 2);
        waypoint::read(bytes).filter(|_| is_waypoints).ok_or(EngineError::NoWaypoints(number))
    }

    /// The memory, region by region, for tests of the memory plan (poison in dead bytes must not change any output).
    /// Whatever is written here can make results wrong, nothing worse.
    pub fn regions_mut(&mut self) -> impl Iterator<Item = &mut [u8]> {
        self.regions.buffers_mut().map(|buffer| &mut **buffer)
    }

    /// Begins the self-test: the inputs follow the seeded rule of [`known_answer`].
    ///
    /// # Errors
    /// [`EngineError::NoKnownAnswer`], [`EngineError::ImageChanged`].
    pub fn start_self_test(&mut self) -> Result<(), EngineError> {
        self.progress = None;
        let answer = self.image.known_answer().ok_or(EngineError::NoKnownAnswer)?;
        self.start_seeded(answer.seed())
    }

    /// Begins an inference over the inputs that the rule of [`known_answer`] gives for a seed.
    ///
    /// # Errors
    /// [`EngineError::ImageChanged`].
    pub fn start_seeded(&mut self, seed: u64) -> Result<(), EngineError> {
        self.progress = None;
        let mut generator = known_answer::Generator::new(seed);
        for input in 0..self.image.input_count() {
            let changed = EngineError::ImageChanged { step: 0 };
            let port = self.image.input(input).ok_or(changed)?;
            let element = self.image.tensor(port.tensor).ok_or(changed)?.element;
            generator.fill(element, self.input_slot(input)?);
        }
        self.begin();
        Ok(())
    }

    /// Runs the next step of the self-test and compares its output with the known answer.
    ///
    /// # Errors
    /// [`EngineError::WrongAnswer`] at the first difference, and those of [`Self::step`].
    pub fn self_test_step(&mut self) -> Result<Progress, EngineError> {
        let next = match self.progress.ok_or(EngineError::NotStarted)? {
            Progress::Running { next } => next,
            Progress::Done => return Ok(Progress::Done),
        };
        let step = self.run(next)?;
        let found = crate::image::crc32(self.written(next, &step)?);
        let answer = self.image.known_answer().ok_or(EngineError::NoKnownAnswer)?;
        let expected = answer.step_crc(next).ok_or(EngineError::ImageChanged { step: next })?;
        if found != expected {
            self.progress = None;
            return Err(EngineError::WrongAnswer { step: next, found, expected });
        }
        self.progress.ok_or(EngineError::NotStarted)
    }

    /// The whole self-test.
    ///
    /// # Errors
    /// Those of [`Self::start_self_test`] and [`Self::self_test_step`].
    pub fn self_test(&mut self) -> Result<(), EngineError> {
        self.start_self_test()?;
        while self.self_test_step()? != Progress::Done {}
        Ok(())
    }

    /// Decodes, checks and runs the step at `position`, and moves on. After an error the inference is abandoned.
    fn run(&mut self, position: u16) -> Result<Step, EngineError> {
        self.progress = None;
        let changed = EngineError::ImageChanged { step: position };
        let step = self.image.step(position).ok_or(changed)?;
        ops::run(&step, &self.image, position, &self.kernels, &mut self.regions).map_err(|_| changed)?;
        let next = position.saturating_add(1);
        let done = next >= self.image.step_count();
        self.progress = Some(if done { Progress::Done } else { Progress::Running { next } });
        Ok(step)
    }

    /// Output bytes of the step that ran last.
    fn written(&self, position: u16, step: &Step) -> Result<&[u8], EngineError> {
        self.tensor(step.output()).ok_or(EngineError::ImageChanged { step: position })
    }

    fn tensor(&self, id: TensorId) -> Option<&[u8]> {
        self.regions.tensor(&self.image.tensor(id)?)
    }

    fn input_slot(&mut self, input: u8) -> Result<&mut [u8], EngineError> {
        let record = self.image.input(input).and_then(|port| self.image.tensor(port.tensor));
        record.and_then(|record| self.regions.tensor_mut(&record)).ok_or(EngineError::ImageChanged { step: 0 })
    }
}

/// The first bytes of each buffer, as many as its region needs.
fn take_regions<'a>(image: &Image<'_>, mut regions: Regions<'a>) -> Result<Regions<'a>, EngineError> {
    let (found, expected) = (regions.count(), usize::from(image.region_count()));
    if let Some(missing) = image.regions().nth(found) {
        return Err(EngineError::RegionMissing(missing.name));
    }
    if found > expected {
        let [found, expected] = [found, expected].map(|count| u32::try_from(count).unwrap_or(u32::MAX));
        return Err(EngineError::RegionCount { found, expected });
    }
    for (buffer, region) in regions.buffers_mut().zip(image.regions()) {
        *buffer = take_region(&region, core::mem::take(buffer))?;
    }
    Ok(regions)
}

fn take_region<'a>(region: &Region, buffer: &'a mut [u8]) -> Result<&'a mut [u8], EngineError> {
    let Region { name, bytes: needed, alignment } = *region;
    let found = u32::try_from(buffer.len()).unwrap_or(u32::MAX);
    let mask = u64::from(alignment.saturating_sub(1));
    let remainder = u32::try_from(buffer.as_ptr().addr() as u64 & mask).unwrap_or(u32::MAX);
    // Nothing lies in a region of no bytes, so nothing need be aligned there.
    if remainder != 0 && needed != 0 {
        return Err(EngineError::ArenaMisaligned { region: name, remainder, alignment });
    }
    buffer.get_mut(..index(needed)).ok_or(EngineError::ArenaTooSmall { region: name, found, needed })
}
