//! The byte-level writer of model images. The format itself is [`firmware::image`]; nothing here knows a byte position
//! that is not named in [`firmware::image::layout`].

use crate::error::{Error, ErrorCode, Result};
use firmware::arena::Regions;
use firmware::image::audit::audit;
use firmware::image::layout::{self, header, region, section};
use firmware::image::{Image, Port, Region, SectionKind, TensorRecord, crc32};
use firmware::program::{ConstRange, Step};
use firmware::tensor::TensorId;
use std::collections::HashMap;
use std::ops::{Deref, DerefMut, Range};

/// Everything an image is made of.
#[derive(Clone, Debug, PartialEq)]
pub struct ImageParts {
    /// Model name, at most 32 bytes of UTF-8.
    pub name: String,
    /// The tensor table; ids are positions.
    pub tensors: Vec<TensorRecord>,
    /// The program in the order of execution.
    pub steps: Vec<Step>,
    /// The constants section, from [`ConstantsBuilder::finish`].
    pub constants: Vec<u8>,
    /// Inputs in header order.
    pub inputs: Vec<ImagePort>,
    /// Outputs in header order.
    pub outputs: Vec<ImagePort>,
    /// The memory regions, fastest first: one to four, of distinct names.
    pub regions: Vec<Region>,
    /// SHA-256 of the quantized model; zeros where unknown.
    pub qmodel_digest: [u8; 32],
    /// Digest that names the build; zeros where unknown.
    pub build_digest: [u8; 32],
    /// Target that the image is compiled for, at most 16 bytes of visible ASCII; empty where unknown.
    pub target: String,
    /// Revision of the model: what an update compares.
    pub revision: u32,
    /// What every step must give for seeded inputs.
    pub known_answer: Option<KnownAnswer>,
}

/// An input or output; owned form of [`Port`].
#[derive(Clone, Debug, PartialEq)]
pub struct ImagePort {
    /// Name, at most 24 bytes of UTF-8.
    pub name: String,
    /// The tensor.
    pub tensor: TensorId,
    /// Scale.
    pub scale: f32,
    /// Zero point; 0 for 16 and 32 bit.
    pub zero_point: i16,
}

/// The known answer; the input rule is that of [`firmware::image::known_answer`].
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct KnownAnswer {
    /// Seed of the inputs.
    pub seed: u64,
    /// CRC-32 of the output bytes of every step.
    pub step_crcs: Vec<u32>,
}

/// Bytes at an address that is a multiple of 16, as images and arenas need.
#[derive(Clone, Debug, Default)]
pub struct AlignedBytes {
    words: Vec<u128>,
    length: usize,
}

const _: () = assert!(align_of::<u128>() == layout::ALIGNMENT);

impl AlignedBytes {
    /// Zeros.
    pub fn zeroed(length: usize) -> Self {
        Self { words: vec![0; length.div_ceil(layout::ALIGNMENT)], length }
    }
}

impl From<&[u8]> for AlignedBytes {
    fn from(bytes: &[u8]) -> Self {
        let mut aligned = Self::zeroed(bytes.len());
        aligned.copy_from_slice(bytes);
        aligned
    }
}

impl Deref for AlignedBytes {
    type Target = [u8];

    fn deref(&self) -> &[u8] {
        &bytemuck::cast_slice(&self.words)[..self.length]
    }
}

impl DerefMut for AlignedBytes {
    fn deref_mut(&mut self) -> &mut [u8] {
        &mut bytemuck::cast_slice_mut(&mut self.words)[..self.length]
    }
}

impl<'a> From<&'a mut AlignedBytes> for Regions<'a> {
    fn from(buffer: &'a mut AlignedBytes) -> Self {
        (&mut buffer[..]).into()
    }
}

/// Collects the constants section: every range starts at a multiple of 16, equal contents are stored once.
#[derive(Clone, Debug, Default)]
pub struct ConstantsBuilder {
    bytes: Vec<u8>,
    known: HashMap<Vec<u8>, ConstRange>,
}

impl ConstantsBuilder {
    /// An empty section.
    pub fn new() -> Self {
        Self::default()
    }

    /// Adds little-endian elements (`i8`, `u8`, `i16`, `i32`, `i64`, `[u16; 2]`).
    ///
    /// # Errors
    /// `TooBig` where the section exceeds 32-bit offsets.
    pub fn push<T: bytemuck::NoUninit>(&mut self, elements: &[T]) -> Result<ConstRange> {
        let content: &[u8] = bytemuck::cast_slice(elements);
        if let Some(range) = self.known.get(content) {
            return Ok(*range);
        }
        let range = ConstRange { offset: to_u32(self.bytes.len())?, bytes: to_u32(content.len())? };
        self.bytes.extend_from_slice(content);
        pad(&mut self.bytes);
        self.known.insert(content.to_vec(), range);
        Ok(range)
    }

    /// The section's bytes.
    pub fn finish(self) -> Vec<u8> {
        self.bytes
    }
}

/// Writes an image and has the runtime's own parser, CRC check and audit accept it.
///
/// # Errors
/// `TooBig` or `Malformed` where a part does not fit the format; `Malformed` with the parser's words where the parts
/// contradict each other.
pub fn emit(parts: &ImageParts) -> Result<Vec<u8>> {
    let bytes = assemble(parts)?;
    let aligned = AlignedBytes::from(bytes.as_slice());
    let image = Image::parse(&aligned).map_err(|error| malformed(&parts.name, error.to_string()))?;
    image.check().map_err(|error| malformed(&parts.name, error.to_string()))?;
    audit(&image).map_err(|error| malformed(&parts.name, error.to_string()))?;
    Ok(bytes)
}

/// Writes an image without judging it, for [`emit`] and for tests of the parser.
///
/// # Errors
/// `TooBig` or `Malformed` where a part does not fit its field.
pub fn assemble(parts: &ImageParts) -> Result<Vec<u8>> {
    let mut bytes = vec![0; header::BYTES];
    let (step_index, program) = program_sections(&parts.steps)?;
    let sections: [(SectionKind, Vec<u8>); layout::SECTIONS] = [
        (SectionKind::Ports, ports_section(parts)?),
        (SectionKind::Tensors, parts.tensors.iter().flat_map(TensorRecord::to_bytes).collect()),
        (SectionKind::StepIndex, step_index),
        (SectionKind::Program, program),
        (SectionKind::Constants, parts.constants.clone()),
        (SectionKind::KnownAnswer, known_answer_section(parts.known_answer.as_ref())),
    ];
    write_header(&mut bytes, parts)?;
    for (kind, content) in &sections {
        append_section(&mut bytes, *kind, content)?;
    }
    let total = to_u32(bytes.len())?;
    bytes[header::TOTAL_BYTES].copy_from_slice(&total.to_le_bytes());
    reseal(&mut bytes);
    Ok(bytes)
}

/// The same image with another known answer (or none).
///
/// # Errors
/// As [`emit`]; also where `image` is no image.
pub fn with_known_answer(image: &[u8], known_answer: Option<&KnownAnswer>) -> Result<Vec<u8>> {
    let aligned = AlignedBytes::from(image);
    Image::parse(&aligned).map_err(|error| malformed("image", error.to_string()))?;
    let start = slot_field(image, SectionKind::KnownAnswer, section::OFFSET) as usize;
    let mut bytes = image[..start].to_vec();
    append_section(&mut bytes, SectionKind::KnownAnswer, &known_answer_section(known_answer))?;
    let total = to_u32(bytes.len())?;
    bytes[header::TOTAL_BYTES].copy_from_slice(&total.to_le_bytes());
    reseal(&mut bytes);
    let aligned = AlignedBytes::from(bytes.as_slice());
    Image::parse(&aligned).map_err(|error| malformed("known answer", error.to_string()))?;
    Ok(bytes)
}

/// The same image with another revision.
///
/// # Errors
/// `Malformed` where `image` is no image.
pub fn with_revision(image: &[u8], revision: u32) -> Result<Vec<u8>> {
    let mut aligned = AlignedBytes::from(image);
    Image::parse(&aligned).map_err(|error| malformed("image", error.to_string()))?;
    aligned[header::REVISION].copy_from_slice(&revision.to_le_bytes());
    reseal(&mut aligned);
    Ok(aligned.to_vec())
}

/// Recomputes the CRCs of all sections and of the header of an image that was changed by hand. Sections that do not
/// lie in the file keep their CRC; a file shorter than a header is left alone.
pub fn reseal(image: &mut [u8]) {
    if image.len() < header::BYTES {
        return;
    }
    for kind in SectionKind::ALL {
        let start = slot_field(image, kind, section::OFFSET) as usize;
        let length = slot_field(image, kind, section::LENGTH) as usize;
        let end = start.saturating_add(length).next_multiple_of(layout::ALIGNMENT);
        if let Some(content) = image.get(start..end) {
            let crc = crc32(content);
            image[slot(kind, section::CRC)].copy_from_slice(&crc.to_le_bytes());
        }
    }
    let crc = crc32(&image[..header::CRC.start]);
    image[header::CRC].copy_from_slice(&crc.to_le_bytes());
}

fn write_header(bytes: &mut [u8], parts: &ImageParts) -> Result<()> {
    let features = parts
        .steps
        .iter()
        .fold(0, |bits, step| bits | step.feature() | step.kernel().map_or(0, |kernel| kernel.feature()));
    bytes[header::MAGIC].copy_from_slice(&layout::MAGIC);
    bytes[header::FORMAT].copy_from_slice(&layout::FORMAT.to_le_bytes());
    bytes[header::STEP_COUNT].copy_from_slice(&count::<u16>(parts.steps.len(), "steps")?.to_le_bytes());
    bytes[header::FEATURES].copy_from_slice(&features.to_le_bytes());
    bytes[header::TENSOR_COUNT].copy_from_slice(&count::<u16>(parts.tensors.len(), "tensors")?.to_le_bytes());
    bytes[header::INPUT_COUNT].copy_from_slice(&[count(parts.inputs.len(), "inputs")?]);
    bytes[header::OUTPUT_COUNT].copy_from_slice(&[count(parts.outputs.len(), "outputs")?]);
    bytes[header::REGION_COUNT].copy_from_slice(&[count(parts.regions.len(), "memory regions")?]);
    let name = bytes[header::NAME].get_mut(..parts.name.len());
    name.ok_or_else(|| malformed(&parts.name, "the model name is longer than 32 bytes"))?
        .copy_from_slice(parts.name.as_bytes());
    let target = bytes[header::TARGET].get_mut(..parts.target.len());
    target
        .ok_or_else(|| malformed(&parts.target, "the target name is longer than 16 bytes"))?
        .copy_from_slice(parts.target.as_bytes());
    bytes[header::REVISION].copy_from_slice(&parts.revision.to_le_bytes());
    bytes[header::QMODEL_DIGEST].copy_from_slice(&parts.qmodel_digest);
    bytes[header::BUILD_DIGEST].copy_from_slice(&parts.build_digest);
    let slots = bytes[header::REGIONS].chunks_exact_mut(region::BYTES);
    if parts.regions.len() > slots.len() {
        return Err(malformed(&parts.name, format!("more than {} memory regions", layout::REGION_SLOTS)));
    }
    for (slot, memory) in slots.zip(&parts.regions) {
        slot[region::NAME].copy_from_slice(&memory.name.to_bytes());
        slot[region::ARENA_BYTES].copy_from_slice(&memory.bytes.to_le_bytes());
        slot[region::ALIGNMENT].copy_from_slice(&memory.alignment.to_le_bytes());
    }
    Ok(())
}

fn append_section(bytes: &mut Vec<u8>, kind: SectionKind, content: &[u8]) -> Result<()> {
    let offset = to_u32(bytes.len())?;
    let length = to_u32(content.len())?;
    bytes.extend_from_slice(content);
    pad(bytes);
    bytes[slot(kind, section::KIND)].copy_from_slice(&kind.code().to_le_bytes());
    bytes[slot(kind, section::OFFSET)].copy_from_slice(&offset.to_le_bytes());
    bytes[slot(kind, section::LENGTH)].copy_from_slice(&length.to_le_bytes());
    Ok(())
}

fn ports_section(parts: &ImageParts) -> Result<Vec<u8>> {
    let mut records = Vec::new();
    for port in parts.inputs.iter().chain(&parts.outputs) {
        let ImagePort { name, tensor, scale, zero_point } = port;
        let record = Port { name, tensor: *tensor, scale: *scale, zero_point: *zero_point }.to_bytes();
        records.extend(record.ok_or_else(|| malformed(name, "the name is longer than 24 bytes"))?);
    }
    Ok(records)
}

/// Step index and program.
fn program_sections(steps: &[Step]) -> Result<(Vec<u8>, Vec<u8>)> {
    let (mut index, mut program) = (Vec::new(), Vec::new());
    for (position, step) in steps.iter().enumerate() {
        index.extend(to_u32(program.len())?.to_le_bytes());
        let encoded = postcard::to_allocvec(step);
        program.extend(encoded.map_err(|error| malformed(format!("step {position}"), error.to_string()))?);
    }
    Ok((index, program))
}

fn known_answer_section(known_answer: Option<&KnownAnswer>) -> Vec<u8> {
    known_answer.map_or_else(Vec::new, |answer| {
        let crcs = answer.step_crcs.iter().flat_map(|crc| crc.to_le_bytes());
        answer.seed.to_le_bytes().into_iter().chain(crcs).collect()
    })
}

/// Byte range of a field of a section's slot.
fn slot(kind: SectionKind, field: Range<usize>) -> Range<usize> {
    let start = header::SECTIONS.start + kind as usize * section::BYTES;
    start + field.start..start + field.end
}

fn slot_field(image: &[u8], kind: SectionKind, field: Range<usize>) -> u32 {
    let bytes = &image[slot(kind, field)];
    u32::from_le_bytes(bytes.try_into().expect("slot fields have four bytes"))
}

fn pad(bytes: &mut Vec<u8>) {
    bytes.resize(bytes.len().next_multiple_of(layout::ALIGNMENT), 0);
}

fn to_u32(length: usize) -> Result<u32> {
    u32::try_from(length).map_err(|_| Error::new(ErrorCode::TooBig, "image", "more than 4 GiB"))
}

fn count<T: TryFrom<usize>>(number: usize, what: &str) -> Result<T> {
    T::try_from(number).map_err(|_| Error::new(ErrorCode::TooBig, "image", format!("{number} {what} do not fit")))
}

fn malformed(place: impl Into<String>, message: impl Into<String>) -> Error {
    Error::new(ErrorCode::Malformed, place, message)
}
