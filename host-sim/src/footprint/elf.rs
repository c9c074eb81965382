//! A linked firmware: its sections, its functions with their code, and the frame sizes that the compiler noted.

use model_compiler::error::{Error, ErrorCode, Result};
use object::{
    Architecture, Object as _, ObjectSection as _, ObjectSymbol as _, SectionFlags, SectionKind, SymbolKind, elf,
};
use std::collections::{BTreeMap, BTreeSet};
use std::ops::Range;

/// Instruction sets whose calls are decoded.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum InstructionSet {
    Thumb,
    A64,
}

/// A section that takes memory of the machine.
#[derive(Clone, Debug)]
pub(super) struct Section {
    pub name: String,
    pub address: u64,
    pub bytes: u64,
    pub has_contents: bool,
    pub is_writable: bool,
}

/// A function.
#[derive(Clone, Debug)]
pub(super) struct Function<'a> {
    pub name: String,
    pub address: u64,
    pub code: &'a [u8],
    /// Parts of the code that are no instructions (tables, literals), from its start.
    pub data: Vec<Range<usize>>,
    /// Bytes of its stack frame, as the compiler notes them.
    pub frame: Option<u64>,
}

/// A linked program.
#[derive(Debug)]
pub(super) struct Elf<'a> {
    pub file: String,
    pub instruction_set: InstructionSet,
    /// By address.
    pub sections: Vec<Section>,
    /// By address.
    pub functions: Vec<Function<'a>>,
}

impl<'a> Elf<'a> {
    /// Reads what is needed of an ELF.
    ///
    /// # Errors
    /// It is no ELF, or of another machine.
    pub fn parse(file: &str, bytes: &'a [u8]) -> Result<Self> {
        let malformed = |error: object::Error| {
            let error = Error::new(ErrorCode::Malformed, file, format!("this is no ELF: {error}"));
            error.with_help("give the linked program, as `target/mcu/thumbv7em-none-eabihf/release/an386-drive`")
        };
        let object = object::File::parse(bytes).map_err(malformed)?;
        let instruction_set = match object.architecture() {
            Architecture::Arm => InstructionSet::Thumb,
            Architecture::Aarch64 => InstructionSet::A64,
            other => {
                let error = Error::new(ErrorCode::Unsupported, file, format!("a program for {other:?}"));
                return Err(error.with_help("Cortex-M (Thumb) and 64-bit Arm are known"));
            }
        };
        let mut sections: Vec<Section> = object.sections().filter_map(|section| allocated(&section)).collect();
        sections.sort_by_key(|section| section.address);
        let frames = frames(&object).map_err(malformed)?;
        let functions = functions(&object, &frames).map_err(malformed)?;
        Ok(Self { file: file.to_owned(), instruction_set, sections, functions })
    }
}

fn allocated<'d>(section: &impl object::ObjectSection<'d>) -> Option<Section> {
    let SectionFlags::Elf { sh_flags, .. } = section.flags() else { return None };
    (sh_flags.0 & elf::SHF_ALLOC.0 != 0).then(|| Section {
        name: section.name().unwrap_or("?").to_owned(),
        address: section.address(),
        bytes: section.size(),
        has_contents: section.kind() != SectionKind::UninitializedData,
        is_writable: sh_flags.0 & elf::SHF_WRITE.0 != 0,
    })
}

/// Frame sizes by address of the function: records of an address and an unsigned LEB128 (LLVM, `-stack-size-section`).
fn frames(object: &object::File<'_>) -> object::Result<BTreeMap<u64, u64>> {
    let mut frames = BTreeMap::new();
    let Some(section) = object.section_by_name(".stack_sizes") else { return Ok(frames) };
    let width = if object.is_64() { 8 } else { 4 };
    let mut bytes = section.data()?;
    while let Some((address, rest)) = bytes.split_at_checked(width) {
        let address = address.iter().rev().fold(0, |address, byte| address << 8 | u64::from(*byte));
        let length = rest.iter().position(|byte| byte & 0x80 == 0).map_or(rest.len(), |last| last + 1);
        let (digits, rest) = rest.split_at(length);
        let size = digits.iter().rev().fold(0, |size, byte| size << 7 | u64::from(byte & 0x7F));
        frames.insert(address & !thumb_bit(object), size);
        bytes = rest;
    }
    Ok(frames)
}

/// Addresses of Thumb functions are odd.
fn thumb_bit(object: &object::File<'_>) -> u64 {
    u64::from(object.architecture() == Architecture::Arm)
}

/// Functions by address; of several names of one the first in alphabetical order. One without a size (assembly) ends
/// where the next symbol begins.
fn functions<'a>(object: &object::File<'a>, frames: &BTreeMap<u64, u64>) -> object::Result<Vec<Function<'a>>> {
    let mut names: BTreeMap<u64, (String, u64)> = BTreeMap::new();
    let mut marks: BTreeMap<u64, bool> = BTreeMap::new();
    let mut starts: BTreeSet<u64> = BTreeSet::new();
    for symbol in object.symbols().filter(|symbol| symbol.is_definition() || symbol.kind() == SymbolKind::Unknown) {
        let (name, address) = (symbol.name()?, symbol.address());
        // Mapping symbols ("ELF for the Arm Architecture"): from here on instructions, or data.
        match name.split('.').next() {
            Some("$d") => drop(marks.insert(address, true)),
            Some("$t" | "$x" | "$a") => drop(marks.insert(address, false)),
            _ if symbol.kind() == SymbolKind::Text => {
                let address = address & !thumb_bit(object);
                let name = format!("{:#}", rustc_demangle::demangle(name));
                let entry = names.entry(address).or_insert_with(|| (name.clone(), symbol.size()));
                *entry = (entry.0.clone().min(name), entry.1.max(symbol.size()));
                starts.insert(address);
            }
            _ => {}
        }
    }
    let mut functions = Vec::new();
    for section in object.sections().filter(|section| section.kind() == SectionKind::Text) {
        let (first, bytes) = (section.address(), section.data()?);
        let end_of_section = first + bytes.len() as u64;
        for (&address, (name, size)) in names.range(first..end_of_section) {
            let next = starts.range(address + 1..).next().map_or(end_of_section, |next| *next);
            let end = if *size == 0 { next } else { address + size }.min(end_of_section);
            let code = &bytes[(address - first) as usize..(end - first) as usize];
            let data = data_ranges(&marks, address..end);
            functions.push(Function { name: name.clone(), address, code, data, frame: frames.get(&address).copied() });
        }
    }
    functions.sort_by_key(|function| function.address);
    Ok(functions)
}

/// Where a range holds data, from its start.
fn data_ranges(marks: &BTreeMap<u64, bool>, range: Range<u64>) -> Vec<Range<usize>> {
    let before = marks.range(..=range.start).next_back().is_some_and(|(_, is_data)| *is_data);
    let mut begun = before.then_some(range.start);
    let mut data = Vec::new();
    let end = (range.end, false);
    for (at, is_data) in marks.range(range.start + 1..range.end).map(|(at, is_data)| (*at, *is_data)).chain([end]) {
        match begun {
            Some(from) if !is_data => {
                data.push((from - range.start) as usize..(at - range.start) as usize);
                begun = None;
            }
            None if is_data => begun = Some(at),
            _ => {}
        }
    }
    data
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn data_lies_between_mapping_symbols() {
        let marks = BTreeMap::from([(0, false), (8, true), (12, false), (20, true), (40, false)]);
        assert_eq!(data_ranges(&marks, 0..16), [8..12]);
        assert_eq!(data_ranges(&marks, 4..24), [4..8, 16..20]);
        assert_eq!(data_ranges(&marks, 24..32), [0..8]);
        assert!(data_ranges(&marks, 40..48).is_empty());
    }
}
