//! Writes torch checkpoints, good and bad: a Python value tree, its pickle, and both containers of `torch.save`.

use std::io::{Cursor, Write};

use zip::write::{SimpleFileOptions, ZipWriter};

/// A Python value as pickle writes it.
#[derive(Clone, Debug)]
pub enum Py {
    /// `None`
    None,
    /// `True` or `False`
    Bool(bool),
    /// An int of 32 bits, or else a long of 64.
    Int(i64),
    /// A float.
    Float(f64),
    /// A string.
    Str(String),
    /// A list.
    List(Vec<Py>),
    /// A tuple.
    Tuple(Vec<Py>),
    /// A dict.
    Dict(Vec<(Py, Py)>),
    /// An `OrderedDict` with the attribute `_metadata`, as `state_dict()` returns it.
    StateDict(Vec<(Py, Py)>),
    /// A call of `module.name` with arguments.
    Call(&'static str, &'static str, Vec<Py>),
    /// A class or function.
    Global(&'static str, &'static str),
    /// A storage: its key, class and claimed element count, and in legacy files the view.
    Storage(String, &'static str, i64, Option<(i64, i64)>),
    /// Bytes put into the pickle as they are.
    Raw(Vec<u8>),
}

impl Py {
    /// A string.
    pub fn str(text: &str) -> Self {
        Self::Str(text.to_owned())
    }

    /// A tuple of ints.
    pub fn ints(values: &[i64]) -> Self {
        Self::Tuple(values.iter().map(|&value| Self::Int(value)).collect())
    }

    /// A dict with string keys.
    pub fn dict(items: impl IntoIterator<Item = (&'static str, Py)>) -> Self {
        Self::Dict(items.into_iter().map(|(key, value)| (Self::str(key), value)).collect())
    }

    /// A tensor as torch rebuilds it from a storage.
    pub fn tensor(storage: Py, offset: i64, shape: &[i64], strides: &[i64]) -> Self {
        let hooks = Self::Call("collections", "OrderedDict", vec![]);
        let arguments =
            vec![storage, Self::Int(offset), Self::ints(shape), Self::ints(strides), Self::Bool(false), hooks];
        Self::Call("torch._utils", "_rebuild_tensor_v2", arguments)
    }
}

/// A storage's contents.
#[derive(Clone, Debug)]
pub struct Storage {
    /// Name in the file.
    pub key: String,
    /// Elements that are written as the count (legacy only).
    pub elements: i64,
    /// The elements, little-endian.
    pub bytes: Vec<u8>,
}

/// What is saved: a value and the storages it uses.
#[derive(Clone, Debug)]
pub struct Saved {
    /// The value.
    pub root: Py,
    /// The storages, in file order.
    pub storages: Vec<Storage>,
}

impl Saved {
    /// A state dict of contiguous `f32` tensors.
    pub fn state_dict(tensors: &[(&str, &[usize], &[f32])]) -> Self {
        let elements = tensors.iter().map(|(name, shape, values)| {
            (*name, "FloatStorage", *shape, values.iter().flat_map(|value| value.to_le_bytes()).collect())
        });
        Self::of_types(&elements.collect::<Vec<_>>())
    }

    /// A state dict of contiguous tensors: name, storage class, shape, little-endian elements.
    pub fn of_types(tensors: &[(&str, &'static str, &[usize], Vec<u8>)]) -> Self {
        let mut items = Vec::new();
        let mut storages = Vec::new();
        for (at, (name, class, shape, bytes)) in tensors.iter().enumerate() {
            let shape: Vec<i64> = shape.iter().map(|&extent| extent as i64).collect();
            let elements = shape.iter().product();
            let key = at.to_string();
            let storage = Py::Storage(key.clone(), class, elements, None);
            items.push((Py::str(name), Py::tensor(storage, 0, &shape, &contiguous(&shape))));
            storages.push(Storage { key, elements, bytes: bytes.clone() });
        }
        Self { root: Py::StateDict(items), storages }
    }

    /// One storage `"0"` of the floats 0, 1, 2, … and the value that uses it.
    pub fn counting(elements: u16, root: impl FnOnce(Py) -> Py) -> Self {
        let storage = Py::Storage("0".to_owned(), "FloatStorage", elements.into(), None);
        let bytes = (0..elements).flat_map(|value| f32::from(value).to_le_bytes()).collect();
        Self { root: root(storage), storages: vec![Storage { key: "0".to_owned(), elements: elements.into(), bytes }] }
    }

    /// The same, with another value around it.
    #[must_use]
    pub fn wrap(self, wrap: impl FnOnce(Py) -> Py) -> Self {
        Self { root: wrap(self.root), storages: self.storages }
    }

    /// The legacy stream.
    pub fn legacy(&self) -> Vec<u8> {
        self.legacy_with(&LegacyHead::default())
    }

    /// The legacy stream behind another head.
    pub fn legacy_with(&self, head: &LegacyHead) -> Vec<u8> {
        let magic = [b"\x8a\x0a".as_slice(), &head.magic].concat();
        let system = Py::dict([
            ("protocol_version", Py::Int(1001)),
            ("little_endian", Py::Bool(head.little_endian)),
            ("type_sizes", Py::dict([("int", Py::Int(4))])),
        ]);
        let keys = Py::List(self.storages.iter().map(|storage| Py::str(&storage.key)).collect());
        let values = [&Py::Raw(magic), &Py::Int(head.protocol), &system, &self.root, &keys];
        let mut bytes: Vec<u8> = values.into_iter().flat_map(|value| pickle(value, Container::Legacy)).collect();
        for storage in &self.storages {
            bytes.extend(storage.elements.to_le_bytes());
            bytes.extend(&storage.bytes);
        }
        bytes
    }

    /// Names and contents of the zip archive's entries.
    pub fn entries(&self) -> Vec<(String, Vec<u8>)> {
        let mut entries = vec![
            ("model/data.pkl".to_owned(), pickle(&self.root, Container::Zip)),
            ("model/byteorder".to_owned(), b"little".to_vec()),
        ];
        let data = |storage: &Storage| (format!("model/data/{}", storage.key), storage.bytes.clone());
        entries.extend(self.storages.iter().map(data));
        entries.push(("model/version".to_owned(), b"3\n".to_vec()));
        entries
    }

    /// The zip archive.
    pub fn zip(&self) -> Vec<u8> {
        zip_of(&self.entries(), zip::CompressionMethod::Stored)
    }
}

/// The first three pickles of a legacy stream.
#[derive(Clone, Debug)]
pub struct LegacyHead {
    /// Little-endian magic number.
    pub magic: [u8; 10],
    /// Torch's protocol.
    pub protocol: i64,
    /// Byte order it claims.
    pub little_endian: bool,
}

impl Default for LegacyHead {
    fn default() -> Self {
        let magic = [0x6c, 0xfc, 0x9c, 0x46, 0xf9, 0x20, 0x6a, 0xa8, 0x50, 0x19];
        Self { magic, protocol: 1001, little_endian: true }
    }
}

/// A zip archive of these entries.
pub fn zip_of(entries: &[(String, Vec<u8>)], compression: zip::CompressionMethod) -> Vec<u8> {
    let mut writer = ZipWriter::new(Cursor::new(Vec::new()));
    for (name, bytes) in entries {
        let options = SimpleFileOptions::default().compression_method(compression);
        writer.start_file(name.as_str(), options).expect("entry names differ");
        writer.write_all(bytes).expect("writing to memory");
    }
    writer.finish().expect("writing to memory").into_inner()
}

/// Row-major strides.
pub fn contiguous(shape: &[i64]) -> Vec<i64> {
    (0..shape.len()).map(|axis| shape[axis + 1..].iter().product()).collect()
}

/// The container decides how storages are named: with a sixth field in legacy streams.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Container {
    /// Torch before 1.6.
    Legacy,
    /// Torch since 1.6.
    Zip,
}

/// The pickle of a value, protocol 2, as `torch.save` writes it.
pub fn pickle(value: &Py, container: Container) -> Vec<u8> {
    let mut pickler = Pickler { bytes: vec![0x80, 2], container };
    pickler.value(value);
    pickler.bytes.push(b'.');
    pickler.bytes
}

struct Pickler {
    bytes: Vec<u8>,
    container: Container,
}

impl Pickler {
    fn value(&mut self, value: &Py) {
        match value {
            Py::None => self.bytes.push(b'N'),
            Py::Bool(value) => self.bytes.push(if *value { 0x88 } else { 0x89 }),
            Py::Int(value) => self.int(*value),
            Py::Float(value) => {
                self.bytes.push(b'G');
                self.bytes.extend(value.to_be_bytes());
            }
            Py::Str(text) => {
                self.bytes.push(b'X');
                self.bytes.extend((text.len() as u32).to_le_bytes());
                self.bytes.extend(text.as_bytes());
            }
            Py::List(items) => {
                self.bytes.extend(b"](");
                items.iter().for_each(|item| self.value(item));
                self.bytes.push(b'e');
            }
            Py::Tuple(items) => self.tuple(items),
            Py::Dict(items) => {
                self.bytes.push(b'}');
                self.items(items);
            }
            Py::StateDict(items) => {
                self.global("collections", "OrderedDict");
                self.bytes.extend(b")R");
                self.items(items);
                self.value(&Py::dict([("_metadata", Py::dict([("", Py::dict([("version", Py::Int(1))]))]))]));
                self.bytes.push(b'b');
            }
            Py::Call(module, name, arguments) => {
                self.global(module, name);
                self.tuple(arguments);
                self.bytes.push(b'R');
            }
            Py::Global(module, name) => self.global(module, name),
            Py::Storage(key, class, elements, view) => self.storage(key, class, *elements, *view),
            Py::Raw(bytes) => self.bytes.extend(bytes),
        }
    }

    fn int(&mut self, value: i64) {
        if let Ok(value) = i32::try_from(value) {
            self.bytes.push(b'J');
            self.bytes.extend(value.to_le_bytes());
        } else {
            self.bytes.extend([0x8a, 8]);
            self.bytes.extend(value.to_le_bytes());
        }
    }

    fn tuple(&mut self, items: &[Py]) {
        self.bytes.push(b'(');
        items.iter().for_each(|item| self.value(item));
        self.bytes.push(b't');
    }

    fn items(&mut self, items: &[(Py, Py)]) {
        self.bytes.push(b'(');
        for (key, value) in items {
            self.value(key);
            self.value(value);
        }
        self.bytes.push(b'u');
    }

    fn global(&mut self, module: &str, name: &str) {
        self.bytes.extend(format!("c{module}\n{name}\n").as_bytes());
    }

    fn storage(&mut self, key: &str, class: &'static str, elements: i64, view: Option<(i64, i64)>) {
        let mut id =
            vec![Py::str("storage"), Py::Global("torch", class), Py::str(key), Py::str("cuda:0"), Py::Int(elements)];
        if self.container == Container::Legacy {
            id.push(view.map_or(Py::None, |(offset, length)| {
                Py::Tuple(vec![Py::str("view"), Py::Int(offset), Py::Int(length)])
            }));
        }
        self.tuple(&id);
        self.bytes.push(b'Q');
    }
}
