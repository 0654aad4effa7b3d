//! The part of ISO base media files (mp4, mov) that a video reader needs: how the video track is coded and, for every sample,
//! where its bytes are and when it is shown. Fragmented files, edit lists and several sample descriptions included.
//!
//! The reader is our own because files come from anywhere: every count is checked against the file before anything is
//! allocated for it, nothing here can panic, and only the index is held in memory, never the media.

mod boxes;
mod edits;
mod entry;
mod fragment;
mod samples;

pub use edits::{Edit, Shown};
pub use entry::SampleEntry;

use boxes::Defaults;
use boxes::{Boxes, be32, be64};

use crate::formats::ReadError;
use crate::formats::read_error::Position;
use crate::video::image::Orientation;
use std::fs::File;
use std::io::{BufReader, Read, Seek, SeekFrom};
use std::path::Path;

/// Every sample of a movie takes at least four bytes of the file, in its table of sizes or in the media; with 24 bytes a sample,
/// the index stays below six times the size of the file.
const SMALLEST_SAMPLE: u64 = 4;
/// Boxes inside boxes.
const DEEPEST: usize = 12;

/// The video track of a file: the first one that is switched on, pictures of chapters and covers aside.
#[derive(Debug, Clone, PartialEq)]
pub struct Track {
    /// Its number in the file (`track_ID`), by which fragments and `ffmpeg` know it.
    pub id: u32,
    /// Players show it.
    pub enabled: bool,
    /// At least one.
    pub entries: Vec<SampleEntry>,
    /// How decoded pictures come upright; none where that is more than quarter turns and a mirror.
    pub orientation: Option<Orientation>,
    /// Width to height of a pixel by the matrix, which may stretch pictures.
    pub stretch: Option<f64>,
    /// Pixels by the header of the track, before it is turned; 0 where it says nothing.
    pub size: [u32; 2],
    /// Ticks per second of [`Sample::time`].
    pub timescale: u32,
    /// Ticks per second of [`Edit::duration`].
    pub movie_timescale: u32,
    /// In decoding order.
    pub samples: Vec<Sample>,
    /// Empty: everything is shown.
    pub edits: Vec<Edit>,
    /// Samples come in movie fragments.
    pub fragmented: bool,
}

/// One coded picture.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Sample {
    /// Bytes from the start of the file.
    pub offset: u64,
    /// Presentation time in ticks.
    pub time: i64,
    /// Bytes; a sample of none is no picture, the one before stays on.
    pub size: u32,
    /// Index into [`Track::entries`].
    pub entry: u16,
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

/// Reads the index of the video track.
pub fn read(path: &Path) -> Result<Track, ReadError> {
    let file = File::open(path).map_err(|cause| ReadError::io(path, cause))?;
    let len = file
        .metadata()
        .map_err(|cause| ReadError::io(path, cause))?
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
        let (kind, header, size) = match top.box_header(at) {
            Ok(found) => found,
            // What cameras append after the last box is none. Media that is cut off shows when samples are compared with the file.
            Err((kind, _)) if track.is_some() && &kind != b"moof" => break,
            Err((_, error)) => return Err(error),
        };
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
                    ReadError::malformed(
                        path,
                        Position::Offset(at),
                        "a movie fragment before the movie header",
                    )
                })?;
                track.fragmented = true;
                reader.fragment(&bytes, at, track, &mut fragments)?;
            }
            _ => {}
        }
        at += size;
    }
    let track = track.ok_or_else(|| {
        ReadError::malformed(
            path,
            Position::File,
            "no movie header (`moov`): not an mp4, or cut off while it was recorded",
        )
    })?;
    check(path, len, &track)?;
    Ok(track)
}

/// Samples must lie inside the file.
fn check(path: &Path, len: u64, track: &Track) -> Result<(), ReadError> {
    if track.samples.is_empty() {
        return Err(ReadError::malformed(
            path,
            Position::File,
            "the video track has no samples",
        ));
    }
    for (index, sample) in track.samples.iter().enumerate() {
        if sample
            .offset
            .checked_add(u64::from(sample.size))
            .is_none_or(|end| end > len)
        {
            return Err(ReadError::malformed(
                path,
                Position::Offset(sample.offset),
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

/// Kind, size of the header, size of the box.
type BoxHeader = ([u8; 4], u64, u64);

impl TopLevel<'_> {
    /// Kind, size of the header, size of the box; or the kind of the box that cannot be read.
    fn box_header(&mut self, at: u64) -> Result<BoxHeader, ([u8; 4], ReadError)> {
        let bytes = self
            .payload(at, 16.min(self.len - at))
            .map_err(|error| (*b"moof", error))?;
        let short = u64::from(be32(&bytes, 0).unwrap_or(0));
        let kind = [bytes[4], bytes[5], bytes[6], bytes[7]];
        let (header, size) = match short {
            0 => (8, self.len - at),
            1 => (16, be64(&bytes, 8).unwrap_or(0)),
            size => (8, size),
        };
        if size < header || size > self.len - at {
            let error = ReadError::malformed(
                self.path,
                Position::Offset(at),
                format!(
                    "box `{}` claims {size} bytes, {} are left: truncated?",
                    kind.escape_ascii(),
                    self.len - at
                ),
            );
            return Err((kind, error));
        }
        Ok((kind, header, size))
    }

    fn payload(&mut self, at: u64, size: u64) -> Result<Vec<u8>, ReadError> {
        debug_assert!(at + size <= self.len, "checked by box_header");
        let fail = |cause| ReadError::io(self.path, cause);
        self.file.seek(SeekFrom::Start(at)).map_err(fail)?;
        let mut bytes = vec![0; size as usize];
        self.file.read_exact(&mut bytes).map_err(fail)?;
        Ok(bytes)
    }
}
