//! A relocatable ELF object that a firmware's linker takes.

use crate::error::{Error, ErrorCode, Result};
use clap::ValueEnum;
use firmware::image::layout;
use object::write::{Object, Symbol, SymbolSection};
use object::{
    Architecture, BinaryFormat, Endianness, FileFlags, SectionKind, SymbolFlags, SymbolKind, SymbolScope, elf,
};

/// Section that holds the image.
pub(super) const SECTION: &str = ".model";

/// Architecture of a program that links the image.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, ValueEnum)]
pub enum Machine {
    /// 32-bit Arm: Cortex-M, Cortex-R.
    #[default]
    Arm,
    /// 64-bit Arm: Cortex-A.
    Aarch64,
    /// x86-64.
    #[value(name = "x86-64")]
    X86_64,
}

pub(super) fn object(image: &[u8], machine: Machine) -> Result<Vec<u8>> {
    let architecture = match machine {
        Machine::Arm => Architecture::Arm,
        Machine::Aarch64 => Architecture::Aarch64,
        Machine::X86_64 => Architecture::X86_64,
    };
    let mut object = Object::new(BinaryFormat::Elf, architecture, Endianness::Little);
    if machine == Machine::Arm {
        // Linkers refuse to mix versions of the Arm ABI. Data has no float ABI, so none is stated.
        let e_flags = elf::EF_ARM_EABI_VER5;
        object.flags = FileFlags::Elf { os_abi: elf::ELFOSABI_NONE, abi_version: 0, e_flags };
    }
    let section = object.add_section(Vec::new(), SECTION.into(), SectionKind::ReadOnlyData);
    object.set_section_data(section, image, layout::ALIGNMENT as u64);
    let bytes = image.len() as u64;
    let data = (SymbolSection::Section(section), SymbolKind::Data);
    let symbols = [
        ("model_start", 0, bytes, data),
        ("model_end", bytes, 0, data),
        ("model_size", bytes, 0, (SymbolSection::Absolute, SymbolKind::Data)),
    ];
    for (name, value, size, (section, kind)) in symbols {
        object.add_symbol(Symbol {
            name: name.into(),
            value,
            size,
            kind,
            scope: SymbolScope::Dynamic,
            weak: false,
            section,
            flags: SymbolFlags::None,
        });
    }
    object.write().map_err(|e| Error::new(ErrorCode::TooBig, "ELF object", e.to_string()))
}
