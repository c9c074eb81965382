//! Trained weights from a file: named tensors in file order, whatever the container.
//!
//! Three containers are read, recognized by their content and never by the file's name: the zip archive and the legacy
//! stream that `torch.save` writes, and safetensors. A torch file holds a pickle, a program for a stack machine that
//! may call anything; the machine here runs only the few opcodes and globals that build a state dict and refuses the
//! rest by name, so an unknown file is safe to open.
//!
//! Four promises hold for any bytes: no panic; no memory or time beyond a small multiple of the file's length (sizes a
//! file merely claims are checked before anything is allocated); an error that names the place, what was found, what
//! was expected and what to do; and the same checkpoint for the same bytes.

mod element;
mod legacy;
mod pickle;
mod safetensors;
mod state_dict;
mod tensor_view;
mod torch_zip;

use std::collections::HashMap;
use std::path::Path;

use sha2::{Digest, Sha256};

use crate::error::{Error, ErrorCode, Result};

pub(super) use element::decode;
pub use element::{DType, TensorData};

/// Largest file that is opened, in bytes: far above any driving network, far below a host's memory.
const MAX_FILE_BYTES: u64 = 8 << 30;

/// The container a checkpoint was read from.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Format {
    /// `torch.save` since 1.6: a zip archive with a pickle and one file per storage.
    TorchZip,
    /// `torch.save` before 1.6: a sequence of pickles followed by the storages.
    TorchLegacy,
    /// A JSON header followed by the tensors.
    Safetensors,
}

impl Format {
    /// Name for reports.
    pub fn name(self) -> &'static str {
        match self {
            Self::TorchZip => "torch zip",
            Self::TorchLegacy => "torch legacy",
            Self::Safetensors => "safetensors",
        }
    }
}

/// One tensor of a checkpoint, row-major.
#[derive(Clone, Debug, PartialEq)]
pub struct NamedTensor {
    /// Name, as in the model's state dict (without a common `module.`).
    pub name: String,
    /// Extents, outermost first; empty for a scalar. Their product never overflows.
    pub shape: Vec<usize>,
    /// Element type in the file.
    pub dtype: DType,
    /// Elements, converted: every floating type to `f32`, every integer type to `i64`.
    pub data: TensorData,
}

impl NamedTensor {
    /// The elements of a floating tensor; `None` for an integer one.
    pub fn floats(&self) -> Option<&[f32]> {
        match &self.data {
            TensorData::Float(values) => Some(values),
            TensorData::Integer(_) => None,
        }
    }

    /// The elements of an integer tensor; `None` for a floating one.
    pub fn integers(&self) -> Option<&[i64]> {
        match &self.data {
            TensorData::Float(_) => None,
            TensorData::Integer(values) => Some(values),
        }
    }

    /// Index per axis and value of the first NaN or infinity. An `f64` beyond the range of `f32` counts as infinite.
    pub fn first_non_finite(&self) -> Option<(Vec<usize>, f32)> {
        let values = self.floats()?;
        let mut flat = values.iter().position(|value| !value.is_finite())?;
        let value = values[flat];
        let mut index = vec![0; self.shape.len()];
        for (axis, &extent) in self.shape.iter().enumerate().rev() {
            (index[axis], flat) = (flat % extent, flat / extent);
        }
        Some((index, value))
    }
}

/// Everything a checkpoint file says about a model.
#[derive(Clone, Debug)]
pub struct Checkpoint {
    tensors: Vec<NamedTensor>,
    index: HashMap<String, usize>,
    skipped: Vec<String>,
    sha256: [u8; 32],
    format: Format,
}

impl Checkpoint {
    /// The tensors, in file order; at least one.
    pub fn tensors(&self) -> &[NamedTensor] {
        &self.tensors
    }

    /// Gives up the tensors, in file order.
    pub fn into_tensors(self) -> Vec<NamedTensor> {
        self.tensors
    }

    /// The tensor of this name.
    pub fn get(&self, name: &str) -> Option<&NamedTensor> {
        self.index.get(name).map(|&at| &self.tensors[at])
    }

    /// Names of entries around and among the tensors that were not read (an epoch, hyper-parameters), in file order.
    pub fn skipped(&self) -> &[String] {
        &self.skipped
    }

    /// SHA-256 of the whole file.
    pub fn sha256(&self) -> &[u8; 32] {
        &self.sha256
    }

    /// The container.
    pub fn format(&self) -> Format {
        self.format
    }

    /// Floating tensors that hold a NaN or an infinity; the importer refuses those it uses.
    pub fn non_finite(&self) -> impl Iterator<Item = &NamedTensor> {
        self.tensors.iter().filter(|tensor| tensor.first_non_finite().is_some())
    }

    /// Gives every tensor its name in the index and removes `module.`, which `DataParallel` puts before every name.
    fn new(mut contents: Contents, sha256: [u8; 32], format: Format) -> Result<Self> {
        const DATA_PARALLEL: &str = "module.";
        if contents.tensors.is_empty() {
            return Err(Error::new(ErrorCode::Tensors, "", "no tensors found, expected the weights of a network")
                .with_help("save the weights: torch.save(model.state_dict(), FILE)"));
        }
        if contents.tensors.iter().all(|tensor| tensor.name.starts_with(DATA_PARALLEL)) {
            contents.tensors.iter_mut().for_each(|tensor| drop(tensor.name.drain(..DATA_PARALLEL.len())));
        }
        let index = contents.tensors.iter().enumerate().map(|(at, tensor)| (tensor.name.clone(), at)).collect();
        Ok(Self { tensors: contents.tensors, index, skipped: contents.skipped, sha256, format })
    }
}

/// What a container's reader returns; no name occurs twice.
struct Contents {
    tensors: Vec<NamedTensor>,
    skipped: Vec<String>,
}

/// Reads a checkpoint file.
///
/// # Errors
/// `Io` where the file cannot be read, and those of [`parse`], all naming the file.
pub fn read(path: &Path) -> Result<Checkpoint> {
    let bytes = read_bounded(path)?;
    parse(&bytes).map_err(|error| error.within(path.display()))
}

pub(super) fn read_bounded(path: &Path) -> Result<Vec<u8>> {
    let metadata = std::fs::metadata(path).map_err(|error| Error::io(path, &error))?;
    if metadata.len() > MAX_FILE_BYTES {
        let message = format!("found {} bytes, expected at most {MAX_FILE_BYTES}", metadata.len());
        return Err(Error::new(ErrorCode::Unsupported, path.display().to_string(), message)
            .with_help("save the state dict alone, without the optimizer"));
    }
    std::fs::read(path).map_err(|error| Error::io(path, &error))
}

/// Reads a checkpoint from the bytes of a file, in time and memory bounded by their number.
///
/// # Errors
/// `Malformed` for a damaged or truncated file or one of no known format, `Refused` for a pickle that names anything
/// outside the allow-list, `Unsupported` for an element type, byte order or variant that is not read, `Tensors` where
/// no weights are found. Non-finite values are no error here: see [`Checkpoint::non_finite`].
pub fn parse(bytes: &[u8]) -> Result<Checkpoint> {
    let format = recognize(bytes)?;
    let contents = match format {
        Format::TorchZip => torch_zip::parse(bytes)?,
        Format::TorchLegacy => legacy::parse(bytes)?,
        Format::Safetensors => safetensors::parse(bytes)?,
    };
    Checkpoint::new(contents, Sha256::digest(bytes).into(), format)
}

fn recognize(bytes: &[u8]) -> Result<Format> {
    if bytes.starts_with(b"PK\x03\x04") {
        Ok(Format::TorchZip)
    } else if bytes.first() == Some(&pickle::PROTO) {
        Ok(Format::TorchLegacy)
    } else if bytes.get(8) == Some(&b'{') {
        Ok(Format::Safetensors)
    } else {
        let found = match bytes.get(..bytes.len().min(8)) {
            None | Some([]) => "an empty file".to_owned(),
            Some(start) => format!("a file that begins with \"{}\"", start.escape_ascii()),
        };
        let expected = "expected a torch zip archive (PK), a torch legacy stream (a pickle), safetensors or ONNX";
        let help = if bytes.starts_with(b"version https://git-lfs") {
            "this is a pointer left by Git LFS: fetch the file itself with `git lfs pull`"
        } else {
            "save the weights with torch.save(model.state_dict(), FILE) or safetensors, and check that the download is complete"
        };
        Err(Error::new(ErrorCode::Malformed, "byte 0", format!("found {found}, {expected}")).with_help(help))
    }
}

/// Bytes of converted elements a file may turn into. Views of one storage may overlap, so a few bytes can claim any
/// size; real checkpoints stay below eight bytes out per byte in (`u8` kept as `i64`).
fn output_budget(file_bytes: usize) -> usize {
    file_bytes.saturating_mul(16).saturating_add(16 << 20)
}

/// Text of a file, fit for a message: escaped and cut.
fn quoted(text: &str) -> String {
    const SHOWN: usize = 80;
    match text.char_indices().nth(SHOWN) {
        None => format!("{text:?}"),
        Some((end, _)) => format!("{:?}…", &text[..end]),
    }
}

/// A damaged file; the usual cause is an incomplete copy.
pub(super) fn malformed(place: impl Into<String>, message: impl Into<String>) -> Error {
    Error::new(ErrorCode::Malformed, place, message)
        .with_help("the file is damaged or incomplete: copy or download it again")
}
