//! Typed fields of VRS records. A stream describes the layout of its records in JSON; fields are found by name, never by a
//! remembered offset, because offsets changed between versions of the recorder.

use super::stored::Cursor;
use serde::Deserialize;
use std::collections::BTreeMap;

/// The fields of one block of a record.
#[derive(Debug, Clone, PartialEq)]
pub struct Layout {
    pieces: BTreeMap<String, Piece>,
    /// Bytes of the part with fixed offsets.
    fixed: usize,
    /// Number of fields of variable size.
    variable: usize,
}

#[derive(Debug, Clone, PartialEq)]
struct Piece {
    scalar: Scalar,
    place: Position,
}

#[derive(Debug, Clone, Copy, PartialEq)]
enum Position {
    /// Byte offset in the fixed part.
    Fixed(usize),
    /// Entry of the table of variable fields.
    Variable(usize),
}

#[derive(Debug, Clone, Copy, PartialEq)]
enum Scalar {
    Unsigned(usize),
    Signed(usize),
    Float,
    Double,
    /// Points, matrices, strings and everything that is not read as a number.
    Other(usize),
}

#[derive(Deserialize)]
struct Description {
    data_layout: Vec<PieceDescription>,
}

#[derive(Deserialize)]
struct PieceDescription {
    name: String,
    #[serde(rename = "type")]
    kind: String,
    offset: Option<usize>,
    index: Option<usize>,
    size: Option<usize>,
}

impl Layout {
    /// Parses a stream's description of a layout.
    ///
    /// # Errors
    /// A sentence that says what is wrong.
    pub fn parse(text: &str) -> Result<Self, String> {
        let description: Description =
            serde_json::from_str(text).map_err(|error| error.to_string())?;
        let mut layout = Layout {
            pieces: BTreeMap::new(),
            fixed: 0,
            variable: 0,
        };
        for piece in description.data_layout {
            let scalar = Scalar::parse(&piece.kind);
            let place = match (piece.offset, piece.index) {
                (Some(offset), _) => {
                    let size = piece.size.unwrap_or(1).checked_mul(scalar.size());
                    let end = size.and_then(|size| offset.checked_add(size));
                    layout.fixed = layout.fixed.max(end.ok_or("a field without an end")?);
                    Position::Fixed(offset)
                }
                (None, Some(index)) => {
                    layout.variable = layout.variable.max(index.saturating_add(1));
                    Position::Variable(index)
                }
                (None, None) => return Err(format!("field `{}` has no place", piece.name)),
            };
            layout.pieces.insert(piece.name, Piece { scalar, place });
        }
        Ok(layout)
    }

    /// The layout of tag records.
    pub(super) fn tags() -> Self {
        let piece = |index| Piece {
            scalar: Scalar::Other(1),
            place: Position::Variable(index),
        };
        Layout {
            pieces: BTreeMap::from([
                ("user_tags".to_owned(), piece(0)),
                ("vrs_tags".to_owned(), piece(1)),
            ]),
            fixed: 0,
            variable: 2,
        }
    }

    /// Bytes up to the end of the table of variable fields.
    #[must_use]
    pub fn fixed_size(&self) -> usize {
        self.fixed.saturating_add(self.variable.saturating_mul(8))
    }
}

impl Scalar {
    fn parse(kind: &str) -> Self {
        let inner = kind
            .split_once('<')
            .map_or(kind, |(_, rest)| rest.trim_end_matches('>'));
        match inner {
            "Bool" | "bool" | "uint8_t" => Scalar::Unsigned(1),
            "uint16_t" => Scalar::Unsigned(2),
            "uint32_t" => Scalar::Unsigned(4),
            "uint64_t" => Scalar::Unsigned(8),
            "int8_t" => Scalar::Signed(1),
            "int16_t" => Scalar::Signed(2),
            "int32_t" => Scalar::Signed(4),
            "int64_t" => Scalar::Signed(8),
            "float" => Scalar::Float,
            "double" => Scalar::Double,
            _ => Scalar::Other(Self::compound(inner)),
        }
    }

    /// Bytes of points and matrices: `Point3Df`, `Matrix4Dd`, ...
    fn compound(name: &str) -> usize {
        let item = match name.as_bytes().last() {
            Some(b'd') => 8,
            _ => 4,
        };
        let count = |n: u8| usize::from(n.saturating_sub(b'0').min(4));
        match name.as_bytes() {
            [b'P', b'o', b'i', b'n', b't', n, ..] => item * count(*n),
            [b'M', b'a', b't', b'r', b'i', b'x', n, ..] => item * count(*n) * count(*n),
            _ => 1,
        }
    }

    fn size(self) -> usize {
        match self {
            Scalar::Unsigned(size) | Scalar::Signed(size) | Scalar::Other(size) => size,
            Scalar::Float => 4,
            Scalar::Double => 8,
        }
    }
}

/// The fields of one record.
#[derive(Debug, Clone, Copy)]
pub struct Fields<'a> {
    layout: &'a Layout,
    payload: &'a [u8],
}

impl<'a> Fields<'a> {
    /// # Errors
    /// When the payload is shorter than the layout's fixed part.
    pub fn new(layout: &'a Layout, payload: &'a [u8]) -> Result<Self, String> {
        if payload.len() < layout.fixed_size() {
            return Err(format!(
                "a record of {} bytes is shorter than its layout ({})",
                payload.len(),
                layout.fixed_size()
            ));
        }
        Ok(Fields { layout, payload })
    }

    /// An integer field of any width.
    #[must_use]
    pub fn integer(&self, name: &str) -> Option<i64> {
        let piece = self.layout.pieces.get(name)?;
        let Position::Fixed(at) = piece.place else {
            return None;
        };
        let (size, signed) = match piece.scalar {
            Scalar::Unsigned(size) => (size, false),
            Scalar::Signed(size) => (size, true),
            _ => return None,
        };
        let mut bytes = [0; 8];
        bytes[..size].copy_from_slice(self.payload.get(at..at + size)?);
        let value = i64::from_le_bytes(bytes);
        let unused = 64 - 8 * size as u32;
        Some(if signed {
            value << unused >> unused
        } else {
            value
        })
    }

    /// A floating-point field.
    #[must_use]
    pub fn float(&self, name: &str) -> Option<f64> {
        let piece = self.layout.pieces.get(name)?;
        let Position::Fixed(at) = piece.place else {
            return None;
        };
        match piece.scalar {
            Scalar::Float => Some(f64::from(f32::from_le_bytes(
                self.payload.get(at..at + 4)?.try_into().ok()?,
            ))),
            Scalar::Double => Some(f64::from_le_bytes(
                self.payload.get(at..at + 8)?.try_into().ok()?,
            )),
            _ => None,
        }
    }

    /// A string field.
    #[must_use]
    pub fn text(&self, name: &str) -> Option<String> {
        self.variable(name)
            .map(|bytes| String::from_utf8_lossy(bytes).into_owned())
    }

    /// A field that maps strings to strings: pairs to the end, without a count.
    #[must_use]
    pub fn string_map(&self, name: &str) -> Option<Vec<(String, String)>> {
        let data = self.variable(name)?;
        let mut cursor = Cursor { data, at: 0 };
        let mut pairs = Vec::new();
        while cursor.at < data.len() {
            pairs.push((cursor.text()?, cursor.text()?));
        }
        Some(pairs)
    }

    fn variable(&self, name: &str) -> Option<&'a [u8]> {
        let piece = self.layout.pieces.get(name)?;
        let Position::Variable(index) = piece.place else {
            return None;
        };
        let (offset, length) = self.table(index)?;
        let start = self.layout.fixed_size().checked_add(offset)?;
        self.payload.get(start..start.checked_add(length)?)
    }

    fn table(&self, index: usize) -> Option<(usize, usize)> {
        let at = self.layout.fixed.checked_add(index.checked_mul(8)?)?;
        let mut cursor = Cursor {
            data: self.payload,
            at,
        };
        Some((cursor.u32()? as usize, cursor.u32()? as usize))
    }

    /// What follows this block in the record.
    #[must_use]
    pub fn rest(&self) -> Option<&'a [u8]> {
        let mut end = 0;
        for index in 0..self.layout.variable {
            let (offset, length) = self.table(index)?;
            end = end.max(offset.checked_add(length)?);
        }
        self.payload
            .get(self.layout.fixed_size().checked_add(end)?..)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    const TEXT: &str = r#"{"data_layout":[{"name":"width","type":"DataPieceValue<uint32_t>","offset":0},
        {"name":"when","type":"DataPieceValue<int64_t>","offset":4},{"name":"gain","type":"DataPieceValue<double>","offset":12},
        {"name":"offset","type":"DataPieceArray<float>","offset":20,"size":3},
        {"name":"label","type":"DataPieceString","index":0},{"name":"more","type":"DataPieceStringMap<string>","index":1}]}"#;

    fn payload() -> Vec<u8> {
        let mut bytes = Vec::new();
        bytes.extend(7_u32.to_le_bytes());
        bytes.extend((-5_i64).to_le_bytes());
        bytes.extend(0.25_f64.to_le_bytes());
        bytes.extend([0; 12]);
        for (offset, length) in [(0_u32, 3_u32), (3, 10)] {
            bytes.extend(offset.to_le_bytes());
            bytes.extend(length.to_le_bytes());
        }
        bytes.extend(b"abc");
        for text in ["k", "v"] {
            bytes.extend(1_u32.to_le_bytes());
            bytes.extend(text.as_bytes());
        }
        bytes.extend(b"rest");
        bytes
    }

    #[test]
    fn fields_are_found_by_name() {
        let layout = Layout::parse(TEXT).unwrap();
        let payload = payload();
        let fields = Fields::new(&layout, &payload).unwrap();
        assert_eq!(fields.integer("width"), Some(7));
        assert_eq!(fields.integer("when"), Some(-5));
        assert_eq!(fields.float("gain"), Some(0.25));
        assert_eq!(fields.text("label").as_deref(), Some("abc"));
        assert_eq!(
            fields.string_map("more").unwrap(),
            [("k".to_owned(), "v".to_owned())]
        );
        assert_eq!(fields.rest(), Some(b"rest".as_slice()));
        assert_eq!(fields.integer("gain"), None);
        assert_eq!(fields.integer("absent"), None);
    }

    proptest! {
        #[test]
        fn no_payload_makes_it_panic(data in proptest::collection::vec(any::<u8>(), 0..80)) {
            let layout = Layout::parse(TEXT).unwrap();
            if let Ok(fields) = Fields::new(&layout, &data) {
                let _ = (fields.text("label"), fields.string_map("more"), fields.rest());
            }
        }
    }
}
