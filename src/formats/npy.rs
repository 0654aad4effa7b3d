//! NumPy's npy: one array with its type and shape (NEP 1, versions 1 to 3).
//!
//! Read: `f2 f4 f8 i1 i2 i4 i8 u1 u2 u4 u8 b1` in either byte order, C or Fortran order, into C order. Objects, strings,
//! records, complex numbers and dates are refused. Written: version 1, little-endian, C order, byte for byte what NumPy writes.

use super::FormatError;
use half::f16;
use ndarray::{ArrayD, IxDyn};
use std::path::Path;

/// The element type of an array.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Dtype {
    Bool,
    I8,
    I16,
    I32,
    I64,
    U8,
    U16,
    U32,
    U64,
    F16,
    F32,
    F64,
}

/// An array as it lies in the file, in C order.
#[derive(Debug, Clone, PartialEq)]
pub struct NpyArray {
    pub shape: Vec<usize>,
    pub data: NpyData,
}

/// The elements of an [`NpyArray`].
#[derive(Debug, Clone, PartialEq)]
pub enum NpyData {
    Bool(Vec<bool>),
    I8(Vec<i8>),
    I16(Vec<i16>),
    I32(Vec<i32>),
    I64(Vec<i64>),
    U8(Vec<u8>),
    U16(Vec<u16>),
    U32(Vec<u32>),
    U64(Vec<u64>),
    F16(Vec<f16>),
    F32(Vec<f32>),
    F64(Vec<f64>),
}

/// Evaluates `$body` with `$v` bound to the vector of whatever variant `$data` is.
macro_rules! with_data {
    ($data:expr, $v:ident => $body:expr) => {
        match $data {
            NpyData::Bool($v) => $body,
            NpyData::I8($v) => $body,
            NpyData::I16($v) => $body,
            NpyData::I32($v) => $body,
            NpyData::I64($v) => $body,
            NpyData::U8($v) => $body,
            NpyData::U16($v) => $body,
            NpyData::U32($v) => $body,
            NpyData::U64($v) => $body,
            NpyData::F16($v) => $body,
            NpyData::F32($v) => $body,
            NpyData::F64($v) => $body,
        }
    };
}

/// Reads the array in the file at `path`.
pub fn read(path: &Path) -> Result<NpyArray, FormatError> {
    std::fs::read(path)
        .map_err(FormatError::from)
        .and_then(|bytes| parse(&bytes))
        .map_err(|e| e.in_file(path))
}

/// Writes `array` to `path` (to a temporary name first, then renamed).
pub fn write(path: &Path, array: &NpyArray) -> Result<(), FormatError> {
    super::write_atomically(path, &to_bytes(array)).map_err(|e| e.in_file(path))
}

/// Reads an array from the bytes of an npy file.
pub fn parse(bytes: &[u8]) -> Result<NpyArray, FormatError> {
    let header = Header::parse(bytes)?;
    let body = &bytes[header.end..];
    let count = header
        .shape
        .iter()
        .try_fold(1usize, |n, &d| n.checked_mul(d))
        .ok_or_else(|| malformed(10, format!("shape {:?} is absurd", header.shape)))?;
    let width = header.dtype.width();
    if count.checked_mul(width) != Some(body.len()) {
        let reason = format!(
            "shape {:?} of {width}-byte elements does not fit the {} bytes of data",
            header.shape,
            body.len()
        );
        return Err(malformed(header.end as u64, reason));
    }
    let data = decode(body, &header)?;
    let (shape, data) = if header.fortran && header.shape.len() > 1 {
        let order = c_order(&header.shape);
        let data = with_data!(&data, v => NpyData::from_vec(order.map(|i| v[i]).collect()));
        (header.shape, data)
    } else {
        (header.shape, data)
    };
    Ok(NpyArray { shape, data })
}

/// The bytes of an npy file (version 1.0, little-endian, C order).
pub fn to_bytes(array: &NpyArray) -> Vec<u8> {
    let mut shape: Vec<String> = array.shape.iter().map(usize::to_string).collect();
    if shape.len() == 1 {
        shape.push(String::new());
    }
    let shape = shape.join(", ").trim_end().to_owned();
    let code = array.data.dtype().code();
    let mut header = format!("{{'descr': '{code}', 'fortran_order': False, 'shape': ({shape}), }}");
    // NumPy reserves room to grow the first axis in place, then fills up to a multiple of 64.
    let first = array.shape.first().map_or(0, |n| n.to_string().len());
    if !array.shape.is_empty() {
        header.push_str(&" ".repeat(21 - first));
    }
    let fill = 64 - (11 + header.len()) % 64;
    header.push_str(&" ".repeat(fill));
    header.push('\n');
    let mut out = b"\x93NUMPY\x01\x00".to_vec();
    out.extend((header.len() as u16).to_le_bytes());
    out.extend(header.as_bytes());
    with_data!(&array.data, v => v.iter().for_each(|x| x.append_to(&mut out)));
    out
}

impl NpyArray {
    /// The number of elements.
    pub fn len(&self) -> usize {
        self.shape.iter().product()
    }

    /// Whether there is no element.
    pub fn is_empty(&self) -> bool {
        self.len() == 0
    }

    pub fn dtype(&self) -> Dtype {
        self.data.dtype()
    }

    /// The array with elements of type `T`.
    ///
    /// Between floats values are rounded, and only a finite value that would become infinite is an error. Every other
    /// conversion must be exact: integers in range, floats that are whole numbers, bools as 0 and 1.
    pub fn to<T: Element>(&self) -> Result<ArrayD<T>, FormatError> {
        let convert = |index: usize, value: Option<T>| {
            value.ok_or_else(|| FormatError::Conversion {
                reason: format!(
                    "element {index} of the array ({}) cannot be held by {}",
                    self.data.dtype().code(),
                    T::DTYPE.code()
                ),
            })
        };
        let values: Result<Vec<T>, FormatError> = with_data!(&self.data, v => v
            .iter()
            .enumerate()
            .map(|(i, &x)| convert(i, T::from_number(x.to_number())))
            .collect());
        ArrayD::from_shape_vec(IxDyn(&self.shape), values?).map_err(|e| FormatError::Conversion {
            reason: e.to_string(),
        })
    }

    /// [`NpyArray::to`], and the array must have exactly this number of axes: `array.to_dim::<f64, ndarray::Ix2>()`.
    pub fn to_dim<T: Element, D: ndarray::Dimension>(
        &self,
    ) -> Result<ndarray::Array<T, D>, FormatError> {
        self.to::<T>()?
            .into_dimensionality()
            .map_err(|_| FormatError::Conversion {
                reason: format!(
                    "the array has shape {:?}, expected {} axes",
                    self.shape,
                    D::NDIM.unwrap_or_default()
                ),
            })
    }
}

impl<T: Element, D: ndarray::Dimension> From<&ndarray::Array<T, D>> for NpyArray {
    fn from(array: &ndarray::Array<T, D>) -> Self {
        Self {
            shape: array.shape().to_vec(),
            data: NpyData::from_vec(array.iter().copied().collect()),
        }
    }
}

impl NpyData {
    pub fn dtype(&self) -> Dtype {
        fn of<T: Element>(_: &[T]) -> Dtype {
            T::DTYPE
        }
        with_data!(self, v => of(v))
    }

    /// Wraps a vector of any supported element type.
    pub fn from_vec<T: Element>(values: Vec<T>) -> Self {
        T::wrap(values)
    }
}

impl Dtype {
    const ALL: [Self; 12] = [
        Self::Bool,
        Self::I8,
        Self::I16,
        Self::I32,
        Self::I64,
        Self::U8,
        Self::U16,
        Self::U32,
        Self::U64,
        Self::F16,
        Self::F32,
        Self::F64,
    ];

    /// Bytes per element.
    pub fn width(self) -> usize {
        match self {
            Self::Bool | Self::I8 | Self::U8 => 1,
            Self::I16 | Self::U16 | Self::F16 => 2,
            Self::I32 | Self::U32 | Self::F32 => 4,
            Self::I64 | Self::U64 | Self::F64 => 8,
        }
    }

    /// NumPy's `descr`.
    pub fn code(self) -> &'static str {
        match self {
            Self::Bool => "|b1",
            Self::I8 => "|i1",
            Self::I16 => "<i2",
            Self::I32 => "<i4",
            Self::I64 => "<i8",
            Self::U8 => "|u1",
            Self::U16 => "<u2",
            Self::U32 => "<u4",
            Self::U64 => "<u8",
            Self::F16 => "<f2",
            Self::F32 => "<f4",
            Self::F64 => "<f8",
        }
    }
}

/// A number on its way between element types, without loss.
#[derive(Debug, Clone, Copy)]
pub enum Number {
    Integer(i128),
    Float(f64),
}

mod sealed {
    pub trait Sealed {}
}

/// An element type that npy files can hold. Sealed: the list is [`Dtype`]'s.
pub trait Element: Copy + sealed::Sealed + 'static {
    const DTYPE: Dtype;
    #[doc(hidden)]
    fn to_number(self) -> Number;
    #[doc(hidden)]
    fn from_number(number: Number) -> Option<Self>;
    #[doc(hidden)]
    fn wrap(values: Vec<Self>) -> NpyData;
    #[doc(hidden)]
    fn append_to(self, out: &mut Vec<u8>);
}

/// The whole number that `number` is, if it is one.
fn whole(number: Number) -> Option<i128> {
    match number {
        Number::Integer(i) => Some(i),
        Number::Float(f) if f.fract() == 0.0 && f.abs() < 1.8e19 => Some(f as i128),
        Number::Float(_) => None,
    }
}

macro_rules! integers {
    ($($t:ty => $variant:ident),*) => { $(
        impl sealed::Sealed for $t {}
        impl Element for $t {
            const DTYPE: Dtype = Dtype::$variant;
            fn to_number(self) -> Number {
                Number::Integer(self.into())
            }
            fn from_number(number: Number) -> Option<Self> {
                whole(number)?.try_into().ok()
            }
            fn wrap(values: Vec<Self>) -> NpyData {
                NpyData::$variant(values)
            }
            fn append_to(self, out: &mut Vec<u8>) {
                out.extend(self.to_le_bytes());
            }
        }
    )* };
}
integers!(i8 => I8, i16 => I16, i32 => I32, i64 => I64, u8 => U8, u16 => U16, u32 => U32, u64 => U64);

macro_rules! floats {
    ($($t:ty => $variant:ident, $from:expr, $digits:expr);*) => { $(
        impl sealed::Sealed for $t {}
        impl Element for $t {
            const DTYPE: Dtype = Dtype::$variant;
            fn to_number(self) -> Number {
                Number::Float(self.into())
            }
            fn from_number(number: Number) -> Option<Self> {
                match number {
                    Number::Integer(i) if i.unsigned_abs() <= 1 << $digits => Some($from(i as f64)),
                    Number::Integer(_) => None,
                    Number::Float(f) => {
                        let value: Self = $from(f);
                        (value.is_finite() || !f.is_finite()).then_some(value)
                    }
                }
            }
            fn wrap(values: Vec<Self>) -> NpyData {
                NpyData::$variant(values)
            }
            fn append_to(self, out: &mut Vec<u8>) {
                out.extend(self.to_le_bytes());
            }
        }
    )* };
}
floats!(f16 => F16, f16::from_f64, 11; f32 => F32, |f: f64| f as f32, 24; f64 => F64, |f: f64| f, 53);

impl sealed::Sealed for bool {}
impl Element for bool {
    const DTYPE: Dtype = Dtype::Bool;
    fn to_number(self) -> Number {
        Number::Integer(self.into())
    }
    fn from_number(number: Number) -> Option<Self> {
        match whole(number)? {
            0 => Some(false),
            1 => Some(true),
            _ => None,
        }
    }
    fn wrap(values: Vec<Self>) -> NpyData {
        NpyData::Bool(values)
    }
    fn append_to(self, out: &mut Vec<u8>) {
        out.push(self.into());
    }
}

fn malformed(offset: u64, reason: impl Into<String>) -> FormatError {
    FormatError::malformed("npy", offset, reason)
}

/// What stands before the data.
struct Header {
    dtype: Dtype,
    big_endian: bool,
    fortran: bool,
    shape: Vec<usize>,
    /// Where the data starts.
    end: usize,
}

impl Header {
    fn parse(bytes: &[u8]) -> Result<Self, FormatError> {
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
        let (order, kind) = descr.split_at(usize::from(descr.starts_with(['<', '>', '|', '='])));
        let dtype = Dtype::ALL
            .into_iter()
            .find(|d| &d.code()[1..] == kind)
            .ok_or_else(|| {
                let why = if kind.starts_with('O') {
                    ": objects would have to be unpickled"
                } else {
                    ""
                };
                malformed(
                    start as u64,
                    format!("elements of type `{descr}` are not read{why}"),
                )
            })?;
        Ok(Self {
            dtype,
            big_endian: order == ">",
            fortran: found.1.ok_or_else(|| wrong("`fortran_order`"))?,
            shape: found.2.ok_or_else(|| wrong("`shape`"))?,
            end,
        })
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
                // A record type: skip it, the caller says that it is not read.
                self.at = self.text.rfind(']').unwrap_or(self.at) + 1;
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

/// The elements in file order. `body` has been checked to be a whole number of elements.
fn decode(body: &[u8], header: &Header) -> Result<NpyData, FormatError> {
    macro_rules! numbers {
        ($variant:ident, $t:ty) => {
            NpyData::$variant(
                body.chunks_exact(size_of::<$t>())
                    .map(|chunk| {
                        let mut bytes = [0; size_of::<$t>()];
                        bytes.copy_from_slice(chunk);
                        if header.big_endian {
                            <$t>::from_be_bytes(bytes)
                        } else {
                            <$t>::from_le_bytes(bytes)
                        }
                    })
                    .collect(),
            )
        };
    }
    Ok(match header.dtype {
        Dtype::Bool => {
            if let Some(at) = body.iter().position(|&b| b > 1) {
                let reason = format!("a truth value of {}", body[at]);
                return Err(malformed((header.end + at) as u64, reason));
            }
            NpyData::Bool(body.iter().map(|&b| b == 1).collect())
        }
        Dtype::U8 => NpyData::U8(body.to_vec()),
        Dtype::I8 => numbers!(I8, i8),
        Dtype::I16 => numbers!(I16, i16),
        Dtype::I32 => numbers!(I32, i32),
        Dtype::I64 => numbers!(I64, i64),
        Dtype::U16 => numbers!(U16, u16),
        Dtype::U32 => numbers!(U32, u32),
        Dtype::U64 => numbers!(U64, u64),
        Dtype::F16 => numbers!(F16, f16),
        Dtype::F32 => numbers!(F32, f32),
        Dtype::F64 => numbers!(F64, f64),
    })
}

/// For every element in C order, where it lies in Fortran order.
fn c_order(shape: &[usize]) -> impl Iterator<Item = usize> {
    let mut strides = Vec::with_capacity(shape.len());
    let mut stride = 1;
    for &d in shape {
        strides.push(stride);
        stride *= d.max(1);
    }
    let shape = shape.to_vec();
    let count = shape.iter().product();
    (0..count).map(move |mut i| {
        let mut at = 0;
        for (d, s) in shape.iter().zip(&strides).rev() {
            at += i % d * s;
            i /= d;
        }
        at
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    /// A version 1 file with this header text.
    fn file(header: &str, body: &[u8]) -> Vec<u8> {
        let mut out = b"\x93NUMPY\x01\x00".to_vec();
        out.extend((header.len() as u16).to_le_bytes());
        out.extend(header.as_bytes());
        out.extend(body);
        out
    }

    #[test]
    fn every_type_survives_the_round_trip() {
        let all = [
            NpyData::Bool(vec![true, false, true]),
            NpyData::I8(vec![-128, 0, 127]),
            NpyData::I16(vec![i16::MIN, 0, i16::MAX]),
            NpyData::I32(vec![i32::MIN, 0, i32::MAX]),
            NpyData::I64(vec![i64::MIN, 0, i64::MAX]),
            NpyData::U8(vec![0, 1, 255]),
            NpyData::U16(vec![0, 1, u16::MAX]),
            NpyData::U32(vec![0, 1, u32::MAX]),
            NpyData::U64(vec![0, 1, u64::MAX]),
            NpyData::F16(vec![f16::MIN, f16::ONE, f16::INFINITY]),
            NpyData::F32(vec![f32::MIN, 0.1, f32::INFINITY]),
            NpyData::F64(vec![f64::MIN, 0.1, f64::INFINITY]),
        ];
        for data in all {
            let array = NpyArray {
                shape: vec![3, 1],
                data,
            };
            assert_eq!(parse(&to_bytes(&array)).unwrap(), array);
        }
    }

    #[test]
    fn bytes_are_those_that_numpy_writes() {
        // numpy 2.4: np.save of np.array([[1.5, -2]], "<f4").
        let array = NpyArray::from(&ndarray::arr2(&[[1.5f32, -2.0]]));
        let mut expected = b"\x93NUMPY\x01\x00\x76\x00".to_vec();
        expected.extend(b"{'descr': '<f4', 'fortran_order': False, 'shape': (1, 2), }");
        expected.resize(127, b' ');
        expected.push(b'\n');
        expected.extend([0, 0, 0xc0, 0x3f, 0, 0, 0, 0xc0]);
        assert_eq!(to_bytes(&array), expected);
    }

    #[test]
    fn fortran_order_and_big_endian_become_c_order() {
        // np.array([[1, 2, 3], [4, 5, 6]], ">i2", order="F")
        let body: Vec<u8> = [1i16, 4, 2, 5, 3, 6]
            .iter()
            .flat_map(|v| v.to_be_bytes())
            .collect();
        let bytes = file(
            "{'descr': '>i2', 'fortran_order': True, 'shape': (2, 3), }\n",
            &body,
        );
        let array = parse(&bytes).unwrap();
        assert_eq!(array.data, NpyData::I16(vec![1, 2, 3, 4, 5, 6]));
        let matrix = array.to_dim::<f64, ndarray::Ix2>().unwrap();
        assert_eq!(matrix[[1, 0]], 4.0);
        assert!(array.to_dim::<f64, ndarray::Ix1>().is_err());
    }

    #[test]
    fn scalars_and_empty_arrays_are_arrays() {
        let scalar = parse(&file(
            "{'descr': '<i8', 'fortran_order': False, 'shape': (), }",
            &7i64.to_le_bytes(),
        ))
        .unwrap();
        assert_eq!(scalar.to::<u8>().unwrap()[[]], 7);
        let empty = parse(&file(
            "{'descr': '<f4', 'fortran_order': True, 'shape': (0, 3), }",
            &[],
        ))
        .unwrap();
        assert!(empty.is_empty());
        assert_eq!(parse(&to_bytes(&empty)).unwrap(), empty);
        assert_eq!(parse(&to_bytes(&scalar)).unwrap(), scalar);
    }

    #[test]
    fn conversions_that_would_change_a_value_are_errors() {
        let ints = NpyArray::from(&ndarray::arr1(&[0i64, 300, -1]));
        assert!(ints.to::<u8>().is_err());
        assert!(ints.to::<f32>().is_ok());
        let large = NpyArray::from(&ndarray::arr1(&[(1i64 << 53) + 1]));
        assert!(large.to::<f64>().is_err());
        let floats = NpyArray::from(&ndarray::arr1(&[0.5f64, f64::NAN]));
        assert!(floats.to::<i64>().is_err());
        assert!(floats.to::<f32>().unwrap()[1].is_nan());
        let huge = NpyArray::from(&ndarray::arr1(&[1e300f64]));
        assert!(huge.to::<f32>().is_err());
        let flags = NpyArray::from(&ndarray::arr1(&[1u8, 0]));
        assert_eq!(
            flags.to::<bool>().unwrap(),
            ndarray::arr1(&[true, false]).into_dyn()
        );
    }

    #[test]
    fn what_would_need_python_is_refused_with_the_reason() {
        for (header, part) in [
            (
                "{'descr': '|O', 'fortran_order': False, 'shape': (1,), }",
                "unpickled",
            ),
            (
                "{'descr': [('a', '<f4')], 'fortran_order': False, 'shape': (1,), }",
                "records",
            ),
            (
                "{'descr': '<U3', 'fortran_order': False, 'shape': (1,), }",
                "<U3",
            ),
            (
                "{'descr': '<f4', 'fortran_order': False, 'shape': (99999999999, 99999999999), }",
                "absurd",
            ),
            (
                "{'descr': '<f4', 'fortran_order': False, 'shape': (5,), }",
                "does not fit",
            ),
            ("__import__('os').system('true')", "dictionary"),
        ] {
            let error = parse(&file(header, b"1234")).unwrap_err().to_string();
            assert!(error.contains(part), "{header}: {error}");
        }
    }

    proptest! {
        #[test]
        fn no_header_makes_the_parser_panic(text in "\\PC{0,80}", body in proptest::collection::vec(any::<u8>(), 0..20)) {
            let _ = parse(&file(&text, &body));
        }

        #[test]
        fn no_damage_makes_the_parser_panic(at in 0usize..150, value in any::<u8>(), cut in 0usize..150) {
            let mut bytes = to_bytes(&NpyArray::from(&ndarray::arr2(&[[1.5f32, -2.0]])));
            let at = at % bytes.len();
            bytes[at] = value;
            bytes.truncate(cut);
            let _ = parse(&bytes);
        }

        #[test]
        fn arrays_survive_the_round_trip(rows in 0usize..5, columns in 0usize..5, seed in any::<i32>()) {
            let array = ndarray::Array2::from_shape_fn((rows, columns), |(r, c)| seed.wrapping_add((r * 7 + c) as i32));
            let back = parse(&to_bytes(&NpyArray::from(&array))).unwrap().to::<i32>().unwrap();
            prop_assert_eq!(back, array.into_dyn());
        }
    }
}
