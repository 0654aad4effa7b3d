//! What stands before the data: a dictionary in Python's syntax.

use super::{Dtype, FormatError, malformed};

/// What stands before the data.
pub(super) struct Header {
    pub dtype: Dtype,
    pub big_endian: bool,
    pub fortran: bool,
    pub shape: Vec<usize>,
    /// Where the data starts.
    pub end: usize,
}

impl Header {
    pub fn parse(bytes: &[u8]) -> Result<Self, FormatError> {
        if !bytes.starts_with(b"\x93NUMPY") {
            return Err(malformed(0, "not an npy file: wrong magic"));
        }
        let (start, length) = match (bytes.get(6), bytes.get(8..12)) {
            (Some(1), Some(l)) => (10, u32::from(u16::from_le_bytes([l[0], l[1]]))),
            (Some(2 | 3), Some(l)) => (12, u32::from_le_bytes([l[0], l[1], l[2], l[3]])),
            (Some(v), Some(_)) => return Err(malformed(6, format!("version {v} is unknown"))),
            _ => return Err(malformed(bytes.len() as u64, "the header is cut short")),
        };
        if length > 1 << 16 {
            return Err(malformed(8, format!("a header of {length} bytes")));
        }
        let end = start + length as usize;
        let text = bytes
            .get(start..end)
            .ok_or_else(|| malformed(bytes.len() as u64, "the header is cut short"))?;
        let text = std::str::from_utf8(text)
            .map_err(|_| malformed(start as u64, "the header is not text"))?;
        let mut parser = Literal { text, at: 0 };
        let fields = parser.dict().map_err(|(at, reason)| {
            malformed((start + at) as u64, format!("in the header: {reason}"))
        })?;
        let wrong = |what: &str| malformed(start as u64, format!("the header has no valid {what}"));
        let mut found = (None, None, None);
        for (key, value) in fields {
            match (key, value) {
                ("descr", Value::Text(t)) => found.0 = Some(t),
                ("fortran_order", Value::Bool(b)) => found.1 = Some(b),
                ("shape", Value::Tuple(t)) => found.2 = Some(t),
                ("descr", _) => return Err(wrong("type: records are not read")),
                (other, _) => return Err(wrong(&format!("entry `{other}`"))),
            }
        }
        let descr = found.0.ok_or_else(|| wrong("`descr`"))?;
        let (dtype, big_endian) = dtype(descr).map_err(|reason| malformed(start as u64, reason))?;
        Ok(Self {
            dtype,
            big_endian,
            fortran: found.1.ok_or_else(|| wrong("`fortran_order`"))?,
            shape: found.2.ok_or_else(|| wrong("`shape`"))?,
            end,
        })
    }
}

/// Where the pickle of an npy file of objects starts.
pub(super) fn pickle_start(bytes: &[u8]) -> Result<usize, FormatError> {
    let refused = match Header::parse(bytes) {
        Ok(header) => {
            let code = header.dtype.code();
            let reason = format!("an array of type `{code}`, not of objects");
            return Err(malformed(0, reason));
        }
        Err(error) => error,
    };
    let end = match (bytes.get(6), bytes.get(8..12)) {
        (Some(1), Some(l)) => 10 + usize::from(u16::from_le_bytes([l[0], l[1]])),
        (_, Some(l)) => 12 + u32::from_le_bytes([l[0], l[1], l[2], l[3]]) as usize,
        _ => return Err(refused),
    };
    let header = bytes.get(10..end).unwrap_or(&[]);
    let objects = header.windows(4).any(|word| word == b"'|O'");
    if objects { Ok(end) } else { Err(refused) }
}

/// The element type that `descr` names, and whether its bytes are in big-endian order.
pub(super) fn dtype(descr: &str) -> Result<(Dtype, bool), String> {
    let (order, kind) = descr.split_at(usize::from(descr.starts_with(['<', '>', '|', '='])));
    let dtype = Dtype::ALL.into_iter().find(|d| &d.code()[1..] == kind);
    match dtype {
        Some(dtype) => Ok((dtype, order == ">")),
        None => Err(format!(
            "elements of type `{descr}` are not read{}",
            if kind.starts_with('O') {
                ": objects would have to be unpickled"
            } else {
                ""
            }
        )),
    }
}

/// The little of Python's literals that headers use.
struct Literal<'a> {
    text: &'a str,
    at: usize,
}

enum Value<'a> {
    Text(&'a str),
    Bool(bool),
    Tuple(Vec<usize>),
    Other,
}

type LiteralError = (usize, &'static str);

impl<'a> Literal<'a> {
    fn dict(&mut self) -> Result<Vec<(&'a str, Value<'a>)>, LiteralError> {
        let mut fields = Vec::new();
        self.expect(b'{')?;
        while !self.accept(b'}') {
            let key = self.string()?;
            self.expect(b':')?;
            fields.push((key, self.value()?));
            if !self.accept(b',') {
                self.expect(b'}')?;
                break;
            }
        }
        self.space();
        if self.at < self.text.len() {
            return Err((self.at, "something follows the dictionary"));
        }
        Ok(fields)
    }

    fn value(&mut self) -> Result<Value<'a>, LiteralError> {
        match self.peek() {
            Some(b'\'' | b'"') => Ok(Value::Text(self.string()?)),
            Some(b'(') => self.tuple(),
            Some(b'[') => {
                // A record type: skip to its last bracket, never back; the caller says that it is not read.
                let rest = &self.text[self.at..];
                self.at += rest.rfind(']').map_or(rest.len(), |end| end + 1);
                Ok(Value::Other)
            }
            _ => {
                for (word, value) in [("True", true), ("False", false)] {
                    if self.text[self.at..].starts_with(word) {
                        self.at += word.len();
                        return Ok(Value::Bool(value));
                    }
                }
                Err((self.at, "an unknown value"))
            }
        }
    }

    fn tuple(&mut self) -> Result<Value<'a>, LiteralError> {
        let mut numbers = Vec::new();
        self.expect(b'(')?;
        while !self.accept(b')') {
            if numbers.len() == 32 {
                return Err((self.at, "more than 32 axes"));
            }
            numbers.push(self.number()?);
            if !self.accept(b',') {
                self.expect(b')')?;
                break;
            }
        }
        Ok(Value::Tuple(numbers))
    }

    fn number(&mut self) -> Result<usize, LiteralError> {
        self.space();
        let rest = &self.text[self.at..];
        let digits = rest.bytes().take_while(u8::is_ascii_digit).count();
        let number = rest[..digits]
            .parse()
            .map_err(|_| (self.at, "an axis is not a number"))?;
        self.at += digits;
        // Python 2 wrote long integers as `3L`.
        if self.text[self.at..].starts_with('L') {
            self.at += 1;
        }
        Ok(number)
    }

    fn string(&mut self) -> Result<&'a str, LiteralError> {
        let quote = match self.peek() {
            Some(q @ (b'\'' | b'"')) => char::from(q),
            _ => return Err((self.at, "a quote is missing")),
        };
        let rest = &self.text[self.at + 1..];
        let end = rest.find(quote).ok_or((self.at, "a quote is missing"))?;
        self.at += end + 2;
        Ok(&rest[..end])
    }

    fn space(&mut self) {
        let rest = &self.text[self.at..];
        self.at += rest.len() - rest.trim_start().len();
    }

    fn peek(&mut self) -> Option<u8> {
        self.space();
        self.text.as_bytes().get(self.at).copied()
    }

    fn accept(&mut self, byte: u8) -> bool {
        let yes = self.peek() == Some(byte);
        self.at += usize::from(yes);
        yes
    }

    fn expect(&mut self, byte: u8) -> Result<(), LiteralError> {
        if self.accept(byte) {
            return Ok(());
        }
        Err((self.at, "not the dictionary that NumPy writes"))
    }
}
