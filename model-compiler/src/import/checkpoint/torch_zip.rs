//! The zip archive `torch.save` writes since 1.6: `<root>/data.pkl`, and `<root>/data/<key>` per storage.

use std::borrow::Cow;
use std::io::{Cursor, Read};

use zip::ZipArchive;
use zip::result::ZipError;

use crate::error::{Error, ErrorCode, Result};

use super::pickle::{Pickle, Source};
use super::tensor_view::StorageRef;
use super::{Contents, malformed, output_budget, quoted, state_dict};

/// Reads an archive.
pub(super) fn parse(bytes: &[u8]) -> Result<Contents> {
    let mut archive = Archive::open(bytes)?;
    archive.refuse_torchscript()?;
    archive.check_byte_order()?;
    let name = format!("{}data.pkl", archive.root);
    let program = archive.file(&name)?;
    let pickle = Pickle::load(Source { bytes: &program, start: 0, file: &name })?;
    if pickle.end != program.len() {
        let message = format!("found {} bytes after the pickle, expected its end", program.len() - pickle.end);
        return Err(malformed(format!("{name}: byte {}", pickle.end), message));
    }
    state_dict::read(&pickle, bytes.len(), |storage| archive.storage(storage).map(Cow::Owned))
}

struct Archive<'a> {
    zip: ZipArchive<Cursor<&'a [u8]>>,
    /// Folder of all entries, with its slash.
    root: String,
    /// Bytes that may still be unpacked: an archive of a few bytes can claim any size.
    budget: usize,
}

impl<'a> Archive<'a> {
    fn open(bytes: &'a [u8]) -> Result<Self> {
        let zip = ZipArchive::new(Cursor::new(bytes)).map_err(|error| zip_error("zip archive", &error))?;
        check_extent(&zip, bytes)?;
        let root = find_root(&zip)?;
        Ok(Self { zip, root, budget: output_budget(bytes.len()) })
    }

    fn contains(&self, name: &str) -> bool {
        self.zip.index_for_name(&format!("{}{name}", self.root)).is_some()
    }

    fn refuse_torchscript(&self) -> Result<()> {
        if !self.contains("constants.pkl") {
            return Ok(());
        }
        let message = "found a TorchScript program (constants.pkl), expected a state dict";
        Err(Error::new(ErrorCode::Unsupported, "zip archive", message)
            .with_help("load it with torch.jit.load and save the weights alone: torch.save(model.state_dict(), FILE)"))
    }

    /// Archives before torch 2.1 say nothing and are little-endian.
    fn check_byte_order(&mut self) -> Result<()> {
        if !self.contains("byteorder") {
            return Ok(());
        }
        let name = format!("{}byteorder", self.root);
        let order = self.file(&name)?;
        if order == b"little" {
            return Ok(());
        }
        let shown = order.get(..order.len().min(16)).unwrap_or_default().escape_ascii();
        let message = format!("found \"{shown}\", expected \"little\"");
        Err(Error::new(ErrorCode::Unsupported, name, message)
            .with_help("save the checkpoint on a little-endian machine"))
    }

    /// A storage's bytes, exactly as many as the pickle claims.
    fn storage(&mut self, storage: &StorageRef) -> Result<Vec<u8>> {
        let name = format!("{}data/{}", self.root, storage.key);
        let bytes = self.file_where(&name, |size| {
            let found = usize::try_from(size).ok();
            if found.is_some() && found == storage.bytes() {
                return Ok(());
            }
            let (elements, width) = (storage.elements, storage.dtype.bytes());
            Err(malformed(&name, format!("found {size} bytes, expected {elements} elements of {width} bytes")))
        })?;
        Ok(bytes)
    }

    fn file(&mut self, name: &str) -> Result<Vec<u8>> {
        self.file_where(name, |_| Ok(()))
    }

    /// An entry's bytes, if `accept` agrees with its size. Entries are checked against their CRC while they are read.
    fn file_where(&mut self, name: &str, accept: impl FnOnce(u64) -> Result<()>) -> Result<Vec<u8>> {
        let place = quoted(name);
        let entry = self.zip.by_name(name).map_err(|error| zip_error(&place, &error))?;
        let size = entry.size();
        accept(size)?;
        let length = usize::try_from(size).ok().filter(|&length| length <= self.budget).ok_or_else(|| {
            malformed(&place, format!("found a claim of {size} bytes, expected at most {}", self.budget))
        })?;
        self.budget -= length;
        let mut bytes = Vec::new();
        // One byte more than claimed, to see a longer entry without unpacking it.
        let read = entry.take(size.saturating_add(1)).read_to_end(&mut bytes);
        read.map_err(|error| malformed(&place, error.to_string()))?;
        if bytes.len() != length {
            return Err(malformed(&place, format!("found {} bytes or more, expected {length}", bytes.len())));
        }
        Ok(bytes)
    }
}

/// An archive may hide before, after or between other data; torch writes none.
fn check_extent(zip: &ZipArchive<Cursor<&[u8]>>, bytes: &[u8]) -> Result<()> {
    const END_RECORD: &[u8] = b"PK\x05\x06";
    const END_RECORD_BYTES: usize = 22;
    if zip.offset() != 0 {
        return Err(malformed("byte 0", format!("found {} bytes before the archive, expected none", zip.offset())));
    }
    let end = bytes.len().checked_sub(END_RECORD_BYTES + zip.comment().len());
    if end.and_then(|end| bytes.get(end..)).is_some_and(|record| record.starts_with(END_RECORD)) {
        return Ok(());
    }
    Err(malformed("end of the file", "found bytes after the zip archive, expected none"))
}

/// The folder that holds `data.pkl`.
fn find_root(zip: &ZipArchive<Cursor<&[u8]>>) -> Result<String> {
    let names = || zip.file_names().filter_map(|name| name.ok());
    let mut roots = names().filter_map(|name| {
        let root = name.strip_suffix("data.pkl")?;
        let is_folder = root.is_empty() || root.find('/') == Some(root.len() - 1);
        is_folder.then(|| root.to_owned())
    });
    match (roots.next(), roots.next()) {
        (Some(root), None) => Ok(root),
        (Some(first), Some(second)) => {
            let message = format!("found {first}data.pkl and {second}data.pkl, expected one");
            Err(malformed("zip archive", message))
        }
        (None, _) => {
            let found: Vec<String> = names().take(4).map(|name| quoted(&name)).collect();
            let message = format!("found no data.pkl among {} entries ({}), expected one", zip.len(), found.join(", "));
            Err(Error::new(ErrorCode::Malformed, "zip archive", message)
                .with_help("this is not a torch checkpoint: save with torch.save(model.state_dict(), FILE)"))
        }
    }
}

fn zip_error(place: &str, error: &ZipError) -> Error {
    match error {
        ZipError::FileNotFound => malformed(place, "found no such entry in the archive, expected one"),
        ZipError::UnsupportedArchive(_) | ZipError::CompressionMethodNotSupported(_) => {
            Error::new(ErrorCode::Unsupported, place, format!("found {error}, expected stored or deflated entries"))
                .with_help("save it again with torch.save, which stores entries as they are")
        }
        _ => malformed(place, format!("found {error}, expected a complete zip archive")),
    }
}
