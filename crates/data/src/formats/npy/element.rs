//! Element types: what npy files can hold, and conversions between them that lose nothing.

use half::f16;

/// The element type of an array.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Dtype {
    /// `b1`: a byte that is 0 or 1.
    Bool,
    /// `i1`: signed, 8 bits.
    I8,
    /// `i2`: signed, 16 bits.
    I16,
    /// `i4`: signed, 32 bits.
    I32,
    /// `i8`: signed, 64 bits.
    I64,
    /// `u1`: unsigned, 8 bits.
    U8,
    /// `u2`: unsigned, 16 bits.
    U16,
    /// `u4`: unsigned, 32 bits.
    U32,
    /// `u8`: unsigned, 64 bits.
    U64,
    /// `f2`: half precision.
    F16,
    /// `f4`: single precision.
    F32,
    /// `f8`: double precision.
    F64,
}

/// The elements of an [`super::NpyArray`].
#[derive(Debug, Clone, PartialEq)]
pub enum NpyData {
    /// Of [`Dtype::Bool`].
    Bool(Vec<bool>),
    /// Of [`Dtype::I8`].
    I8(Vec<i8>),
    /// Of [`Dtype::I16`].
    I16(Vec<i16>),
    /// Of [`Dtype::I32`].
    I32(Vec<i32>),
    /// Of [`Dtype::I64`].
    I64(Vec<i64>),
    /// Of [`Dtype::U8`].
    U8(Vec<u8>),
    /// Of [`Dtype::U16`].
    U16(Vec<u16>),
    /// Of [`Dtype::U32`].
    U32(Vec<u32>),
    /// Of [`Dtype::U64`].
    U64(Vec<u64>),
    /// Of [`Dtype::F16`].
    F16(Vec<f16>),
    /// Of [`Dtype::F32`].
    F32(Vec<f32>),
    /// Of [`Dtype::F64`].
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
pub(super) use with_data;

impl NpyData {
    /// The type of the elements.
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
    pub(super) const ALL: [Self; 12] = [
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

    /// By NumPy's code without byte order: `f8`, `i4`, `b1`.
    pub fn from_code(code: &str) -> Option<Self> {
        Self::ALL.into_iter().find(|d| &d.code()[1..] == code)
    }

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
    /// From an integer type, or a bool as 0 or 1.
    Integer(i128),
    /// From a float type of any width.
    Float(f64),
}

mod sealed {
    pub trait Sealed {}
}

/// An element type that npy files can hold. Sealed: the list is [`Dtype`]'s.
pub trait Element: Copy + sealed::Sealed + 'static {
    /// The variant of [`Dtype`] that names this type.
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
