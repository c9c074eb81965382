//! From the value a pickle built to named tensors: finds the state dict among its wrappers.

use std::borrow::Cow;
use std::collections::HashSet;

use crate::error::{Error, ErrorCode, Result};

use super::pickle::{Object, Pickle, Value};
use super::tensor_view::{StorageRef, TensorView, gather};
use super::{Contents, malformed, quoted};

/// Keys under which training scripts save the weights, the most telling first.
const WRAPPERS: [&str; 6] = ["state_dict", "model_state_dict", "model", "net", "network", "weights"];
/// Dicts around the state dict; also ends a search through a dict that holds itself.
const MAX_WRAPPERS: usize = 4;

/// A dict's items.
type Items = [(Value, Value)];

/// Reads the tensors of the state dict; `load` returns a storage's bytes, exactly as many as claimed.
pub(super) fn read<'s>(
    pickle: &Pickle,
    file_bytes: usize,
    load: impl FnMut(&StorageRef) -> Result<Cow<'s, [u8]>>,
) -> Result<Contents> {
    let mut views: Vec<(&str, &TensorView)> = Vec::new();
    let mut skipped = Vec::new();
    for &(key, value) in find(pickle, &mut skipped)? {
        match (pickle.text(key), pickle.object(value)) {
            (Some(name), Some(Object::Tensor(view))) => views.push((name, view)),
            _ => skipped.push(key_name(pickle, key)),
        }
    }
    Ok(Contents { tensors: gather(&views, file_bytes, load)?, skipped })
}

/// The dict whose values are the tensors; notes what lies beside it.
fn find<'p>(pickle: &'p Pickle, skipped: &mut Vec<String>) -> Result<&'p Items> {
    let mut value = pickle.root();
    for _ in 0..MAX_WRAPPERS {
        let Some(items) = dict(pickle, value) else {
            return Err(not_found(format!("found {}, expected a dict of tensors", pickle.describe(value))));
        };
        refuse_repeated_names(pickle, items)?;
        match wrapped(pickle, items) {
            Some(inner) => {
                let beside = items.iter().filter(|item| item.1 != inner);
                skipped.extend(beside.map(|item| key_name(pickle, item.0)));
                value = inner;
            }
            None if holds_tensors(pickle, items) => return Ok(items),
            None => return Err(not_found(contents_message(pickle, items))),
        }
    }
    Err(not_found(format!("found more than {MAX_WRAPPERS} dicts around the weights, expected fewer")))
}

/// Python writes a name once; a file that repeats one could also make two bytes of it a long copy each.
fn refuse_repeated_names(pickle: &Pickle, items: &Items) -> Result<()> {
    let mut seen = HashSet::with_capacity(items.len());
    match items.iter().filter_map(|item| pickle.text(item.0)).find(|name| !seen.insert(*name)) {
        None => Ok(()),
        Some(name) => Err(malformed(format!("tensor {}", quoted(name)), "found twice, expected once per file")),
    }
}

fn key_name(pickle: &Pickle, key: Value) -> String {
    pickle.text(key).map_or_else(|| format!("({} as a name)", pickle.describe(key)), str::to_owned)
}

/// The dict that wraps the weights here: under a well-known key, or else the only dict of tensors beside no tensor.
fn wrapped(pickle: &Pickle, items: &Items) -> Option<Value> {
    let is_dict = |value| dict(pickle, value).is_some();
    let known =
        |wrapper: &&str| items.iter().find(|(key, value)| pickle.text(*key) == Some(wrapper) && is_dict(*value));
    if let Some((_, value)) = WRAPPERS.iter().find_map(known) {
        return Some(*value);
    }
    if holds_tensors(pickle, items) {
        return None;
    }
    let mut dicts = items.iter().map(|item| item.1).filter(|&value| {
        let items = dict(pickle, value);
        items.is_some_and(|items| holds_tensors(pickle, items))
    });
    dicts.next().filter(|_| dicts.next().is_none())
}

fn dict<'p>(pickle: &'p Pickle, value: Value) -> Option<&'p Items> {
    match pickle.object(value)? {
        Object::Dict(items) => Some(items),
        _ => None,
    }
}

fn holds_tensors(pickle: &Pickle, items: &Items) -> bool {
    items.iter().any(|&(_, value)| matches!(pickle.object(value), Some(Object::Tensor(_))))
}

fn contents_message(pickle: &Pickle, items: &Items) -> String {
    const SHOWN: usize = 8;
    let shown = items.iter().take(SHOWN).map(|&(key, value)| {
        format!("{}: {}", pickle.text(key).map_or(pickle.describe(key).to_owned(), quoted), pickle.describe(value))
    });
    let shown: Vec<String> = shown.collect();
    let more = if items.len() > SHOWN { ", …" } else { "" };
    format!("found a dict of {{{}{more}}}, expected tensors, or one dict of tensors", shown.join(", "))
}

fn not_found(message: String) -> Error {
    Error::new(ErrorCode::Tensors, "state dict", message)
        .with_help("save the weights: torch.save(model.state_dict(), FILE)")
}
