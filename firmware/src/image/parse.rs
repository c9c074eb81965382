//! `Image::parse`: every check, in the order of the file. Nothing here allocates, recurses or reads the constants; the
//! longest loop is steps × tensor records.

use super::bytes::{u8_at, u16_at, u32_at, u64_at};
use super::layout::{self, header, region, section, tensor};
use super::{
    Check, Image, ParseError, Place, Port, Region, RegionName, Section, SectionKind, TensorRecord, crc32, ensure,
    ensure_equal, shown, text,
};
use crate::ops::{self, StepContext};
use crate::program::Step;
use crate::tensor::{ElementType, TensorId, index};
use core::ops::Range;

pub(super) fn parse(bytes: &[u8]) -> Result<Image<'_>, ParseError> {
    let mut image = read_header(bytes)?;
    read_regions(&mut image)?;
    read_sections(&mut image)?;
    check_step_index(&image)?;
    for id in 0..image.tensor_count {
        check_tensor(&image, id)?;
    }
    check_ports(&image)?;
    image.work = check_program(&image)?;
    Ok(image)
}

/// A place in the header.
fn at(field: &Range<usize>) -> Place {
    Place::Header(u16::try_from(field.start).unwrap_or(u16::MAX))
}

/// Everything that one needs to know before the rest can be trusted to be what it says.
fn read_header(bytes: &[u8]) -> Result<Image<'_>, ParseError> {
    let length = shown(bytes.len() as u64);
    let remainder = shown((bytes.as_ptr().addr() % layout::ALIGNMENT) as u64);
    ensure_equal(Check::Misaligned, Place::File, remainder, 0)?;
    let header_bytes = shown(header::BYTES as u64);
    ensure(Check::HeaderLength, Place::File, length >= header_bytes, length, header_bytes)?;
    let magic = bytes.get(header::MAGIC).unwrap_or_default();
    let first = magic.first().copied().unwrap_or_default();
    ensure(Check::Magic, at(&header::MAGIC), magic == layout::MAGIC, first, layout::MAGIC[0])?;
    let format = u16_at(bytes, header::FORMAT).unwrap_or_default();
    ensure_equal(Check::Format, at(&header::FORMAT), format, layout::FORMAT)?;
    let crc = crc32(bytes.get(..header::CRC.start).unwrap_or_default());
    ensure_equal(Check::HeaderCrc, at(&header::CRC), u32_at(bytes, header::CRC).unwrap_or_default(), crc)?;
    let total = i64::from(u32_at(bytes, header::TOTAL_BYTES).unwrap_or_default());
    ensure_equal(Check::TotalBytes, Place::File, length, total)?;
    check_reserved(bytes, header::RESERVED_A)?;
    check_reserved(bytes, header::RESERVED_B)?;
    let used = section::BYTES.saturating_mul(layout::SECTIONS);
    check_reserved(bytes, header::SECTIONS.start.saturating_add(used)..header::SECTIONS.end)?;
    let name = bytes.get(header::NAME).unwrap_or_default();
    ensure(Check::ModelName, at(&header::NAME), text(name).is_some(), 0, 0)?;
    let target = bytes.get(header::TARGET).unwrap_or_default();
    let is_plain = text(target).is_some_and(|name| name.bytes().all(|byte| byte.is_ascii_graphic()));
    ensure(Check::TargetName, at(&header::TARGET), is_plain, 0, 0)?;
    read_counts(bytes)
}

/// Reserved bytes are zero.
fn check_reserved(bytes: &[u8], field: Range<usize>) -> Result<(), ParseError> {
    let stray = bytes.get(field.clone()).unwrap_or_default().iter().copied().find(|byte| *byte != 0);
    ensure(Check::HeaderReserved, at(&field), stray.is_none(), stray.unwrap_or_default(), 0)
}

/// Features and counts; regions and sections are still empty.
fn read_counts(bytes: &[u8]) -> Result<Image<'_>, ParseError> {
    let image = Image {
        bytes,
        sections: Default::default(),
        features: u64_at(bytes, header::FEATURES).unwrap_or_default(),
        regions: Default::default(),
        step_count: u16_at(bytes, header::STEP_COUNT).unwrap_or_default(),
        tensor_count: u16_at(bytes, header::TENSOR_COUNT).unwrap_or_default(),
        input_count: u8_at(bytes, header::INPUT_COUNT).unwrap_or_default(),
        output_count: u8_at(bytes, header::OUTPUT_COUNT).unwrap_or_default(),
        region_count: u8_at(bytes, header::REGION_COUNT).unwrap_or_default(),
        work: 0,
    };
    let unknown = image.features & !Step::KNOWN_FEATURES;
    ensure(Check::Features, at(&header::FEATURES), unknown == 0, shown(unknown), 0)?;
    let count = |check, field: Range<usize>, found: u16, limit: u16| {
        ensure(check, at(&field), (1..=limit).contains(&found), found, limit)
    };
    count(Check::StepCount, header::STEP_COUNT, image.step_count, layout::MAX_STEPS)?;
    count(Check::TensorCount, header::TENSOR_COUNT, image.tensor_count, layout::MAX_TENSORS)?;
    count(Check::InputCount, header::INPUT_COUNT, image.input_count.into(), layout::MAX_PORTS.into())?;
    count(Check::OutputCount, header::OUTPUT_COUNT, image.output_count.into(), layout::MAX_PORTS.into())?;
    Ok(image)
}

/// One to four regions of distinct names; the slots behind them are zero.
fn read_regions(image: &mut Image<'_>) -> Result<(), ParseError> {
    let slots = layout::REGION_SLOTS;
    let count = usize::from(image.region_count);
    let place = at(&header::REGION_COUNT);
    ensure(Check::RegionCount, place, (1..=slots).contains(&count), image.region_count, shown(slots as u64))?;
    let behind = header::REGIONS.start.saturating_add(region::BYTES.saturating_mul(count.min(slots)));
    check_reserved(image.bytes, behind..header::REGIONS.end)?;
    for number in 0..count.min(slots) {
        let start = header::REGIONS.start.saturating_add(region::BYTES.saturating_mul(number));
        let place = at(&(start..header::REGIONS.end));
        let slot = image.bytes.get(start..start.saturating_add(region::BYTES)).unwrap_or_default();
        let name = slot.get(region::NAME).and_then(|name| RegionName::from_bytes(name.try_into().ok()?));
        ensure(Check::RegionName, place, name.is_some(), slot.first().copied().unwrap_or_default(), b'm')?;
        let read = Region {
            name: name.unwrap_or_default(),
            bytes: u32_at(slot, region::ARENA_BYTES).unwrap_or_default(),
            alignment: u32_at(slot, region::ALIGNMENT).unwrap_or_default(),
        };
        let earlier = image.regions.iter().take(number).position(|other| other.name == read.name);
        let same = shown(earlier.unwrap_or(number) as u64);
        ensure(Check::RegionRepeated, place, earlier.is_none(), same, shown(number as u64))?;
        let fits = read.alignment.is_power_of_two() && (16..=layout::MAX_ARENA_ALIGNMENT).contains(&read.alignment);
        ensure(Check::RegionAlignment, place, fits, read.alignment, 16)?;
        if let Some(known) = image.regions.get_mut(number) {
            *known = read;
        }
        let total = image.regions.iter().fold(0_u64, |sum, region| sum.saturating_add(region.bytes.into()));
        ensure(Check::RegionBytes, place, total <= u64::from(u32::MAX), shown(total), u32::MAX)?;
    }
    Ok(())
}

/// The section table: gapless, of the lengths that the counts imply, zero-padded; CRCs of all but the two sections
/// that only [`Image::check`] reads.
fn read_sections(image: &mut Image<'_>) -> Result<(), ParseError> {
    let slots = image.bytes.get(header::SECTIONS).unwrap_or_default();
    let mut next = header::BYTES as u64;
    for (position, kind) in SectionKind::ALL.into_iter().enumerate() {
        let place = Place::Section(kind);
        let slot = super::bytes::record_at(slots, position, section::BYTES).unwrap_or_default();
        let code = u32_at(slot, section::KIND).unwrap_or_default();
        ensure_equal(Check::SectionKind, place, code, kind.code())?;
        let read = Section {
            offset: u32_at(slot, section::OFFSET).unwrap_or_default(),
            length: u32_at(slot, section::LENGTH).unwrap_or_default(),
            crc: u32_at(slot, section::CRC).unwrap_or_default(),
        };
        ensure_equal(Check::SectionOffset, place, i64::from(read.offset), shown(next))?;
        check_section_length(image, kind, read.length)?;
        next = next.saturating_add(layout::padded(read.length.into()));
        ensure(
            Check::SectionEnd,
            place,
            next <= image.bytes.len() as u64,
            shown(next),
            shown(image.bytes.len() as u64),
        )?;
        if let Some(known) = image.sections.get_mut(position) {
            *known = read;
        }
        check_section_content(image, kind)?;
    }
    ensure_equal(Check::SectionEnd, Place::File, shown(next), shown(image.bytes.len() as u64))
}

fn check_section_length(image: &Image<'_>, kind: SectionKind, length: u32) -> Result<(), ParseError> {
    let records = |count: u64, size: usize| count.saturating_mul(size as u64);
    let expected = match kind {
        SectionKind::Ports => {
            let ports = u64::from(image.input_count).saturating_add(image.output_count.into());
            records(ports, layout::port::BYTES)
        }
        SectionKind::Tensors => records(image.tensor_count.into(), tensor::BYTES),
        SectionKind::StepIndex => records(image.step_count.into(), layout::step_index::BYTES),
        SectionKind::KnownAnswer if length != 0 => {
            let crcs = records(image.step_count.into(), layout::known_answer::CRC_BYTES);
            crcs.saturating_add(layout::known_answer::CRCS as u64)
        }
        SectionKind::Program | SectionKind::Constants | SectionKind::KnownAnswer => length.into(),
    };
    ensure_equal(Check::SectionLength, Place::Section(kind), i64::from(length), shown(expected))
}

fn check_section_content(image: &Image<'_>, kind: SectionKind) -> Result<(), ParseError> {
    let place = Place::Section(kind);
    let padded = image.padded_section(kind);
    let padding = padded.get(image.section(kind).len()..).unwrap_or_default();
    let stray = padding.iter().copied().find(|byte| *byte != 0);
    ensure(Check::SectionPadding, place, stray.is_none(), stray.unwrap_or_default(), 0)?;
    if matches!(kind, SectionKind::Constants | SectionKind::KnownAnswer) {
        return Ok(());
    }
    ensure_equal(Check::SectionCrc, place, crc32(padded), image.section_crc(kind))
}

/// Every entry of the step index frames one step exactly.
fn check_step_index(image: &Image<'_>) -> Result<(), ParseError> {
    let program = image.section(SectionKind::Program).len();
    let mut last = None;
    for position in 0..image.step_count {
        let place = Place::Step(position);
        let start = image.step_start(position).unwrap_or_default();
        let rises = last.map_or(start == 0, |last| start > last) && start < program;
        let nearest = last.map_or(0, |last: usize| shown(last as u64).saturating_add(1));
        ensure(Check::StepIndex, place, rises, shown(start as u64), nearest)?;
        last = Some(start);
    }
    for position in 0..image.step_count {
        let place = Place::Step(position);
        let bytes = image.step_bytes(position).unwrap_or_default();
        let decoded = postcard::take_from_bytes::<Step>(bytes);
        let length = shown(bytes.len() as u64);
        ensure(Check::StepDecode, place, decoded.is_ok(), length, length)?;
        let rest = decoded.map_or(0, |(_, rest)| rest.len());
        ensure(Check::StepLength, place, rest == 0, length, length.saturating_sub(shown(rest as u64)))?;
    }
    Ok(())
}

/// One record of the tensor table, and that its live range is the truth.
fn check_tensor(image: &Image<'_>, id: u16) -> Result<(), ParseError> {
    let place = Place::Tensor(id);
    let bytes = image.tensor_bytes(TensorId(id)).unwrap_or_default();
    let code = u8_at(bytes, tensor::ELEMENT).unwrap_or_default();
    let record = TensorRecord::from_bytes(bytes);
    ensure(Check::TensorElement, place, record.is_some(), code, 0)?;
    let Some(record) = record else { return Ok(()) };
    let scratch = record.element == ElementType::Scratch;
    let stray = bytes.get(tensor::RESERVED).unwrap_or_default().iter().copied().find(|byte| *byte != 0);
    ensure(Check::TensorReserved, place, stray.is_none(), stray.unwrap_or_default(), 0)?;
    let last_region = image.region_count.saturating_sub(1);
    ensure(Check::TensorRegion, place, record.region <= last_region, record.region, last_region)?;
    let batch = u16_at(bytes, tensor::BATCH).unwrap_or_default();
    ensure_equal(Check::TensorBatch, place, batch, u16::from(!scratch))?;
    let dims = [record.shape.height, record.shape.width, record.shape.channels];
    let has_shape = if scratch { dims == [0; 3] } else { dims.iter().all(|dim| *dim != 0) };
    ensure(Check::TensorShape, place, has_shape, shown(record.shape.elements()), i64::from(!scratch))?;
    let implied = record.shape.elements().saturating_mul(record.element.bytes().into());
    let length = u64::from(record.bytes);
    let exact = if scratch { length != 0 } else { length == implied };
    ensure(Check::TensorBytes, place, exact, shown(length), shown(implied.max(1)))?;
    let remainder = index(record.offset) % layout::ARENA_OFFSET_ALIGNMENT;
    ensure_equal(Check::TensorAlignment, place, shown(remainder as u64), 0)?;
    let room = image.region(record.region).unwrap_or_default().bytes;
    ensure(Check::TensorInside, place, record.end() <= u64::from(room), shown(record.end()), room)?;
    let ordered = record.first_step <= record.last_step && record.last_step < image.step_count;
    ensure(Check::TensorLive, place, ordered, record.last_step, image.step_count.saturating_sub(1))?;
    if scratch { check_scratch_use(image, id, &record) } else { check_tensor_use(image, id, &record) }
}

fn check_scratch_use(image: &Image<'_>, id: u16, record: &TensorRecord) -> Result<(), ParseError> {
    let place = Place::Tensor(id);
    let one_step = record.first_step == record.last_step;
    let user = image.step(record.first_step).and_then(|step| step.scratch());
    let used = one_step && user == Some(TensorId(id));
    ensure(Check::ScratchOneStep, place, used, record.last_step, record.first_step)?;
    ensure(Check::TensorInPlace, place, record.in_place_of.is_none(), stored(record.in_place_of), tensor::NOT_IN_PLACE)
}

/// `first_step` writes the tensor and `last_step` reads it, unless it is an input or an output.
fn check_tensor_use(image: &Image<'_>, id: u16, record: &TensorRecord) -> Result<(), ParseError> {
    let place = Place::Tensor(id);
    let id = TensorId(id);
    let last = image.step_count.saturating_sub(1);
    if image.is_input(id) {
        ensure_equal(Check::InputFirstStep, place, record.first_step, 0)?;
        let own = record.in_place_of.is_none();
        ensure(Check::TensorInPlace, place, own, stored(record.in_place_of), tensor::NOT_IN_PLACE)?;
    } else {
        let writes = image.step(record.first_step).is_some_and(|step| step.output() == id);
        ensure(Check::TensorWritten, place, writes, record.first_step, record.first_step)?;
    }
    if image.is_output(id) {
        return ensure_equal(Check::TensorOutputLive, place, record.last_step, last);
    }
    let reads = image.step(record.last_step).is_some_and(|step| step.reads().contains(&Some(id)));
    // An input that nobody reads holds its place until step 0 only.
    let unused_input = image.is_input(id) && record.last_step == 0;
    ensure(Check::TensorLastUse, place, reads || unused_input, record.last_step, last)
}

fn stored(in_place_of: Option<TensorId>) -> u16 {
    in_place_of.map_or(tensor::NOT_IN_PLACE, |id| id.0)
}

/// Inputs and outputs name distinct tensors; inputs lie apart.
fn check_ports(image: &Image<'_>) -> Result<(), ParseError> {
    for number in 0..image.input_count {
        let record = check_port(image, Place::Input(number), image.input(number))?;
        for other in (0..number).filter_map(|other| image.input(other)) {
            let same = image.input(number).is_some_and(|port| port.tensor == other.tensor);
            ensure(Check::PortRepeated, Place::Input(number), !same, other.tensor.0, other.tensor.0)?;
            let apart = record.zip(image.tensor(other.tensor)).is_none_or(|(a, b)| !a.overlaps(&b));
            ensure(Check::InputOverlap, Place::Input(number), same || apart, other.tensor.0, other.tensor.0)?;
        }
    }
    for number in 0..image.output_count {
        check_port(image, Place::Output(number), image.output(number))?;
        for other in (0..number).filter_map(|other| image.output(other)) {
            let same = image.output(number).is_some_and(|port| port.tensor == other.tensor);
            ensure(Check::PortRepeated, Place::Output(number), !same, other.tensor.0, other.tensor.0)?;
        }
    }
    Ok(())
}

fn check_port(image: &Image<'_>, place: Place, port: Option<Port<'_>>) -> Result<Option<TensorRecord>, ParseError> {
    ensure(Check::PortText, place, port.is_some(), 0, 0)?;
    let Some(port) = port else { return Ok(None) };
    let usable = port.scale.is_finite() && port.scale > 0.0;
    ensure(Check::PortScale, place, usable, port.scale.to_bits(), 1.0_f32.to_bits())?;
    let record = image.tensor(port.tensor).filter(|record| record.element != ElementType::Scratch);
    let last = image.tensor_count.saturating_sub(1);
    ensure(Check::PortTensor, place, record.is_some(), port.tensor.0, last)?;
    let allowed = record.map_or(0..=0, |record| record.element.zero_points());
    ensure(Check::PortZeroPoint, place, allowed.contains(&port.zero_point), port.zero_point, *allowed.start())?;
    Ok(record)
}

/// Every step over the whole table; returns the work of one inference.
fn check_program(image: &Image<'_>) -> Result<u64, ParseError> {
    let (mut work, mut features) = (0_u64, 0);
    for position in 0..image.step_count {
        let Some(step) = image.step(position) else { continue };
        let context = StepContext { image, position };
        context.check_operands(&step)?;
        context.check_overlaps(&step)?;
        work = work.saturating_add(ops::validate(&step, &context)?);
        ensure(Check::Work, Place::Step(position), work <= layout::MAX_WORK, shown(work), shown(layout::MAX_WORK))?;
        features |= step.feature() | step.kernel().map_or(0, |kernel| kernel.feature());
    }
    ensure_equal(Check::StepFeatures, at(&header::FEATURES), shown(image.features), shown(features))?;
    Ok(work)
}
