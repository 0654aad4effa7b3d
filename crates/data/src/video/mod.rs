//! Videos: mp4 with H.264 by the embedded decoder, folders of pictures, and everything else through the user's `ffmpeg`.
//!
//! [`Video`] is opened once, knows when each of its frames is shown, and decodes any of them from any thread with memory that does
//! not depend on its length. In reading order: [`choice`] (which frames make a clip), [`mp4`] (where the samples are),
//! [`h264`] and [`embedded`] (pictures), [`colour`] (RGB), [`folder`] and [`exif`], [`ffmpeg`]; `parallel`: the
//! squares of a clip on several cores; [`image`]: single pictures, and the resize of every clip.

pub mod choice;
pub mod colour;
pub mod embedded;
pub mod exif;
pub mod ffmpeg;
pub mod folder;
pub mod grey16;
pub mod h264;
pub mod image;
pub mod mp4;
mod parallel;
mod parked;
mod resize;

pub use choice::FrameTimes;
pub use parallel::Squares;

use crate::clip::Rgb;
use crate::formats::ReadError;
use crate::formats::read_error::Position;
use crate::video::image::{Image, Turn};
use ndarray::{Array3, Array4};
use std::fs::File;
use std::io::Read;
use std::path::{Path, PathBuf};
use std::sync::Arc;

const CONVERT: &str = "convert it: `ffmpeg -i IN -pix_fmt yuv420p OUT.mp4`";

/// How to read a video.
#[derive(Debug, Clone, PartialEq, serde::Serialize, serde::Deserialize, schemars::JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct VideoSettings {
    /// Who decodes.
    pub decoder: DecoderChoice,
    /// Frames per second of a folder of pictures, which does not say it itself.
    pub folder_fps: f64,
}

impl VideoSettings {
    /// The default settings with this decoder.
    #[must_use]
    pub fn by(decoder: DecoderChoice) -> Self {
        VideoSettings {
            decoder,
            ..VideoSettings::default()
        }
    }
}

impl Default for VideoSettings {
    fn default() -> Self {
        VideoSettings {
            decoder: DecoderChoice::Auto,
            folder_fps: 30.0,
        }
    }
}

/// Who decodes a video.
#[derive(
    Debug,
    Clone,
    Copy,
    PartialEq,
    Eq,
    Default,
    serde::Serialize,
    serde::Deserialize,
    schemars::JsonSchema,
    clap::ValueEnum,
)]
#[serde(rename_all = "snake_case")]
pub enum DecoderChoice {
    /// The embedded decoder where it can, else `ffmpeg` if it is there.
    #[default]
    Auto,
    /// Never start another program.
    Embedded,
    /// Always `ffmpeg`.
    Ffmpeg,
}

impl DecoderChoice {
    /// As it is written in settings.
    #[must_use]
    pub fn name(self) -> &'static str {
        match self {
            DecoderChoice::Auto => "auto",
            DecoderChoice::Embedded => "embedded",
            DecoderChoice::Ffmpeg => "ffmpeg",
        }
    }
}

/// What a video is.
#[derive(Debug, Clone, PartialEq)]
pub struct VideoInfo {
    /// Square pixels of the upright picture, rotation applied.
    pub width: u32,
    /// Square pixels of the upright picture, as the width.
    pub height: u32,
    /// Frames per second; the mean where the rate varies.
    pub fps: f64,
    /// Number of frames that are shown.
    pub frames: usize,
    /// Degrees clockwise by which the stored pictures are turned (already applied to every frame that comes out).
    pub rotation: u32,
    /// Stored pictures are mirrored left to right (already undone).
    pub mirrored: bool,
    /// Width to height of a stored pixel, upright; every frame that comes out has square ones.
    pub pixel_aspect: f64,
    /// Frames are not evenly spaced.
    pub variable_rate: bool,
    /// `embedded H.264`, `ffmpeg` or `folder of pictures`.
    pub decoder: &'static str,
    /// Why the embedded decoder left an mp4 to `ffmpeg`.
    pub beyond_embedded: Option<String>,
}

impl VideoInfo {
    /// The decoder, and why it was not the embedded one.
    #[must_use]
    pub fn read_by(&self) -> String {
        match &self.beyond_embedded {
            Some(why) => format!("{} ({why})", self.decoder),
            None => self.decoder.to_owned(),
        }
    }

    /// Seconds from the first frame to the end of the last.
    #[must_use]
    pub fn seconds(&self) -> f64 {
        self.frames as f64 / self.fps
    }
}

/// An opened video.
#[derive(Debug, Clone)]
pub struct Video {
    path: PathBuf,
    info: VideoInfo,
    schedule: Arc<FrameTimes>,
    pictures: Backing,
}

#[derive(Debug, Clone)]
enum Backing {
    Embedded(Arc<embedded::Index>),
    Folder(Arc<Vec<PathBuf>>),
    Ffmpeg(ffmpeg::Index),
}

/// What became of an mp4.
enum Mp4 {
    Video(Box<Video>),
    /// Its video track, and why the embedded decoder cannot read it; none where it was not asked.
    Beyond {
        id: u32,
        why: Option<String>,
    },
}

/// One upright frame.
#[derive(Debug, Clone, PartialEq)]
pub struct Frame {
    /// Counted from the first frame of the video.
    pub index: usize,
    /// From the first frame of the video.
    pub seconds: f64,
    /// Upright, with square pixels.
    pub image: Image,
}

impl Video {
    /// Opens a file or a folder with the default settings.
    ///
    /// # Errors
    /// When there is nothing to read, or neither the embedded decoder nor `ffmpeg` can read it.
    pub fn open(path: impl AsRef<Path>) -> Result<Self, ReadError> {
        Self::open_with(path, &VideoSettings::default())
    }

    /// Opens a file or a folder.
    ///
    /// # Errors
    /// As [`Video::open`].
    pub fn open_with(path: impl AsRef<Path>, settings: &VideoSettings) -> Result<Self, ReadError> {
        let path = path.as_ref();
        if path.is_dir() {
            return Self::open_folder(path, settings.folder_fps);
        }
        let mut head = [0; 16];
        let mut file = File::open(path).map_err(|cause| ReadError::io(path, cause))?;
        let read = file
            .read(&mut head)
            .map_err(|cause| ReadError::io(path, cause))?;
        drop(file);
        let is_mp4 = mp4::sniff(&head[..read]);
        let (mut reason, mut track) = (None, None);
        if is_mp4 {
            match Self::open_mp4(path, settings.decoder) {
                Ok(Mp4::Video(video)) => return Ok(*video),
                Ok(Mp4::Beyond { id, why }) => (track, reason) = (Some(id), why),
                // A box that is not understood may be one that ffmpeg knows; it finds the track itself.
                Err(ReadError::Unsupported { reason: why, .. }) => reason = Some(why),
                Err(ReadError::Malformed { .. }) if settings.decoder == DecoderChoice::Ffmpeg => {}
                Err(error) => return Err(error),
            }
        }
        if settings.decoder == DecoderChoice::Embedded {
            let reason = reason.unwrap_or_else(|| "not an mp4".to_owned());
            return Err(ReadError::unsupported(
                path,
                format!("{reason}, which the embedded decoder does not read"),
            ));
        }
        if !ffmpeg::available() {
            let what = match (settings.decoder, reason) {
                (DecoderChoice::Ffmpeg, _) => "`ffmpeg` was asked for".to_owned(),
                (_, Some(reason)) => reason,
                (_, None) => "not an mp4".to_owned(),
            };
            return Err(ReadError::unsupported(
                path,
                format!("{what}; with `ffmpeg` on the PATH it can be read; or {CONVERT}"),
            ));
        }
        let mut video = Self::open_ffmpeg(path, track)?;
        video.info.beyond_embedded = reason;
        Ok(video)
    }

    fn open_mp4(path: &Path, decoder: DecoderChoice) -> Result<Mp4, ReadError> {
        let track = mp4::read(path)?;
        let id = track.id;
        if decoder == DecoderChoice::Ffmpeg {
            return Ok(Mp4::Beyond { id, why: None });
        }
        let (index, schedule) = match embedded::Index::new(path, track)? {
            Ok(found) => found,
            Err(why) => return Ok(Mp4::Beyond { id, why: Some(why) }),
        };
        let orientation = index.orientation;
        let [width, height] = index.size;
        let (width, height) = orientation.turn.size(width, height);
        let pixel_aspect = if matches!(orientation.turn, Turn::Clockwise | Turn::CounterClockwise) {
            1.0 / index.pixel_aspect
        } else {
            index.pixel_aspect
        };
        let (width, height) = image::squared(width, height, pixel_aspect);
        Ok(Mp4::Video(Box::new(Video {
            path: path.to_owned(),
            info: VideoInfo {
                width,
                height,
                fps: schedule.fps(),
                frames: schedule.frames(),
                rotation: orientation.turn.degrees(),
                mirrored: orientation.mirrored,
                pixel_aspect,
                variable_rate: matches!(schedule, FrameTimes::Variable { .. }),
                decoder: "embedded H.264",
                beyond_embedded: None,
            },
            schedule: Arc::new(schedule),
            pictures: Backing::Embedded(Arc::new(index)),
        })))
    }

    fn open_ffmpeg(path: &Path, track: Option<u32>) -> Result<Self, ReadError> {
        let (index, schedule) = ffmpeg::open(path, track)?;
        let pixel_aspect = index.pixel_aspect;
        let [width, height] = index.size;
        let (width, height) = image::squared(width, height, pixel_aspect);
        Ok(Video {
            path: path.to_owned(),
            info: VideoInfo {
                width,
                height,
                fps: schedule.fps(),
                frames: schedule.frames(),
                rotation: 0,
                mirrored: false,
                pixel_aspect,
                variable_rate: matches!(schedule, FrameTimes::Variable { .. }),
                decoder: "ffmpeg",
                beyond_embedded: None,
            },
            schedule: Arc::new(schedule),
            pictures: Backing::Ffmpeg(index),
        })
    }

    fn open_folder(path: &Path, fps: f64) -> Result<Self, ReadError> {
        if !(fps.is_finite() && fps > 0.0) {
            return Err(ReadError::Settings(format!("`folder_fps` is {fps}")));
        }
        let files = folder::list(path)?;
        let first = folder::read(&files[0])?;
        Ok(Video {
            path: path.to_owned(),
            info: VideoInfo {
                width: first.width,
                height: first.height,
                fps,
                frames: files.len(),
                rotation: 0,
                mirrored: false,
                pixel_aspect: 1.0,
                variable_rate: false,
                decoder: "folder of pictures",
                beyond_embedded: None,
            },
            schedule: Arc::new(FrameTimes::Constant {
                fps,
                frames: files.len(),
            }),
            pictures: Backing::Folder(Arc::new(files)),
        })
    }

    /// The file or the folder of pictures that was opened.
    #[must_use]
    pub fn path(&self) -> &Path {
        &self.path
    }

    /// Its size, rate, length and decoder.
    #[must_use]
    pub fn info(&self) -> &VideoInfo {
        &self.info
    }

    /// When frames are shown.
    #[must_use]
    pub fn schedule(&self) -> &FrameTimes {
        &self.schedule
    }

    /// The frames of `range` in order, decoded as they are asked for; the range is cut at the end of the video.
    ///
    /// # Errors
    /// When the file cannot be opened; later errors come out of the iterator, which then ends.
    pub fn frames(&self, range: std::ops::Range<usize>) -> Result<Frames, ReadError> {
        let end = range.end.min(self.info.frames);
        self.chosen((range.start.min(end)..end).collect())
    }

    /// The named frames, in ascending order without repetition, whatever order they are given in.
    ///
    /// # Errors
    /// As [`Video::frames`]; indices beyond the end are left out.
    pub fn chosen(&self, mut frames: Vec<usize>) -> Result<Frames, ReadError> {
        frames.retain(|frame| *frame < self.info.frames);
        frames.sort_unstable();
        frames.dedup();
        let inner = match &self.pictures {
            Backing::Embedded(index) => Inner::Embedded(
                Box::new(embedded::Wanted::new(Arc::clone(index), &frames)?),
                Arc::clone(index),
            ),
            Backing::Folder(files) => Inner::Folder(Arc::clone(files), frames.into_iter()),
            Backing::Ffmpeg(index) => Inner::Ffmpeg(Box::new(ffmpeg::Wanted::new(index, frames))),
        };
        Ok(Frames {
            schedule: Arc::clone(&self.schedule),
            pixel_aspect: self.info.pixel_aspect,
            size: (self.info.width, self.info.height),
            inner,
        })
    }

    /// A clip: `frames` pictures at `fps` from frame `start` on, the short side resized to `side` and cropped to the centre square
    /// (the release's `load_clip`; [`FrameTimes::clip`] says which frames these are).
    ///
    /// # Errors
    /// When `start` lies beyond the end, or a frame cannot be decoded.
    pub fn load_clip(
        &self,
        start: usize,
        fps: f64,
        frames: usize,
        side: u32,
    ) -> Result<Rgb, ReadError> {
        if start >= self.info.frames {
            return Err(ReadError::OutOfRange {
                source_name: self.path.display().to_string(),
                index: start,
                len: self.info.frames,
            });
        }
        if !(fps.is_finite() && fps > 0.0 && side > 0 && frames > 0) {
            return Err(ReadError::Settings(format!(
                "a clip of {frames} frames at {fps} per second, {side} pixels wide"
            )));
        }
        let chosen = self.schedule.clip(start, fps, frames);
        let mut squares: Vec<(usize, Image)> = Vec::with_capacity(frames);
        for frame in self.chosen(chosen.clone())? {
            let frame = frame?;
            squares.push((frame.index, frame.image.square(side)));
        }
        let side = side as usize;
        let mut pixels = Vec::with_capacity(frames * side * side * 3);
        for frame in chosen {
            let found = squares
                .binary_search_by_key(&frame, |(index, _)| *index)
                .map_err(|_| {
                    ReadError::malformed(&self.path, Position::Frame(frame as u64), "not decoded")
                })?;
            pixels.extend_from_slice(&squares[found].1.data);
        }
        let frames = Array4::from_shape_vec((frames, side, side, 3), pixels)
            .map_err(|error| ReadError::Settings(error.to_string()))?;
        Ok(Rgb { rate: fps, frames })
    }
}

/// Iterator over decoded frames.
#[derive(Debug)]
pub struct Frames {
    schedule: Arc<FrameTimes>,
    pixel_aspect: f64,
    size: (u32, u32),
    inner: Inner,
}

#[derive(Debug)]
enum Inner {
    Embedded(Box<embedded::Wanted>, Arc<embedded::Index>),
    Folder(Arc<Vec<PathBuf>>, std::vec::IntoIter<usize>),
    Ffmpeg(Box<ffmpeg::Wanted>),
}

impl Iterator for Frames {
    type Item = Result<Frame, ReadError>;

    fn next(&mut self) -> Option<Self::Item> {
        let result = match &mut self.inner {
            Inner::Embedded(wanted, index) => wanted.next()?.map(|(frame, picture, colours)| {
                let image = colour::to_rgb(&picture, colours);
                (frame, image.upright(index.orientation))
            }),
            Inner::Folder(files, frames) => {
                let frame = frames.next()?;
                folder::read(&files[frame]).map(|image| (frame, image))
            }
            Inner::Ffmpeg(wanted) => wanted.next()?,
        };
        let is_folder = matches!(self.inner, Inner::Folder(..));
        Some(result.map(|(index, image)| {
            let image = image.with_square_pixels(self.pixel_aspect);
            // Where the size of a stream changes on the way, the first one counts.
            let image = if is_folder {
                image
            } else {
                image.resized(self.size.0, self.size.1)
            };
            Frame {
                index,
                seconds: self.schedule.seconds(index),
                image,
            }
        }))
    }
}

/// A picture as an array `[H, W, 3]`.
#[must_use]
pub fn to_array(image: &Image) -> Array3<u8> {
    let shape = (image.height as usize, image.width as usize, 3);
    Array3::from_shape_vec(shape, image.data.clone())
        .expect("an image holds height x width x 3 bytes")
}
