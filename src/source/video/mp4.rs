//! The part of ISO base media files (mp4, mov) that a video reader needs: the first video track's codec configuration and, for
//! every sample, where its bytes are and when it is shown. Fragmented files and edit lists included.
//!
//! The reader is our own because files come from anywhere: every count is checked against the file before anything is
//! allocated for it, nothing here can panic, and only the index is held in memory, never the media.

use crate::source::SourceError;
use crate::source::error::Place;
use std::fs::File;
use std::io::{BufReader, Read, Seek, SeekFrom};
use std::path::Path;

/// A sample table entry is 24 bytes in memory; a file whose samples are smaller than this on average is not a video, and
/// refusing it keeps the index below the size of the file.
const SMALLEST_MEAN_SAMPLE: u64 = 24;
/// Boxes inside boxes.
const DEEPEST: usize = 12;

/// The first video track of a file.
#[derive(Debug, Clone, PartialEq)]
pub struct Track {
    /// Four characters of the sample description: `avc1`, `hvc1`, `av01`, ...
    pub codec: [u8; 4],
    /// The payload of `avcC`, when there is one.
    pub avc_configuration: Option<Vec<u8>>,
    /// Coded size in pixels.
    pub width: u32,
    pub height: u32,
    /// Degrees clockwise by which the decoded picture has to be turned for display: 0, 90, 180 or 270.
    pub rotation: u32,
    /// Ticks per second of [`Sample::time`].
    pub timescale: u32,
    /// In decoding order.
    pub samples: Vec<Sample>,
    /// First tick that is shown (edit list); earlier samples are decoded but not part of the video.
    pub first_shown: i64,
}

/// One coded picture.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Sample {
    /// Bytes from the start of the file.
    pub offset: u64,
    /// Presentation time in ticks.
    pub time: i64,
    /// Bytes.
    pub size: u32,
    /// Decoding can start here.
    pub sync: bool,
}

/// Whether the file starts like an ISO base media file.
pub fn sniff(head: &[u8]) -> bool {
    head.len() >= 8
        && matches!(
            &head[4..8],
            b"ftyp" | b"moov" | b"mdat" | b"wide" | b"free" | b"skip"
        )
}

/// Reads the index of the first video track.
pub fn read(path: &Path) -> Result<Track, SourceError> {
    let file = File::open(path).map_err(|cause| SourceError::io(path, cause))?;
    let len = file
        .metadata()
        .map_err(|cause| SourceError::io(path, cause))?
        .len();
    let mut top = TopLevel {
        path,
        file: BufReader::new(file),
        len,
    };
    let mut track: Option<Track> = None;
    let mut fragments = Defaults::default();
    let mut at = 0;
    while at + 8 <= len {
        let (kind, header, size) = top.box_header(at)?;
        match &kind {
            b"moov" if track.is_none() => {
                let bytes = top.payload(at + header, size - header)?;
                let reader = Boxes {
                    path,
                    base: at + header,
                    file_len: len,
                };
                let (found, defaults) = reader.movie(&bytes)?;
                track = Some(found);
                fragments = defaults;
            }
            b"moof" => {
                let bytes = top.payload(at + header, size - header)?;
                let reader = Boxes {
                    path,
                    base: at + header,
                    file_len: len,
                };
                let track = track.as_mut().ok_or_else(|| {
                    SourceError::malformed(
                        path,
                        Place::Offset(at),
                        "a movie fragment before the movie header",
                    )
                })?;
                reader.fragment(&bytes, at, track, &mut fragments)?;
            }
            _ => {}
        }
        at += size;
    }
    let track = track.ok_or_else(|| {
        SourceError::malformed(
            path,
            Place::File,
            "no movie header (`moov`): not an mp4, or cut off while it was recorded",
        )
    })?;
    check(path, len, &track)?;
    Ok(track)
}

/// Samples must lie inside the file.
fn check(path: &Path, len: u64, track: &Track) -> Result<(), SourceError> {
    if track.samples.is_empty() {
        return Err(SourceError::malformed(
            path,
            Place::File,
            "the video track has no samples",
        ));
    }
    for (index, sample) in track.samples.iter().enumerate() {
        if sample
            .offset
            .checked_add(u64::from(sample.size))
            .is_none_or(|end| end > len)
        {
            return Err(SourceError::malformed(
                path,
                Place::Offset(sample.offset),
                format!(
                    "sample {index} of {} bytes lies beyond the end of the file ({len} bytes): truncated?",
                    sample.size
                ),
            ));
        }
    }
    Ok(())
}

struct TopLevel<'a> {
    path: &'a Path,
    file: BufReader<File>,
    len: u64,
}

impl TopLevel<'_> {
    /// Kind, size of the header, size of the box.
    fn box_header(&mut self, at: u64) -> Result<([u8; 4], u64, u64), SourceError> {
        let bytes = self.payload(at, 16.min(self.len - at))?;
        let short = u64::from(be32(&bytes, 0).unwrap_or(0));
        let kind = [bytes[4], bytes[5], bytes[6], bytes[7]];
        let (header, size) = match short {
            0 => (8, self.len - at),
            1 => (16, be64(&bytes, 8).unwrap_or(0)),
            size => (8, size),
        };
        if size < header || size > self.len - at {
            return Err(SourceError::malformed(
                self.path,
                Place::Offset(at),
                format!(
                    "box `{}` claims {size} bytes, {} are left",
                    kind.escape_ascii(),
                    self.len - at
                ),
            ));
        }
        Ok((kind, header, size))
    }

    fn payload(&mut self, at: u64, size: u64) -> Result<Vec<u8>, SourceError> {
        debug_assert!(at + size <= self.len, "checked by box_header");
        let fail = |cause| SourceError::io(self.path, cause);
        self.file.seek(SeekFrom::Start(at)).map_err(fail)?;
        let mut bytes = vec![0; size as usize];
        self.file.read_exact(&mut bytes).map_err(fail)?;
        Ok(bytes)
    }
}

/// What fragments leave out.
#[derive(Debug, Default, Clone)]
struct Defaults {
    track_id: u32,
    duration: u32,
    size: u32,
    flags: u32,
    /// Decoding time after the last fragment.
    next_time: i64,
}

struct Boxes<'a> {
    path: &'a Path,
    /// Offset in the file of the bytes at hand.
    base: u64,
    file_len: u64,
}

/// A box's payload and its offset within the bytes at hand.
#[derive(Clone, Copy)]
struct Inner<'b> {
    kind: [u8; 4],
    data: &'b [u8],
    at: usize,
}

impl Boxes<'_> {
    fn damaged(&self, at: usize, reason: impl Into<String>) -> SourceError {
        SourceError::malformed(self.path, Place::Offset(self.base + at as u64), reason)
    }

    fn children<'b>(
        &self,
        data: &'b [u8],
        at: usize,
        depth: usize,
    ) -> Result<Vec<Inner<'b>>, SourceError> {
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

    fn need(&self, found: Option<u32>, at: usize, what: &str) -> Result<u32, SourceError> {
        found.ok_or_else(|| self.damaged(at, format!("`{what}` is cut off")))
    }

    fn movie(&self, moov: &[u8]) -> Result<(Track, Defaults), SourceError> {
        let top = self.children(moov, 0, 0)?;
        let mut video = None;
        for trak in top.iter().filter(|inner| &inner.kind == b"trak") {
            if let Some(found) = self.track(*trak)? {
                video = Some(found);
                break;
            }
        }
        let Some((track, track_id)) = video else {
            return Err(SourceError::malformed(
                self.path,
                Place::Offset(self.base),
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
    fn track(&self, trak: Inner<'_>) -> Result<Option<(Track, u32)>, SourceError> {
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
            width: 0,
            height: 0,
            rotation,
            timescale,
            samples: Vec::new(),
            first_shown: edit_start,
        };
        self.sample_table(table, &mut track)?;
        Ok(Some((track, track_id)))
    }

    /// Media time of the first edit that shows something.
    fn edit_start(&self, edts: Inner<'_>) -> Result<i64, SourceError> {
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

    fn sample_table(&self, stbl: Inner<'_>, track: &mut Track) -> Result<(), SourceError> {
        let mut tables = Tables::default();
        for inner in self.children(stbl.data, stbl.at, 4)? {
            match &inner.kind {
                b"stsd" => self.description(inner, track)?,
                b"stts" => tables.durations = inner.data,
                b"ctts" => tables.shifts = inner.data,
                b"stss" => tables.syncs = Some(inner.data),
                b"stsc" => tables.chunks = inner.data,
                b"stsz" => tables.sizes = inner.data,
                b"stco" => tables.offsets = Some((inner.data, 4)),
                b"co64" => tables.offsets = Some((inner.data, 8)),
                _ => {}
            }
        }
        self.samples(stbl.at, &tables, track)
    }

    fn description(&self, stsd: Inner<'_>, track: &mut Track) -> Result<(), SourceError> {
        let entries = self.children(stsd.data.get(8..).unwrap_or(&[]), stsd.at + 8, 5)?;
        let Some(entry) = entries.first() else {
            return Err(self.damaged(stsd.at, "`stsd` describes nothing"));
        };
        track.codec = entry.kind;
        // 6 reserved, 2 reference index, 16 predefined, then 16-bit width and height; extensions start at 78.
        track.width = u32::from(be16(entry.data, 24).unwrap_or(0));
        track.height = u32::from(be16(entry.data, 26).unwrap_or(0));
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

    fn samples(
        &self,
        at: usize,
        tables: &Tables<'_>,
        track: &mut Track,
    ) -> Result<(), SourceError> {
        let count = u64::from(be32(tables.sizes, 8).unwrap_or(0));
        if count == 0 {
            return Ok(()); // a fragmented file
        }
        if count > self.file_len / SMALLEST_MEAN_SAMPLE {
            return Err(self.damaged(
                at,
                format!(
                    "{count} video samples cannot fit into a file of {} bytes",
                    self.file_len
                ),
            ));
        }
        let constant = be32(tables.sizes, 4).unwrap_or(0);
        let Some((offsets, width)) = tables.offsets else {
            return Err(self.damaged(at, "no chunk offsets (`stco` or `co64`)"));
        };
        let chunk_offset = |chunk: u64| {
            let at = usize::try_from(chunk)
                .ok()?
                .checked_mul(width)?
                .checked_add(8)?;
            if width == 4 {
                be32(offsets, at).map(u64::from)
            } else {
                be64(offsets, at)
            }
        };
        let mut durations = Runs::new(tables.durations);
        let mut shifts = Runs::new(tables.shifts);
        let mut next_sync = 0;
        let mut samples = Vec::with_capacity(count as usize);
        let (mut chunk, mut chunk_run, mut left_in_chunk, mut offset) =
            (0_u64, 0_usize, 0_u32, 0_u64);
        let mut decode_time = 0_i64;
        for index in 0..count {
            if left_in_chunk == 0 {
                if index > 0 {
                    chunk += 1;
                }
                // Entries: first chunk (from 1), samples per chunk, description.
                while be32(tables.chunks, 8 + 12 * (chunk_run + 1))
                    .is_some_and(|first| u64::from(first) <= chunk + 1)
                {
                    chunk_run += 1;
                }
                left_in_chunk = be32(tables.chunks, 12 + 12 * chunk_run).unwrap_or(0);
                if left_in_chunk == 0 {
                    return Err(
                        self.damaged(at, format!("chunk {chunk} holds no samples (`stsc`)"))
                    );
                }
                offset = chunk_offset(chunk).ok_or_else(|| {
                    self.damaged(at, format!("no offset for chunk {chunk}, sample {index}"))
                })?;
            }
            let size = if constant != 0 {
                constant
            } else {
                be32(tables.sizes, 12 + 4 * index as usize).ok_or_else(|| {
                    self.damaged(at, format!("no size for sample {index} (`stsz`)"))
                })?
            };
            let duration = durations.next().ok_or_else(|| {
                self.damaged(at, format!("no duration for sample {index} (`stts`)"))
            })?;
            let shift = shifts.next().unwrap_or(0) as i32;
            let sync = match tables.syncs {
                None => true,
                Some(syncs) => {
                    let hit = be32(syncs, 8 + 4 * next_sync) == Some(index as u32 + 1);
                    next_sync += usize::from(hit);
                    hit
                }
            };
            samples.push(Sample {
                offset,
                size,
                time: decode_time + i64::from(shift),
                sync,
            });
            offset = offset.saturating_add(u64::from(size));
            decode_time += i64::from(duration);
            left_in_chunk -= 1;
        }
        track.samples = samples;
        Ok(())
    }

    fn fragment(
        &self,
        moof: &[u8],
        moof_at: u64,
        track: &mut Track,
        defaults: &mut Defaults,
    ) -> Result<(), SourceError> {
        for traf in self.children(moof, 0, 0)? {
            if &traf.kind != b"traf" {
                continue;
            }
            let inside = self.children(traf.data, traf.at, 1)?;
            let Some(header) = inside.iter().find(|inner| &inner.kind == b"tfhd") else {
                continue;
            };
            if be32(header.data, 4) != Some(defaults.track_id) {
                continue;
            }
            let flags = self.need(be32(header.data, 0), header.at, "tfhd")? & 0x00ff_ffff;
            let mut at = 8;
            let mut base = moof_at;
            if flags & 1 != 0 {
                base = be64(header.data, at)
                    .ok_or_else(|| self.damaged(header.at, "`tfhd` is cut off"))?;
                at += 8;
            }
            if flags & 2 != 0 {
                at += 4;
            }
            let mut field = |bit: u32, default: u32| {
                if flags & bit == 0 {
                    return Ok(default);
                }
                at += 4;
                self.need(be32(header.data, at - 4), header.at, "tfhd")
            };
            let duration = field(8, defaults.duration)?;
            let size = field(16, defaults.size)?;
            let sample_flags = field(32, defaults.flags)?;
            if let Some(tfdt) = inside.iter().find(|inner| &inner.kind == b"tfdt") {
                let time = if tfdt.data.first() == Some(&1) {
                    be64(tfdt.data, 4)
                } else {
                    be32(tfdt.data, 4).map(u64::from)
                };
                defaults.next_time = time
                    .and_then(|time| i64::try_from(time).ok())
                    .filter(|time| *time < i64::MAX / 4)
                    .ok_or_else(|| self.damaged(tfdt.at, "`tfdt` holds no time"))?;
            }
            let mut offset = base;
            for trun in inside.iter().filter(|inner| &inner.kind == b"trun") {
                let flags = self.need(be32(trun.data, 0), trun.at, "trun")?;
                let signed = flags >> 24 != 0;
                let count = self.need(be32(trun.data, 4), trun.at, "trun")? as usize;
                let mut at = 8;
                if flags & 1 != 0 {
                    let shift = self.need(be32(trun.data, at), trun.at, "trun")? as i32;
                    offset = base.saturating_add_signed(i64::from(shift));
                    at += 4;
                }
                let mut first_flags = None;
                if flags & 4 != 0 {
                    first_flags = Some(self.need(be32(trun.data, at), trun.at, "trun")?);
                    at += 4;
                }
                let most = (self.file_len / SMALLEST_MEAN_SAMPLE) as usize;
                if track.samples.len().saturating_add(count) > most {
                    return Err(self.damaged(
                        trun.at,
                        format!(
                            "{count} more video samples cannot fit into a file of {} bytes",
                            self.file_len
                        ),
                    ));
                }
                for index in 0..count {
                    let mut field = |bit: u32, default: u32| {
                        if flags & bit == 0 {
                            return Ok(default);
                        }
                        at += 4;
                        self.need(be32(trun.data, at - 4), trun.at, "trun")
                    };
                    let duration = field(0x100, duration)?;
                    let size = field(0x200, size)?;
                    let mut sample_flags = field(0x400, sample_flags)?;
                    let shift = field(0x800, 0)?;
                    if let (0, Some(first)) = (index, first_flags) {
                        sample_flags = first;
                    }
                    let shift = if signed {
                        i64::from(shift as i32)
                    } else {
                        i64::from(shift)
                    };
                    track.samples.push(Sample {
                        offset,
                        size,
                        time: defaults.next_time + shift,
                        // bit 16: not a sync sample
                        sync: sample_flags & 0x1_0000 == 0,
                    });
                    offset = offset.saturating_add(u64::from(size));
                    defaults.next_time += i64::from(duration);
                }
            }
        }
        Ok(())
    }
}

#[derive(Default)]
struct Tables<'b> {
    durations: &'b [u8],
    shifts: &'b [u8],
    syncs: Option<&'b [u8]>,
    chunks: &'b [u8],
    sizes: &'b [u8],
    offsets: Option<(&'b [u8], usize)>,
}

/// Run-length coded values: (count, value) pairs after a 4-byte version and a 4-byte number of pairs.
struct Runs<'b> {
    data: &'b [u8],
    at: usize,
    left: u32,
    value: u32,
}

impl<'b> Runs<'b> {
    fn new(data: &'b [u8]) -> Self {
        Runs {
            data,
            at: 8,
            left: 0,
            value: 0,
        }
    }
}

impl Iterator for Runs<'_> {
    type Item = u32;

    fn next(&mut self) -> Option<u32> {
        while self.left == 0 {
            self.left = be32(self.data, self.at)?;
            self.value = be32(self.data, self.at + 4)?;
            self.at += 8;
        }
        self.left -= 1;
        Some(self.value)
    }
}

fn be16(data: &[u8], at: usize) -> Option<u16> {
    Some(u16::from_be_bytes(data.get(at..at + 2)?.try_into().ok()?))
}

fn be32(data: &[u8], at: usize) -> Option<u32> {
    Some(u32::from_be_bytes(data.get(at..at + 4)?.try_into().ok()?))
}

fn be64(data: &[u8], at: usize) -> Option<u64> {
    Some(u64::from_be_bytes(data.get(at..at + 8)?.try_into().ok()?))
}
