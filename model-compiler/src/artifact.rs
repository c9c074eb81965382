//! Files that the tools write and read back: digest-sealed postcard, written to a temporary name and renamed.
//!
//! Layout: 8 bytes magic · u32 format · u32 zero · 32 bytes SHA-256 of the payload · postcard payload. Little-endian.

use crate::error::{Error, ErrorCode, Result};
use serde::{Serialize, de::DeserializeOwned};
use sha2::{Digest, Sha256};
use std::io::Write;
use std::path::Path;
use tempfile::NamedTempFile;

const HEADER_BYTES: usize = 48;

/// A kind of sealed file.
pub trait Artifact: Serialize + DeserializeOwned {
    /// First 8 bytes of the file.
    const MAGIC: [u8; 8];
    /// What messages call it.
    const KIND: &'static str;
    /// Rises whenever the stored structure changes.
    const FORMAT: u32;
}

impl Artifact for crate::qmodel::QModel {
    const MAGIC: [u8; 8] = *b"QMODEL\r\n";
    const KIND: &'static str = "quantized model";
    const FORMAT: u32 = 2;
}

impl Artifact for crate::record::Record {
    const MAGIC: [u8; 8] = *b"QRECORD\n";
    const KIND: &'static str = "build record";
    const FORMAT: u32 = 3;
}

/// SHA-256 of some bytes.
pub fn sha256(bytes: &[u8]) -> [u8; 32] {
    Sha256::digest(bytes).into()
}

/// Lower-case hexadecimal digits of a digest.
pub fn hex(bytes: &[u8]) -> String {
    bytes.iter().map(|b| format!("{b:02x}")).collect()
}

/// The bytes of an artifact's file.
///
/// # Errors
/// Serialization failed (never for the artifacts of this crate).
pub fn to_bytes<T: Artifact>(artifact: &T) -> Result<Vec<u8>> {
    let payload = postcard::to_allocvec(artifact)
        .map_err(|e| Error::new(ErrorCode::Malformed, "", format!("{} cannot be stored: {e}", T::KIND)))?;
    let mut bytes = Vec::with_capacity(HEADER_BYTES + payload.len());
    bytes.extend_from_slice(&T::MAGIC);
    bytes.extend_from_slice(&T::FORMAT.to_le_bytes());
    bytes.extend_from_slice(&[0; 4]);
    bytes.extend_from_slice(&sha256(&payload));
    bytes.extend_from_slice(&payload);
    Ok(bytes)
}

/// An artifact from its file's bytes.
///
/// # Errors
/// Wrong magic or format, truncated, or changed since it was written.
pub fn from_bytes<T: Artifact>(bytes: &[u8]) -> Result<T> {
    let malformed = |message: String| {
        Error::new(ErrorCode::Malformed, "", message).with_help("make the file again with model-compiler")
    };
    if bytes.len() < HEADER_BYTES || bytes[..8] != T::MAGIC {
        return Err(malformed(format!("this is not a {}", T::KIND)));
    }
    let format = u32::from_le_bytes([bytes[8], bytes[9], bytes[10], bytes[11]]);
    if format != T::FORMAT {
        let (kind, expected) = (T::KIND, T::FORMAT);
        return Err(malformed(format!("format of the {kind}: found {format}, expected {expected}")));
    }
    let payload = &bytes[HEADER_BYTES..];
    if bytes[16..HEADER_BYTES] != sha256(payload) || bytes[12..16] != [0; 4] {
        return Err(malformed(format!("the {} is truncated or was changed: its digest does not match", T::KIND)));
    }
    postcard::from_bytes(payload).map_err(|e| malformed(format!("the {} does not decode: {e}", T::KIND)))
}

/// Whether a file's first bytes are an artifact of this kind.
pub fn is<T: Artifact>(bytes: &[u8]) -> bool {
    bytes.starts_with(&T::MAGIC)
}

/// Reads an artifact.
///
/// # Errors
/// See [`from_bytes`]; the file is named.
pub fn read<T: Artifact>(path: &Path) -> Result<T> {
    let bytes = std::fs::read(path).map_err(|e| Error::io(path, &e))?;
    from_bytes(&bytes).map_err(|e| e.within(path.display()))
}

/// Writes a file whole or not at all: to a temporary name in the same folder, then renamed.
///
/// # Errors
/// The folder does not exist or cannot be written.
pub fn write_file(path: &Path, bytes: &[u8]) -> Result<()> {
    write_files(&[(path, bytes)])
}

/// Writes files that belong together: none gets its name before all are on the disk.
///
/// # Errors
/// A folder does not exist or cannot be written.
pub fn write_files(files: &[(&Path, &[u8])]) -> Result<()> {
    let stage = |(path, bytes): &(&Path, &[u8])| {
        let write = || -> std::io::Result<NamedTempFile> {
            let mut file = NamedTempFile::new_in(folder_of(path))?;
            file.write_all(bytes)?;
            file.as_file().sync_all()?;
            Ok(file)
        };
        write().map_err(|e| Error::io(path, &e))
    };
    let staged: Vec<NamedTempFile> = files.iter().map(stage).collect::<Result<_>>()?;
    for (file, (path, _)) in staged.into_iter().zip(files) {
        file.persist(path).map_err(|e| Error::io(path, &e.error))?;
    }
    Ok(())
}

/// The folder that a file lies in.
pub fn folder_of(path: &Path) -> &Path {
    path.parent().filter(|p| !p.as_os_str().is_empty()).unwrap_or(Path::new("."))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::qmodel::QModel;

    fn empty() -> QModel {
        QModel {
            name: "m".into(),
            system: "aim".into(),
            tensors: vec![],
            steps: vec![],
            inputs: vec![],
            outputs: vec![],
            provenance: vec![("a".into(), "b".into())],
        }
    }

    #[test]
    fn round_trip() {
        assert_eq!(from_bytes::<QModel>(&to_bytes(&empty()).unwrap()).unwrap(), empty());
    }

    #[test]
    fn every_truncation_and_every_flipped_bit_is_refused() {
        let bytes = to_bytes(&empty()).unwrap();
        for length in 0..bytes.len() {
            assert!(from_bytes::<QModel>(&bytes[..length]).is_err(), "length {length}");
        }
        for bit in 0..bytes.len() * 8 {
            let mut changed = bytes.clone();
            changed[bit / 8] ^= 1 << (bit % 8);
            assert!(from_bytes::<QModel>(&changed).is_err(), "bit {bit}");
        }
    }
}
