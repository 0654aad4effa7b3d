//! Videos through the user's own `ffmpeg`: any container and codec it knows. It is started as a separate program and hands over
//! its pictures through a pipe; nothing is linked.
//!
//! What is a frame, and when it is shown, is what `ffmpeg` decodes: packets may hold several pictures or none, and a seek may end
//! anywhere. Where the packets of a container are known to be its frames, and the first ones decoded bear that out, the table
//! of packets is the table of frames, and reading starts at the key frame before what is wanted. Everything else is decoded
//! once when it is opened, and read from its start. In both cases every picture that comes out of the pipe carries its time
//! stamp, by which it is known.

mod process;
mod stamp;

use super::choice::FrameTimes;
use super::parked::Parked;
use crate::formats::ReadError;
use crate::video::image::Image;
use process::{Reader, Source};
use stamp::{Layout, Stamp};
use std::path::Path;
use std::sync::Arc;

pub use process::available;

/// Frames that are decoded to see whether packets are frames.
const TRIAL: usize = 48;
/// Containers whose packets carry their own time stamps and key flags.
const CONTAINERS: [&str; 2] = ["mov", "matroska"];
/// Codecs that put one shown picture into each packet.
const CODECS: [&str; 12] = [
    "h264", "hevc", "av1", "vp9", "prores", "mjpeg", "ffv1", "dnxhd", "png", "huffyuv", "rawvideo",
    "vvc",
];
/// Time stamps are microseconds; they are rounded on their way through other units.
const ROUNDED: i64 = 2;
/// A seek that ends too late is repeated from so many key frames earlier before the file is read from its start.
const EARLIER: usize = 2;

/// A file that `ffmpeg` reads.
#[derive(Debug, Clone)]
pub struct Index {
    source: Arc<Source>,
    /// Time stamp of every frame in microseconds on ffmpeg's own clock, in order of presentation.
    stamps: Arc<Vec<i64>>,
    /// Frames at which decoding can start, ascending; none where the file has to be read from its start.
    keys: Option<Arc<Vec<usize>>>,
    /// What all frames seen when it was opened can come as.
    layout: Layout,
    /// Processes that stand in the middle of the file.
    parked: Arc<Parked<Reader>>,
    /// Upright, as decoded.
    pub size: [u32; 2],
    /// Width to height of a pixel of the upright picture.
    pub pixel_aspect: f64,
}

/// Reads when every frame is shown; of several video tracks `track` is the one that counts, by its number in the file.
///
/// # Errors
/// When `ffmpeg` finds no video, or decodes no frame of it.
pub fn open(path: &Path, track: Option<u32>) -> Result<(Index, FrameTimes), ReadError> {
    let source = Source::new(path, track);
    let packets = source.packets()?;
    let trial = if packets.trusted() {
        source.decoded(Some(TRIAL), true)?
    } else {
        Vec::new()
    };
    let borne_out = !trial.is_empty()
        && trial.len() == packets.stamps.len().min(TRIAL)
        && trial
            .iter()
            .zip(&packets.stamps)
            .all(|(frame, stamp)| frame.time.is_some_and(|t| (t - stamp).abs() <= ROUNDED));
    let (stamps, keys, frames) = if borne_out {
        (packets.stamps, Some(packets.keys), trial)
    } else {
        let frames = source.decoded(None, false)?;
        (repaired(&frames), None, frames)
    };
    let Some(first) = frames.first().copied() else {
        return Err(source.nothing());
    };
    let micros: Vec<i64> = stamps.iter().map(|stamp| stamp - stamps[0]).collect();
    let layout = first.layout();
    let alike = frames.iter().all(|frame| frame.layout() == layout);
    let index = Index {
        source: Arc::new(source),
        layout: if alike { layout } else { Layout::Rgb },
        stamps: Arc::new(stamps),
        keys: keys.map(Arc::new),
        parked: Arc::default(),
        size: [first.width, first.height],
        pixel_aspect: first.pixel_aspect,
    };
    Ok((index, FrameTimes::from_ticks(&micros, 1_000_000)))
}

/// Ascending time stamps. Streams without usable ones are evenly spaced by what is most common among them, else 25 a second, as
/// `ffmpeg` does.
fn repaired(frames: &[Stamp]) -> Vec<i64> {
    let known: Vec<i64> = frames.iter().filter_map(|frame| frame.time).collect();
    if known.len() == frames.len() && known.is_sorted_by(|a, b| a < b) {
        return known;
    }
    let mut steps: Vec<i64> = known.windows(2).map(|pair| pair[1] - pair[0]).collect();
    steps.retain(|step| *step > 0);
    steps.sort_unstable();
    let step = steps.get(steps.len() / 2).copied().unwrap_or(40_000);
    (0..frames.len() as i64).map(|frame| frame * step).collect()
}

impl Index {
    /// The key frame to start from for `frame`, `earlier` key frames before the nearest one.
    fn key(&self, frame: usize, earlier: usize) -> usize {
        let Some(keys) = &self.keys else { return 0 };
        let after = keys.partition_point(|key| *key <= frame);
        after
            .checked_sub(1 + earlier)
            .map_or(0, |found| keys[found])
    }

    /// A process that has yet to hand over `frame`.
    fn reader(&self, frame: usize, layout: Layout) -> Result<Reader, ReadError> {
        let key = self.key(frame, 0);
        let standing = self.parked.take(|reader| {
            let (position, sequential) = (reader.position, self.keys.is_none());
            let near = sequential || key <= position + TRIAL;
            (position <= frame && near && reader.layout == layout).then_some(position)
        });
        if let Some(reader) = standing {
            return Ok(reader);
        }
        if self.keys.is_none() {
            return self.source.read(layout, false, None);
        }
        for earlier in 0..=EARLIER {
            let key = self.key(frame, earlier);
            if key == 0 {
                break;
            }
            let mut reader = self.source.read(layout, true, Some(self.stamps[key]))?;
            // Only what comes behind a key frame that is known is known to be whole.
            let found = reader.peek().and_then(|stamp| self.find(stamp.time?));
            if let Some(found) =
                found.filter(|found| *found <= key && self.key(*found, 0) == *found)
            {
                reader.position = found;
                return Ok(reader);
            }
        }
        self.source.read(layout, true, None)
    }

    fn find(&self, time: i64) -> Option<usize> {
        let at = self.stamps.partition_point(|stamp| *stamp < time - ROUNDED);
        (self.stamps.get(at).copied()? <= time + ROUNDED).then_some(at)
    }
}

/// The wanted frames, decoded and turned upright by `ffmpeg`.
#[derive(Debug)]
pub struct Wanted {
    index: Index,
    layout: Layout,
    /// None before the first frame and after the last.
    reader: Option<Reader>,
    frames: Vec<usize>,
    delivered: usize,
}

impl Wanted {
    /// `frames` in ascending order without repetition.
    #[must_use]
    pub fn new(index: &Index, frames: Vec<usize>) -> Self {
        Wanted {
            index: index.clone(),
            layout: index.layout,
            reader: None,
            frames,
            delivered: 0,
        }
    }

    fn picture(&mut self, frame: usize) -> Result<Image, ReadError> {
        let found = self.next_picture(frame);
        let sought = self.reader.as_ref().is_some_and(|reader| reader.sought);
        if found.is_ok() || !sought {
            return found;
        }
        // A decoder that started in the middle may leave frames out that it has when it started at the beginning.
        self.reader = Some(self.index.source.read(self.layout, true, None)?);
        self.next_picture(frame)
    }

    fn next_picture(&mut self, frame: usize) -> Result<Image, ReadError> {
        // A later start is worth a new process when a key frame lies between.
        let far = |reader: &Reader| {
            let key = self.index.key(frame, 0);
            key > reader.position + TRIAL
        };
        if self.reader.as_ref().is_none_or(far) {
            self.reader = None;
            self.reader = Some(self.index.reader(frame, self.layout)?);
        }
        let Some(mut reader) = self.reader.as_mut() else {
            return Err(self.index.source.nothing());
        };
        loop {
            let missing = "ffmpeg decodes no such frame";
            let Some(stamp) = reader.peek() else {
                return Err(reader.failure(frame, missing));
            };
            if ![Layout::Rgb, stamp.layout()].contains(&reader.layout) {
                // The format changes on the way: `ffmpeg` converts whatever it is.
                self.layout = Layout::Rgb;
                reader = self.reader.insert(self.index.reader(frame, self.layout)?);
                continue;
            }
            if self.index.keys.is_some() {
                let Some(found) = stamp.time.and_then(|time| self.index.find(time)) else {
                    // A picture that is none of the table's.
                    reader.skip().map_err(|why| reader.failure(frame, &why))?;
                    continue;
                };
                reader.position = found;
            }
            if reader.position > frame {
                return Err(reader.failure(frame, missing));
            }
            let asked = reader.position == frame;
            if asked {
                let image = reader.image().map_err(|why| reader.failure(frame, &why))?;
                reader.position += 1;
                return Ok(image);
            }
            reader.skip().map_err(|why| reader.failure(frame, &why))?;
            reader.position += 1;
        }
    }
}

impl Iterator for Wanted {
    type Item = Result<(usize, Image), ReadError>;

    fn next(&mut self) -> Option<Self::Item> {
        let frame = *self.frames.get(self.delivered)?;
        self.delivered += 1;
        let picture = self.picture(frame);
        if picture.is_err() {
            self.reader = None;
            self.delivered = self.frames.len();
        }
        Some(picture.map(|image| (frame, image)))
    }
}

impl Drop for Wanted {
    fn drop(&mut self) {
        let Some(reader) = self.reader.take() else {
            return;
        };
        // Whoever reads on in this file need not start again.
        if reader.position < self.index.stamps.len() {
            self.index.parked.park(reader);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn streams_without_usable_times_are_evenly_spaced() {
        let frames = |times: &[Option<i64>]| -> Vec<Stamp> {
            let line = |time: Option<i64>| {
                let time = time.map_or("NOPTS".to_owned(), |time| time.to_string());
                format!("[showinfo] n:0 pts:{time} sar:1/1 s:2x2")
            };
            let stamps = times.iter().map(|time| Stamp::parse(&line(*time)));
            stamps.map(Option::unwrap).collect()
        };
        let good = [Some(5), Some(20), Some(70)];
        assert_eq!(repaired(&frames(&good)), [5, 20, 70]);
        let stuck = [Some(0), Some(40), Some(40), Some(80), None];
        assert_eq!(repaired(&frames(&stuck)), [0, 40, 80, 120, 160]);
        assert_eq!(repaired(&frames(&[None, None])), [0, 40_000]);
    }
}
