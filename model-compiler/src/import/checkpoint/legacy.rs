//! The stream `torch.save` wrote before 1.6: five pickles, then the storages.
//!
//! The pickles: a magic number, protocol 1001, a description of the system, the saved object, the storages' keys. Then
//! per key, in that order, an `i64` element count and the elements.

use std::borrow::Cow;
use std::collections::HashMap;

use crate::error::{Error, ErrorCode, Result};

use super::pickle::{Object, Pickle, Source, Value};
use super::tensor_view::StorageRef;
use super::{Contents, malformed, quoted, state_dict};

/// 0x1950a86a20f9469cfc6c, little-endian.
const MAGIC: [u8; 10] = [0x6c, 0xfc, 0x9c, 0x46, 0xf9, 0x20, 0x6a, 0xa8, 0x50, 0x19];
const PROTOCOL: i64 = 1001;

/// Reads a legacy stream.
pub(super) fn parse(bytes: &[u8]) -> Result<Contents> {
    let pickle = |start| Pickle::load(Source { bytes, start, file: "" });
    let magic = pickle(0)?;
    check_magic(&magic)?;
    let protocol = pickle(magic.end)?;
    check_protocol(&protocol, magic.end)?;
    let system = pickle(protocol.end)?;
    check_system(&system, protocol.end)?;
    let object = pickle(system.end)?;
    let keys = pickle(object.end)?;
    let storages = locate(bytes, &object, &keys, object.end)?;
    state_dict::read(&object, bytes.len(), |storage| match storages.get(storage.key) {
        Some(bytes) => Ok(Cow::Borrowed(*bytes)),
        None => Err(malformed(format!("storage {}", quoted(storage.key)), "found no such key in the list of storages")),
    })
}

fn check_magic(pickle: &Pickle) -> Result<()> {
    match pickle.object(pickle.root()) {
        Some(Object::Long(number)) if **number == MAGIC => Ok(()),
        _ => {
            let found = pickle.describe(pickle.root());
            let message = format!("found a pickle of {found}, expected torch's magic number 0x1950a86a20f9469cfc6c");
            Err(Error::new(ErrorCode::Malformed, "byte 0", message)
                .with_help("this pickle was not written by torch.save: save with torch.save(model.state_dict(), FILE)"))
        }
    }
}

fn check_protocol(pickle: &Pickle, at: usize) -> Result<()> {
    match pickle.root() {
        Value::Int(PROTOCOL) => Ok(()),
        Value::Int(found) => Err(Error::new(
            ErrorCode::Unsupported,
            format!("byte {at}"),
            format!("found torch protocol {found}, expected {PROTOCOL}"),
        )
        .with_help("load the file in Python and save it again with torch.save")),
        other => Err(malformed(
            format!("byte {at}"),
            format!("found {}, expected torch protocol {PROTOCOL}", pickle.describe(other)),
        )),
    }
}

/// Of the system only the byte order matters; sizes of C types say nothing about the storages.
fn check_system(pickle: &Pickle, at: usize) -> Result<()> {
    let place = || format!("byte {at} (system description)");
    let Some(Object::Dict(items)) = pickle.object(pickle.root()) else {
        return Err(malformed(place(), format!("found {}, expected a dict", pickle.describe(pickle.root()))));
    };
    match items.iter().find(|(key, _)| pickle.text(*key) == Some("little_endian")) {
        Some((_, Value::Bool(true))) => Ok(()),
        Some((_, Value::Bool(false))) => {
            Err(Error::new(ErrorCode::Unsupported, place(), "found big-endian elements, expected little-endian")
                .with_help("save the checkpoint on a little-endian machine"))
        }
        _ => Err(malformed(place(), "found no byte order, expected little_endian: True or False")),
    }
}

/// Where each storage's elements lie. Element sizes are known only from the object that mentions the storage.
fn locate<'a>(bytes: &'a [u8], object: &Pickle, keys: &Pickle, keys_at: usize) -> Result<HashMap<String, &'a [u8]>> {
    let mut known: HashMap<&str, &StorageRef> = HashMap::new();
    for storage in object.storages() {
        known.entry(storage.key).or_insert(storage);
    }
    let Some(Object::List(list)) = keys.object(keys.root()) else {
        let found = keys.describe(keys.root());
        return Err(malformed(format!("byte {keys_at}"), format!("found {found}, expected the list of storage keys")));
    };
    let mut at = keys.end;
    let mut located = HashMap::new();
    for &key in list {
        let storage = keys.text(key).and_then(|key| known.get(key)).ok_or_else(|| {
            let found = keys.text(key).map_or(keys.describe(key).to_owned(), quoted);
            malformed(
                format!("byte {keys_at} (list of storage keys)"),
                format!("found {found}, expected a storage that the saved object uses"),
            )
        })?;
        let elements = storage_bytes(bytes, &mut at, storage)?;
        if located.insert(storage.key.to_owned(), elements).is_some() {
            return Err(malformed(format!("storage {}", quoted(storage.key)), "found twice, expected once"));
        }
    }
    if at != bytes.len() {
        let message = format!("found {} bytes after the last storage, expected the end of the file", bytes.len() - at);
        return Err(malformed(format!("byte {at}"), message));
    }
    Ok(located)
}

/// Element count and elements of the storage at `at`, which moves behind them.
fn storage_bytes<'a>(bytes: &'a [u8], at: &mut usize, storage: &StorageRef) -> Result<&'a [u8]> {
    let place = format!("byte {at} (storage {})", quoted(storage.key));
    let rest = &bytes[*at..];
    let Some((count, rest)) = rest.split_first_chunk() else {
        return Err(malformed(place, format!("found {} bytes before the end, expected an element count", rest.len())));
    };
    let count = i64::from_le_bytes(*count);
    if usize::try_from(count) != Ok(storage.elements) {
        let message = format!("found a count of {count} elements, expected {} as in the object", storage.elements);
        return Err(malformed(place, message));
    }
    let Some(elements) = storage.bytes().and_then(|length| rest.get(..length)) else {
        let width = storage.dtype.bytes();
        let message = format!("found {} bytes before the end, expected {count} elements of {width} bytes", rest.len());
        return Err(malformed(place, message));
    };
    *at += size_of::<i64>() + elements.len();
    Ok(elements)
}
