//! Videos: mp4 with H.264 by the embedded decoder, folders of pictures, and everything else through the user's `ffmpeg`.
//!
//! [`Video`] is opened once, knows when each of its frames is shown, and decodes any of them from any thread with memory that does
//! not depend on its length. In reading order: [`choice`] (which frames make a clip), [`mp4`] (where the samples are),
//! [`h264`] and [`embedded`] (pictures), [`colour`] (RGB), [`folder`], [`ffmpeg`]; [`image`]: single
//! pictures, and the resize of every clip.

pub mod choice;
pub mod colour;
pub mod embedded;
pub mod ffmpeg;
pub mod folder;
pub mod grey16;
pub mod h264;
pub mod image;
pub mod mp4;
mod resize;

pub use choice::FrameTimes;

use crate::clip::Rgb;
use crate::formats::ReadError;
use crate::formats::read_error::Position;
use crate::video::image::Image;
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

/// What a video is.
#[derive(Debug, Clone, PartialEq)]
pub struct VideoInfo {
    /// Pixels of the upright picture, rotation applied.
    pub width: u32,
    pub height: u32,
    /// Frames per second; the mean where the rate varies.
    pub fps: f64,
    /// Number of frames that are shown.
    pub frames: usize,
    /// Degrees clockwise by which the stored pictures are turned (already applied to every frame that comes out).
    pub rotation: u32,
    /// Frames are not evenly spaced.
    pub variable_rate: bool,
    /// `embedded H.264`, `ffmpeg` or `folder of pictures`.
    pub decoder: &'static str,
}

impl VideoInfo {
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

/// One upright frame.
#[derive(Debug, Clone, PartialEq)]
pub struct Frame {
    /// Counted from the first frame of the video.
    pub index: usize,
    /// From the first frame of the video.
    pub seconds: f64,
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
        let reason = if settings.decoder == DecoderChoice::Ffmpeg {
            String::new()
        } else if !mp4::sniff(&head[..read]) {
            "not an mp4".to_owned()
        } else {
            match Self::open_mp4(path)? {
                Ok(video) => return Ok(video),
                Err(reason) => reason,
            }
        };
        if settings.decoder == DecoderChoice::Embedded {
            return Err(ReadError::unsupported(
                path,
                format!("{reason}, which the embedded decoder does not read"),
            ));
        }
        if !ffmpeg::available() {
            let what = if reason.is_empty() {
                "`ffmpeg` was asked for".to_owned()
            } else {
                reason
            };
            return Err(ReadError::unsupported(
                path,
                format!("{what}; with `ffmpeg` on the PATH it can be read; or {CONVERT}"),
            ));
        }
        Self::open_ffmpeg(path)
    }

    /// Inner error: why the embedded decoder cannot read a file that is otherwise fine.
    fn open_mp4(path: &Path) -> Result<Result<Self, String>, ReadError> {
        let track = mp4::read(path)?;
        let Some(configuration) = &track.avc_configuration else {
            return Ok(Err(format!(
                "video of codec `{}`",
                track.codec.escape_ascii()
            )));
        };
        let configuration = h264::Configuration::parse(configuration)
            .map_err(|reason| ReadError::malformed(path, Position::File, reason))?;
        if let Some(reason) = configuration.beyond_embedded() {
            return Ok(Err(reason));
        }
        let sequence = configuration.sequence;
        let rotation = track.rotation;
        let (index, schedule) = embedded::Index::new(path, track, configuration)?;
        let (width, height) = index.turn.size(sequence.width, sequence.height);
        Ok(Ok(Video {
            path: path.to_owned(),
            info: VideoInfo {
                width,
                height,
                fps: schedule.fps(),
                frames: schedule.frames(),
                rotation,
                variable_rate: matches!(schedule, FrameTimes::Variable { .. }),
                decoder: "embedded H.264",
            },
            schedule: Arc::new(schedule),
            pictures: Backing::Embedded(Arc::new(index)),
        }))
    }

    fn open_ffmpeg(path: &Path) -> Result<Self, ReadError> {
        let (index, schedule) = ffmpeg::open(path)?;
        let (_, first) = ffmpeg::Wanted::new(&index, &schedule, vec![0])?
            .next()
            .ok_or_else(|| ReadError::malformed(path, Position::Frame(0), "no picture"))??;
        Ok(Video {
            path: path.to_owned(),
            info: VideoInfo {
                width: first.width,
                height: first.height,
                fps: schedule.fps(),
                frames: schedule.frames(),
                rotation: 0,
                variable_rate: matches!(schedule, FrameTimes::Variable { .. }),
                decoder: "ffmpeg",
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
                variable_rate: false,
                decoder: "folder of pictures",
            },
            schedule: Arc::new(FrameTimes::Constant {
                fps,
                frames: files.len(),
            }),
            pictures: Backing::Folder(Arc::new(files)),
        })
    }

    #[must_use]
    pub fn path(&self) -> &Path {
        &self.path
    }

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
                Box::new(embedded::Wanted::new(Arc::clone(index), frames)?),
                Arc::clone(index),
            ),
            Backing::Folder(files) => Inner::Folder(Arc::clone(files), frames.into_iter()),
            Backing::Ffmpeg(index) if !frames.is_empty() => Inner::Ffmpeg(Box::new(
                ffmpeg::Wanted::new(index, &self.schedule, frames)?,
            )),
            Backing::Ffmpeg(_) => Inner::Folder(Arc::default(), Vec::new().into_iter()),
        };
        Ok(Frames {
            schedule: Arc::clone(&self.schedule),
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
            Inner::Embedded(wanted, index) => wanted.next()?.map(|(frame, picture)| {
                let image = colour::to_rgb(&picture, index.configuration.sequence.colour);
                (frame, image.turned(index.turn))
            }),
            Inner::Folder(files, frames) => {
                let frame = frames.next()?;
                folder::read(&files[frame]).map(|image| (frame, image))
            }
            Inner::Ffmpeg(wanted) => wanted.next()?,
        };
        Some(result.map(|(index, image)| Frame {
            index,
            seconds: self.schedule.seconds(index),
            image,
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
