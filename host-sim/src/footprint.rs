//! What a firmware takes: flash and RAM by section, code by part of the program, and the deepest stack of a function.
//!
//! Everything is read from the linked ELF. A bound of the stack needs the frames' sizes, which the compiler writes where
//! it is asked to (`-Z emit-stack-sizes`); see [`stack`].

use crate::report::json::SCHEMA;
use elf::{Elf, Section};
use model_compiler::error::{Error, ErrorCode, Result};
use schemars::JsonSchema;
use serde::Serialize;
use stack::CallGraph;
use std::path::Path;

mod calls;
mod elf;
pub mod stack;

/// The measure of some programs.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, JsonSchema)]
pub struct FootprintReport {
    /// Version of this document.
    pub schema: u32,
    /// In the order of the command line.
    pub programs: Vec<Footprint>,
}

/// The measure of one program.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, JsonSchema)]
pub struct Footprint {
    /// Path of the ELF.
    pub file: String,
    /// What has to be flashed: code, constants and the first values of variables, bytes.
    pub flash_bytes: u64,
    /// Variables, bytes; neither stack nor memory that the program takes by its address.
    pub ram_bytes: u64,
    /// Sections that take memory of the machine, by address.
    pub sections: Vec<SectionSize>,
    /// Code by part of the program, largest first.
    pub code: Vec<PartSize>,
    /// Bounds of the stack, in the order asked for.
    pub stack: Vec<stack::Bound>,
}

/// A section.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, JsonSchema)]
pub struct SectionSize {
    /// Name, as the linker script gives it.
    pub name: String,
    /// Where it lies when the program runs.
    pub address: u64,
    /// Size, bytes.
    pub bytes: u64,
    /// It has contents, which have to be flashed.
    pub flash: bool,
    /// The program writes it.
    pub ram: bool,
}

/// Functions that belong together.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, JsonSchema)]
pub struct PartSize {
    /// Crate, of the firmware also the module; `runtime` for what has no path (memory functions, division, start-up).
    pub part: String,
    /// Code, bytes; functions that were inlined count where they were.
    pub bytes: u64,
    /// Functions.
    pub functions: usize,
}

/// Measures a program, and bounds the stack of its functions whose path ends with one of `roots`.
///
/// # Errors
/// The file cannot be read, is no ELF of a machine that is known here, or has no such function.
pub fn measure(path: &Path, roots: &[String]) -> Result<Footprint> {
    let bytes = std::fs::read(path).map_err(|e| Error::io(path, &e))?;
    let elf = Elf::parse(&path.display().to_string(), &bytes)?;
    let sections: Vec<SectionSize> = elf.sections.iter().filter(|section| section.bytes > 0).map(of_section).collect();
    let sum = |counts: fn(&SectionSize) -> bool| sections.iter().filter(|s| counts(s)).map(|s| s.bytes).sum();
    let stack = if roots.is_empty() { Vec::new() } else { bounds(&elf, roots)? };
    Ok(Footprint {
        file: elf.file.clone(),
        flash_bytes: sum(|section| section.flash),
        ram_bytes: sum(|section| section.ram),
        code: parts(&elf),
        sections,
        stack,
    })
}

/// Measures programs.
///
/// # Errors
/// Those of [`measure`].
pub fn report(paths: &[impl AsRef<Path>], roots: &[String]) -> Result<FootprintReport> {
    let programs = paths.iter().map(|path| measure(path.as_ref(), roots)).collect::<Result<_>>()?;
    Ok(FootprintReport { schema: SCHEMA, programs })
}

fn of_section(section: &Section) -> SectionSize {
    let Section { name, address, bytes, has_contents, is_writable } = section;
    SectionSize { name: name.clone(), address: *address, bytes: *bytes, flash: *has_contents, ram: *is_writable }
}

fn bounds(elf: &Elf<'_>, roots: &[String]) -> Result<Vec<stack::Bound>> {
    let graph = CallGraph::of(elf);
    let bound = |root: &String| {
        graph.bound(root).ok_or_else(|| {
            let message = format!("no function is called {root}");
            let help = "give the end of its path as `main` or `measure::step`; it may have been inlined";
            Error::new(ErrorCode::Usage, elf.file.clone(), message).with_help(help)
        })
    };
    roots.iter().map(bound).collect()
}

fn parts(elf: &Elf<'_>) -> Vec<PartSize> {
    let mut parts: Vec<PartSize> = Vec::new();
    for function in &elf.functions {
        let part = part_of(&function.name);
        let at = parts.iter().position(|other| other.part == part).unwrap_or_else(|| {
            parts.push(PartSize { part, bytes: 0, functions: 0 });
            parts.len() - 1
        });
        parts[at].bytes += function.code.len() as u64;
        parts[at].functions += 1;
    }
    parts.sort_by(|a, b| b.bytes.cmp(&a.bytes).then_with(|| a.part.cmp(&b.part)));
    parts
}

/// `firmware::ops` of `<firmware::ops::X as core::fmt::Debug>::fmt`, `core` of `core::fmt::write`.
fn part_of(name: &str) -> String {
    let path = name.trim_start_matches(|c: char| !(c.is_alphanumeric() || c == '_'));
    let path = path.trim_start_matches("mut ");
    let end = path.find(|c: char| !(c.is_alphanumeric() || c == '_' || c == ':')).unwrap_or(path.len());
    let mut segments = path[..end].split("::").filter(|segment| !segment.is_empty());
    match (segments.next(), segments.next()) {
        (Some("firmware"), Some(module)) => format!("firmware::{module}"),
        (Some(krate), Some(_)) => krate.to_owned(),
        _ => "runtime".to_owned(),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn functions_belong_to_crates_and_modules() {
        for (name, part) in [
            ("firmware::ops::conv2d::run", "firmware::ops"),
            ("<firmware::drive::Driver as core::fmt::Debug>::fmt", "firmware::drive"),
            ("<&mut firmware::image::Image as core::fmt::Debug>::fmt", "firmware::image"),
            ("core::fmt::write", "core"),
            ("__aeabi_uldivmod", "runtime"),
            ("main", "runtime"),
        ] {
            assert_eq!(part_of(name), part, "{name}");
        }
    }

    #[test]
    fn what_is_no_elf_is_refused_by_name() {
        let file = tempfile::NamedTempFile::new().unwrap();
        std::fs::write(file.path(), b"not an ELF").unwrap();
        let error = measure(file.path(), &[]).unwrap_err();
        assert_eq!(error.code, ErrorCode::Malformed);
        assert_eq!(error.location, file.path().display().to_string());
    }
}
