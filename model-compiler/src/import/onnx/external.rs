//! Elements that lie in files beside the model.

use super::proto::Entry;
use crate::error::{Error, ErrorCode, Result};
use crate::import::checkpoint::malformed;
use std::cell::RefCell;
use std::collections::HashMap;
use std::fs::File;
use std::io::{Read, Seek, SeekFrom};
use std::path::{Component, Path, PathBuf};

const HELP: &str = "copy the model together with its data files, or save it as one file";

/// The folder of a model file; the only place where its data may lie.
pub(super) struct Folder<'a> {
    path: Option<&'a Path>,
    /// Length of each file that was read.
    lengths: RefCell<HashMap<PathBuf, u64>>,
}

impl<'a> Folder<'a> {
    /// A model that came without a folder.
    pub(super) fn none() -> Self {
        Self { path: None, lengths: RefCell::default() }
    }

    pub(super) fn new(path: &'a Path) -> Self {
        Self { path: Some(path), ..Self::none() }
    }

    /// Bytes of all files that were read from.
    pub(super) fn bytes(&self) -> u64 {
        self.lengths.borrow().values().fold(0, |sum, bytes| sum.saturating_add(*bytes))
    }

    /// The bytes that `entries` (`location`, `offset`, `length`) describe, `expected` many.
    pub(super) fn read(&self, entries: &[Entry], expected: Option<usize>) -> Result<Vec<u8>> {
        let entry = |key: &str| entries.iter().find(|e| e.key == key).map(|e| e.value.as_str());
        let number = |key: &str| match entry(key).map(|value| (value, value.parse::<u64>())) {
            None => Ok(None),
            Some((_, Ok(number))) => Ok(Some(number)),
            Some((value, Err(_))) => {
                Err(malformed("", format!("external data: found {key} {value:?}, expected a number of bytes")))
            }
        };
        let location = entry("location").ok_or_else(|| malformed("", "external data without a location"))?;
        let path = self.resolve(location)?;
        let offset = number("offset")?.unwrap_or(0);
        let expected = expected.ok_or_else(|| malformed("", "the extents exceed every memory"))?;
        let length = number("length")?.unwrap_or(expected as u64);
        if length != expected as u64 {
            return Err(malformed("", format!("external data: found {length} bytes, expected {expected}")));
        }
        let io = |e: std::io::Error| Error::io(&path, &e);
        let mut file = File::open(&path).map_err(io)?;
        let available = file.metadata().map_err(io)?.len();
        if offset.checked_add(length).is_none_or(|end| end > available) {
            let message = format!(
                "external data in {}: found {available} bytes, expected {length} at offset {offset}",
                path.display()
            );
            return Err(Error::new(ErrorCode::Malformed, "", message).with_help(HELP));
        }
        let mut bytes = vec![0; expected];
        file.seek(SeekFrom::Start(offset)).map_err(io)?;
        file.read_exact(&mut bytes).map_err(io)?;
        self.lengths.borrow_mut().insert(path, available);
        Ok(bytes)
    }

    /// The file of a location: below the model's folder, and no link that leads out of it.
    fn resolve(&self, location: &str) -> Result<PathBuf> {
        let refuse = |message: String| Err(Error::new(ErrorCode::Refused, "", message).with_help(HELP));
        let Some(folder) = self.path else {
            return refuse(format!("external data in {location:?}, but the model came without a folder"));
        };
        let below =
            Path::new(location).components().all(|part| matches!(part, Component::Normal(_) | Component::CurDir));
        if location.is_empty() || !below {
            return refuse(format!("external data in {location:?}, expected a file in the model's folder"));
        }
        let path = folder.join(location);
        let missing = |e: std::io::Error| {
            Error::new(ErrorCode::Io, "", format!("external data in {}: {e}", path.display())).with_help(HELP)
        };
        let inside = path.canonicalize().map_err(missing)?;
        if !inside.starts_with(folder.canonicalize().map_err(missing)?) {
            return refuse(format!("external data in {location:?}, a link that leads out of the model's folder"));
        }
        if !inside.is_file() {
            return refuse(format!("external data in {location:?}, which is no file"));
        }
        Ok(path)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn entries(fields: &[(&str, &str)]) -> Vec<Entry> {
        fields.iter().map(|(key, value)| Entry { key: (*key).into(), value: (*value).into() }).collect()
    }

    fn read(fields: &[(&str, &str)], expected: usize) -> std::result::Result<Vec<u8>, String> {
        let temporary = tempfile::tempdir().unwrap();
        let inner = temporary.path().join("model");
        std::fs::create_dir_all(inner.join("sub")).unwrap();
        std::fs::write(inner.join("data"), [0, 1, 2, 3, 4, 5, 6, 7]).unwrap();
        std::fs::write(temporary.path().join("outside"), [9]).unwrap();
        #[cfg(unix)]
        std::os::unix::fs::symlink("../outside", inner.join("link")).unwrap();
        let found = Folder::new(&inner).read(&entries(fields), Some(expected));
        found.map_err(|e| e.message.replace(&format!("{}/", inner.display()), "@"))
    }

    #[test]
    fn a_part_of_a_file_is_read() {
        assert_eq!(read(&[("location", "data"), ("offset", "2"), ("length", "3")], 3).unwrap(), [2, 3, 4]);
        assert_eq!(read(&[("location", "./data")], 8).unwrap(), [0, 1, 2, 3, 4, 5, 6, 7]);
    }

    #[test]
    fn what_lies_elsewhere_or_ends_early_is_refused() {
        let outside = |location: &str| format!("external data in {location:?}, expected a file in the model's folder");
        for location in ["../outside", "/etc/hostname", "sub/../../outside", ""] {
            assert_eq!(read(&[("location", location)], 1).unwrap_err(), outside(location));
        }
        #[cfg(unix)]
        assert_eq!(
            read(&[("location", "link")], 1).unwrap_err(),
            "external data in \"link\", a link that leads out of the model's folder"
        );
        assert_eq!(read(&[("location", "sub")], 1).unwrap_err(), "external data in \"sub\", which is no file");
        assert!(read(&[("location", "none")], 1).unwrap_err().starts_with("external data in @none: "));
        assert_eq!(
            read(&[("location", "data"), ("offset", "6")], 4).unwrap_err(),
            "external data in @data: found 8 bytes, expected 4 at offset 6"
        );
        assert_eq!(
            read(&[("location", "data"), ("offset", "18446744073709551615")], 4).unwrap_err(),
            "external data in @data: found 8 bytes, expected 4 at offset 18446744073709551615"
        );
        assert_eq!(
            read(&[("location", "data"), ("length", "5")], 4).unwrap_err(),
            "external data: found 5 bytes, expected 4"
        );
        assert_eq!(
            read(&[("location", "data"), ("offset", "-1")], 4).unwrap_err(),
            "external data: found offset \"-1\", expected a number of bytes"
        );
        assert_eq!(read(&[("offset", "1")], 4).unwrap_err(), "external data without a location");
    }
}
