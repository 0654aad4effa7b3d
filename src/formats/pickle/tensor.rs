//! Tensors as a checkpoint describes them: strided views of storages, checked before anything is read.

/// The element types of tensors.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub enum Scalar {
    F64,
    F32,
    F16,
    BF16,
    I64,
    I32,
    I16,
    I8,
    U8,
    Bool,
}

impl Scalar {
    /// Bytes per element.
    pub fn width(self) -> usize {
        match self {
            Self::F64 | Self::I64 => 8,
            Self::F32 | Self::I32 => 4,
            Self::F16 | Self::BF16 | Self::I16 => 2,
            Self::I8 | Self::U8 | Self::Bool => 1,
        }
    }

    /// `f32`, `bf16`, `i64`, ...
    pub fn name(self) -> &'static str {
        match self {
            Self::F64 => "f64",
            Self::F32 => "f32",
            Self::F16 => "f16",
            Self::BF16 => "bf16",
            Self::I64 => "i64",
            Self::I32 => "i32",
            Self::I16 => "i16",
            Self::I8 => "i8",
            Self::U8 => "u8",
            Self::Bool => "bool",
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
    pub key: String,
    pub scalar: Scalar,
    /// Declared number of elements.
    pub elements: u64,
}

/// A strided view of a storage.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct TensorView {
    pub storage: Storage,
    /// In elements.
    pub offset: u64,
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
