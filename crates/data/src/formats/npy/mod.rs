//! NumPy's npy: one array with its type and shape (NEP 1, versions 1 to 3).
//!
//! Read: `f2 f4 f8 i1 i2 i4 i8 u1 u2 u4 u8 b1` in either byte order, C or Fortran order, into C order. Objects, strings,
//! records, complex numbers and dates are refused. Written: version 1, little-endian, C order, byte for byte what NumPy writes.

mod element;
mod header;
mod rows;
mod values;

pub use element::{Dtype, Element, NpyData, Number};
pub use rows::Rows;

use super::FormatError;
use element::with_data;
use header::Header;
use ndarray::{ArrayD, IxDyn};
use std::any::Any;
use std::path::Path;
use values::{c_order, decode};

/// An array as it lies in the file, in C order.
#[derive(Debug, Clone, PartialEq)]
pub struct NpyArray {
    /// The length of each axis, the slowest first; none for a single number.
    pub shape: Vec<usize>,
    /// As many elements as the product of the shape, the last axis fastest.
    pub data: NpyData,
}

/// More than any recording's array has, and less than a machine has memory.
const MAX_BYTES: u64 = 16 << 30;

/// Reads the array in the file at `path`: a regular file of at most 16 GB.
pub fn read(path: &Path) -> Result<NpyArray, FormatError> {
    super::read_whole(path, MAX_BYTES)
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
    assemble(header, body)
}

/// An array whose type, order and shape are known from elsewhere: from a pickle.
///
/// # Errors
/// When the type is none of those that are read, or the shape does not fit the bytes.
pub fn from_parts(
    descr: &str,
    fortran: bool,
    shape: &[usize],
    body: &[u8],
) -> Result<NpyArray, FormatError> {
    let (dtype, big_endian) = header::dtype(descr).map_err(|reason| malformed(0, reason))?;
    let header = Header {
        dtype,
        big_endian,
        fortran,
        shape: shape.to_vec(),
        end: 0,
    };
    assemble(header, body)
}

fn assemble(header: Header, body: &[u8]) -> Result<NpyArray, FormatError> {
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

/// Where the pickle of an npy file of objects starts; `None` for bytes that are no npy file.
///
/// # Errors
/// When it is an npy file of numbers, or its header is damaged.
pub fn pickle_start(bytes: &[u8]) -> Result<Option<usize>, FormatError> {
    if !bytes.starts_with(b"\x93NUMPY") {
        return Ok(None);
    }
    header::pickle_start(bytes).map(Some)
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

    /// The type of the elements.
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
        let same = with_data!(&self.data, v => (v as &dyn Any).downcast_ref::<Vec<T>>());
        let values: Result<Vec<T>, FormatError> = match same {
            Some(values) => Ok(values.clone()),
            None => with_data!(&self.data, v => v
                .iter()
                .enumerate()
                .map(|(i, &x)| convert(i, T::from_number(x.to_number())))
                .collect()),
        };
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

fn malformed(offset: u64, reason: impl Into<String>) -> FormatError {
    FormatError::malformed("npy", offset, reason)
}

#[cfg(test)]
mod tests {
    use super::*;
    use half::f16;
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
            // The only closing bracket lies before the opening one.
            ("{'],\"a\":[':[", "dictionary"),
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
