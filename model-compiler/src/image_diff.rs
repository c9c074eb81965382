//! What changed between two images: header, ports, sections, steps and their constants.
//!
//! Images name no steps. Steps that give the same bytes in the known answer are the same, wherever a schedule puts them.
//! The rest is matched by position where it has the same operators in the same order, else by operator and output shape
//! along the longest common sequence. Positions, tensor ids and places of constants are no changes by themselves:
//! constants are compared by content, operands by shape and type.

use crate::artifact::{hex, sha256};
use crate::error::{Error, ErrorCode, Result};
use firmware::image::{Image, Port, Region, SectionKind, TensorRecord};
use firmware::program::{ConstRange, Step};
use firmware::tensor::{ElementType, TensorId};
use serde::Serialize;
use serde_json::Value;
use similar::{Algorithm, DiffOp, capture_diff_slices};

mod fields;

/// Changes from one image to another. Empty lists where nothing changed.
#[derive(Clone, Debug, PartialEq, Eq, Serialize)]
pub struct ImageDiff {
    /// The files are equal byte for byte.
    pub equal: bool,
    /// Name, digests, sizes, counts, features, and the whole of each file.
    pub header: Vec<Change>,
    /// Inputs and outputs: shape, type, scale, zero point.
    pub ports: Vec<Change>,
    /// Sections whose bytes differ.
    pub sections: Vec<SectionChange>,
    /// Steps that were added, removed or changed, in the order of execution.
    pub steps: Vec<StepChange>,
}

/// A value in both images; `None` where one has none.
#[derive(Clone, Debug, PartialEq, Eq, Serialize)]
pub struct Change {
    /// What it is.
    pub what: String,
    /// Before.
    pub before: Option<String>,
    /// After.
    pub after: Option<String>,
}

/// A section whose bytes differ.
#[derive(Clone, Debug, PartialEq, Eq, Serialize)]
pub struct SectionChange {
    /// Name.
    pub section: &'static str,
    /// Bytes before.
    pub before_bytes: usize,
    /// Bytes after.
    pub after_bytes: usize,
    /// CRC-32 before.
    pub before_crc: String,
    /// CRC-32 after.
    pub after_crc: String,
}

/// A step of one image or of both.
#[derive(Clone, Debug, PartialEq, Eq, Serialize)]
pub struct StepChange {
    /// Operator.
    pub op: &'static str,
    /// Position before; `None` for an added step.
    pub before: Option<u16>,
    /// Position after; `None` for a removed step.
    pub after: Option<u16>,
    /// Fields, output and operands, place in the arena.
    pub fields: Vec<Change>,
    /// Weights, multipliers, tables.
    pub constants: Vec<ConstantChange>,
    /// The known answer's CRC of its output differs.
    pub answer: bool,
}

/// Constants of a step that differ.
#[derive(Clone, Debug, PartialEq, Eq, Serialize)]
pub struct ConstantChange {
    /// Which of its constants.
    pub what: String,
    /// Bytes before.
    pub before_bytes: usize,
    /// Bytes after.
    pub after_bytes: usize,
    /// Bytes that differ; what one has more than the other differs.
    pub different_bytes: usize,
}

/// Compares two parsed images.
///
/// # Errors
/// `Malformed` where an image changed after it was parsed.
pub fn diff(before: &Image<'_>, after: &Image<'_>) -> Result<ImageDiff> {
    Ok(ImageDiff {
        equal: before.bytes() == after.bytes(),
        header: changes(&header(before), &header(after)),
        ports: changes(&ports(before)?, &ports(after)?),
        sections: SectionKind::ALL.into_iter().filter_map(|kind| section(kind, before, after)).collect(),
        steps: steps(before, after)?,
    })
}

/// Facts by name.
type Facts = Vec<(String, String)>;

/// Facts that differ: in the order of the first list, then what the second has alone.
fn changes(before: &Facts, after: &Facts) -> Vec<Change> {
    let value = |facts: &Facts, name: &str| facts.iter().find(|(n, _)| n == name).map(|(_, value)| value.clone());
    let names = before.iter().chain(after.iter().filter(|(name, _)| value(before, name).is_none())).map(|(n, _)| n);
    let change = |what: &String| Change { what: what.clone(), before: value(before, what), after: value(after, what) };
    names.map(change).filter(|change| change.before != change.after).collect()
}

fn header(image: &Image<'_>) -> Facts {
    let facts = [
        ("name", image.name().to_owned()),
        ("bytes", image.bytes().len().to_string()),
        ("sha256", hex(&sha256(image.bytes()))),
        ("qmodel", hex(&image.qmodel_digest())),
        ("build", hex(&image.build_digest())),
        ("features", format!("{:#x}", image.features())),
        ("target", image.target().to_owned()),
        ("revision", image.revision().to_string()),
        ("steps", image.step_count().to_string()),
        ("tensors", image.tensor_count().to_string()),
        ("work", image.work().to_string()),
        ("known answer's seed", image.known_answer().map_or("none".into(), |answer| answer.seed().to_string())),
    ];
    let facts = facts.map(|(name, value)| (name.to_owned(), value));
    let regions = image.regions().map(|Region { name, bytes, alignment }| {
        (format!("arena {}", name.as_str()), format!("{bytes} B, aligned to {alignment}"))
    });
    facts.into_iter().chain(regions).collect()
}

fn ports(image: &Image<'_>) -> Result<Facts> {
    let inputs = (0..image.input_count()).map(|number| ("input", image.input(number)));
    let outputs = (0..image.output_count()).map(|number| ("output", image.output(number)));
    inputs.chain(outputs).map(|(direction, port)| port_fact(image, direction, port.ok_or_else(changed)?)).collect()
}

fn port_fact(image: &Image<'_>, direction: &str, port: Port<'_>) -> Result<(String, String)> {
    let record = image.tensor(port.tensor).ok_or_else(changed)?;
    let value = format!("{}, scale {}, zero point {}", shape(&record), port.scale, port.zero_point);
    Ok((format!("{direction} {}", port.name), value))
}

fn section(kind: SectionKind, before: &Image<'_>, after: &Image<'_>) -> Option<SectionChange> {
    let (a, b) = (before.section(kind), after.section(kind));
    let crc = |image: &Image<'_>| format!("{:08x}", image.section_crc(kind));
    (a != b).then(|| SectionChange {
        section: kind.name(),
        before_bytes: a.len(),
        after_bytes: b.len(),
        before_crc: crc(before),
        after_crc: crc(after),
    })
}

/// A step with what it is compared by.
struct Placed<'a> {
    image: &'a Image<'a>,
    position: u16,
    step: Step,
    output: TensorRecord,
}

fn program<'a>(image: &'a Image<'a>) -> Result<Vec<Placed<'a>>> {
    let placed = |position| {
        let step = image.step(position).ok_or_else(changed)?;
        let output = image.tensor(step.output()).ok_or_else(changed)?;
        Ok(Placed { image, position, step, output })
    };
    (0..image.step_count()).map(placed).collect()
}

fn steps(before: &Image<'_>, after: &Image<'_>) -> Result<Vec<StepChange>> {
    let (before, after) = (program(before)?, program(after)?);
    let mut found = Vec::new();
    let (mut rest, mut unmatched): (Vec<&Placed<'_>>, Vec<&Placed<'_>>) = (Vec::new(), after.iter().collect());
    for step in &before {
        match unmatched.iter().position(|other| step.is_the_same(other)) {
            Some(same) => found.extend(changed_step(step, unmatched.remove(same))?),
            None => rest.push(step),
        }
    }
    let ops = |steps: &[&Placed<'_>]| steps.iter().map(|p| p.step.name()).collect::<Vec<_>>();
    let keys = |steps: &[&Placed<'_>]| steps.iter().map(|p| (p.step.name(), shape(&p.output))).collect::<Vec<_>>();
    let matched = if ops(&rest) == ops(&unmatched) {
        vec![DiffOp::Equal { old_index: 0, new_index: 0, len: rest.len() }]
    } else {
        capture_diff_slices(Algorithm::Myers, &keys(&rest), &keys(&unmatched))
    };
    for operation in matched {
        let (_, old, new) = operation.as_tag_tuple();
        let pairs = if matches!(operation, DiffOp::Equal { .. }) { old.len() } else { 0 };
        for (a, b) in rest[old.clone()].iter().zip(&unmatched[new.clone()]).take(pairs) {
            found.extend(changed_step(a, b)?);
        }
        found.extend(rest[old].iter().skip(pairs).map(|step| lone_step(Some(step), None)));
        found.extend(unmatched[new].iter().skip(pairs).map(|step| lone_step(None, Some(step))));
    }
    found.sort_by_key(|change| (change.after.or(change.before), change.before));
    Ok(found)
}

impl Placed<'_> {
    /// CRC-32 of its output in the known answer.
    fn answer(&self) -> Option<u32> {
        self.image.known_answer().and_then(|answer| answer.step_crc(self.position))
    }

    /// Same operator, output and answer.
    fn is_the_same(&self, other: &Self) -> bool {
        let same_output = shape(&self.output) == shape(&other.output) && self.answer() == other.answer();
        same_output && self.answer().is_some() && self.step.name() == other.step.name()
    }
}

fn lone_step(before: Option<&Placed<'_>>, after: Option<&Placed<'_>>) -> StepChange {
    let output = |step: Option<&Placed<'_>>| step.map(|step| shape(&step.output));
    StepChange {
        op: before.or(after).map_or("", |step| step.step.name()),
        before: before.map(|step| step.position),
        after: after.map(|step| step.position),
        fields: vec![Change { what: "output".into(), before: output(before), after: output(after) }],
        constants: vec![],
        answer: false,
    }
}

/// `None` where the steps do the same.
fn changed_step(before: &Placed<'_>, after: &Placed<'_>) -> Result<Option<StepChange>> {
    let (a, b) = (fields::of(&before.step)?, fields::of(&after.step)?);
    let facts = |placed: &Placed<'_>, fields: &fields::Fields| -> Result<Facts> {
        let operand =
            |(name, id): &(String, TensorId)| Ok((name.clone(), shape(&placed.image.tensor(*id).ok_or_else(changed)?)));
        let operands = fields.tensors.iter().map(operand).collect::<Result<Facts>>()?;
        let TensorRecord { region, offset, .. } = placed.output;
        let name = placed.image.region(region).ok_or_else(changed)?.name;
        let offset = ("arena offset".to_owned(), format!("{} {offset}", name.as_str()));
        Ok([operands, fields.numbers.clone(), vec![offset]].concat())
    };
    let change = StepChange {
        op: before.step.name(),
        before: Some(before.position),
        after: Some(after.position),
        fields: changes(&facts(before, &a)?, &facts(after, &b)?),
        constants: constants(before, &a, after, &b)?,
        answer: before.answer() != after.answer(),
    };
    Ok((!change.fields.is_empty() || !change.constants.is_empty() || change.answer).then_some(change))
}

fn constants(
    before: &Placed<'_>,
    before_fields: &fields::Fields,
    after: &Placed<'_>,
    after_fields: &fields::Fields,
) -> Result<Vec<ConstantChange>> {
    let bytes = |placed: &Placed<'_>, fields: &fields::Fields, name: &str| -> Result<Vec<u8>> {
        let range = fields.constants.iter().find(|(n, _)| n == name).map(|(_, range)| *range);
        let bytes = range.map(|range: ConstRange| placed.image.constants::<u8>(range).ok_or_else(changed));
        Ok(bytes.transpose()?.unwrap_or_default().to_vec())
    };
    let mut names: Vec<&String> = before_fields.constants.iter().map(|(name, _)| name).collect();
    names.extend(after_fields.constants.iter().map(|(n, _)| n).filter(|n| !before_fields.has_constant(n)));
    let mut found = Vec::new();
    for name in names {
        let (a, b) = (bytes(before, before_fields, name)?, bytes(after, after_fields, name)?);
        if a != b {
            let common = a.iter().zip(&b).filter(|(a, b)| a != b).count();
            found.push(ConstantChange {
                what: name.clone(),
                before_bytes: a.len(),
                after_bytes: b.len(),
                different_bytes: common + a.len().abs_diff(b.len()),
            });
        }
    }
    Ok(found)
}

fn shape(record: &TensorRecord) -> String {
    let element = match record.element {
        ElementType::I8 => "i8",
        ElementType::I16 => "i16",
        ElementType::I32 => "i32",
        ElementType::Scratch => return format!("scratch of {} B", record.bytes),
    };
    format!("{element} {}×{}×{}", record.shape.height, record.shape.width, record.shape.channels)
}

fn changed() -> Error {
    Error::new(ErrorCode::Malformed, "", "the image changed while it was read").with_help("compare again")
}
