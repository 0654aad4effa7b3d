//! Frames of an mp4 by the embedded H.264 decoder: groups of pictures that can be decoded on their own, each from its first
//! picture to the last one that is needed, put into the order of presentation. Pictures that nothing refers to are passed over
//! where they are not asked for, and no more than a handful is ever held.

mod standing;

use super::choice::FrameTimes;
use super::colour::ColourSpace;
use super::h264::{Configuration, PictureError, Pictures};
use super::mp4::{Sample, Track};
use super::parked::Parked;
use crate::formats::ReadError;
use crate::formats::read_error::Position;
use crate::video::image::Orientation;
use rusty_h264_common::YuvFrame;
use standing::Standing;
use std::collections::BTreeMap;
use std::fs::File;
use std::io::{Read, Seek, SeekFrom};
use std::ops::Range;
use std::path::{Path, PathBuf};
use std::sync::Arc;

/// H.264 allows 16 pictures between decoding and presentation.
const MOST_PENDING: usize = 17;
/// A sample that says it starts a sequence, but does not, is passed over this often before decoding starts at the beginning.
const START_TRIES: usize = 4;
/// Samples that are decoded when a video is opened, to see whether the decoder has the tools they were coded with.
const TRIAL: usize = 2;
/// More than a coded picture of the largest size ever takes.
const LARGEST_SAMPLE: u32 = 1 << 28;

/// An opened mp4: everything but the media.
#[derive(Debug)]
pub struct Index {
    path: PathBuf,
    configurations: Arc<Vec<Configuration>>,
    /// How pictures come upright.
    pub orientation: Orientation,
    /// Width to height of a pixel as stored.
    pub pixel_aspect: f64,
    /// Of the stored picture.
    pub size: [u32; 2],
    samples: Vec<Sample>,
    /// Decoding position of every picture, in order of its time in the media.
    order: Vec<u32>,
    /// Position in `order` of every sample; `u32::MAX` for one that is no picture.
    rank: Vec<u32>,
    /// Position in `order` of every frame, in order of presentation.
    shown: Vec<u32>,
    /// Decoders that stand in the middle of the file.
    parked: Arc<Parked<Standing>>,
}

impl Index {
    /// Puts a track into the order of presentation and decodes its first samples. Inner error: why the embedded decoder cannot
    /// read a track that is otherwise fine.
    ///
    /// # Errors
    /// When the file cannot be read, or its H.264 configuration is damaged.
    pub fn new(path: &Path, track: Track) -> Result<Result<(Self, FrameTimes), String>, ReadError> {
        for entry in &track.entries {
            if !matches!(&entry.codec, b"avc1" | b"avc2" | b"avc3" | b"avc4")
                || entry.avc_configuration.is_none()
            {
                return Ok(Err(format!(
                    "video of codec `{}`",
                    entry.codec.escape_ascii()
                )));
            }
        }
        let Some(orientation) = track.orientation else {
            return Ok(Err("a picture turned by less than a quarter".to_owned()));
        };
        let frames = match track.presentation() {
            Ok(frames) => frames,
            Err(reason) => return Ok(Err(reason)),
        };
        let damaged = |reason| ReadError::malformed(path, Position::File, reason);
        let mut configurations = Vec::with_capacity(track.entries.len());
        for (number, entry) in track.entries.iter().enumerate() {
            let mut configuration = Configuration::of(entry).map_err(damaged)?;
            if configuration.sequence.is_none() {
                let used =
                    |sample: &&Sample| sample.size > 0 && usize::from(sample.entry) == number;
                let mut bytes = Vec::new();
                if let Some(sample) = track.samples.iter().find(used) {
                    let mut file = File::open(path).map_err(|cause| ReadError::io(path, cause))?;
                    read(path, &mut file, sample, &mut bytes)?;
                }
                if let Err(reason) = configuration.complete(&bytes) {
                    return Ok(Err(reason));
                }
            }
            if let Some(reason) = configuration.beyond_embedded() {
                return Ok(Err(reason));
            }
            configurations.push(configuration);
        }
        let sizes: Vec<[u32; 2]> = configurations
            .iter()
            .filter_map(|configuration| configuration.sequence)
            .map(|sequence| [sequence.width, sequence.height])
            .collect();
        let size = sizes[0];
        if sizes.iter().any(|other| *other != size) {
            return Ok(Err("a video whose size changes".to_owned()));
        }
        let pixel_aspect = pixel_aspect(&track, &configurations[0]);
        let mut order: Vec<u32> = (0..track.samples.len() as u32)
            .filter(|&index| track.samples[index as usize].size > 0)
            .collect();
        order.sort_by_key(|&index| (track.samples[index as usize].time, index));
        let mut rank = vec![u32::MAX; track.samples.len()];
        for (position, &index) in order.iter().enumerate() {
            rank[index as usize] = position as u32;
        }
        let ticks: Vec<i64> = frames.iter().map(|frame| frame.time).collect();
        let schedule = FrameTimes::from_ticks(&ticks, track.timescale);
        let index = Index {
            path: path.to_owned(),
            configurations: Arc::new(configurations),
            orientation,
            pixel_aspect,
            size,
            shown: frames
                .iter()
                .map(|frame| rank[frame.sample as usize])
                .collect(),
            samples: track.samples,
            order,
            rank,
            parked: Arc::default(),
        };
        Ok(match index.trial()? {
            Some(what) => Err(format!("H.264 with `{what}`")),
            None => Ok((index, schedule)),
        })
    }

    /// What the first samples need that the decoder lacks.
    fn trial(&self) -> Result<Option<String>, ReadError> {
        let mut file = File::open(&self.path).map_err(|cause| ReadError::io(&self.path, cause))?;
        let mut pictures = Pictures::new(Arc::clone(&self.configurations));
        let mut bytes = Vec::new();
        for sample in self
            .samples
            .iter()
            .filter(|sample| sample.size > 0)
            .take(TRIAL)
        {
            read(&self.path, &mut file, sample, &mut bytes)?;
            // What is damaged shows when the frame is asked for.
            match pictures.decode(sample.entry.into(), &bytes) {
                Err(PictureError::Unsupported(what)) => return Ok(Some(what)),
                Err(PictureError::Damaged(_)) => return Ok(None),
                Ok(_) => {}
            }
        }
        Ok(None)
    }

    /// Splits frames, ascending and without repetition, into parts that can be decoded on their own, in any order.
    ///
    /// # Errors
    /// When the file cannot be read.
    pub fn parts(&self, frames: &[usize]) -> Result<Vec<Part>, ReadError> {
        let mut file = File::open(&self.path).map_err(|cause| ReadError::io(&self.path, cause))?;
        let mut bytes = Vec::new();
        let mut is_start = |at: usize| {
            let sample = &self.samples[at];
            if !sample.sync || sample.size == 0 {
                return Ok(false);
            }
            read(&self.path, &mut file, sample, &mut bytes)?;
            // One that does not exist shows when the frame is asked for.
            let configuration = self.configurations.get(usize::from(sample.entry));
            Ok(configuration.is_some_and(|configuration| configuration.is_start(&bytes)))
        };
        let mut parts: Vec<Part> = Vec::new();
        // Ranks up to where the last part reaches: from there on another one starts.
        let mut reach = 0..0;
        for (position, &frame) in frames.iter().enumerate() {
            let rank = self.shown[frame];
            let follows = position > 0 && rank > self.shown[frames[position - 1]];
            if follows
                && reach.contains(&rank)
                && let Some(part) = parts.last_mut()
            {
                part.frames.push(frame);
                continue;
            }
            let start = self.start(rank, &mut is_start)?;
            reach = rank..self.next_start(start, rank, &mut is_start)?;
            parts.push(Part {
                start,
                frames: vec![frame],
            });
        }
        Ok(parts)
    }

    /// The last sample from which the picture of this rank can be decoded.
    fn start(
        &self,
        rank: u32,
        is_start: &mut impl FnMut(usize) -> Result<bool, ReadError>,
    ) -> Result<usize, ReadError> {
        let mut tries = 0;
        for at in (1..=self.order[rank as usize] as usize).rev() {
            if !self.samples[at].sync || self.rank[at] > rank {
                continue;
            }
            if is_start(at)? {
                return Ok(at);
            }
            tries += 1;
            if tries == START_TRIES {
                break;
            }
        }
        Ok(0)
    }

    /// The rank of the next sample behind `start` at which decoding can start, and that is shown after `rank`.
    fn next_start(
        &self,
        start: usize,
        rank: u32,
        is_start: &mut impl FnMut(usize) -> Result<bool, ReadError>,
    ) -> Result<u32, ReadError> {
        let mut tries = 0;
        for at in start + 1..self.samples.len() {
            if !self.samples[at].sync || self.rank[at] <= rank || self.rank[at] == u32::MAX {
                continue;
            }
            if is_start(at)? {
                return Ok(self.rank[at]);
            }
            tries += 1;
            if tries == START_TRIES {
                break;
            }
        }
        Ok(u32::MAX)
    }

    fn damaged(&self, frame: usize, offset: u64, reason: &str) -> ReadError {
        ReadError::malformed(
            &self.path,
            Position::Offset(offset),
            format!("frame {frame}: {reason}"),
        )
    }
}

/// Width to height of a stored pixel, from the first that says it: matrix, `pasp`, the size of the track, the stream.
fn pixel_aspect(track: &Track, configuration: &Configuration) -> f64 {
    let entry = &track.entries[0];
    let ratio = |[wide, high]: [u32; 2]| f64::from(wide) / f64::from(high);
    if let Some(stretch) = track.stretch {
        return stretch;
    }
    if let Some(aspect) = entry.pixel_aspect {
        return ratio(aspect);
    }
    let ([wide, high], coded) = (track.size, entry.size);
    if wide > 0 && high > 0 && !coded.contains(&0) && track.size != coded {
        return ratio(track.size) / ratio(coded);
    }
    let sequence = configuration.sequence;
    let said = sequence.and_then(|sequence| sequence.pixel_aspect);
    said.map_or(1.0, ratio)
}

fn read(
    path: &Path,
    file: &mut File,
    sample: &Sample,
    bytes: &mut Vec<u8>,
) -> Result<(), ReadError> {
    if sample.size > LARGEST_SAMPLE {
        return Err(ReadError::malformed(
            path,
            Position::Offset(sample.offset),
            format!("a picture of {} bytes", sample.size),
        ));
    }
    let fail = |cause| ReadError::io(path, cause);
    file.seek(SeekFrom::Start(sample.offset)).map_err(fail)?;
    bytes.resize(sample.size as usize, 0);
    file.read_exact(bytes).map_err(fail)
}

/// Frames that are decoded together.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Part {
    /// The sample at which decoding starts.
    start: usize,
    /// In order of presentation and of the media.
    pub frames: Vec<usize>,
}

/// The pictures of some parts, one after the other.
#[derive(Debug)]
pub struct Wanted {
    index: Arc<Index>,
    file: File,
    pictures: Pictures,
    /// Parts that are still to come, the next one last.
    parts: Vec<Part>,
    /// Ranks of the part at hand, ascending, and their frames.
    ranks: Vec<(u32, usize)>,
    delivered: usize,
    /// Next sample to decode.
    next: usize,
    /// Pictures shown before this rank come from before the starting point and cannot be decoded.
    first_rank: u32,
    pending: BTreeMap<u32, (YuvFrame, ColourSpace)>,
    sample: Vec<u8>,
    /// Something was wrong: what the decoder holds is not to be believed.
    failed: bool,
}

impl Wanted {
    /// `frames` in ascending order without repetition, all of them less than the number of shown frames.
    ///
    /// # Errors
    /// When the file cannot be read.
    pub fn new(index: Arc<Index>, frames: &[usize]) -> Result<Self, ReadError> {
        let parts = index.parts(frames)?;
        Self::of_parts(index, parts)
    }

    /// The frames of these parts, part by part.
    ///
    /// # Errors
    /// When the file cannot be opened.
    pub fn of_parts(index: Arc<Index>, mut parts: Vec<Part>) -> Result<Self, ReadError> {
        let file = File::open(&index.path).map_err(|cause| ReadError::io(&index.path, cause))?;
        parts.reverse();
        Ok(Wanted {
            pictures: Pictures::new(Arc::clone(&index.configurations)),
            index,
            file,
            parts,
            ranks: Vec::new(),
            delivered: 0,
            next: usize::MAX,
            first_rank: 0,
            pending: BTreeMap::new(),
            sample: Vec::new(),
            failed: false,
        })
    }

    /// Moves to the next part, if there is one.
    fn advance_part(&mut self) -> Range<usize> {
        let Some(part) = self.parts.pop() else {
            return 0..0;
        };
        let shown = &self.index.shown;
        self.ranks = part.frames.iter().map(|&k| (shown[k], k)).collect();
        if let Some(standing) = self.standing(part.start) {
            self.pictures = standing.pictures;
            self.next = standing.next;
            self.first_rank = standing.first_rank;
        } else {
            if part.start != self.next {
                self.pictures.restart();
            }
            self.next = part.start;
            self.first_rank = match part.start {
                0 => 0,
                start => self.index.rank[start],
            };
        }
        self.pending.clear();
        self.delivered = 0;
        0..self.ranks.len()
    }

    /// The next wanted frame and its picture.
    fn advance(&mut self) -> Result<Option<(usize, YuvFrame, ColourSpace)>, ReadError> {
        if self.delivered == self.ranks.len() && self.advance_part().is_empty() {
            return Ok(None);
        }
        let (target, frame) = self.ranks[self.delivered];
        loop {
            if let Some((picture, colours)) = self.pending.remove(&target) {
                self.delivered += 1;
                return Ok(Some((frame, picture, colours)));
            }
            let at = self.next;
            let Some(sample) = self.index.samples.get(at).copied() else {
                return Err(self.index.damaged(frame, 0, "never decoded"));
            };
            self.next += 1;
            let rank = self.index.rank[at];
            // Pictures from before the starting point may refer to what was not decoded; nothing wanted refers to them.
            if rank < self.first_rank || rank == u32::MAX {
                continue;
            }
            read(&self.index.path, &mut self.file, &sample, &mut self.sample)?;
            let entry = usize::from(sample.entry);
            let wanted = self.ranks[self.delivered..]
                .binary_search_by_key(&rank, |(rank, _)| *rank)
                .ok()
                .map(|found| self.ranks[self.delivered + found].1);
            let configuration = self.index.configurations.get(entry);
            if wanted.is_none() && configuration.is_some_and(|c| c.is_disposable(&self.sample)) {
                continue;
            }
            let named = wanted.unwrap_or(frame);
            let picture = match self.pictures.decode(entry, &self.sample) {
                Ok(picture) => picture,
                Err(PictureError::Unsupported(what)) => {
                    return Err(ReadError::unsupported(
                        &self.index.path,
                        format!(
                            "the embedded decoder does not know `{what}` (frame {named}); read it with `decoder: ffmpeg`, or {}",
                            super::CONVERT
                        ),
                    ));
                }
                Err(PictureError::Damaged(reason)) => {
                    return Err(self.index.damaged(named, sample.offset, &reason));
                }
            };
            match (picture, wanted) {
                (Some((picture, _)), _)
                    if [picture.width as u32, picture.height as u32] != self.index.size =>
                {
                    return Err(ReadError::unsupported(
                        &self.index.path,
                        format!(
                            "the size of its pictures changes at frame {named}; read it with `decoder: ffmpeg`, or {}",
                            super::CONVERT
                        ),
                    ));
                }
                (Some(picture), Some(_)) => {
                    self.pending.insert(rank, picture);
                    if self.pending.len() > MOST_PENDING {
                        return Err(self.index.damaged(
                            frame,
                            sample.offset,
                            "frames are too far out of order",
                        ));
                    }
                }
                (None, Some(frame)) => {
                    return Err(self.index.damaged(
                        frame,
                        sample.offset,
                        "the picture is incomplete",
                    ));
                }
                (_, None) => {}
            }
        }
    }
}

impl Iterator for Wanted {
    type Item = Result<(usize, YuvFrame, ColourSpace), ReadError>;

    fn next(&mut self) -> Option<Self::Item> {
        let result = self.advance().transpose();
        if matches!(result, Some(Err(_))) {
            self.failed = true;
            self.parts.clear();
            self.ranks.clear();
            self.delivered = 0;
        }
        result
    }
}
