//! What is reconstructed: a video, or a stored clip with its truth.

use super::ReconstructSettings;
use crate::clip::store::ClipSet;
use crate::clip::{Clip, Intrinsics, RGB, Rgb};
use crate::experiment::{Code, InputArtifact, StageError};
use crate::formats::ReadError;
use crate::geometry::rigid::Rigid;
use crate::labelling::{DepthLabeller, LabelError};
use crate::modality::ClipFormat;
use crate::reconstruction::anchor;
use crate::reconstruction::lens::{LensError, LensSettings};
use crate::reconstruction::windows::Window;
use crate::video::image::Image;
use crate::video::{self, Video};
use crate::view::Fact;
use crate::view::scene::{Badge, Tone};
use ndarray::{Array3, Array4, Axis};
use std::collections::BTreeMap;
use std::fmt::Display;

/// Seconds of a clip.
const CLIP_SECONDS: f64 = 2.0;

/// An opened recording.
pub(super) struct Recording {
    pub title: String,
    pub seconds: f64,
    pub intrinsics: Intrinsics,
    /// World pose of the first camera.
    pub first: Rigid,
    pub assumptions: Vec<Fact>,
    pub badges: Vec<Badge>,
    pub truth: Option<Clip>,
    frames: Frames,
}

enum Frames {
    Video { video: Video, start: f64 },
    Clip(Rgb),
}

/// The frames of one window after the other. A frame that several windows need is decoded once, and kept no longer than needed.
pub(super) struct Stream<'a> {
    /// Frames of the video, by window.
    chosen: Vec<Vec<usize>>,
    decoded: Option<video::Squares>,
    held: BTreeMap<usize, Image>,
    clip: Option<&'a Rgb>,
    format: &'a ClipFormat,
}

impl Recording {
    /// Opens what the settings name.
    pub fn open(
        settings: &ReconstructSettings,
        clips: Option<&InputArtifact>,
        format: &ClipFormat,
    ) -> Result<Self, StageError> {
        match (&settings.video, clips) {
            (Some(path), _) => {
                let video = Video::open_with(path, &settings.reading)
                    .map_err(|error| unreadable(&error))?;
                Self::video(settings, video, format)
            }
            (None, Some(artifact)) => Self::clip(settings, artifact, format),
            (None, None) => Err(input("nothing to reconstruct", "name a file in `video`")),
        }
    }

    fn video(
        settings: &ReconstructSettings,
        video: Video,
        format: &ClipFormat,
    ) -> Result<Self, StageError> {
        let info = video.info().clone();
        let left = info.seconds() - settings.start;
        if info.frames == 0 || left <= 0.0 || !left.is_finite() {
            return Err(input(
                format_args!(
                    "`{}` has {} frames, {:.2} s; nothing is left from {:.2} s on",
                    video.path().display(),
                    info.frames,
                    info.seconds(),
                    settings.start
                ),
                "choose a smaller `start`, or another video",
            ));
        }
        let size = [info.width, info.height];
        let intrinsics = settings
            .lens
            .intrinsics(size, format.size as u32)
            .map_err(|error| lens(&error))?;
        let square = info.width.min(info.height);
        let mut assumptions = vec![
            fact(
                "Video",
                format_args!(
                    "{} x {}, {} frames, {:.2} s, by {}",
                    info.width,
                    info.height,
                    info.frames,
                    info.seconds(),
                    info.read_by()
                ),
            ),
            fact(
                "Frame rate",
                format_args!(
                    "{:.3} Hz from the file{}; the model sees {} frames in two seconds",
                    info.fps,
                    if info.variable_rate {
                        ", which varies: frames are chosen by their times"
                    } else {
                        ""
                    },
                    format.frames
                ),
            ),
            fact(
                "Crop",
                format_args!(
                    "the centre {square} x {square}, resized to {0} x {0}",
                    format.size
                ),
            ),
        ];
        if info.rotation != 0 || info.mirrored {
            let mirrored = if info.mirrored { "mirrored, then " } else { "" };
            assumptions.push(fact(
                "Rotation",
                format_args!("{mirrored}{} degrees, from the file", info.rotation),
            ));
        }
        if (info.pixel_aspect - 1.0).abs() > 1e-6 {
            assumptions.push(fact(
                "Pixels",
                format_args!(
                    "{:.4} times as wide as high by the file, made square",
                    info.pixel_aspect
                ),
            ));
        }
        assumptions.extend(said(&settings.lens, &intrinsics));
        Ok(Self {
            title: video.path().file_stem().map_or_else(
                || "video".into(),
                |stem| stem.to_string_lossy().into_owned(),
            ),
            seconds: settings.seconds.map_or(left, |limit| left.min(limit)),
            intrinsics,
            first: settings.lens.first_pose().map_err(|error| lens(&error))?,
            assumptions,
            badges: Vec::new(),
            truth: None,
            frames: Frames::Video {
                video,
                start: settings.start,
            },
        })
    }

    fn clip(
        settings: &ReconstructSettings,
        artifact: &InputArtifact,
        format: &ClipFormat,
    ) -> Result<Self, StageError> {
        let root = artifact.path.join(&settings.split);
        let clips = ClipSet::open(&root).map_err(StageError::other)?;
        if settings.clip >= clips.len() {
            return Err(input(
                format_args!("split `{}` has {} clips", settings.split, clips.len()),
                "choose a smaller `clip`",
            ));
        }
        let mut clip = clips.clip(settings.clip).map_err(StageError::other)?;
        let rgb = clip.take(RGB).ok_or_else(|| {
            input(
                format_args!("clip `{}` has no colour video", clip.id),
                "choose another clip",
            )
        })?;
        let mut lens_settings = settings.lens;
        let camera = clip.camera();
        let known = camera.and_then(|camera| camera.intrinsics);
        let mut up_known = false;
        if let Some(camera) = camera
            && let (Some(up), Some(pose)) = (camera.up_world, camera.T_world_camera.first())
            && camera.valid.first() == Some(&true)
        {
            let up = pose.rotation.inverse() * up.into_inner();
            lens_settings.up = Some([up.x, up.y, up.z]);
            up_known = true;
        }
        let size = format.size as u32;
        let intrinsics = match known {
            Some(known) => known,
            None => lens_settings
                .intrinsics([size, size], size)
                .map_err(|error| lens(&error))?,
        };
        let [mut lens_fact, mut up_fact] = said(&lens_settings, &intrinsics);
        if known.is_some() {
            lens_fact = fact(
                "Intrinsics",
                format_args!("{}, from the clip", words(&intrinsics)),
            );
        }
        if up_known {
            up_fact = fact("Up", "from the clip");
        }
        let assumptions = vec![fact("Clip", &clip.id), lens_fact, up_fact];
        let mut badges = Vec::new();
        if clip.source == "world" {
            badges.push(Badge {
                text: "synthetic".to_owned(),
                tone: Tone::Plain,
            });
        }
        Ok(Self {
            title: clip.id.clone(),
            seconds: CLIP_SECONDS,
            intrinsics,
            first: lens_settings.first_pose().map_err(|error| lens(&error))?,
            assumptions,
            badges,
            truth: Some(clip),
            frames: Frames::Clip(rgb),
        })
    }

    /// The frames of these windows, as the model takes them.
    pub fn stream<'a>(
        &'a self,
        windows: &[Window],
        format: &'a ClipFormat,
    ) -> Result<Stream<'a>, StageError> {
        let (chosen, decoded, clip) = match &self.frames {
            Frames::Clip(rgb) => (Vec::new(), None, Some(rgb)),
            Frames::Video { video, start } => {
                let schedule = video.schedule();
                let of = |window: &Window| {
                    let first = schedule.nearest(start + window.start_seconds());
                    schedule.clip(first, format.video_rate, format.frames)
                };
                let chosen: Vec<Vec<usize>> = windows.iter().map(of).collect();
                let threads = rayon::current_num_threads();
                let decoded = video
                    .squares(chosen.concat(), format.size as u32, threads)
                    .map_err(|error| unreadable(&error))?;
                (chosen, Some(decoded), None)
            }
        };
        Ok(Stream {
            chosen,
            decoded,
            held: BTreeMap::new(),
            clip,
            format,
        })
    }

    /// The metric depth that a network sees in `count` frames at `rate`, on the grid that the fits use: `[count, S, S]`. It sees
    /// whole pictures; of its maps the centre square is taken, as of the video.
    pub fn anchor(
        &self,
        network: &DepthLabeller,
        rate: f64,
        count: usize,
    ) -> Result<Array3<f32>, StageError> {
        let failed = |stop: Stop| match stop {
            Stop::Label(error) => input(error, "see `anchor_model` in `reviv show reconstruct`"),
            Stop::Read(error) => unreadable(&error),
        };
        let (squares, of) = match &self.frames {
            Frames::Clip(rgb) => {
                let images = rgb.frames.outer_iter().map(|frame| {
                    Ok(Image {
                        width: frame.shape()[1] as u32,
                        height: frame.shape()[0] as u32,
                        data: frame.iter().copied().collect(),
                    })
                });
                let squares = anchor::labelled(network, images).map_err(failed)?;
                let last = squares.len() - 1;
                (squares, (0..count).map(|k| k.min(last)).collect())
            }
            Frames::Video { video, start } => {
                let schedule = video.schedule();
                let chosen = schedule.clip(schedule.nearest(*start), rate, count);
                let mut own = chosen.clone();
                own.sort_unstable();
                own.dedup();
                let decoded = video
                    .chosen(own.clone())
                    .map_err(|error| unreadable(&error))?;
                let images = decoded.map(|frame| Ok(frame.map_err(Stop::Read)?.image));
                let squares = anchor::labelled(network, images).map_err(failed)?;
                let last = squares.len() - 1;
                let place = |frame: &usize| own.binary_search(frame).unwrap_or(last).min(last);
                (squares, chosen.iter().map(place).collect::<Vec<usize>>())
            }
        };
        let views: Vec<_> = of.iter().map(|at| squares[*at].view()).collect();
        ndarray::stack(Axis(0), &views).map_err(StageError::other)
    }
}

/// What may end the labelling of an anchor.
enum Stop {
    Label(LabelError),
    Read(ReadError),
}

impl From<LabelError> for Stop {
    fn from(error: LabelError) -> Self {
        Self::Label(error)
    }
}

impl Stream<'_> {
    /// The frames of a window; windows are asked for in their order.
    pub fn window(&mut self, index: usize) -> Result<Rgb, StageError> {
        if let Some(clip) = self.clip {
            return Ok(clip.clone());
        }
        let chosen = &self.chosen[index];
        let first = chosen.iter().min().copied().unwrap_or(0);
        self.held.retain(|frame, _| *frame >= first);
        let side = self.format.size;
        let mut frames = Array4::zeros((chosen.len(), side, side, 3));
        for (mut slot, wanted) in frames.outer_iter_mut().zip(chosen) {
            while !self.held.contains_key(wanted) {
                let frame = self.decoded.as_mut().and_then(Iterator::next);
                let (number, square) = frame
                    .ok_or_else(|| {
                        input(
                            format_args!("the video ends before its frame {wanted}"),
                            "check the file, or convert it with `ffmpeg`",
                        )
                    })?
                    .map_err(|error| unreadable(&error))?;
                self.held.insert(number, square);
            }
            slot.assign(&video::to_array(&self.held[wanted]));
        }
        Ok(Rgb {
            rate: self.format.video_rate,
            frames,
        })
    }
}

fn fact(label: &str, value: impl Display) -> Fact {
    Fact {
        label: label.to_owned(),
        value: value.to_string(),
    }
}

fn words(lens: &Intrinsics) -> String {
    format!(
        "fx {:.2}, fy {:.2}, cx {:.2}, cy {:.2} at {} x {}",
        lens.fx, lens.fy, lens.cx, lens.cy, lens.width, lens.height
    )
}

/// What the settings say of the camera, and what is assumed instead.
fn said(settings: &LensSettings, lens: &Intrinsics) -> [Fact; 2] {
    let from = match settings.calibration {
        Some(_) => "from `lens.calibration`".to_owned(),
        None => format!(
            "ASSUMED: {} degrees across the square (`lens.field_of_view`, `lens.calibration`)",
            settings.field_of_view
        ),
    };
    let up = match settings.up {
        Some(_) => "from `lens.up`".to_owned(),
        None => "ASSUMED: the first camera is level (`lens.up`)".to_owned(),
    };
    [
        fact("Intrinsics", format_args!("{}, {from}", words(lens))),
        fact("Up", up),
    ]
}

pub(super) fn input(message: impl Display, help: &str) -> StageError {
    StageError::Input {
        code: Code::E0601,
        message: message.to_string(),
        help: help.to_owned(),
    }
}

fn unreadable(error: &ReadError) -> StageError {
    input(error, "check the file, or convert it with `ffmpeg`")
}

fn lens(error: &LensError) -> StageError {
    input(error, "correct `lens`")
}
