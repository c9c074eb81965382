//! The model image: one little-endian file, executed in place, every byte of it covered by a check.
//!
//! # The format
//!
//! The base address is a multiple of 16. Fixed records, 32-bit offsets, no pointers, no compression. Field positions
//! are the constants of [`layout`], which the compiler's writer uses too.
//!
//! | part | content | covered by |
//! |---|---|---|
//! | header, 384 bytes | magic, format, counts, features, name, target, revision, digests, regions, sections | header CRC |
//! | ports | inputs, then outputs: tensor, zero point, scale (metadata), name; 32 bytes each | section CRC |
//! | tensors | 32-byte records `{region, type, offset, bytes, dims, first_step, last_step, in_place_of}` | section CRC |
//! | step index | first byte of every step in the program, `u32` each | section CRC |
//! | program | the steps, [postcard](https://docs.rs/postcard) of [`crate::program::Step`] | section CRC |
//! | constants | weights, biases, multipliers, tables; ranges start at multiples of 16 | section CRC |
//! | known answer | optional: a seed and the CRC of every step's output ([`known_answer`]) | section CRC |
//!
//! Sections follow each other without gaps, each padded with zeros to a multiple of 16. A section's CRC covers its
//! padding and is stored in the section table; the header CRC covers the table; reserved bytes are zero; the file is as
//! long as the header says. CRCs are CRC-32/ISO-HDLC.
//!
//! The arena lies in one to four memory regions (tightly coupled `fast`, SRAM `main`, external `slow`), listed fastest
//! first; one, named `main`, is the ordinary case. A tensor record names its region and its offset there.
//!
//! A tensor record is also the live range: `first_step` writes the tensor (0 for inputs), `last_step` reads it for the
//! last time (the program's last step for outputs). Scratch is a record of type `Scratch` with no shape that one step
//! uses. `in_place_of` names the operand whose memory the writing step takes over.
//!
//! # What each level proves
//!
//! | level | reads | proves |
//! |---|---|---|
//! | [`Image::parse`] | header, tables, program | no access out of bounds, no panic, bounded work, live tensors never overwritten |
//! | [`Image::check`] ([`Checker`] in slices) | every byte | the bytes are those that were written |
//! | [`crate::engine::Engine::self_test`] | constants | this machine computes what the compiler's did |
//! | [`audit::audit`] | constants | no accumulator overflows; multipliers, shifts and tables are in their ranges |
//!
//! `parse` proves nothing about the *values* of constants: damaged weights give wrong numbers, not a fault. CRCs are no
//! protection against intent; for that sign the file and check the signature before `parse`.
//!
//! # An image byte by byte
//!
//! One step, `y = R(q·2^23, 23)` over 16 codes (a copy):
//!
//! ```text
#![doc = include_str!("image/example.hex")]
//! ```
//!
//! At 0 magic, format 1, 1 step, length; at 0x10 features: bit 6 (requantize); at 0x18 2 tensors, 1 input, 1 output, 1
//! region. At 0x80 the region `main`: 32 bytes, aligned to 16 (further regions would follow). At 0xC0 the section table `(kind, offset, length, CRC)`.
//! At 0x17C the header CRC. At 0x180 the two ports, at 0x1C0 the two tensor records, at 0x200 the step index, at 0x210
//! the step: variant 6, input 0, output 1, zero point 0, multiplier and shift, zero point 0, bounds −128..127.
#![deny(
    clippy::indexing_slicing,
    clippy::arithmetic_side_effects,
    clippy::unwrap_used,
    clippy::expect_used,
    clippy::panic
)]

use crate::ops::{self, StepContext};
use crate::program::{ConstRange, Step};
use crate::tensor::{TensorId, index};
use bytemuck::Pod;

pub mod audit;
mod bytes;
mod checker;
mod checks;
pub mod known_answer;
pub mod layout;
mod parse;
mod records;
mod region;
mod stored;

pub(crate) use checker::Cursor;
pub use checker::{CheckError, CheckProgress, Checker, crc32};
pub(crate) use checker::{Digest, digest};
pub use checks::{Check, ParseError, Place};
pub(crate) use checks::{ensure, ensure_equal, shown};
pub use known_answer::KnownAnswer;
pub use records::{Port, TensorRecord, text};
pub use region::{Region, RegionName};
pub use stored::StoredImage;

/// A section of the file; the number is its slot in the header.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
#[repr(u8)]
pub enum SectionKind {
    /// Inputs, then outputs ([`layout::port`]).
    Ports = 0,
    /// The tensor table ([`layout::tensor`]).
    Tensors = 1,
    /// First byte of each step ([`layout::step_index`]).
    StepIndex = 2,
    /// The steps, postcard.
    Program = 3,
    /// Weights, biases, multipliers, tables: what [`ConstRange`]s refer to.
    Constants = 4,
    /// Optional ([`layout::known_answer`]).
    KnownAnswer = 5,
}

impl SectionKind {
    /// All sections in file order.
    pub const ALL: [Self; layout::SECTIONS] =
        [Self::Ports, Self::Tensors, Self::StepIndex, Self::Program, Self::Constants, Self::KnownAnswer];

    /// The number stored in the section's slot.
    pub const fn code(self) -> u32 {
        // Not zero, so that an unused slot names no section.
        self as u32 | 0x100
    }

    /// Name for messages.
    pub const fn name(self) -> &'static str {
        match self {
            Self::Ports => "ports",
            Self::Tensors => "tensors",
            Self::StepIndex => "step index",
            Self::Program => "program",
            Self::Constants => "constants",
            Self::KnownAnswer => "known answer",
        }
    }
}

/// Where a section lies.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
struct Section {
    offset: u32,
    length: u32,
    crc: u32,
}

impl Section {
    /// The section's bytes in the file, with its padding.
    fn padded(self, file: &[u8]) -> &[u8] {
        let start = index(self.offset);
        let end = start.saturating_add(index(self.length)).checked_next_multiple_of(layout::ALIGNMENT);
        end.and_then(|end| file.get(start..end)).unwrap_or_default()
    }
}

/// A parsed image: a view of the caller's bytes and a proof that [`Image::parse`] accepted them.
#[derive(Clone, Copy, Debug)]
pub struct Image<'a> {
    bytes: &'a [u8],
    sections: [Section; layout::SECTIONS],
    features: u64,
    regions: [Region; layout::REGION_SLOTS],
    step_count: u16,
    tensor_count: u16,
    input_count: u8,
    output_count: u8,
    region_count: u8,
    work: u64,
}

impl<'a> Image<'a> {
    /// Accepts an image or says what is wrong with it. Reads header, tables and program, not the constants.
    ///
    /// # Errors
    /// The first check of [`Check`] that fails.
    pub fn parse(bytes: &'a [u8]) -> Result<Self, ParseError> {
        parse::parse(bytes)
    }

    /// The same proof over other bytes: what the engine sees if the memory of an image changes after `parse`. For
    /// tests.
    #[cfg(feature = "fault-injection")]
    pub fn changed_to<'b>(&self, bytes: &'b [u8]) -> Image<'b> {
        Image { bytes, ..*self }
    }

    /// The whole file.
    pub fn bytes(&self) -> &'a [u8] {
        self.bytes
    }

    /// Model name.
    pub fn name(&self) -> &'a str {
        self.bytes.get(layout::header::NAME).and_then(text).unwrap_or_default()
    }

    /// SHA-256 of the quantized model, all zero where unknown.
    pub fn qmodel_digest(&self) -> [u8; 32] {
        self.digest(layout::header::QMODEL_DIGEST)
    }

    /// Digest that names the build, all zero where unknown.
    pub fn build_digest(&self) -> [u8; 32] {
        self.digest(layout::header::BUILD_DIGEST)
    }

    fn digest(&self, at: core::ops::Range<usize>) -> [u8; 32] {
        self.bytes.get(at).and_then(|field| field.try_into().ok()).unwrap_or_default()
    }

    /// Name of the target that the image was compiled for, empty where unknown.
    pub fn target(&self) -> &'a str {
        self.bytes.get(layout::header::TARGET).and_then(text).unwrap_or_default()
    }

    /// Revision of the model: what an update compares.
    pub fn revision(&self) -> u32 {
        bytes::u32_at(self.bytes, layout::header::REVISION).unwrap_or_default()
    }

    /// CRC-32 of the header. As the header holds the CRCs of all sections, it tells images apart.
    pub fn header_crc(&self) -> u32 {
        bytes::u32_at(self.bytes, layout::header::CRC).unwrap_or_default()
    }

    /// Union of the feature bits of all steps and kernels.
    pub fn features(&self) -> u64 {
        self.features
    }

    /// The memory regions, fastest first: an [`crate::engine::Engine`] needs a buffer in each, in this order.
    pub fn regions(&self) -> impl Iterator<Item = Region> + '_ {
        self.regions.iter().take(self.region_count.into()).copied()
    }

    /// A memory region, by position; `None` behind the last.
    pub fn region(&self, region: u8) -> Option<Region> {
        self.regions().nth(region.into())
    }

    /// Number of memory regions, at least one.
    pub fn region_count(&self) -> u8 {
        self.region_count
    }

    /// Bytes of arena that an [`crate::engine::Engine`] needs, in all regions together.
    pub fn arena_bytes(&self) -> u32 {
        self.regions().fold(0, |sum, region| sum.saturating_add(region.bytes))
    }

    /// The largest alignment that a region needs.
    pub fn arena_alignment(&self) -> u32 {
        self.regions().map(|region| region.alignment).max().unwrap_or_default()
    }

    /// Number of steps.
    pub fn step_count(&self) -> u16 {
        self.step_count
    }

    /// Number of tensor records, scratch included.
    pub fn tensor_count(&self) -> u16 {
        self.tensor_count
    }

    /// Number of inputs.
    pub fn input_count(&self) -> u8 {
        self.input_count
    }

    /// Number of outputs.
    pub fn output_count(&self) -> u8 {
        self.output_count
    }

    /// Elementary operations of one inference: multiply-accumulates of weighted steps and attention, elements touched
    /// by the others.
    pub fn work(&self) -> u64 {
        self.work
    }

    /// The part of [`Self::work`] that one step does; `None` behind the last.
    pub fn step_work(&self, position: u16) -> Option<u64> {
        ops::validate(&self.step(position)?, &StepContext { image: self, position }).ok()
    }

    /// An input, in header order; `None` behind the last.
    pub fn input(&self, input: u8) -> Option<Port<'a>> {
        (input < self.input_count).then(|| self.port(input.into())).flatten()
    }

    /// An output, in header order; `None` behind the last.
    pub fn output(&self, output: u8) -> Option<Port<'a>> {
        let position = usize::from(self.input_count).saturating_add(output.into());
        (output < self.output_count).then(|| self.port(position)).flatten()
    }

    fn port(&self, position: usize) -> Option<Port<'a>> {
        Port::from_bytes(bytes::record_at(self.section(SectionKind::Ports), position, layout::port::BYTES)?)
    }

    /// Whether a tensor is an input of the network.
    pub(crate) fn is_input(&self, id: TensorId) -> bool {
        (0..self.input_count).any(|input| self.port_tensor(input.into()) == Some(id.0))
    }

    /// Whether a tensor is an output of the network.
    pub(crate) fn is_output(&self, id: TensorId) -> bool {
        let first = usize::from(self.input_count);
        (0..self.output_count).any(|output| self.port_tensor(first.saturating_add(output.into())) == Some(id.0))
    }

    fn port_tensor(&self, position: usize) -> Option<u16> {
        let record = bytes::record_at(self.section(SectionKind::Ports), position, layout::port::BYTES)?;
        bytes::u16_at(record, layout::port::TENSOR)
    }

    /// A tensor record; `None` behind the last.
    pub fn tensor(&self, id: TensorId) -> Option<TensorRecord> {
        TensorRecord::from_bytes(self.tensor_bytes(id)?)
    }

    fn tensor_bytes(&self, id: TensorId) -> Option<&'a [u8]> {
        bytes::record_at(self.section(SectionKind::Tensors), id.0.into(), layout::tensor::BYTES)
    }

    /// Decodes the step at a position; `None` behind the last.
    pub fn step(&self, position: u16) -> Option<Step> {
        postcard::from_bytes(self.step_bytes(position)?).ok()
    }

    /// The stored bytes of a step.
    fn step_bytes(&self, position: u16) -> Option<&'a [u8]> {
        let program = self.section(SectionKind::Program);
        let end = self.step_start(position.checked_add(1)?).unwrap_or(program.len());
        program.get(self.step_start(position)?..end)
    }

    /// Entry of the step index.
    fn step_start(&self, position: u16) -> Option<usize> {
        let entry = bytes::record_at(self.section(SectionKind::StepIndex), position.into(), layout::step_index::BYTES)?;
        bytes::u32_at(entry, 0..layout::step_index::BYTES).map(index)
    }

    /// The elements of a constant range; `None` if it leaves its section or has a fraction of an element.
    pub fn constants<T: Pod>(&self, range: ConstRange) -> Option<&'a [T]> {
        let start = index(range.offset);
        let end = start.checked_add(index(range.bytes))?;
        bytemuck::try_cast_slice(self.section(SectionKind::Constants).get(start..end)?).ok()
    }

    /// The known answer, if the image has one.
    pub fn known_answer(&self) -> Option<KnownAnswer<'a>> {
        let section = self.section(SectionKind::KnownAnswer);
        (!section.is_empty()).then(|| KnownAnswer::new(section))
    }

    /// The bytes of a section, without padding.
    pub fn section(&self, kind: SectionKind) -> &'a [u8] {
        let Section { offset, length, .. } = self.slot(kind);
        let start = index(offset);
        self.bytes.get(start..start.saturating_add(index(length))).unwrap_or_default()
    }

    /// The bytes of a section with its padding.
    fn padded_section(&self, kind: SectionKind) -> &'a [u8] {
        self.slot(kind).padded(self.bytes)
    }

    /// CRC-32 that the header records for a section.
    pub fn section_crc(&self, kind: SectionKind) -> u32 {
        self.slot(kind).crc
    }

    fn slot(&self, kind: SectionKind) -> Section {
        self.sections.get(kind as usize).copied().unwrap_or_default()
    }
}
