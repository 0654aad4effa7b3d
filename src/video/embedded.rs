//! Frames of an mp4 by the embedded H.264 decoder: seeks to the refresh before what is wanted, decodes forward, puts pictures
//! into the order of presentation, and never holds more than a handful of them.

use super::choice::FrameTimes;
use super::h264::{Configuration, PictureError, Pictures};
use super::mp4::{Sample, Track};
use crate::formats::ReadError;
use crate::formats::read_error::Position;
use crate::video::image::Turn;
use rusty_h264_common::YuvFrame;
use std::collections::BTreeMap;
use std::fs::File;
use std::io::{Read, Seek, SeekFrom};
use std::path::{Path, PathBuf};
use std::sync::Arc;

/// H.264 allows 16 pictures between decoding and presentation.
const MOST_PENDING: usize = 17;
/// A sample that says it starts a sequence, but does not, is passed over this often before decoding starts at the beginning.
const SYNC_TRIES: usize = 4;

/// An opened mp4: everything but the media.
#[derive(Debug)]
pub struct Index {
    pub path: PathBuf,
    pub configuration: Configuration,
    pub turn: Turn,
    samples: Vec<Sample>,
    /// Decoding position of every shown frame, in order of presentation.
    shown: Vec<u32>,
    /// Presentation position of every sample; `u32::MAX` where it is not shown.
    rank: Vec<u32>,
}

impl Index {
    /// Orders the track for presentation.
    pub fn new(
        path: &Path,
        track: Track,
        configuration: Configuration,
    ) -> Result<(Self, FrameTimes), ReadError> {
        let mut shown: Vec<u32> = (0..track.samples.len() as u32)
            .filter(|&index| track.samples[index as usize].time >= track.first_shown)
            .collect();
        shown.sort_by_key(|&index| (track.samples[index as usize].time, index));
        if shown.is_empty() {
            return Err(ReadError::malformed(
                path,
                Position::File,
                "the edit list hides every frame",
            ));
        }
        let mut rank = vec![u32::MAX; track.samples.len()];
        for (position, &index) in shown.iter().enumerate() {
            rank[index as usize] = position as u32;
        }
        let ticks: Vec<i64> = shown
            .iter()
            .map(|&index| track.samples[index as usize].time)
            .collect();
        let schedule = FrameTimes::from_ticks(&ticks, track.timescale);
        let index = Index {
            path: path.to_owned(),
            configuration,
            turn: Turn::from_degrees(track.rotation),
            samples: track.samples,
            shown,
            rank,
        };
        Ok((index, schedule))
    }
}

/// The wanted pictures of a file, one after the other.
#[derive(Debug)]
pub struct Wanted {
    index: Arc<Index>,
    file: File,
    pictures: Pictures,
    /// Next sample to decode.
    next: usize,
    /// Samples shown before this rank come from before the starting point and cannot be decoded.
    first_rank: u32,
    /// Ascending, without repetition.
    frames: Vec<usize>,
    delivered: usize,
    pending: BTreeMap<u32, YuvFrame>,
    sample: Vec<u8>,
}

impl Wanted {
    /// `frames` in ascending order, all of them less than the number of shown frames.
    pub fn new(index: Arc<Index>, frames: Vec<usize>) -> Result<Self, ReadError> {
        let file = File::open(&index.path).map_err(|cause| ReadError::io(&index.path, cause))?;
        let mut wanted = Wanted {
            pictures: Pictures::new(index.configuration.clone()),
            index,
            file,
            next: 0,
            first_rank: 0,
            frames,
            delivered: 0,
            pending: BTreeMap::new(),
            sample: Vec::new(),
        };
        wanted.seek()?;
        Ok(wanted)
    }

    /// Moves to the last starting point from which all wanted frames can be decoded.
    fn seek(&mut self) -> Result<(), ReadError> {
        let Some(&first) = self.frames.first() else {
            return Ok(());
        };
        let index = Arc::clone(&self.index);
        let earliest = self
            .frames
            .iter()
            .take(MOST_PENDING)
            .map(|&frame| index.shown[frame])
            .min()
            .unwrap_or(0) as usize;
        let mut tries = 0;
        for at in (1..=earliest).rev() {
            let rank = index.rank[at];
            if !index.samples[at].sync || rank as usize > first {
                continue;
            }
            self.read(at)?;
            if index.configuration.is_intra(&self.sample) {
                self.next = at;
                self.first_rank = rank;
                return Ok(());
            }
            tries += 1;
            if tries == SYNC_TRIES {
                break;
            }
        }
        self.next = 0;
        Ok(())
    }

    fn read(&mut self, at: usize) -> Result<(), ReadError> {
        let sample = self.index.samples[at];
        let fail = |cause| ReadError::io(&self.index.path, cause);
        self.file
            .seek(SeekFrom::Start(sample.offset))
            .map_err(fail)?;
        self.sample.resize(sample.size as usize, 0);
        self.file.read_exact(&mut self.sample).map_err(fail)
    }

    /// The next wanted frame and its picture.
    fn advance(&mut self) -> Result<Option<(usize, YuvFrame)>, ReadError> {
        let Some(&frame) = self.frames.get(self.delivered) else {
            return Ok(None);
        };
        loop {
            if let Some(picture) = self.pending.remove(&(frame as u32)) {
                self.delivered += 1;
                return Ok(Some((frame, picture)));
            }
            let at = self.next;
            let Some(&sample) = self.index.samples.get(at) else {
                return Err(self.damaged(frame, 0, "never decoded"));
            };
            self.next += 1;
            let rank = self.index.rank[at];
            // Pictures from before the starting point may refer to what was not decoded; nothing wanted refers to them.
            if rank < self.first_rank {
                continue;
            }
            self.read(at)?;
            let wanted = self.frames[self.delivered..]
                .binary_search(&(rank as usize))
                .is_ok();
            if !wanted && self.index.configuration.is_disposable(&self.sample) {
                continue;
            }
            let picture = match self.pictures.decode(&self.sample) {
                Ok(picture) => picture,
                Err(PictureError::Unsupported(what)) => {
                    return Err(ReadError::unsupported(
                        &self.index.path,
                        format!(
                            "the embedded decoder does not know `{what}` (frame {rank}); set `decoder: ffmpeg`, or {}",
                            super::CONVERT
                        ),
                    ));
                }
                Err(PictureError::Damaged(reason)) => {
                    return Err(self.damaged(rank as usize, sample.offset, &reason));
                }
            };
            match picture {
                Some(picture) if wanted => {
                    self.pending.insert(rank, picture);
                    if self.pending.len() > MOST_PENDING {
                        return Err(self.damaged(
                            frame,
                            sample.offset,
                            "frames are too far out of order",
                        ));
                    }
                }
                None if wanted => {
                    return Err(self.damaged(
                        rank as usize,
                        sample.offset,
                        "the picture is incomplete",
                    ));
                }
                Some(_) | None => {}
            }
        }
    }

    fn damaged(&self, frame: usize, offset: u64, reason: &str) -> ReadError {
        ReadError::malformed(
            &self.index.path,
            Position::Offset(offset),
            format!("frame {frame}: {reason}"),
        )
    }
}

impl Iterator for Wanted {
    type Item = Result<(usize, YuvFrame), ReadError>;

    fn next(&mut self) -> Option<Self::Item> {
        let result = self.advance().transpose();
        if matches!(result, Some(Err(_))) {
            self.delivered = self.frames.len();
        }
        result
    }
}
