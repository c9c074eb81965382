//! Images in the forms that flash tools, linkers and Rust programs take: options of `compile`, and `convert`.

use super::check_output;
use crate::artifact;
use crate::emit::AlignedBytes;
use crate::error::{Error, ErrorCode, Result};
use crate::flash::{self, Address, Format, Machine, Options};
use clap::Args;
use firmware::image::Image;
use std::path::{Path, PathBuf};

/// What is written beside or instead of the image itself.
#[derive(Debug, Args)]
pub(super) struct FormArgs {
    /// Form of the output file. compile writes the image itself beside it, with the extension .img.
    #[arg(long, value_enum, default_value = "img")]
    format: Format,
    /// Where the image lies in the chip's memory: hexadecimal or decimal, a multiple of 16.
    #[arg(long)]
    address: Option<Address>,
    /// Architecture of the program that links an ELF object [default: arm].
    #[arg(long, value_enum)]
    machine: Option<Machine>,
    /// Also write a linker script with the image's memory, to be included by memory.x or passed by -T.
    #[arg(long, value_name = "FILE.x", requires = "address")]
    linker: Option<PathBuf>,
}

/// A file to be written.
pub(super) type NewFile = (PathBuf, Vec<u8>);

impl FormArgs {
    /// Refuses options that contradict each other, before minutes of work.
    pub(super) fn check(&self) -> Result<()> {
        let unused = |option: &str, what: &str, help: &str| {
            Err(Error::new(ErrorCode::Usage, option, format!("{what} of --format {}", self.format.name()))
                .with_help(help))
        };
        if self.machine.is_some() && self.format != Format::Elf {
            return unused("--machine", "there is no architecture in a file", "leave it out, or add --format elf");
        }
        if self.linker.is_some() && self.format == Format::Rs {
            return unused(
                "--linker",
                "the image lies among the program's constants in a file",
                "leave it out, or add --format elf",
            );
        }
        let needs_address = matches!(self.format, Format::Hex | Format::Srec);
        if self.address.is_some() && !needs_address && self.linker.is_none() {
            return unused("--address", "there is no address in a file", "leave it out, or add --linker FILE.x");
        }
        if self.address.is_none() && needs_address {
            return Err(flash::needs_address(self.format.name()));
        }
        Ok(())
    }

    /// Where the image itself goes: to the output, or beside it.
    pub(super) fn image_path(&self, output: &Path) -> Result<PathBuf> {
        let beside = if self.format == Format::Img { output.into() } else { output.with_extension("img") };
        if self.format != Format::Img && beside == output {
            let error = Error::new(ErrorCode::Usage, output.display().to_string(), "this name is for the image itself");
            return Err(error.with_help(format!("give the output another extension, such as .{}", self.format.name())));
        }
        Ok(beside)
    }

    /// Names of what [`Self::files`] gives.
    pub(super) fn paths(&self, output: &Path) -> Vec<PathBuf> {
        std::iter::once(output.to_owned()).chain(self.linker.clone()).collect()
    }

    /// The output and the linker script.
    pub(super) fn files(&self, image: &[u8], output: &Path) -> Result<Vec<NewFile>> {
        let (aligned, beside) = (AlignedBytes::from(image), self.image_path(output)?);
        let name = Image::parse(&aligned)?.name();
        let beside = Path::new(beside.file_name().unwrap_or_default());
        let Self { format, address, machine, .. } = *self;
        let options = Options { format, address, machine: machine.unwrap_or_default() };
        let mut files = vec![(output.to_owned(), flash::file(image, name, beside, &options)?)];
        if let Some(linker) = &self.linker {
            files.push((linker.clone(), flash::linker_script(image, name, &options)?));
        }
        Ok(files)
    }
}

/// Writes an image in another form. Rust source includes the image, which is copied to its folder.
pub(super) fn run(input: &Path, forms: &FormArgs, output: &Path) -> Result<String> {
    forms.check()?;
    let image = std::fs::read(input).map_err(|e| Error::io(input, &e))?;
    let is_image = || -> Result<()> { Ok(Image::parse(&AlignedBytes::from(image.as_slice()))?.check()?) };
    is_image().map_err(|e| e.within(input.display()))?;
    let copy = Some(forms.image_path(output)?).filter(|copy| forms.format == Format::Rs && copy != input);
    check_outputs(&[forms.paths(output), copy.iter().cloned().collect()].concat(), input)?;
    let mut files = forms.files(&image, output)?;
    files.extend(copy.map(|copy| (copy, image)));
    write(&files)?;
    Ok(files.iter().map(|(path, bytes)| format!("{}: {} B\n", path.display(), bytes.len())).collect())
}

/// Every output can be written, replaces no input and has a name of its own.
pub(super) fn check_outputs(outputs: &[PathBuf], input: &Path) -> Result<()> {
    for (position, output) in outputs.iter().enumerate() {
        check_output(output, input)?;
        if outputs.iter().take(position).any(|other| other == output) {
            let error = Error::new(ErrorCode::Usage, output.display().to_string(), "two outputs have this name");
            return Err(error.with_help("give each another name"));
        }
    }
    Ok(())
}

pub(super) fn write(files: &[NewFile]) -> Result<()> {
    let files: Vec<(&Path, &[u8])> = files.iter().map(|(path, bytes)| (path.as_path(), bytes.as_slice())).collect();
    artifact::write_files(&files)
}
