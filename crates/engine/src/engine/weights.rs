//! Named arrays on the host, and the safetensors files they live in.
//!
//! Writing is exact: equal contents give equal bytes (sorted names, sorted metadata, fixed header padding). Reading trusts
//! nothing: every length is checked against the file before anything is allocated.

use std::collections::BTreeMap;
use std::fs::File;
use std::io::{BufReader, Read, Seek, SeekFrom, Write};
use std::path::Path;

use serde_json::{Map, Value};

use super::EngineError;

/// Longest header that is read (the format's own limit).
const MAX_HEADER: u64 = 100_000_000;

/// The values of one array. Half-precision floats widen to `F32` on reading, small integers to `I64`.
#[derive(Debug, Clone, PartialEq)]
pub enum Values {
    /// Single precision; on reading also what was half precision or bfloat16.
    F32(Vec<f32>),
    /// Double precision.
    F64(Vec<f64>),
    /// Signed, 64 bits; on reading also narrower integers of more than a byte, and signed bytes.
    I64(Vec<i64>),
    /// Unsigned bytes.
    U8(Vec<u8>),
}

impl Values {
    /// How many values there are.
    #[must_use]
    pub fn len(&self) -> usize {
        match self {
            Self::F32(v) => v.len(),
            Self::F64(v) => v.len(),
            Self::I64(v) => v.len(),
            Self::U8(v) => v.len(),
        }
    }

    /// Whether there is no value.
    #[must_use]
    pub fn is_empty(&self) -> bool {
        self.len() == 0
    }

    /// `f32`, `f64`, `i64` or `u8`.
    #[must_use]
    pub fn kind(&self) -> &'static str {
        match self {
            Self::F32(_) => "f32",
            Self::F64(_) => "f64",
            Self::I64(_) => "i64",
            Self::U8(_) => "u8",
        }
    }
}

/// An array on the host, row-major.
#[derive(Debug, Clone, PartialEq)]
pub struct HostTensor {
    /// The length of each axis, the slowest first; none for a single number.
    pub shape: Vec<usize>,
    /// As many values as the product of the shape.
    pub values: Values,
}

impl HostTensor {
    /// An f32 array.
    #[must_use]
    pub fn f32_of(values: Vec<f32>, shape: &[usize]) -> Self {
        Self {
            shape: shape.to_vec(),
            values: Values::F32(values),
        }
    }

    /// The values, if they are f32; `name` is for the error.
    pub fn f32(&self, name: &str) -> Result<&[f32], EngineError> {
        match &self.values {
            Values::F32(values) => Ok(values),
            other => Err(kind(name, other, "f32")),
        }
    }

    /// The values, if they are integers; `name` is for the error.
    pub fn i64(&self, name: &str) -> Result<&[i64], EngineError> {
        match &self.values {
            Values::I64(values) => Ok(values),
            other => Err(kind(name, other, "i64")),
        }
    }

    /// The values, if they are bytes; `name` is for the error.
    pub fn u8(&self, name: &str) -> Result<&[u8], EngineError> {
        match &self.values {
            Values::U8(values) => Ok(values),
            other => Err(kind(name, other, "u8")),
        }
    }
}

fn kind(name: &str, found: &Values, expected: &'static str) -> EngineError {
    EngineError::Kind {
        name: name.to_owned(),
        found: found.kind(),
        expected,
    }
}

/// Arrays by name, with the file's text metadata.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct Weights {
    /// By name: field paths joined by dots, `encoder.blocks.0.attn.qkv.weight`.
    pub tensors: BTreeMap<String, HostTensor>,
    /// Texts by key, from the header's `__metadata__`.
    pub metadata: BTreeMap<String, String>,
}

impl Weights {
    /// Adds an f32 array.
    pub fn insert_f32(&mut self, name: &str, values: Vec<f32>, shape: &[usize]) {
        self.tensors
            .insert(name.to_owned(), HostTensor::f32_of(values, shape));
    }

    /// The array `name`, which must have `shape`.
    pub fn get(&self, name: &str, shape: &[usize]) -> Result<&HostTensor, EngineError> {
        let tensor = self.tensors.get(name).ok_or_else(|| EngineError::Missing {
            name: name.to_owned(),
            expected: shape.to_vec(),
        })?;
        if tensor.shape != shape {
            return Err(EngineError::Shape {
                name: name.to_owned(),
                found: tensor.shape.clone(),
                expected: shape.to_vec(),
            });
        }
        Ok(tensor)
    }

    /// The arrays whose names start with `prefix.`, without it. Metadata is not copied.
    #[must_use]
    pub fn below(&self, prefix: &str) -> Self {
        let start = format!("{prefix}.");
        let tensors = self
            .tensors
            .iter()
            .filter_map(|(name, tensor)| {
                let rest = name.strip_prefix(&start)?;
                Some((rest.to_owned(), tensor.clone()))
            })
            .collect();
        Self {
            tensors,
            metadata: BTreeMap::new(),
        }
    }

    /// Adds all arrays of `other` under `prefix.`.
    pub fn add_below(&mut self, prefix: &str, other: Self) {
        for (name, tensor) in other.tensors {
            self.tensors.insert(format!("{prefix}.{name}"), tensor);
        }
    }

    /// Reads a safetensors file.
    ///
    /// # Errors
    /// When the file cannot be read, or is not a complete safetensors file.
    pub fn read(path: &Path) -> Result<Self, EngineError> {
        let refuse = |reason: String| EngineError::File {
            path: path.display().to_string(),
            reason,
        };
        let file = File::open(path).map_err(|error| refuse(error.to_string()))?;
        let length = file
            .metadata()
            .map_err(|error| refuse(error.to_string()))?
            .len();
        Self::read_from(BufReader::new(file), length).map_err(refuse)
    }

    /// Reads from bytes in memory.
    ///
    /// # Errors
    /// When they are not a complete safetensors file; the reason.
    pub fn from_bytes(bytes: &[u8]) -> Result<Self, String> {
        Self::read_from(std::io::Cursor::new(bytes), bytes.len() as u64)
    }

    fn read_from(mut source: impl Read + Seek, length: u64) -> Result<Self, String> {
        let io = |error: std::io::Error| error.to_string();
        let mut prefix = [0_u8; 8];
        source
            .read_exact(&mut prefix)
            .map_err(|_| "shorter than 8 bytes".to_owned())?;
        let header_length = u64::from_le_bytes(prefix);
        if header_length > MAX_HEADER || header_length > length.saturating_sub(8) {
            return Err(format!(
                "header of {header_length} bytes in a file of {length}"
            ));
        }
        let mut header = vec![0_u8; header_length as usize];
        source.read_exact(&mut header).map_err(io)?;
        let header: Map<String, Value> =
            serde_json::from_slice(&header).map_err(|error| format!("header: {error}"))?;
        let start = 8 + header_length;
        let mut left = length - start;
        let mut weights = Self::default();
        for (name, entry) in header {
            if name == "__metadata__" {
                let entries = entry.as_object().ok_or("metadata is not a map")?;
                for (key, value) in entries {
                    let value = value
                        .as_str()
                        .ok_or("metadata holds something else than text")?;
                    weights.metadata.insert(key.clone(), value.to_owned());
                }
                continue;
            }
            let entry = Entry::parse(&name, &entry, length - start)?;
            // Tensors may not share bytes: what is allocated stays in proportion to the file.
            left = left
                .checked_sub(entry.bytes as u64)
                .ok_or_else(|| format!("tensor `{name}` overlaps another"))?;
            source
                .seek(SeekFrom::Start(start + entry.begin))
                .map_err(io)?;
            let mut bytes = vec![0_u8; entry.bytes];
            source.read_exact(&mut bytes).map_err(io)?;
            weights.tensors.insert(
                name,
                HostTensor {
                    shape: entry.shape,
                    values: entry.kind.values(&bytes),
                },
            );
        }
        Ok(weights)
    }

    /// Writes a safetensors file; equal contents give equal bytes. The file appears complete or not at all.
    ///
    /// # Errors
    /// When it cannot be written.
    pub fn write(&self, path: &Path) -> Result<(), EngineError> {
        let refuse = |error: std::io::Error| EngineError::Write {
            path: path.display().to_string(),
            error,
        };
        let folder = match path.parent() {
            Some(parent) if !parent.as_os_str().is_empty() => parent,
            _ => Path::new("."),
        };
        let file = crate::formats::temporary_in(folder).map_err(refuse)?;
        let mut out = std::io::BufWriter::new(file);
        self.write_to(&mut out).map_err(refuse)?;
        let file = out
            .into_inner()
            .map_err(|error| refuse(error.into_error()))?;
        file.as_file().sync_all().map_err(refuse)?;
        file.persist(path).map_err(|error| refuse(error.error))?;
        Ok(())
    }

    /// The bytes of the file that [`Weights::write`] would write.
    #[must_use]
    pub fn to_bytes(&self) -> Vec<u8> {
        let mut bytes = Vec::new();
        self.write_to(&mut bytes)
            .expect("writing into memory cannot fail");
        bytes
    }

    fn write_to(&self, out: &mut impl Write) -> std::io::Result<()> {
        let mut header = Map::new();
        if !self.metadata.is_empty() {
            let entries = self
                .metadata
                .iter()
                .map(|(key, value)| (key.clone(), value.clone().into()));
            header.insert("__metadata__".into(), Value::Object(entries.collect()));
        }
        let mut end = 0_usize;
        for (name, tensor) in &self.tensors {
            assert_eq!(
                tensor.values.len(),
                tensor.shape.iter().product::<usize>(),
                "`{name}` holds as many values as its shape"
            );
            let kind = ElementKind::of(&tensor.values);
            let begin = end;
            end += tensor.values.len() * kind.size();
            let mut entry = Map::new();
            entry.insert("dtype".into(), kind.name().into());
            entry.insert("shape".into(), tensor.shape.clone().into());
            entry.insert("data_offsets".into(), vec![begin, end].into());
            header.insert(name.clone(), Value::Object(entry));
        }
        let mut text = serde_json::to_vec(&Value::Object(header))?;
        while text.len() % 8 != 0 {
            text.push(b' ');
        }
        out.write_all(&(text.len() as u64).to_le_bytes())?;
        out.write_all(&text)?;
        for tensor in self.tensors.values() {
            match &tensor.values {
                Values::F32(values) => write_all(out, values, f32::to_le_bytes)?,
                Values::F64(values) => write_all(out, values, f64::to_le_bytes)?,
                Values::I64(values) => write_all(out, values, i64::to_le_bytes)?,
                Values::U8(values) => out.write_all(values)?,
            }
        }
        out.flush()
    }
}

fn write_all<T: Copy, const N: usize>(
    out: &mut impl Write,
    values: &[T],
    bytes: impl Fn(T) -> [u8; N],
) -> std::io::Result<()> {
    let mut buffer = Vec::with_capacity(N * 4096);
    for chunk in values.chunks(4096) {
        buffer.clear();
        for value in chunk {
            buffer.extend_from_slice(&bytes(*value));
        }
        out.write_all(&buffer)?;
    }
    Ok(())
}

/// The element types of the format that models and data use.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum ElementKind {
    F64,
    F32,
    F16,
    BF16,
    I64,
    I32,
    I16,
    U16,
    I8,
    U8,
    Bool,
}

impl ElementKind {
    const ALL: [(Self, &'static str, usize); 11] = [
        (Self::F64, "F64", 8),
        (Self::F32, "F32", 4),
        (Self::F16, "F16", 2),
        (Self::BF16, "BF16", 2),
        (Self::I64, "I64", 8),
        (Self::I32, "I32", 4),
        (Self::I16, "I16", 2),
        (Self::U16, "U16", 2),
        (Self::I8, "I8", 1),
        (Self::U8, "U8", 1),
        (Self::Bool, "BOOL", 1),
    ];

    fn of(values: &Values) -> Self {
        match values {
            Values::F32(_) => Self::F32,
            Values::F64(_) => Self::F64,
            Values::I64(_) => Self::I64,
            Values::U8(_) => Self::U8,
        }
    }

    fn parse(name: &str) -> Option<Self> {
        Self::ALL.iter().find(|row| row.1 == name).map(|row| row.0)
    }

    fn row(self) -> (Self, &'static str, usize) {
        *Self::ALL
            .iter()
            .find(|row| row.0 == self)
            .expect("every kind has a row")
    }

    fn name(self) -> &'static str {
        self.row().1
    }

    fn size(self) -> usize {
        self.row().2
    }

    /// Little-endian `bytes` as values; their number is a multiple of the size.
    fn values(self, bytes: &[u8]) -> Values {
        fn each<const N: usize, T>(bytes: &[u8], value: impl Fn([u8; N]) -> T) -> Vec<T> {
            let (chunks, _) = bytes.as_chunks::<N>();
            chunks.iter().map(|chunk| value(*chunk)).collect()
        }
        match self {
            Self::F64 => Values::F64(each(bytes, f64::from_le_bytes)),
            Self::F32 => Values::F32(each(bytes, f32::from_le_bytes)),
            Self::F16 => Values::F32(each(bytes, |b| half::f16::from_le_bytes(b).to_f32())),
            Self::BF16 => Values::F32(each(bytes, |b| half::bf16::from_le_bytes(b).to_f32())),
            Self::I64 => Values::I64(each(bytes, i64::from_le_bytes)),
            Self::I32 => Values::I64(each(bytes, |b| i64::from(i32::from_le_bytes(b)))),
            Self::I16 => Values::I64(each(bytes, |b| i64::from(i16::from_le_bytes(b)))),
            Self::U16 => Values::I64(each(bytes, |b| i64::from(u16::from_le_bytes(b)))),
            Self::I8 => Values::I64(each(bytes, |b| i64::from(i8::from_le_bytes(b)))),
            Self::U8 | Self::Bool => Values::U8(bytes.to_vec()),
        }
    }
}

/// One array in a header, checked against the size of the file's data.
struct Entry {
    kind: ElementKind,
    shape: Vec<usize>,
    begin: u64,
    bytes: usize,
}

impl Entry {
    fn parse(name: &str, entry: &Value, available: u64) -> Result<Self, String> {
        let bad = |what: &str| format!("tensor `{name}`: {what}");
        let kind = entry["dtype"].as_str().ok_or_else(|| bad("no dtype"))?;
        let kind =
            ElementKind::parse(kind).ok_or_else(|| bad(&format!("unsupported dtype `{kind}`")))?;
        let numbers = |key: &str| -> Option<Vec<u64>> {
            entry[key].as_array()?.iter().map(Value::as_u64).collect()
        };
        let shape = numbers("shape").ok_or_else(|| bad("no shape"))?;
        let offsets = numbers("data_offsets").ok_or_else(|| bad("no data_offsets"))?;
        let [begin, end] = offsets[..] else {
            return Err(bad("data_offsets is not a pair"));
        };
        let elements = shape
            .iter()
            .try_fold(1_u64, |product, size| product.checked_mul(*size));
        let bytes = elements.and_then(|count| count.checked_mul(kind.size() as u64));
        if end > available || begin > end || bytes != Some(end - begin) {
            return Err(bad(&format!(
                "shape {shape:?} and bytes {begin}..{end} do not fit together or into the file"
            )));
        }
        Ok(Self {
            kind,
            shape: shape.iter().map(|size| *size as usize).collect(),
            begin,
            bytes: (end - begin) as usize,
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn sample() -> Weights {
        let mut weights = Weights::default();
        weights.insert_f32("b.weight", vec![1.0, -0.0, f32::MIN_POSITIVE, 3.5], &[2, 2]);
        weights.insert_f32("a", vec![], &[0, 4]);
        weights.tensors.insert(
            "ids".into(),
            HostTensor {
                shape: vec![3],
                values: Values::I64(vec![1, -2, 64_000]),
            },
        );
        weights.tensors.insert(
            "mask".into(),
            HostTensor {
                shape: vec![],
                values: Values::U8(vec![1]),
            },
        );
        weights.metadata.insert("z".into(), "1".into());
        weights.metadata.insert("a".into(), "ü".into());
        weights
    }

    #[test]
    fn a_file_reads_back_and_equal_contents_give_equal_bytes() {
        let bytes = sample().to_bytes();
        let again = Weights::from_bytes(&bytes).unwrap();
        assert_eq!(again, sample());
        assert_eq!(again.to_bytes(), bytes);
    }

    #[test]
    fn the_safetensors_crate_reads_what_is_written() {
        let bytes = sample().to_bytes();
        let file = safetensors::SafeTensors::deserialize(&bytes).unwrap();
        assert_eq!(file.tensor("b.weight").unwrap().shape(), [2, 2]);
        assert_eq!(file.len(), 4);
    }

    #[test]
    fn any_truncation_or_flipped_byte_is_refused_or_read_without_panic() {
        let bytes = sample().to_bytes();
        for end in 0..bytes.len() {
            assert!(Weights::from_bytes(&bytes[..end]).is_err(), "{end}");
        }
        for index in 0..bytes.len() {
            let mut broken = bytes.clone();
            broken[index] ^= 0x5a;
            let _ = Weights::from_bytes(&broken);
        }
    }

    #[test]
    fn a_huge_length_field_allocates_nothing() {
        let mut bytes = (u64::MAX).to_le_bytes().to_vec();
        bytes.extend_from_slice(b"{}");
        assert!(Weights::from_bytes(&bytes).is_err());
        let header =
            br#"{"x":{"dtype":"F32","shape":[4611686018427387904],"data_offsets":[0,16]}}"#;
        let mut bytes = (header.len() as u64).to_le_bytes().to_vec();
        bytes.extend_from_slice(header);
        assert!(
            Weights::from_bytes(&bytes)
                .unwrap_err()
                .contains("do not fit")
        );
    }

    #[test]
    fn tensors_that_share_bytes_are_refused() {
        let file = |second: &str| {
            let header = format!(
                r#"{{"x":{{"dtype":"U8","shape":[3],"data_offsets":[0,3]}},"y":{{"dtype":"U8","shape":[2],"data_offsets":{second}}}}}"#
            );
            let mut bytes = (header.len() as u64).to_le_bytes().to_vec();
            bytes.extend_from_slice(header.as_bytes());
            bytes.extend_from_slice(&[1, 2, 3, 4]);
            Weights::from_bytes(&bytes)
        };
        let error = file("[2,4]").unwrap_err();
        assert!(error.contains("`y` overlaps another"), "{error}");
    }

    #[test]
    fn a_written_file_is_the_bytes() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("w.safetensors");
        sample().write(&path).unwrap();
        assert_eq!(std::fs::read(&path).unwrap(), sample().to_bytes());
        assert_eq!(Weights::read(&path).unwrap(), sample());
    }
}
