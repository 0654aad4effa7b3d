//! Tensors as a checkpoint describes them: strided views of storages, checked before anything is read.

/// The element types of tensors.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub enum Scalar {
    /// Double precision.
    F64,
    /// Single precision.
    F32,
    /// Half precision: five bits of exponent, ten of fraction.
    F16,
    /// bfloat16: eight bits of exponent, seven of fraction.
    BF16,
    /// Eight bits, four of them exponent.
    F8E4M3,
    /// Eight bits, five of them exponent.
    F8E5M2,
    /// Eight bits in a form that is not read: FNUZ, or exponent alone.
    F8Other,
    /// Signed, 64 bits.
    I64,
    /// Signed, 32 bits.
    I32,
    /// Signed, 16 bits.
    I16,
    /// Signed, 8 bits.
    I8,
    /// Unsigned, 64 bits.
    U64,
    /// Unsigned, 32 bits.
    U32,
    /// Unsigned, 16 bits.
    U16,
    /// Unsigned, 8 bits.
    U8,
    /// A byte that is 0 or 1.
    Bool,
    /// Complex, two numbers of 64 bits: not read.
    C128,
    /// Complex, two numbers of 32 bits: not read.
    C64,
    /// Complex, two numbers of 16 bits: not read.
    C32,
    /// Quantised: what the numbers mean stands beside them.
    QI32,
    /// Quantised, signed, 8 bits: not read.
    QI8,
    /// Quantised, unsigned, 8 bits: not read.
    QU8,
}

/// Every type: width in bytes, our name, torch's, that of torch's storage, that of safetensors.
type Row = (
    Scalar,
    usize,
    &'static str,
    &'static str,
    &'static str,
    &'static str,
);

const TABLE: [Row; 22] = [
    (Scalar::F64, 8, "f64", "float64", "DoubleStorage", "F64"),
    (Scalar::F32, 4, "f32", "float32", "FloatStorage", "F32"),
    (Scalar::F16, 2, "f16", "float16", "HalfStorage", "F16"),
    (
        Scalar::BF16,
        2,
        "bf16",
        "bfloat16",
        "BFloat16Storage",
        "BF16",
    ),
    (Scalar::F8E4M3, 1, "f8_e4m3", "float8_e4m3fn", "", "F8_E4M3"),
    (Scalar::F8E5M2, 1, "f8_e5m2", "float8_e5m2", "", "F8_E5M2"),
    (Scalar::F8Other, 1, "f8", "float8_e4m3fnuz", "", "F8_E8M0"),
    (Scalar::I64, 8, "i64", "int64", "LongStorage", "I64"),
    (Scalar::I32, 4, "i32", "int32", "IntStorage", "I32"),
    (Scalar::I16, 2, "i16", "int16", "ShortStorage", "I16"),
    (Scalar::I8, 1, "i8", "int8", "CharStorage", "I8"),
    (Scalar::U64, 8, "u64", "uint64", "", "U64"),
    (Scalar::U32, 4, "u32", "uint32", "", "U32"),
    (Scalar::U16, 2, "u16", "uint16", "", "U16"),
    (Scalar::U8, 1, "u8", "uint8", "ByteStorage", "U8"),
    (Scalar::Bool, 1, "bool", "bool", "BoolStorage", "BOOL"),
    (
        Scalar::C128,
        16,
        "c128",
        "complex128",
        "ComplexDoubleStorage",
        "C128",
    ),
    (
        Scalar::C64,
        8,
        "c64",
        "complex64",
        "ComplexFloatStorage",
        "C64",
    ),
    (
        Scalar::C32,
        4,
        "c32",
        "complex32",
        "ComplexHalfStorage",
        "C32",
    ),
    (Scalar::QI32, 4, "qi32", "qint32", "QInt32Storage", "QI32"),
    (Scalar::QI8, 1, "qi8", "qint8", "QInt8Storage", "QI8"),
    (Scalar::QU8, 1, "qu8", "quint8", "QUInt8Storage", "QU8"),
];

impl Scalar {
    fn row(self) -> &'static Row {
        // In the order of the types.
        &TABLE[self as usize]
    }

    /// Bytes per element.
    pub fn width(self) -> usize {
        self.row().1
    }

    /// `f32`, `bf16`, `i64`, ...
    pub fn name(self) -> &'static str {
        self.row().2
    }

    /// By the name of torch's storage: `FloatStorage`.
    pub fn of_storage(name: &str) -> Option<Self> {
        TABLE
            .iter()
            .find(|row| !name.is_empty() && row.4 == name)
            .map(|row| row.0)
    }

    /// By the name of torch's type, without `torch.`: `float32`.
    pub fn of_torch(name: &str) -> Option<Self> {
        let name = match name {
            "double" => "float64",
            "float" => "float32",
            "half" => "float16",
            "long" => "int64",
            "int" => "int32",
            "short" => "int16",
            "cdouble" => "complex128",
            "cfloat" => "complex64",
            "chalf" => "complex32",
            "float8_e5m2fnuz" | "float8_e8m0fnu" => "float8_e4m3fnuz",
            name => name,
        };
        TABLE.iter().find(|row| row.3 == name).map(|row| row.0)
    }

    /// By the name that safetensors uses: `F32`.
    pub fn of_safetensors(name: &str) -> Option<Self> {
        TABLE.iter().find(|row| row.5 == name).map(|row| row.0)
    }

    /// Torch's name with `torch.`.
    pub fn torch(self) -> String {
        format!("torch.{}", self.row().3)
    }

    /// Why values of this type are no real numbers that can be read; `None` where they are.
    pub fn unreadable(self) -> Option<&'static str> {
        match self {
            Self::C128 | Self::C64 | Self::C32 => Some("complex numbers"),
            Self::QI32 | Self::QI8 | Self::QU8 => {
                Some("quantised numbers, whose scale this product does not apply")
            }
            Self::F8Other => Some("eight-bit numbers in a form that this product does not know"),
            _ => None,
        }
    }

    /// The largest error of a number of at most one that was brought to this type, whether rounded or cut off.
    pub fn precision(self) -> f32 {
        match self {
            Self::BF16 => 1.0 / 256.0,
            Self::F16 => 1.0 / 2048.0,
            Self::F8E4M3 => 1.0 / 16.0,
            Self::F8E5M2 => 1.0 / 8.0,
            _ => 0.0,
        }
    }

    /// Whether values of this type are model weights.
    pub fn is_float(self) -> bool {
        matches!(self, Self::F64 | Self::F32 | Self::F16 | Self::BF16)
    }
}

/// A storage of a torch archive: the member `data/<key>`.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Storage {
    /// Its name in the checkpoint, which views of the same memory share.
    pub key: String,
    /// The type of its elements.
    pub scalar: Scalar,
    /// Declared number of elements.
    pub elements: u64,
}

/// A strided view of a storage.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct TensorView {
    /// The storage that it is a view of.
    pub storage: Storage,
    /// In elements.
    pub offset: u64,
    /// The length of each axis, in elements; none for a single number.
    pub shape: Vec<u64>,
    /// In elements.
    pub strides: Vec<u64>,
}

impl TensorView {
    /// Number of elements.
    pub fn elements(&self) -> u64 {
        self.shape.iter().product()
    }

    /// One past the last element of the storage that the view touches.
    pub fn end(&self) -> u64 {
        if self.elements() == 0 {
            return self.offset;
        }
        let last: u64 = self
            .shape
            .iter()
            .zip(&self.strides)
            .map(|(d, s)| (d - 1) * s)
            .sum();
        self.offset + last + 1
    }

    /// Whether the elements lie in order without gaps.
    pub fn is_contiguous(&self) -> bool {
        if self.elements() == 0 {
            return true;
        }
        let mut expected = 1;
        for (&d, &s) in self.shape.iter().zip(&self.strides).rev() {
            if d != 1 && s != expected {
                return false;
            }
            expected *= d;
        }
        true
    }

    /// The view must lie inside its storage, and no two of its elements may be the same one.
    pub(super) fn check(&self) -> Result<(), String> {
        let elements = self
            .shape
            .iter()
            .try_fold(1u64, |n, &d| n.checked_mul(d))
            .filter(|&n| n <= self.storage.elements)
            .ok_or_else(|| {
                format!(
                    "a tensor of shape {:?} over a storage of {} elements",
                    self.shape, self.storage.elements
                )
            })?;
        if elements == 0 {
            return Ok(());
        }
        let mut axes: Vec<(u64, u64)> = self
            .strides
            .iter()
            .copied()
            .zip(self.shape.iter().copied())
            .filter(|&(_, d)| d > 1)
            .collect();
        axes.sort_unstable();
        let mut reach = 0u64;
        for (stride, d) in axes {
            if stride <= reach {
                return Err(format!(
                    "a tensor of shape {:?} with strides {:?} overlaps itself",
                    self.shape, self.strides
                ));
            }
            reach = stride
                .checked_mul(d - 1)
                .and_then(|r| r.checked_add(reach))
                .ok_or("strides that overflow")?;
        }
        let end = self
            .offset
            .checked_add(reach)
            .and_then(|e| e.checked_add(1));
        if end.is_none_or(|end| end > self.storage.elements) {
            return Err(format!(
                "a tensor of shape {:?} with strides {:?} at {} leaves its storage of {} elements",
                self.shape, self.strides, self.offset, self.storage.elements
            ));
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_table_of_types_is_in_their_order() {
        for (index, row) in TABLE.iter().enumerate() {
            assert_eq!(row.0 as usize, index, "{}", row.2);
            assert_eq!(Scalar::of_torch(row.3), Some(row.0));
        }
    }

    fn view(offset: u64, shape: &[u64], strides: &[u64], elements: u64) -> Result<(), String> {
        TensorView {
            storage: Storage {
                key: "0".to_owned(),
                scalar: Scalar::F32,
                elements,
            },
            offset,
            shape: shape.to_vec(),
            strides: strides.to_vec(),
        }
        .check()
    }

    #[test]
    fn views_must_stay_inside_their_storage_and_not_repeat_elements() {
        assert!(view(0, &[2, 3], &[3, 1], 6).is_ok());
        assert!(view(0, &[3, 2], &[1, 3], 6).is_ok());
        assert!(view(1, &[], &[], 2).is_ok());
        assert!(view(0, &[0, 3], &[3, 1], 0).is_ok());
        assert!(view(0, &[2, 2], &[4, 2], 7).is_ok());
        assert!(view(1, &[2, 3], &[3, 1], 6).is_err());
        assert!(view(0, &[1000, 1000], &[0, 0], 1).is_err());
        assert!(view(0, &[2, 3], &[1, 1], 6).is_err());
        assert!(view(0, &[1 << 40, 1 << 40], &[1, 1], 6).is_err());
        assert!(view(0, &[2, 2], &[1 << 47, 1 << 47], 6).is_err());
    }
}
