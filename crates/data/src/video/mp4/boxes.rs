//! Boxes inside boxes: the movie header down to the track and its codec.

use super::{DEEPEST, Edit, Track};
use crate::formats::ReadError;
use crate::formats::read_error::Position;
use crate::video::image::Orientation;
use std::path::Path;

pub(super) struct Boxes<'a> {
    pub(super) path: &'a Path,
    /// Offset in the file of the bytes at hand.
    pub(super) base: u64,
    pub(super) file_len: u64,
}

/// What fragments leave out.
#[derive(Debug, Default, Clone)]
pub(super) struct Defaults {
    /// Index of the sample description.
    pub(super) entry: u16,
    pub(super) duration: u32,
    pub(super) size: u32,
    pub(super) flags: u32,
    /// Decoding time after the last fragment.
    pub(super) next_time: i64,
}

/// From a number that counts from 1.
pub(super) fn entry_index(number: u32) -> u16 {
    u16::try_from(number.saturating_sub(1)).unwrap_or(u16::MAX)
}

/// A box's payload and its offset within the bytes at hand.
#[derive(Clone, Copy)]
pub(super) struct Inner<'b> {
    pub(super) kind: [u8; 4],
    pub(super) data: &'b [u8],
    pub(super) at: usize,
}

impl Boxes<'_> {
    pub(super) fn damaged(&self, at: usize, reason: impl Into<String>) -> ReadError {
        ReadError::malformed(self.path, Position::Offset(self.base + at as u64), reason)
    }

    pub(super) fn children<'b>(
        &self,
        data: &'b [u8],
        at: usize,
        depth: usize,
    ) -> Result<Vec<Inner<'b>>, ReadError> {
        if depth > DEEPEST {
            return Err(self.damaged(at, "boxes nested too deeply"));
        }
        let mut children = Vec::new();
        let mut here = 0;
        while here + 8 <= data.len() {
            let short = be32(data, here).unwrap_or(0) as u64;
            let left = (data.len() - here) as u64;
            let (header, size) = match short {
                0 => (8, left),
                1 => (16, be64(data, here + 8).unwrap_or(0)),
                size => (8, size),
            };
            let kind = [
                data[here + 4],
                data[here + 5],
                data[here + 6],
                data[here + 7],
            ];
            if size < header || size > left {
                return Err(self.damaged(
                    at + here,
                    format!(
                        "box `{}` claims {size} bytes, {left} are left",
                        kind.escape_ascii()
                    ),
                ));
            }
            children.push(Inner {
                kind,
                data: &data[here + header as usize..here + size as usize],
                at: at + here + header as usize,
            });
            here += size as usize;
        }
        Ok(children)
    }

    pub(super) fn need(&self, found: Option<u32>, at: usize, what: &str) -> Result<u32, ReadError> {
        found.ok_or_else(|| self.damaged(at, format!("`{what}` is cut off")))
    }

    pub(super) fn movie(&self, moov: &[u8]) -> Result<(Track, Defaults), ReadError> {
        let top = self.children(moov, 0, 0)?;
        let mut movie = Movie::default();
        if let Some(mvhd) = top.iter().find(|inner| &inner.kind == b"mvhd") {
            let wide = mvhd.data.first() == Some(&1);
            movie.timescale = be32(mvhd.data, if wide { 20 } else { 12 }).unwrap_or(0);
            movie.matrix = Matrix::read(mvhd.data, if wide { 48 } else { 36 });
        }
        let chapters = movie_chapters(&top);
        let mut tracks = Vec::new();
        for trak in top.iter().filter(|inner| &inner.kind == b"trak") {
            tracks.extend(self.track(*trak, &movie, &chapters)?);
        }
        // A picture of its own is a cover where there is a video beside it.
        let still = |track: &Track| matches!(&track.entries[0].codec, b"jpeg" | b"png " | b"mjpa");
        if tracks.iter().any(|track| !still(track)) {
            tracks.retain(|track| !still(track));
        }
        let chosen = tracks.iter().position(|track| track.enabled).unwrap_or(0);
        if top.iter().any(|inner| &inner.kind == b"cmov") {
            return Err(ReadError::unsupported(
                self.path,
                "a compressed movie header",
            ));
        }
        if tracks.is_empty() {
            return Err(ReadError::malformed(
                self.path,
                Position::Offset(self.base),
                "there is no video track",
            ));
        }
        let track = tracks.swap_remove(chosen);
        let mut defaults = Defaults::default();
        for mvex in top.iter().filter(|inner| &inner.kind == b"mvex") {
            for trex in self.children(mvex.data, mvex.at, 1)? {
                if &trex.kind == b"trex" && be32(trex.data, 4) == Some(track.id) {
                    defaults.entry = entry_index(self.need(be32(trex.data, 8), trex.at, "trex")?);
                    defaults.duration = self.need(be32(trex.data, 12), trex.at, "trex")?;
                    defaults.size = self.need(be32(trex.data, 16), trex.at, "trex")?;
                    defaults.flags = self.need(be32(trex.data, 20), trex.at, "trex")?;
                }
            }
        }
        Ok((track, defaults))
    }

    /// The track, if it is a video track.
    fn track(
        &self,
        trak: Inner<'_>,
        movie: &Movie,
        chapters: &[u32],
    ) -> Result<Option<Track>, ReadError> {
        let mut header = None;
        let mut media = None;
        let mut edits = Vec::new();
        for inner in self.children(trak.data, trak.at, 1)? {
            match &inner.kind {
                b"tkhd" => header = Some(inner),
                b"mdia" => media = Some(inner),
                b"edts" => edits = self.edits(inner)?,
                _ => {}
            }
        }
        let (Some(header), Some(media)) = (header, media) else {
            return Ok(None);
        };
        let (mut is_video, mut timescale, mut table) = (false, 0, None);
        for inner in self.children(media.data, media.at, 2)? {
            match &inner.kind {
                b"hdlr" => is_video = inner.data.get(8..12) == Some(b"vide".as_slice()),
                b"mdhd" => {
                    let at = if inner.data.first() == Some(&1) {
                        20
                    } else {
                        12
                    };
                    timescale = self.need(be32(inner.data, at), inner.at, "mdhd")?;
                }
                b"minf" => {
                    table = self
                        .children(inner.data, inner.at, 3)?
                        .into_iter()
                        .find(|inner| &inner.kind == b"stbl");
                }
                _ => {}
            }
        }
        let (true, Some(table)) = (is_video, table) else {
            return Ok(None);
        };
        if timescale == 0 {
            return Err(self.damaged(media.at, "the video track's timescale is 0"));
        }
        let wide = header.data.first() == Some(&1);
        let need = |at: usize| self.need(be32(header.data, at), header.at, "tkhd");
        let flags = need(0)?;
        let id = need(if wide { 20 } else { 12 })?;
        if chapters.contains(&id) {
            return Ok(None);
        }
        let at = if wide { 52 } else { 40 };
        need(at + 32)?;
        let matrix = Matrix::read(header.data, at).after(movie.matrix);
        let side = |at: usize| be32(header.data, at).unwrap_or(0) >> 16;
        let mut track = Track {
            id,
            enabled: flags & 1 != 0,
            entries: Vec::new(),
            orientation: Orientation::from_matrix(matrix.0),
            stretch: matrix.stretch(),
            size: [side(at + 36), side(at + 40)],
            timescale,
            movie_timescale: movie.timescale,
            samples: Vec::new(),
            edits,
            fragmented: false,
        };
        self.sample_table(table, &mut track)?;
        if track.entries.is_empty() {
            return Err(self.damaged(table.at, "no sample description (`stsd`)"));
        }
        Ok(Some(track))
    }

    fn edits(&self, edts: Inner<'_>) -> Result<Vec<Edit>, ReadError> {
        let mut edits = Vec::new();
        for elst in self.children(edts.data, edts.at, 2)? {
            if &elst.kind != b"elst" {
                continue;
            }
            let wide = elst.data.first() == Some(&1);
            let count = self.need(be32(elst.data, 4), elst.at, "elst")? as usize;
            let size = if wide { 20 } else { 12 };
            for entry in elst.data[8..].chunks_exact(size).take(count) {
                let fields = if wide {
                    (be64(entry, 0), be64(entry, 8).map(|time| time as i64))
                } else {
                    let time = be32(entry, 4).map(|time| i64::from(time as i32));
                    (be32(entry, 0).map(u64::from), time)
                };
                if let (Some(duration), Some(media_time)) = fields {
                    edits.push(Edit {
                        duration,
                        media_time: media_time.clamp(i64::MIN / 4, i64::MAX / 4),
                        rate: be32(entry, size - 4).unwrap_or(0) as i32,
                    });
                }
            }
        }
        Ok(edits)
    }
}

/// What the header of the movie says about all its tracks.
#[derive(Debug, Default)]
struct Movie {
    timescale: u32,
    matrix: Matrix,
}

/// Tracks that hold the pictures of another track's chapters.
fn movie_chapters(top: &[Inner<'_>]) -> Vec<u32> {
    let mut found = Vec::new();
    for trak in top.iter().filter(|inner| &inner.kind == b"trak") {
        for tref in plain_children(trak.data).filter(|(kind, _)| kind == b"tref") {
            for (_, ids) in plain_children(tref.1).filter(|(kind, _)| kind == b"chap") {
                found.extend((0..ids.len() / 4).filter_map(|at| be32(ids, 4 * at)));
            }
        }
    }
    found
}

/// Boxes with short headers, as far as they go.
fn plain_children(data: &[u8]) -> impl Iterator<Item = ([u8; 4], &[u8])> {
    let mut here = 0;
    std::iter::from_fn(move || {
        let size = be32(data, here)? as usize;
        let kind = data.get(here + 4..here + 8)?.try_into().ok()?;
        let body = data.get(here + 8..here.checked_add(size)?)?;
        here += size;
        Some((kind, body))
    })
}

/// `a b c d` of a display matrix, 16.16 fixed point: x' = a x + c y, y' = b x + d y.
#[derive(Debug, Clone, Copy)]
struct Matrix([i32; 4]);

impl Default for Matrix {
    fn default() -> Self {
        Matrix([1 << 16, 0, 0, 1 << 16])
    }
}

impl Matrix {
    /// Rows of three numbers each; the identity where it is cut off.
    fn read(data: &[u8], at: usize) -> Self {
        let cell = |index: usize| be32(data, at + 4 * index).map(|value| value as i32);
        match [cell(0), cell(1), cell(3), cell(4)] {
            [Some(a), Some(b), Some(c), Some(d)] => Matrix([a, b, c, d]),
            _ => Self::default(),
        }
    }

    /// First this one, then `next`.
    fn after(self, next: Self) -> Self {
        let [a, b, c, d] = self.0.map(i64::from);
        let [e, f, g, h] = next.0.map(i64::from);
        let cell = |p: i64, q: i64| ((p + q) >> 16).clamp(i32::MIN.into(), i32::MAX.into()) as i32;
        Matrix([
            cell(a * e, b * g),
            cell(a * f, b * h),
            cell(c * e, d * g),
            cell(c * f, d * h),
        ])
    }

    /// Width to height of a pixel where the two differ by more than a hundredth.
    fn stretch(self) -> Option<f64> {
        let [a, b, c, d] = self.0.map(f64::from);
        let (x, y) = (a.hypot(c), b.hypot(d));
        let ratio = x / y;
        (x > 1.0 && y > 1.0 && (ratio - 1.0).abs() > 0.01).then_some(ratio)
    }
}

pub(super) fn be32(data: &[u8], at: usize) -> Option<u32> {
    Some(u32::from_be_bytes(data.get(at..at + 4)?.try_into().ok()?))
}

pub(super) fn be64(data: &[u8], at: usize) -> Option<u64> {
    Some(u64::from_be_bytes(data.get(at..at + 8)?.try_into().ok()?))
}
