//! One row of an array at a time, for arrays that are larger than memory should hold.

use super::element::{Element, Number, with_data};
use super::header::Header;
use super::values::decode;
use super::{FormatError, NpyData, malformed};
use std::io::Read;

/// No row is larger: 64 MB are a depth map of sixteen million pixels.
const MOST_ROW_BYTES: usize = 64 << 20;

/// The rows (along the first axis) of an npy file that is read from front to back.
pub struct Rows<R> {
    reader: R,
    header: Header,
    next: usize,
    bytes: Vec<u8>,
    values: Vec<f64>,
}

impl<R: Read> Rows<R> {
    /// Reads the header of a file of `size` bytes.
    ///
    /// # Errors
    /// When it is no npy file, its shape does not fit `size`, or its values lie in Fortran order.
    pub fn new(mut reader: R, size: u64) -> Result<Self, FormatError> {
        let mut head = vec![0; 12];
        read_exact(&mut reader, &mut head, 0)?;
        // Version 1 has a length of two bytes, the others of four.
        let length = match head[6] {
            1 => usize::from(u16::from_le_bytes([head[8], head[9]])) + 10,
            _ => u32::from_le_bytes([head[8], head[9], head[10], head[11]]) as usize + 12,
        };
        if length <= 1 << 17 && length > head.len() {
            let start = head.len();
            head.resize(length, 0);
            read_exact(&mut reader, &mut head[start..], start as u64)?;
        }
        let header = Header::parse(&head)?;
        if header.fortran && header.shape.len() > 1 {
            let reason = "the array is in Fortran order, which is not read row by row";
            return Err(malformed(10, reason));
        }
        let elements = header
            .shape
            .iter()
            .try_fold(1u64, |n, &d| n.checked_mul(d as u64));
        let total = elements.and_then(|n| n.checked_mul(header.dtype.width() as u64));
        if total.and_then(|n| n.checked_add(header.end as u64)) != Some(size) {
            let shape = &header.shape;
            let reason = format!("shape {shape:?} does not fit the {size} bytes of the array");
            return Err(malformed(header.end as u64, reason));
        }
        let mut sides = header.shape.iter().skip(1);
        let row = sides.try_fold(1usize, |n, &d| n.checked_mul(d));
        let row = row.filter(|row| *row <= MOST_ROW_BYTES / header.dtype.width());
        let Some(row) = row else {
            let reason = format!("shape {:?} has rows larger than are read", header.shape);
            return Err(malformed(header.end as u64, reason));
        };
        let row_bytes = row * header.dtype.width();
        Ok(Rows {
            reader,
            header,
            next: 0,
            bytes: vec![0; row_bytes],
            values: Vec::with_capacity(row),
        })
    }

    /// The shape of the whole array.
    pub fn shape(&self) -> &[usize] {
        &self.header.shape
    }

    /// The next row as numbers (64-bit integers beyond 2^53 are rounded); `None` at the end.
    ///
    /// # Errors
    /// When the file ends early or, at the end, its checksum is wrong.
    pub fn next_row(&mut self) -> Result<Option<&[f64]>, FormatError> {
        let rows = self.header.shape.first().copied().unwrap_or(1);
        if self.next >= rows || self.bytes.is_empty() {
            // One byte further is where an archive compares the checksum.
            let more = self.reader.read(&mut [0])?;
            return match more {
                0 => Ok(None),
                _ => Err(malformed(self.offset(), "something follows the array")),
            };
        }
        let at = self.offset();
        read_exact(&mut self.reader, &mut self.bytes, at)?;
        let data = decode(&self.bytes, &self.header)?;
        self.values.clear();
        with_data!(&data, v => self.values.extend(v.iter().map(|x| number(x.to_number()))));
        self.next += 1;
        Ok(Some(&self.values))
    }

    fn offset(&self) -> u64 {
        (self.header.end + self.next * self.bytes.len()) as u64
    }
}

fn read_exact(reader: &mut impl Read, bytes: &mut [u8], at: u64) -> Result<(), FormatError> {
    reader
        .read_exact(bytes)
        .map_err(|error| match error.kind() {
            std::io::ErrorKind::UnexpectedEof | std::io::ErrorKind::InvalidData => {
                malformed(at, format!("the array is cut short: {error}"))
            }
            _ => error.into(),
        })
}

fn number(number: Number) -> f64 {
    match number {
        Number::Integer(i) => i as f64,
        Number::Float(f) => f,
    }
}
