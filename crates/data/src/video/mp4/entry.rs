//! Sample descriptions: codec, its configuration, colours and the shape of pixels.

use super::Track;
use super::boxes::{Boxes, Inner, be32};
use crate::formats::ReadError;

/// How the samples of a track, or of a part of it, are coded.
#[derive(Debug, Clone, PartialEq, Eq, Default)]
pub struct SampleEntry {
    /// Four characters: `avc1`, `hvc1`, `av01`, ...
    pub codec: [u8; 4],
    /// Coded pixels as the container says.
    pub size: [u32; 2],
    /// The payload of `avcC`, when there is one.
    pub avc_configuration: Option<Vec<u8>>,
    /// Matrix coefficients of `colr` (ITU-T H.273).
    pub matrix: Option<u8>,
    /// Range of `colr`: whether luma goes from 0 to 255.
    pub full_range: Option<bool>,
    /// Width to height of a pixel, from `pasp`.
    pub pixel_aspect: Option<[u32; 2]>,
}

/// The matrix that names none.
const UNSPECIFIED: u8 = 2;
/// So many descriptions are more than any camera writes.
const MOST_ENTRIES: usize = 256;

impl Boxes<'_> {
    pub(super) fn descriptions(&self, stsd: Inner<'_>, track: &mut Track) -> Result<(), ReadError> {
        let entries = self.children(stsd.data.get(8..).unwrap_or(&[]), stsd.at + 8, 5)?;
        if entries.is_empty() || entries.len() > MOST_ENTRIES {
            return Err(self.damaged(
                stsd.at,
                format!("`stsd` has {} descriptions", entries.len()),
            ));
        }
        track.entries = entries.iter().map(|entry| describe(*entry)).collect();
        Ok(())
    }
}

fn describe(entry: Inner<'_>) -> SampleEntry {
    let size = be32(entry.data, 24).unwrap_or(0);
    let mut found = SampleEntry {
        codec: entry.kind,
        size: [size >> 16, size & 0xffff],
        ..SampleEntry::default()
    };
    // Extensions start at 78. Trailing bytes that are no box do occur here: look only as far as boxes go.
    let rest = entry.data.get(78..).unwrap_or(&[]);
    let mut here = 0;
    while let (Some(size), Some(kind)) = (be32(rest, here), rest.get(here + 4..here + 8)) {
        let size = size as usize;
        let Some(body) = rest.get(here + 8..(here + size).max(here + 8)) else {
            break;
        };
        match kind {
            b"avcC" => found.avc_configuration = Some(body.to_vec()),
            b"pasp" => {
                if let (Some(wide @ 1..), Some(high @ 1..)) = (be32(body, 0), be32(body, 4)) {
                    found.pixel_aspect = Some([wide, high]);
                }
            }
            b"colr" => {
                let nclx = body.starts_with(b"nclx");
                if (nclx || body.starts_with(b"nclc")) && body.len() >= 10 {
                    // After the kind: primaries, transfer, matrix, two bytes each.
                    let matrix = u16::from_be_bytes([body[8], body[9]]);
                    found.matrix = Some(u8::try_from(matrix).unwrap_or(UNSPECIFIED));
                    if let (true, Some(flags)) = (nclx, body.get(10)) {
                        found.full_range = Some(flags & 0x80 != 0);
                    }
                }
            }
            _ => {}
        }
        if size < 8 {
            break;
        }
        here += size;
    }
    found
}
