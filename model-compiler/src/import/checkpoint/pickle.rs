//! A small machine for the pickles of `torch.save`: it builds plain values and tensor descriptions, and calls nothing.
//!
//! Pickle is a stack language whose `REDUCE` calls any importable function. Here a global is an entry of a fixed
//! allow-list ([`globals`]), `REDUCE` of an entry is one of a handful of pure constructions written below, and
//! everything else ends the reading with the name and the byte. Objects live in one list and refer to each other by
//! position, so cyclic and deeply nested values need no recursion, neither to build nor to drop.

mod globals;
mod machine;
mod opcode;

use crate::error::{Error, ErrorCode, Result};

use super::tensor_view::{StorageRef, TensorView};

use globals::Global;
pub(super) use opcode::PROTO;

/// Opcodes executed per pickle. A state dict needs about 40 per tensor; with the machine's memory per opcode bounded,
/// this bounds the machine's memory.
const MAX_OPCODES: usize = 1 << 21;
/// Nested marks, the machine's only depth.
const MAX_DEPTH: usize = 1000;
/// Bytes of a module or class name.
const MAX_NAME: usize = 1000;

/// A value of the machine.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) enum Value {
    None,
    Bool(bool),
    Int(i64),
    /// A float, which no checkpoint needs for its weights.
    Float,
    Object(ObjectId),
}

/// Position in [`Pickle`]'s list of objects.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct ObjectId(u32);

/// A value that does not fit a word.
#[derive(Clone, Debug)]
pub(super) enum Object<'a> {
    Text(&'a str),
    /// Bytes, or a string of Python 2 that is not UTF-8.
    Bytes,
    /// Little-endian two's complement, more than 64 bits.
    Long(&'a [u8]),
    List(Vec<Value>),
    Tuple(Vec<Value>),
    Dict(Vec<(Value, Value)>),
    Global(Global),
    Storage {
        storage: StorageRef<'a>,
        /// Elements of it that are seen: all, or those of a legacy view.
        window: (usize, usize),
    },
    Tensor(Box<TensorView<'a>>),
    /// An instance of an inert global: contents unread.
    Opaque,
}

/// Where a pickle lies, for messages.
#[derive(Clone, Copy, Debug)]
pub(super) struct Source<'a> {
    pub bytes: &'a [u8],
    /// First byte of the pickle.
    pub start: usize,
    /// Name of the file inside an archive; empty for the file itself.
    pub file: &'a str,
}

impl Source<'_> {
    /// `data.pkl: byte 12`.
    pub fn place(&self, byte: usize) -> String {
        if self.file.is_empty() { format!("byte {byte}") } else { format!("{}: byte {byte}", self.file) }
    }
}

/// What a pickle built.
#[derive(Debug)]
pub(super) struct Pickle<'a> {
    objects: Vec<Object<'a>>,
    root: Value,
    /// One past the pickle's last byte.
    pub end: usize,
}

impl<'a> Pickle<'a> {
    /// Runs the pickle that starts at `source.start`; bytes after its `STOP` are left alone.
    pub fn load(source: Source<'a>) -> Result<Self> {
        machine::run(source)
    }

    /// The value at the top.
    pub fn root(&self) -> Value {
        self.root
    }

    /// The object a value refers to; `None` for a plain value.
    pub fn object(&self, value: Value) -> Option<&Object<'a>> {
        object(&self.objects, value)
    }

    /// Every storage that was mentioned, in order of mention.
    pub fn storages(&self) -> impl Iterator<Item = &StorageRef<'a>> {
        self.objects.iter().filter_map(|object| match object {
            Object::Storage { storage, .. } => Some(storage),
            _ => None,
        })
    }

    /// The text a value refers to.
    pub fn text(&self, value: Value) -> Option<&'a str> {
        match self.object(value)? {
            Object::Text(text) => Some(text),
            _ => None,
        }
    }

    /// The value's type, for messages.
    pub fn describe(&self, value: Value) -> &'static str {
        describe(&self.objects, value)
    }
}

fn object<'o, 'a>(objects: &'o [Object<'a>], value: Value) -> Option<&'o Object<'a>> {
    match value {
        Value::Object(ObjectId(at)) => objects.get(usize::try_from(at).ok()?),
        _ => None,
    }
}

fn describe(objects: &[Object], value: Value) -> &'static str {
    match value {
        Value::None => "None",
        Value::Bool(_) => "a bool",
        Value::Int(_) => "an int",
        Value::Float => "a float",
        Value::Object(_) => match object(objects, value) {
            Some(Object::Text(_)) => "a string",
            Some(Object::Bytes) => "bytes",
            Some(Object::Long(_)) => "a long int",
            Some(Object::List(_)) => "a list",
            Some(Object::Tuple(_)) => "a tuple",
            Some(Object::Dict(_)) => "a dict",
            Some(Object::Global(_)) => "a class or function",
            Some(Object::Storage { .. }) => "a storage",
            Some(Object::Tensor(_)) => "a tensor",
            Some(Object::Opaque) | None => "an object",
        },
    }
}

/// The error for a name outside the allow-list.
fn refused_global(place: String, module: &str, name: &str) -> Error {
    let found = super::quoted(&format!("{module}.{name}"));
    if globals::is_unread_storage(module, name) {
        let message = format!("found storage class {found}, expected a float, integer or bool storage");
        return Error::new(ErrorCode::Unsupported, place, message)
            .with_help("convert the weights before saving: {name: tensor.float()}");
    }
    let message =
        format!("found {found}, which the pickle could call; expected only the names a state dict of tensors needs");
    Error::new(ErrorCode::Refused, place, message).with_help(
        "nothing was executed; if you trust the file, load it in Python and save the weights alone: torch.save(model.state_dict(), FILE)",
    )
}

#[cfg(test)]
mod tests;
