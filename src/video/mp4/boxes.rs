//! Boxes inside boxes: the movie header down to the track and its codec.

use super::fragment::Defaults;
use super::{DEEPEST, Track};
use crate::formats::ReadError;
use crate::formats::read_error::Position;
use std::path::Path;

pub(super) struct Boxes<'a> {
    pub(super) path: &'a Path,
    /// Offset in the file of the bytes at hand.
    pub(super) base: u64,
    pub(super) file_len: u64,
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
        let mut video = None;
        for trak in top.iter().filter(|inner| &inner.kind == b"trak") {
            if let Some(found) = self.track(*trak)? {
                video = Some(found);
                break;
            }
        }
        let Some((track, track_id)) = video else {
            return Err(ReadError::malformed(
                self.path,
                Position::Offset(self.base),
                "there is no video track",
            ));
        };
        let mut defaults = Defaults {
            track_id,
            ..Defaults::default()
        };
        for mvex in top.iter().filter(|inner| &inner.kind == b"mvex") {
            for trex in self.children(mvex.data, mvex.at, 1)? {
                if &trex.kind == b"trex" && be32(trex.data, 4) == Some(track_id) {
                    defaults.duration = self.need(be32(trex.data, 12), trex.at, "trex")?;
                    defaults.size = self.need(be32(trex.data, 16), trex.at, "trex")?;
                    defaults.flags = self.need(be32(trex.data, 20), trex.at, "trex")?;
                }
            }
        }
        Ok((track, defaults))
    }

    /// The track and its id, if it is a video track.
    pub(super) fn track(&self, trak: Inner<'_>) -> Result<Option<(Track, u32)>, ReadError> {
        let mut header = None;
        let mut media = None;
        let mut edit_start = 0;
        for inner in self.children(trak.data, trak.at, 1)? {
            match &inner.kind {
                b"tkhd" => header = Some(inner),
                b"mdia" => media = Some(inner),
                b"edts" => edit_start = self.edit_start(inner)?,
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
        let track_id = self.need(
            be32(header.data, if wide { 20 } else { 12 }),
            header.at,
            "tkhd",
        )?;
        let matrix = if wide { 52 } else { 40 };
        let a = self.need(be32(header.data, matrix), header.at, "tkhd")? as i32;
        let b = self.need(be32(header.data, matrix + 4), header.at, "tkhd")? as i32;
        let turn = f64::from(b).atan2(f64::from(a)).to_degrees();
        let rotation = ((turn / 90.0).round() as i32).rem_euclid(4) as u32 * 90;

        let mut track = Track {
            codec: *b"    ",
            avc_configuration: None,
            rotation,
            timescale,
            samples: Vec::new(),
            first_shown: edit_start,
        };
        self.sample_table(table, &mut track)?;
        Ok(Some((track, track_id)))
    }

    /// Media time of the first edit that shows something.
    pub(super) fn edit_start(&self, edts: Inner<'_>) -> Result<i64, ReadError> {
        for elst in self.children(edts.data, edts.at, 2)? {
            if &elst.kind != b"elst" {
                continue;
            }
            let wide = elst.data.first() == Some(&1);
            let count = self.need(be32(elst.data, 4), elst.at, "elst")? as usize;
            let entry = if wide { 20 } else { 12 };
            for index in 0..count.min(elst.data.len() / entry) {
                let at = 8 + index * entry;
                let media_time = if wide {
                    be64(elst.data, at + 8).map(|value| value as i64)
                } else {
                    be32(elst.data, at + 4).map(|value| i64::from(value as i32))
                };
                match media_time {
                    Some(-1) => {}
                    Some(time) => return Ok(time.clamp(0, i64::MAX / 4)),
                    None => return Err(self.damaged(elst.at, "`elst` is cut off")),
                }
            }
        }
        Ok(0)
    }

    pub(super) fn description(&self, stsd: Inner<'_>, track: &mut Track) -> Result<(), ReadError> {
        let entries = self.children(stsd.data.get(8..).unwrap_or(&[]), stsd.at + 8, 5)?;
        let Some(entry) = entries.first() else {
            return Err(self.damaged(stsd.at, "`stsd` describes nothing"));
        };
        track.codec = entry.kind;
        // Extensions start at 78.
        if let Some(rest) = entry.data.get(78..) {
            // Trailing bytes that are no box do occur here: look for `avcC` only as far as boxes go.
            let mut here = 0;
            while let (Some(size), Some(kind)) = (be32(rest, here), rest.get(here + 4..here + 8)) {
                let size = size as usize;
                let Some(body) = rest.get(here + 8..(here + size).max(here + 8)) else {
                    break;
                };
                if kind == b"avcC" {
                    track.avc_configuration = Some(body.to_vec());
                }
                if size < 8 {
                    break;
                }
                here += size;
            }
        }
        Ok(())
    }
}

pub(super) fn be32(data: &[u8], at: usize) -> Option<u32> {
    Some(u32::from_be_bytes(data.get(at..at + 4)?.try_into().ok()?))
}

pub(super) fn be64(data: &[u8], at: usize) -> Option<u64> {
    Some(u64::from_be_bytes(data.get(at..at + 8)?.try_into().ok()?))
}
