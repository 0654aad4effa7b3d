//! The interpreter: one pass over the opcodes, on an arena.

use super::objects::long;
use super::{Id, MAX_NODES, MAX_TEXT, Node, PickleError};
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
        }
    }

    /// All objects, and the one that the pickle is.
    pub(super) fn run(mut self) -> Result<(Vec<Node>, Id), PickleError> {
        loop {
            self.start = self.at;
            if self.nodes.len() > MAX_NODES {
                return self.refuse(format!("more than {MAX_NODES} objects"));
            }
            let opcode = self.u8()?;
            match opcode {
                // PROTO
                0x80 => {
                    let version = self.u8()?;
                    if !(2..=5).contains(&version) {
                        return self.refuse(format!("protocol {version} is not read"));
                    }
                }
                // FRAME
                0x95 => drop(self.take(8)?),
                b'.' => {
                    let root = self.pop()?;
                    return Ok((self.nodes, root));
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
                    let bytes = self.take(length.into())?;
                    let Some(value) = long(bytes) else {
                        return self.refuse("an integer of more than 16 bytes");
                    };
                    self.push(Node::Int(value));
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
                b'B' => {
                    let length = self.u32()? as usize;
                    let bytes = self.take(length)?.to_vec();
                    self.push(Node::Bytes(bytes));
                }
                b'C' => {
                    let length = self.u8()?;
                    let bytes = self.take(length.into())?.to_vec();
                    self.push(Node::Bytes(bytes));
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
                b'e' => {
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
                b'h' => {
                    let slot = self.u8()?;
                    self.recall(slot.into())?;
                }
                b'j' => {
                    let slot = self.u32()?;
                    self.recall(slot)?;
                }
                b'c' => {
                    let module = self.line()?;
                    let name = self.line()?;
                    let global = self.global(module, name)?;
                    self.push(Node::Global(global));
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

    fn take(&mut self, count: usize) -> Result<&'a [u8], PickleError> {
        let Some(bytes) = self.bytes[self.at..].get(..count) else {
            return self.refuse("the pickle is cut short");
        };
        self.at += count;
        Ok(bytes)
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

    fn text(&mut self, length: usize) -> Result<String, PickleError> {
        if length > MAX_TEXT {
            return self.refuse(format!("a text of {length} bytes"));
        }
        match std::str::from_utf8(self.take(length)?) {
            Ok(text) => Ok(text.to_owned()),
            Err(_) => self.refuse("a text that is not UTF-8"),
        }
    }

    fn line(&mut self) -> Result<&'a str, PickleError> {
        let rest = &self.bytes[self.at..];
        let Some(end) = rest.iter().take(1024).position(|&b| b == b'\n') else {
            return self.refuse("a name without an end");
        };
        self.at += end + 1;
        match std::str::from_utf8(&rest[..end]) {
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
            Node::List(list) => list.extend(items),
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
