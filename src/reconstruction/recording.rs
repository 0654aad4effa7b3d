//! What is reconstructed: a video, or a stored clip with its truth.

use super::anchor;
use super::camera::CameraSettings;
use super::error::ReconstructError;
use super::windows::Window;
use crate::clip::{Clip, Intrinsics, RGB, Rgb};
use crate::geometry::rigid::Rigid;
use crate::labelling::{DepthLabeller, LabelError};
use crate::modality::ClipFormat;
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
#[derive(Debug)]
pub struct Recording {
    /// The video's or the clip's name.
    pub title: String,
    /// How much of it is reconstructed.
    pub seconds: f64,
    /// Of the square frames that the model sees.
    pub intrinsics: Intrinsics,
    /// World pose of the first camera.
    pub first: Rigid,
    /// What is assumed of it, and where that comes from.
    pub assumptions: Vec<Fact>,
    /// `synthetic`, ...
    pub badges: Vec<Badge>,
    /// The clip without its video.
    pub truth: Option<Clip>,
    frames: Frames,
    is_synthetic: bool,
}

/// What clips of the built-in world say their source is, and models what they were trained on.
pub const SYNTHETIC: &str = "world";

#[derive(Debug)]
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
    /// A video from `start` on, at most `limit` seconds of it, for a model that takes clips of `format`.
    ///
    /// # Errors
    /// When nothing is left of the video, or what is said of its camera cannot be.
    pub fn of_video(
        video: Video,
        [start, limit]: [Option<f64>; 2],
        camera: &CameraSettings,
        format: &ClipFormat,
    ) -> Result<Self, ReconstructError> {
        let start = start.unwrap_or(0.0);
        let info = video.info().clone();
        let left = info.seconds() - start;
        if info.frames == 0 || left <= 0.0 || !left.is_finite() {
            return Err(ReconstructError::NothingLeft {
                path: video.path().to_owned(),
                frames: info.frames,
                seconds: info.seconds(),
                start,
            });
        }
        let size = [info.width, info.height];
        let intrinsics = camera.intrinsics(size, format.size as u32)?;
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
        assumptions.extend(said(camera, &intrinsics));
        Ok(Self {
            title: video.path().file_stem().map_or_else(
                || "video".into(),
                |stem| stem.to_string_lossy().into_owned(),
            ),
            seconds: limit.map_or(left, |limit| left.min(limit)),
            intrinsics,
            first: camera.first_pose()?,
            assumptions,
            badges: Vec::new(),
            truth: None,
            frames: Frames::Video { video, start },
            is_synthetic: false,
        })
    }

    /// A stored clip; what it knows of its camera goes before `camera`, and its truth is shown beside the prediction.
    ///
    /// # Errors
    /// When it has no colour video, or what is said of its camera cannot be.
    pub fn of_clip(
        mut clip: Clip,
        camera: &CameraSettings,
        format: &ClipFormat,
    ) -> Result<Self, ReconstructError> {
        let rgb = clip.take(RGB).ok_or_else(|| ReconstructError::NoColour {
            clip: clip.id.clone(),
        })?;
        let mut lens_settings = *camera;
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
            None => lens_settings.intrinsics([size, size], size)?,
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
        let is_synthetic = clip.source == SYNTHETIC;
        if is_synthetic {
            badges.push(Badge {
                text: "synthetic".to_owned(),
                tone: Tone::Plain,
            });
        }
        Ok(Self {
            title: clip.id.clone(),
            seconds: CLIP_SECONDS,
            intrinsics,
            first: lens_settings.first_pose()?,
            assumptions,
            badges,
            truth: Some(clip),
            frames: Frames::Clip(rgb),
            is_synthetic,
        })
    }

    /// Where in the video it starts, seconds.
    #[must_use]
    pub fn start(&self) -> f64 {
        match &self.frames {
            Frames::Video { start, .. } => *start,
            Frames::Clip(_) => 0.0,
        }
    }

    /// Whether it is of the built-in world.
    #[must_use]
    pub fn is_synthetic(&self) -> bool {
        self.is_synthetic
    }

    /// The frames of these windows, as the model takes them.
    pub(super) fn stream<'a>(
        &'a self,
        windows: &[Window],
        format: &'a ClipFormat,
    ) -> Result<Stream<'a>, ReconstructError> {
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
                let decoded = video.squares(chosen.concat(), format.size as u32, threads)?;
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
    ) -> Result<Array3<f32>, ReconstructError> {
        let (squares, of) = match &self.frames {
            Frames::Clip(rgb) => {
                let images = rgb.frames.outer_iter().map(|frame| {
                    Ok::<_, ReconstructError>(Image {
                        width: frame.shape()[1] as u32,
                        height: frame.shape()[0] as u32,
                        data: frame.iter().copied().collect(),
                    })
                });
                let squares = anchor::labelled(network, images)?;
                let last = squares.len() - 1;
                (squares, (0..count).map(|k| k.min(last)).collect())
            }
            Frames::Video { video, start } => {
                let schedule = video.schedule();
                let chosen = schedule.clip(schedule.nearest(*start), rate, count);
                let mut own = chosen.clone();
                own.sort_unstable();
                own.dedup();
                let decoded = video.chosen(own.clone())?;
                let images = decoded.map(|frame| Ok::<_, ReconstructError>(frame?.image));
                let squares = anchor::labelled(network, images)?;
                let last = squares.len() - 1;
                let place = |frame: &usize| own.binary_search(frame).unwrap_or(last).min(last);
                (squares, chosen.iter().map(place).collect::<Vec<usize>>())
            }
        };
        let views: Vec<_> = of.iter().map(|at| squares[*at].view()).collect();
        ndarray::stack(Axis(0), &views)
            .map_err(|error| LabelError::Frames(error.to_string()).into())
    }
}

impl Stream<'_> {
    /// The frames of a window; windows are asked for in their order.
    pub(super) fn window(&mut self, index: usize) -> Result<Rgb, ReconstructError> {
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
                let (number, square) =
                    frame.ok_or(ReconstructError::Ends { before: *wanted })??;
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

fn words(intrinsics: &Intrinsics) -> String {
    format!(
        "fx {:.2}, fy {:.2}, cx {:.2}, cy {:.2} at {} x {}",
        intrinsics.fx,
        intrinsics.fy,
        intrinsics.cx,
        intrinsics.cy,
        intrinsics.width,
        intrinsics.height
    )
}

/// What the settings say of the camera, and what is assumed instead.
fn said(settings: &CameraSettings, intrinsics: &Intrinsics) -> [Fact; 2] {
    let from = match settings.calibration {
        Some(_) => "from `camera.calibration`".to_owned(),
        None => format!(
            "ASSUMED: {} degrees across the square (`camera.field_of_view`, `camera.calibration`)",
            settings.field_of_view
        ),
    };
    let up = match settings.up {
        Some(_) => "from `camera.up`".to_owned(),
        None => "ASSUMED: the first camera is level (`camera.up`)".to_owned(),
    };
    [
        fact("Intrinsics", format_args!("{}, {from}", words(intrinsics))),
        fact("Up", up),
    ]
}
