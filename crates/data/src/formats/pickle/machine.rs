//! The interpreter: one pass over the opcodes, on an arena.

use super::literal::{text_or_bytes, unescaped, unquoted};
use super::scalars::long;
use super::{
    CUT, Id, MAX_FILE_NODES, MAX_FILE_TEXT, MAX_LINE, MAX_NODES, MAX_SHORT, MAX_TEXT, Node,
    PickleError, StoredBytes,
};
use std::collections::BTreeMap;

/// A pickle on its way.
pub(super) struct Machine<'a> {
    bytes: &'a [u8],
    at: usize,
    /// Where the current opcode starts.
    start: usize,
    pub(super) nodes: Vec<Node>,
    pub(super) stack: Vec<Id>,
    marks: Vec<usize>,
    memo: BTreeMap<u32, Id>,
    /// Bytes that calls have copied so far.
    pub(super) copied: usize,
    /// Where the bytes begin in the file in which long byte strings stay.
    pub(super) file_offset: Option<u64>,
    /// Storages whose bytes are in this pickle, by the key that their tensors name.
    pub(super) storages: BTreeMap<String, StoredBytes>,
    /// Bytes in which calls may still look for storages: honest pickles do it once with each of their own.
    pub(super) storage_budget: usize,
}

impl<'a> Machine<'a> {
    pub(super) fn new(bytes: &'a [u8]) -> Self {
        Self {
            bytes,
            at: 0,
            start: 0,
            nodes: Vec::new(),
            stack: Vec::new(),
            marks: Vec::new(),
            memo: BTreeMap::new(),
            copied: 0,
            file_offset: None,
            storages: BTreeMap::new(),
            storage_budget: bytes.len(),
        }
    }

    /// Runs to the end: the object that the pickle is, and where it ends.
    pub(super) fn run(&mut self) -> Result<(Id, usize), PickleError> {
        let most = match self.file_offset {
            Some(_) => MAX_FILE_NODES,
            None => MAX_NODES,
        };
        loop {
            self.start = self.at;
            if self.nodes.len() > most {
                return self.refuse(format!("more than {most} objects"));
            }
            let opcode = self.u8()?;
            match opcode {
                // PROTO
                0x80 => {
                    let version = self.u8()?;
                    if version > 5 {
                        return self.refuse(format!("protocol {version} is not read"));
                    }
                }
                // FRAME
                0x95 => drop(self.take(8)?),
                b'.' => {
                    let root = self.pop()?;
                    return Ok((root, self.at));
                }
                b'(' => self.marks.push(self.stack.len()),
                b'0' => drop(self.pop()?),
                b'1' => drop(self.pop_mark()?),
                b'N' => self.push(Node::None),
                0x88 => self.push(Node::Bool(true)),
                0x89 => self.push(Node::Bool(false)),
                b'K' => {
                    let value = self.u8()?;
                    self.push(Node::Int(value.into()));
                }
                b'M' => {
                    let value = u16::from_le_bytes(self.array()?);
                    self.push(Node::Int(value.into()));
                }
                b'J' => {
                    let value = i32::from_le_bytes(self.array()?);
                    self.push(Node::Int(value.into()));
                }
                // LONG1
                0x8a => {
                    let length = self.u8()?;
                    self.long(length.into())?;
                }
                // LONG4
                0x8b => {
                    let length = self.u32()? as usize;
                    self.long(length)?;
                }
                // Numbers and texts of protocol 0 stand in lines.
                b'I' | b'L' => {
                    let line = self.line(MAX_LINE)?;
                    let node = match (opcode, line) {
                        (b'I', "00") => Node::Bool(false),
                        (b'I', "01") => Node::Bool(true),
                        _ => match line.trim_end_matches('L').parse() {
                            Ok(value) => Node::Int(value),
                            Err(_) => return self.refuse("a line that is no integer"),
                        },
                    };
                    self.push(node);
                }
                b'F' => match self.line(MAX_LINE)?.parse() {
                    Ok(value) => self.push(Node::Float(value)),
                    Err(_) => return self.refuse("a line that is no number"),
                },
                b'S' => {
                    let Some(bytes) = unquoted(self.line_bytes(MAX_TEXT)?) else {
                        return self.refuse("a text without its quotes");
                    };
                    self.push(text_or_bytes(bytes));
                }
                b'V' => {
                    let Some(text) = unescaped(self.line_bytes(MAX_TEXT)?) else {
                        return self.refuse("a text with an escape that is no character");
                    };
                    self.push(Node::Text(text));
                }
                // BINSTRING, SHORT_BINSTRING: what Python 2 called a string.
                b'T' | b'U' => {
                    let length = if opcode == b'T' {
                        self.u32()? as usize
                    } else {
                        self.u8()?.into()
                    };
                    if self.stays(length) {
                        self.payload(length)?;
                        continue;
                    }
                    if length > MAX_TEXT {
                        return self.refuse(format!("a text of {length} bytes"));
                    }
                    let bytes = self.take(length)?.to_vec();
                    self.push(text_or_bytes(bytes));
                }
                b'G' => {
                    let value = f64::from_be_bytes(self.array()?);
                    self.push(Node::Float(value));
                }
                b'X' => {
                    let length = self.u32()? as usize;
                    let text = self.text(length)?;
                    self.push(Node::Text(text));
                }
                // SHORT_BINUNICODE
                0x8c => {
                    let length = self.u8()?;
                    let text = self.text(length.into())?;
                    self.push(Node::Text(text));
                }
                // BINUNICODE8
                0x8d => {
                    let length = self.u64()?;
                    let text = self.text(length)?;
                    self.push(Node::Text(text));
                }
                b'B' => {
                    let length = self.u32()? as usize;
                    self.payload(length)?;
                }
                // BINBYTES8, BYTEARRAY8
                0x8e | 0x96 => {
                    let length = self.u64()?;
                    self.payload(length)?;
                }
                b'C' => {
                    let length = self.u8()?;
                    self.payload(length.into())?;
                }
                // EMPTY_SET, FROZENSET (ADDITEMS, 0x90, is below with APPENDS)
                0x8f => self.push(Node::Set(Vec::new())),
                0x91 => {
                    let items = self.pop_mark()?;
                    self.push(Node::Set(items));
                }
                b'l' => {
                    let items = self.pop_mark()?;
                    self.push(Node::List(items));
                }
                b'd' => {
                    let items = self.pop_mark()?;
                    self.push(Node::Dict(Vec::new()));
                    self.set(&items)?;
                }
                b')' => self.push(Node::Tuple(Vec::new())),
                b']' => self.push(Node::List(Vec::new())),
                b'}' => self.push(Node::Dict(Vec::new())),
                b't' => {
                    let items = self.pop_mark()?;
                    self.push(Node::Tuple(items));
                }
                0x85..=0x87 => {
                    let count = usize::from(opcode - 0x84);
                    let mut items = Vec::with_capacity(count);
                    for _ in 0..count {
                        items.push(self.pop()?);
                    }
                    items.reverse();
                    self.push(Node::Tuple(items));
                }
                b'a' => {
                    let item = self.pop()?;
                    self.append(&[item])?;
                }
                b'e' | 0x90 => {
                    let items = self.pop_mark()?;
                    self.append(&items)?;
                }
                b's' => {
                    let value = self.pop()?;
                    let key = self.pop()?;
                    self.set(&[key, value])?;
                }
                b'u' => {
                    let items = self.pop_mark()?;
                    self.set(&items)?;
                }
                b'q' => {
                    let slot = self.u8()?;
                    self.remember(slot.into())?;
                }
                b'r' => {
                    let slot = self.u32()?;
                    self.remember(slot)?;
                }
                // MEMOIZE
                0x94 => {
                    let slot = self.memo.len() as u32;
                    self.remember(slot)?;
                }
                b'p' | b'g' => match self.line(MAX_LINE)?.parse() {
                    Ok(slot) if opcode == b'p' => self.remember(slot)?,
                    Ok(slot) => self.recall(slot)?,
                    Err(_) => return self.refuse("a memo slot that is no number"),
                },
                // DUP
                b'2' => {
                    let top = self.top()?;
                    self.stack.push(top);
                }
                b'h' => {
                    let slot = self.u8()?;
                    self.recall(slot.into())?;
                }
                b'j' => {
                    let slot = self.u32()?;
                    self.recall(slot)?;
                }
                b'c' => {
                    let module = self.line(MAX_LINE)?;
                    let name = self.line(MAX_LINE)?;
                    let global = self.global(module, name)?;
                    self.push(Node::Global(global));
                }
                // INST, OBJ: an instance with the arguments behind the mark.
                b'i' => {
                    let module = self.line(MAX_LINE)?;
                    let name = self.line(MAX_LINE)?;
                    let class = self.global(module, name)?;
                    let arguments = self.pop_mark()?;
                    self.construct(class, &arguments)?;
                }
                b'o' => {
                    let arguments = self.pop_mark()?;
                    let class = arguments.first().map(|&class| self.node(class));
                    let Some(Node::Global(class)) = class.cloned() else {
                        return self.refuse("an instance of something that is not a name");
                    };
                    self.construct(class, &arguments[1..])?;
                }
                // STACK_GLOBAL
                0x93 => {
                    let (name, module) = (self.pop()?, self.pop()?);
                    let (Node::Text(module), Node::Text(name)) =
                        (self.node(module), self.node(name))
                    else {
                        return self.refuse("a global whose name is not text");
                    };
                    let global = self.global(module, name)?;
                    self.push(Node::Global(global));
                }
                b'R' => self.reduce()?,
                // NEWOBJ
                0x81 => self.new_object()?,
                // NEWOBJ_EX
                0x92 => {
                    let named = self.pop()?;
                    if !matches!(self.node(named), Node::Dict(pairs) if pairs.is_empty()) {
                        return self.refuse("an instance made from named arguments");
                    }
                    self.new_object()?;
                }
                b'b' => self.build()?,
                b'Q' => self.persistent()?,
                other => {
                    return self.refuse(format!(
                        "opcode {other:#04x} is not on the list of those that only describe data"
                    ));
                }
            }
        }
    }

    pub(super) fn refuse<T>(&self, reason: impl Into<String>) -> Result<T, PickleError> {
        Err(PickleError {
            offset: self.start,
            reason: reason.into(),
        })
    }

    /// Bytes that were taken before.
    pub(super) fn earlier(&self, stored: &StoredBytes) -> Option<&'a [u8]> {
        let StoredBytes::File { offset, length } = stored else {
            return None;
        };
        let start = usize::try_from(offset.checked_sub(self.file_offset?)?).ok()?;
        self.bytes.get(start..start.checked_add(*length as usize)?)
    }

    fn take(&mut self, count: usize) -> Result<&'a [u8], PickleError> {
        let Some(bytes) = self.bytes[self.at..].get(..count) else {
            return self.refuse(CUT);
        };
        self.at += count;
        Ok(bytes)
    }

    /// Whether a byte string of this length stays in the file.
    fn stays(&self, length: usize) -> bool {
        self.file_offset.is_some() && length > MAX_SHORT
    }

    /// A byte string as an object.
    fn payload(&mut self, length: usize) -> Result<(), PickleError> {
        let at = self.at as u64;
        let bytes = self.take(length)?;
        let node = match self.file_offset {
            Some(start) if length > MAX_SHORT => Node::Stored(StoredBytes::File {
                offset: start + at,
                length: length as u64,
            }),
            _ => Node::Bytes(bytes.to_vec()),
        };
        self.push(node);
        Ok(())
    }

    fn array<const N: usize>(&mut self) -> Result<[u8; N], PickleError> {
        let mut out = [0; N];
        out.copy_from_slice(self.take(N)?);
        Ok(out)
    }

    fn u8(&mut self) -> Result<u8, PickleError> {
        Ok(self.array::<1>()?[0])
    }

    fn u32(&mut self) -> Result<u32, PickleError> {
        Ok(u32::from_le_bytes(self.array()?))
    }

    fn u64(&mut self) -> Result<usize, PickleError> {
        let length = u64::from_le_bytes(self.array()?);
        // More than there are bytes: taking them fails.
        Ok(usize::try_from(length).unwrap_or(usize::MAX))
    }

    fn long(&mut self, length: usize) -> Result<(), PickleError> {
        let bytes = self.take(length)?;
        let Some(value) = long(bytes) else {
            return self.refuse("an integer of more than 16 bytes");
        };
        self.push(Node::Int(value));
        Ok(())
    }

    fn text(&mut self, length: usize) -> Result<String, PickleError> {
        let most = match self.file_offset {
            Some(_) => MAX_FILE_TEXT,
            None => MAX_TEXT,
        };
        if length > most {
            return self.refuse(format!("a text of {length} bytes"));
        }
        match std::str::from_utf8(self.take(length)?) {
            Ok(text) => Ok(text.to_owned()),
            Err(_) => self.refuse("a text that is not UTF-8"),
        }
    }

    fn line_bytes(&mut self, longest: usize) -> Result<&'a [u8], PickleError> {
        let rest = &self.bytes[self.at..];
        let Some(end) = rest.iter().take(longest).position(|&b| b == b'\n') else {
            return self.refuse(if rest.len() < longest {
                CUT
            } else {
                "a line without an end"
            });
        };
        self.at += end + 1;
        let line = &rest[..end];
        Ok(line.strip_suffix(b"\r").unwrap_or(line))
    }

    fn line(&mut self, longest: usize) -> Result<&'a str, PickleError> {
        match std::str::from_utf8(self.line_bytes(longest)?) {
            Ok(text) => Ok(text),
            Err(_) => self.refuse("a name that is not UTF-8"),
        }
    }

    pub(super) fn push(&mut self, node: Node) {
        self.stack.push(Id(self.nodes.len() as u32));
        self.nodes.push(node);
    }

    pub(super) fn pop(&mut self) -> Result<Id, PickleError> {
        let floor = self.marks.last().copied().unwrap_or(0);
        if self.stack.len() <= floor {
            return self.refuse("the stack is empty");
        }
        match self.stack.pop() {
            Some(id) => Ok(id),
            None => self.refuse("the stack is empty"),
        }
    }

    fn pop_mark(&mut self) -> Result<Vec<Id>, PickleError> {
        let Some(mark) = self.marks.pop() else {
            return self.refuse("no mark on the stack");
        };
        Ok(self.stack.split_off(mark))
    }

    pub(super) fn top(&self) -> Result<Id, PickleError> {
        let floor = self.marks.last().copied().unwrap_or(0);
        match self.stack.last() {
            Some(&id) if self.stack.len() > floor => Ok(id),
            _ => self.refuse("the stack is empty"),
        }
    }

    pub(super) fn node(&self, id: Id) -> &Node {
        &self.nodes[id.0 as usize]
    }

    fn append(&mut self, items: &[Id]) -> Result<(), PickleError> {
        let list = self.top()?;
        match &mut self.nodes[list.0 as usize] {
            Node::List(list) | Node::Set(list) => list.extend(items),
            _ => return self.refuse("items appended to something that is not a list"),
        }
        Ok(())
    }

    fn set(&mut self, items: &[Id]) -> Result<(), PickleError> {
        let dict = self.top()?;
        if !items.len().is_multiple_of(2) {
            return self.refuse("a key without a value");
        }
        match &mut self.nodes[dict.0 as usize] {
            Node::Dict(pairs) => pairs.extend(items.chunks_exact(2).map(|p| (p[0], p[1]))),
            _ => return self.refuse("items set on something that is not a dictionary"),
        }
        Ok(())
    }

    fn remember(&mut self, slot: u32) -> Result<(), PickleError> {
        let top = self.top()?;
        self.memo.insert(slot, top);
        Ok(())
    }

    fn recall(&mut self, slot: u32) -> Result<(), PickleError> {
        match self.memo.get(&slot) {
            Some(&id) => self.stack.push(id),
            None => return self.refuse(format!("memo slot {slot} is empty")),
        }
        Ok(())
    }
}
