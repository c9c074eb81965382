//! The stack machine: one opcode at a time, every size checked against what is there.

use std::collections::HashMap;

use crate::error::{Error, ErrorCode, Result};

use super::super::tensor_view::{MAX_RANK, StorageRef, TensorView};
use super::super::{malformed, quoted};
use super::globals::{self, Global};
use super::opcode::{self as op, *};
use super::{
    MAX_DEPTH, MAX_NAME, MAX_OPCODES, Object, ObjectId, Pickle, Source, Value, describe, object, refused_global,
};

struct Machine<'a> {
    source: Source<'a>,
    /// Next byte.
    at: usize,
    /// The opcode being executed and its byte.
    opcode: u8,
    opcode_at: usize,
    stack: Vec<Value>,
    /// Heights of the stack at the open marks.
    marks: Vec<usize>,
    memo: HashMap<usize, Value>,
    objects: Vec<Object<'a>>,
    /// Items copied from one object to another, which no opcode count bounds.
    copied: usize,
}

/// Runs a pickle up to its `STOP`.
pub(super) fn run(source: Source) -> Result<Pickle> {
    let mut machine = Machine {
        source,
        at: source.start,
        opcode: PROTO,
        opcode_at: source.start,
        stack: Vec::new(),
        marks: Vec::new(),
        memo: HashMap::new(),
        objects: Vec::new(),
        copied: 0,
    };
    for _ in 0..MAX_OPCODES {
        machine.opcode_at = machine.at;
        machine.opcode = machine.byte()?;
        if machine.opcode == STOP {
            let root = machine.pop()?;
            return Ok(Pickle { objects: machine.objects, root, end: machine.at });
        }
        machine.step()?;
    }
    Err(machine.malformed(format!("found more than {MAX_OPCODES} opcodes, expected at most so many in a checkpoint")))
}

impl<'a> Machine<'a> {
    fn step(&mut self) -> Result<()> {
        match self.opcode {
            PROTO => self.protocol(),
            FRAME => self.frame(),
            MARK => self.mark(),
            POP => self.discard(),
            POP_MARK => self.pop_to_mark().map(drop),
            DUP => self.top().and_then(|top| self.push(top)),

            NONE => self.push(Value::None),
            NEWTRUE => self.push(Value::Bool(true)),
            NEWFALSE => self.push(Value::Bool(false)),
            BININT => self.array().and_then(|bytes| self.push(Value::Int(i32::from_le_bytes(bytes).into()))),
            BININT1 => self.byte().and_then(|byte| self.push(Value::Int(byte.into()))),
            BININT2 => self.array().and_then(|bytes| self.push(Value::Int(u16::from_le_bytes(bytes).into()))),
            LONG1 | LONG4 => self.long(),
            BINFLOAT => self.take(8).and_then(|_| self.push(Value::Float)),
            SHORT_BINUNICODE | BINUNICODE | BINUNICODE8 => self.unicode(),
            SHORT_BINSTRING | BINSTRING => self.python2_string(),
            SHORT_BINBYTES | BINBYTES | BINBYTES8 | BYTEARRAY8 => {
                self.sized().and_then(|_| self.push_object(Object::Bytes))
            }

            EMPTY_TUPLE => self.push_object(Object::Tuple(Vec::new())),
            TUPLE1 => self.tuple_of(1),
            TUPLE2 => self.tuple_of(2),
            TUPLE3 => self.tuple_of(3),
            TUPLE => self.pop_to_mark().and_then(|items| self.push_object(Object::Tuple(items))),
            EMPTY_LIST => self.push_object(Object::List(Vec::new())),
            APPEND => self.pop().and_then(|item| self.append(vec![item])),
            APPENDS => self.pop_to_mark().and_then(|items| self.append(items)),
            EMPTY_DICT => self.push_object(Object::Dict(Vec::new())),
            SETITEM => self.pop_many(2).and_then(|pair| self.set_items(pair)),
            SETITEMS => self.pop_to_mark().and_then(|items| self.set_items(items)),
            EMPTY_SET => self.push_object(Object::Opaque),
            ADDITEMS => self.pop_to_mark().and_then(|_| self.expect_opaque()),
            FROZENSET => self.pop_to_mark().and_then(|_| self.push_object(Object::Opaque)),

            BINPUT => self.byte().and_then(|index| self.remember(index.into())),
            LONG_BINPUT => self.count32().and_then(|index| self.remember(index)),
            MEMOIZE => self.remember(self.memo.len()),
            BINGET => self.byte().and_then(|index| self.recall(index.into())),
            LONG_BINGET => self.count32().and_then(|index| self.recall(index)),

            GLOBAL => self.global(),
            STACK_GLOBAL => self.stack_global(),
            REDUCE | NEWOBJ => self.construct(),
            BUILD => self.build(),
            BINPERSID => self.persistent_id(),
            other => Err(self.unknown_opcode(other)),
        }
    }

    fn unknown_opcode(&self, found: u8) -> Error {
        let message = format!("found opcode {found:#04x} ({}), expected one that torch.save writes", op::name(found));
        let code = match op::name(found) {
            _ if op::builds_anything(found) => ErrorCode::Refused,
            "no opcode" => return self.malformed(message),
            _ => ErrorCode::Unsupported,
        };
        Error::new(code, self.source.place(self.opcode_at), message)
            .with_help("load the file in Python and save the weights alone: torch.save(model.state_dict(), FILE)")
    }

    // Bytes of the program.

    fn take(&mut self, count: usize) -> Result<&'a [u8]> {
        let rest = self.source.bytes.get(self.at..).unwrap_or(&[]);
        let Some(taken) = rest.get(..count) else {
            return Err(self.malformed(format!("found {} bytes before the end, expected {count} more", rest.len())));
        };
        self.at += count;
        Ok(taken)
    }

    fn array<const N: usize>(&mut self) -> Result<[u8; N]> {
        let mut bytes = [0; N];
        bytes.copy_from_slice(self.take(N)?);
        Ok(bytes)
    }

    fn byte(&mut self) -> Result<u8> {
        self.array().map(|[byte]| byte)
    }

    fn count32(&mut self) -> Result<usize> {
        self.array().map(|bytes| u32::from_le_bytes(bytes) as usize)
    }

    /// The operand of an opcode that carries its length in 1, 4 or 8 bytes.
    fn sized(&mut self) -> Result<&'a [u8]> {
        let count = match self.opcode {
            SHORT_BINUNICODE | SHORT_BINSTRING | SHORT_BINBYTES | LONG1 => self.byte()?.into(),
            BINUNICODE8 | BINBYTES8 | BYTEARRAY8 => {
                let count = u64::from_le_bytes(self.array()?);
                usize::try_from(count).unwrap_or(usize::MAX)
            }
            _ => self.count32()?,
        };
        self.take(count)
    }

    /// A line of a `GLOBAL`, without its end.
    fn line(&mut self) -> Result<&'a str> {
        let rest = self.source.bytes.get(self.at..).unwrap_or(&[]);
        let Some(end) = rest.iter().take(MAX_NAME).position(|&byte| byte == b'\n') else {
            return Err(self.malformed(format!("found a name without an end, expected a line of at most {MAX_NAME}")));
        };
        self.at += end + 1;
        self.utf8(&rest[..end])
    }

    fn utf8(&self, bytes: &'a [u8]) -> Result<&'a str> {
        std::str::from_utf8(bytes).map_err(|error| self.malformed(format!("found {error}, expected UTF-8")))
    }

    // The stack.

    fn push(&mut self, value: Value) -> Result<()> {
        self.stack.push(value);
        Ok(())
    }

    fn push_object(&mut self, object: Object<'a>) -> Result<()> {
        // At most one object per opcode, so the position fits.
        let id = ObjectId(self.objects.len() as u32);
        self.objects.push(object);
        self.push(Value::Object(id))
    }

    /// Lowest height the opcodes since the last mark may reach.
    fn floor(&self) -> usize {
        self.marks.last().copied().unwrap_or(0)
    }

    fn pop_many(&mut self, count: usize) -> Result<Vec<Value>> {
        let available = self.stack.len() - self.floor();
        if available < count {
            return Err(self.malformed(format!("found {available} values on the stack, expected {count}")));
        }
        Ok(self.stack.split_off(self.stack.len() - count))
    }

    fn pop(&mut self) -> Result<Value> {
        let value = self.top()?;
        self.stack.pop();
        Ok(value)
    }

    fn top(&self) -> Result<Value> {
        match self.stack.last() {
            Some(&value) if self.stack.len() > self.floor() => Ok(value),
            _ => Err(self.malformed("found an empty stack, expected a value")),
        }
    }

    fn mark(&mut self) -> Result<()> {
        if self.marks.len() == MAX_DEPTH {
            return Err(self.malformed(format!("found more than {MAX_DEPTH} nested marks, expected at most so many")));
        }
        self.marks.push(self.stack.len());
        Ok(())
    }

    fn pop_to_mark(&mut self) -> Result<Vec<Value>> {
        match self.marks.pop() {
            Some(height) => Ok(self.stack.split_off(height)),
            None => Err(self.malformed("found no mark, expected one")),
        }
    }

    /// `POP` takes a value, or the mark where one is on top.
    fn discard(&mut self) -> Result<()> {
        if self.marks.last() == Some(&self.stack.len()) {
            self.marks.pop();
            return Ok(());
        }
        self.pop().map(drop)
    }

    // Plain values.

    fn protocol(&mut self) -> Result<()> {
        match self.byte()? {
            2..=5 => Ok(()),
            found => Err(self.malformed(format!("found pickle protocol {found}, expected 2 to 5"))),
        }
    }

    /// Frames only group reads; the length must still be there.
    fn frame(&mut self) -> Result<()> {
        let length = u64::from_le_bytes(self.array()?);
        let rest = self.source.bytes.len().saturating_sub(self.at);
        if usize::try_from(length).is_ok_and(|length| length <= rest) {
            return Ok(());
        }
        Err(self.malformed(format!("found {rest} bytes before the end, expected a frame of {length}")))
    }

    fn long(&mut self) -> Result<()> {
        let bytes = self.sized()?;
        if bytes.len() > 8 {
            return self.push_object(Object::Long(bytes));
        }
        let negative = bytes.last().is_some_and(|byte| byte & 0x80 != 0);
        let mut extended = [if negative { 0xff } else { 0 }; 8];
        extended[..bytes.len()].copy_from_slice(bytes);
        self.push(Value::Int(i64::from_le_bytes(extended)))
    }

    fn unicode(&mut self) -> Result<()> {
        let bytes = self.sized()?;
        let text = self.utf8(bytes)?;
        self.push_object(Object::Text(text))
    }

    fn python2_string(&mut self) -> Result<()> {
        let bytes = self.sized()?;
        self.push_object(std::str::from_utf8(bytes).map_or(Object::Bytes, Object::Text))
    }

    // Containers.

    fn tuple_of(&mut self, count: usize) -> Result<()> {
        let items = self.pop_many(count)?;
        self.push_object(Object::Tuple(items))
    }

    fn top_object(&mut self) -> Result<&mut Object<'a>> {
        match self.top()? {
            Value::Object(ObjectId(at)) => Ok(&mut self.objects[at as usize]),
            _ => Err(self.unexpected_top("an object")),
        }
    }

    fn append(&mut self, items: Vec<Value>) -> Result<()> {
        match self.top_object()? {
            Object::List(list) => list.extend(items),
            Object::Opaque => {}
            _ => return Err(self.unexpected_top("a list")),
        }
        Ok(())
    }

    fn set_items(&mut self, items: Vec<Value>) -> Result<()> {
        let (pairs, rest) = items.as_chunks();
        if !rest.is_empty() {
            return Err(self.malformed(format!("found {} values, expected keys and values in pairs", items.len())));
        }
        match self.top_object()? {
            Object::Dict(dict) => dict.extend(pairs.iter().map(|&[key, value]| (key, value))),
            Object::Opaque => {}
            _ => return Err(self.unexpected_top("a dict")),
        }
        Ok(())
    }

    fn expect_opaque(&mut self) -> Result<()> {
        match self.top_object()? {
            Object::Opaque => Ok(()),
            _ => Err(self.unexpected_top("a set")),
        }
    }

    fn unexpected_top(&self, expected: &str) -> Error {
        let found = self.top().map_or("nothing", |top| describe(&self.objects, top));
        self.malformed(format!("found {found}, expected {expected}"))
    }

    // The memo.

    fn remember(&mut self, index: usize) -> Result<()> {
        if index >= MAX_OPCODES {
            return Err(self.malformed(format!("found memo index {index}, expected less than {MAX_OPCODES}")));
        }
        let top = self.top()?;
        self.memo.insert(index, top);
        Ok(())
    }

    fn recall(&mut self, index: usize) -> Result<()> {
        match self.memo.get(&index) {
            Some(&value) => self.push(value),
            None => Err(self.malformed(format!("found memo index {index}, which nothing was stored at"))),
        }
    }

    // Globals and what is made of them.

    fn global(&mut self) -> Result<()> {
        let (module, name) = (self.line()?, self.line()?);
        self.push_global(module, name)
    }

    fn stack_global(&mut self) -> Result<()> {
        let names = self.pop_many(2)?;
        match (self.text(names[0]), self.text(names[1])) {
            (Some(module), Some(name)) => self.push_global(module, name),
            _ => Err(self.malformed("found something else, expected the names of a module and of its member")),
        }
    }

    fn push_global(&mut self, module: &str, name: &str) -> Result<()> {
        match globals::lookup(module, name) {
            Some(global) => self.push_object(Object::Global(global)),
            None => Err(refused_global(self.here(), module, name)),
        }
    }

    /// `REDUCE` and `NEWOBJ`: a global and its arguments become the value it stands for.
    fn construct(&mut self) -> Result<()> {
        let operands = self.pop_many(2)?;
        let Some(&Object::Global(global)) = object(&self.objects, operands[0]) else {
            return Err(self.expected("a global of the allow-list", operands[0]));
        };
        let arguments = self.short_tuple(operands[1], "arguments")?;
        match (global, arguments.as_slice()) {
            (Global::OrderedDict, []) => self.push_object(Object::Dict(Vec::new())),
            (Global::OrderedDict, &[pairs]) => self.ordered_dict(pairs),
            (Global::RebuildTensor, &[storage, offset, shape, strides, ..]) => {
                self.rebuild_tensor(storage, offset, shape, strides)
            }
            (Global::RebuildParameter, &[tensor, ..]) => self.rebuild_parameter(tensor),
            (Global::Size, &[extents]) => self.push(extents),
            (Global::Inert, _) => self.push_object(Object::Opaque),
            (global, arguments) => {
                Err(self.malformed(format!("found {global:?} with {} arguments, expected others", arguments.len())))
            }
        }
    }

    /// Python 2 pickles an `OrderedDict` with a list of `[key, value]`.
    fn ordered_dict(&mut self, pairs: Value) -> Result<()> {
        let Some(Object::List(pairs)) = object(&self.objects, pairs) else {
            return Err(self.expected("a list of pairs", pairs));
        };
        self.copied += pairs.len();
        if self.copied > MAX_OPCODES {
            return Err(self.malformed(format!("found more than {MAX_OPCODES} dict items, expected fewer")));
        }
        let pair = |&pair: &Value| match object(&self.objects, pair) {
            Some(Object::List(pair) | Object::Tuple(pair)) if pair.len() == 2 => Ok((pair[0], pair[1])),
            _ => Err(self.expected("a pair", pair)),
        };
        let items = pairs.iter().map(pair).collect::<Result<_>>()?;
        self.push_object(Object::Dict(items))
    }

    fn rebuild_tensor(&mut self, storage: Value, offset: Value, shape: Value, strides: Value) -> Result<()> {
        let Some(&Object::Storage { storage, window: (start, end) }) = object(&self.objects, storage) else {
            return Err(self.expected("a storage", storage));
        };
        let (offset, shape, strides) = (self.count(offset)?, self.counts(shape)?, self.counts(strides)?);
        let view = TensorView::new(storage, start..end, offset, shape, strides)
            .map_err(|message| self.malformed(format!("storage {}: {message}", quoted(storage.key))))?;
        self.push_object(Object::Tensor(Box::new(view)))
    }

    fn rebuild_parameter(&mut self, tensor: Value) -> Result<()> {
        match object(&self.objects, tensor) {
            Some(Object::Tensor(_)) => self.push(tensor),
            _ => Err(self.expected("a tensor", tensor)),
        }
    }

    /// `BUILD` sets attributes (`_metadata` of a state dict); none are kept.
    fn build(&mut self) -> Result<()> {
        self.pop()?;
        match self.top_object()? {
            Object::Dict(_) | Object::Opaque => Ok(()),
            _ => Err(self.unexpected_top("a dict")),
        }
    }

    /// `("storage", class, key, location, elements)` and, in the legacy format, `None` or `(key, offset, elements)` of
    /// a view. The location (`cuda:0`) says where the tensor was, not what it is.
    fn persistent_id(&mut self) -> Result<()> {
        let id = self.pop()?;
        let fields = self.short_tuple(id, "a storage's persistent id")?;
        let (&[kind, class, key, _location, elements], view) = match fields.split_first_chunk() {
            Some((first, rest)) if rest.len() <= 1 => (first, rest.first()),
            _ => return Err(self.malformed(format!("found {} fields, expected 5 or 6", fields.len()))),
        };
        if self.text(kind) != Some("storage") {
            return Err(self.expected("the word \"storage\"", kind));
        }
        let Some(&Object::Global(Global::Storage(dtype))) = object(&self.objects, class) else {
            return Err(self.expected("a storage class", class));
        };
        let key = self.text(key).ok_or_else(|| self.expected("a storage key", key))?;
        let elements = self.count(elements)?;
        let window = match view {
            None | Some(Value::None) => (0, elements),
            Some(&view) => self.legacy_view(view, elements)?,
        };
        self.push_object(Object::Storage { storage: StorageRef { key, dtype, elements }, window })
    }

    fn legacy_view(&self, view: Value, elements: usize) -> Result<(usize, usize)> {
        let fields = self.short_tuple(view, "a view")?;
        let &[_key, offset, length] = fields.as_slice() else {
            return Err(self.malformed(format!("found a view of {} fields, expected 3", fields.len())));
        };
        let (start, length) = (self.count(offset)?, self.count(length)?);
        match start.checked_add(length) {
            Some(end) if end <= elements => Ok((start, end)),
            _ => {
                Err(self.malformed(format!("found a view of {length} elements at {start}, expected it in {elements}")))
            }
        }
    }

    // Values with a meaning.

    fn text(&self, value: Value) -> Option<&'a str> {
        match object(&self.objects, value) {
            Some(Object::Text(text)) => Some(text),
            _ => None,
        }
    }

    fn count(&self, value: Value) -> Result<usize> {
        match value {
            Value::Int(count) => usize::try_from(count)
                .map_err(|_| self.malformed(format!("found the number {count}, expected none below zero"))),
            _ => Err(self.expected("a number", value)),
        }
    }

    fn counts(&self, value: Value) -> Result<Vec<usize>> {
        self.short_tuple(value, "extents or strides")?.into_iter().map(|value| self.count(value)).collect()
    }

    /// The items of a tuple (or list) that no checkpoint makes long.
    fn short_tuple(&self, value: Value, what: &str) -> Result<Vec<Value>> {
        match object(&self.objects, value) {
            Some(Object::Tuple(items) | Object::List(items)) if items.len() <= MAX_RANK => Ok(items.clone()),
            Some(Object::Tuple(items) | Object::List(items)) => {
                Err(self.malformed(format!("found {what} of length {}, expected at most {MAX_RANK}", items.len())))
            }
            _ => Err(self.expected(&format!("a tuple ({what})"), value)),
        }
    }

    // Errors.

    fn here(&self) -> String {
        format!("{} ({})", self.source.place(self.opcode_at), op::name(self.opcode))
    }

    fn malformed(&self, message: impl Into<String>) -> Error {
        malformed(self.here(), message)
    }

    fn expected(&self, expected: &str, found: Value) -> Error {
        self.malformed(format!("found {}, expected {expected}", describe(&self.objects, found)))
    }
}
