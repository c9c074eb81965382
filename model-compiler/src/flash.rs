//! An image in the forms that flash tools, linkers and Rust programs take.

use crate::error::{Error, ErrorCode, Result};
use clap::ValueEnum;
use firmware::image::layout;
use std::fmt;
use std::path::Path;
use std::str::FromStr;

mod elf;
mod intel_hex;
mod linker;
mod rust_source;
mod s_record;

pub use elf::Machine;

/// Form of a file that holds an image.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, ValueEnum)]
pub enum Format {
    /// The image itself.
    #[default]
    Img,
    /// Intel HEX with 32-bit addresses.
    Hex,
    /// Motorola S-records with 32-bit addresses (S3, S7).
    Srec,
    /// Relocatable ELF object: section `.model`, symbols `model_start`, `model_end`, `model_size`.
    Elf,
    /// Rust source that includes the image.
    Rs,
}

/// How an image is to be written.
#[derive(Clone, Copy, Debug, Default)]
pub struct Options {
    /// The form.
    pub format: Format,
    /// Where the image lies in the chip's memory; HEX, S-records and linker fragments need it.
    pub address: Option<Address>,
    /// The chip's architecture, for ELF.
    pub machine: Machine,
}

/// Address of an image in the chip's memory: a multiple of 16.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Address(u64);

impl FromStr for Address {
    type Err = String;

    fn from_str(text: &str) -> std::result::Result<Self, String> {
        let digits = text.strip_prefix("0x").or_else(|| text.strip_prefix("0X"));
        let value = digits.map_or_else(|| text.parse(), |digits| u64::from_str_radix(digits, 16));
        let value = value.map_err(|_| format!("found {text:?}, expected an address such as 0x21000000"))?;
        if !value.is_multiple_of(layout::ALIGNMENT as u64) {
            return Err(format!("found {value:#x}, expected a multiple of {}", layout::ALIGNMENT));
        }
        Ok(Self(value))
    }
}

impl fmt::Display for Address {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{:#010x}", self.0)
    }
}

impl Format {
    /// Name of the option's value, which is the usual extension.
    pub const fn name(self) -> &'static str {
        match self {
            Self::Img => "img",
            Self::Hex => "hex",
            Self::Srec => "srec",
            Self::Elf => "elf",
            Self::Rs => "rs",
        }
    }
}

/// The bytes of an image's file. `image_file` is what Rust source includes, as seen from its own folder.
///
/// # Errors
/// `Usage` without an address where the format needs one; `TooBig` where the image ends behind 32-bit addresses.
pub fn file(image: &[u8], name: &str, image_file: &Path, options: &Options) -> Result<Vec<u8>> {
    match options.format {
        Format::Img => Ok(image.to_vec()),
        Format::Hex => intel_hex::file(image, address_32(image, options)?),
        Format::Srec => Ok(s_record::file(image, name, address_32(image, options)?).into_bytes()),
        Format::Elf => elf::object(image, options.machine),
        Format::Rs => rust_source::file(image, image_file).map(String::into_bytes),
    }
}

/// A linker script that gives the image its memory: to be included by `memory.x` of cortex-m-rt, or given to the linker
/// by a `-T` of its own.
///
/// # Errors
/// `Usage` without an address.
pub fn linker_script(image: &[u8], name: &str, options: &Options) -> Result<Vec<u8>> {
    Ok(linker::script(image.len(), name, address(options, "a linker script")?, options.format == Format::Elf)
        .into_bytes())
}

/// The form that a file seems to have, by its first bytes; `None` for everything else, the image itself included.
pub fn form(bytes: &[u8]) -> Option<&'static str> {
    let forms: [(&[u8], _); 3] = [(b"\x7fELF", "an ELF file"), (b":", "Intel HEX"), (b"S0", "a file of S-records")];
    forms.into_iter().find(|(start, _)| bytes.starts_with(start)).map(|(_, form)| form)
}

fn address(options: &Options, what: &str) -> Result<Address> {
    options.address.ok_or_else(|| needs_address(what))
}

pub(crate) fn needs_address(what: &str) -> Error {
    Error::new(ErrorCode::Usage, "--address", format!("{what} needs the address of the image"))
        .with_help("add --address 0x… (where the image lies in the chip's memory, a multiple of 16)")
}

/// The address of an image that ends within 32 bits.
fn address_32(image: &[u8], options: &Options) -> Result<u32> {
    let address = address(options, options.format.name())?;
    let end = address.0.saturating_add(image.len() as u64);
    let fits = u32::try_from(address.0).ok().filter(|_| end <= 1 << 32);
    fits.ok_or_else(|| {
        let message = format!("the image's {} B at {address} end at {end:#x}, behind 32-bit addresses", image.len());
        Error::new(ErrorCode::TooBig, "--address", message).with_help("choose a lower address, or --format elf")
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn addresses_are_hexadecimal_or_decimal_and_aligned() {
        for (text, value) in [("0x21000000", 0x2100_0000), ("0X10", 16), ("32", 32), ("0", 0)] {
            assert_eq!(text.parse(), Ok(Address(value)));
        }
        for text in ["", "0x", "21000000h", "-16", "0x8", "8", "0x1_0000", "0x10000000000000000"] {
            assert!(text.parse::<Address>().is_err(), "{text}");
        }
    }

    #[test]
    fn the_last_byte_of_a_32_bit_address_space_can_be_used_and_no_more() {
        for (start, image, fits) in [(0xFFFF_FFF0, 16, true), (0xFFFF_FFF0, 32, false), (1 << 32, 0, false)] {
            let options = Options { format: Format::Hex, address: Some(Address(start)), ..Options::default() };
            assert_eq!(address_32(&vec![0; image], &options).is_ok(), fits, "{image} B at {start:#x}");
        }
    }
}
