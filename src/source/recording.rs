//! One recording of a head-mounted camera, whatever made it, and how it is cut into clips of two seconds.
//!
//! An adapter (one file per data set) fills a [`Recording`]: pictures that are read when they are needed, and small tables that
//! are held. Everything else happens here, once for all data sets: the two clocks of a clip, the quarter turn of Aria's and
//! Quest's pictures, the fit to a square, projection of gaze, hands in the camera, the body in the gravity frame, and the rule
//! that colour and depth belong together only within 10 ms.

pub use super::cut::CutSettings;

use super::SourceError;
use super::image::{Image, SquareFit, Turn};
use super::track::{Joints, SECOND, Track, nearest};
use super::{DropReason, Outcome};
use crate::clip::clock::{CLIP_SECONDS, SIGNAL_RATE, SIGNAL_SAMPLES};
use crate::clip::frames::{WorldJoints, gravity_frame_of, joints_in_camera, joints_in_frame};
use crate::clip::{CameraTrack, Clip, Depth, GazeTrack, Intrinsics, JointTrack, Rgb};
use crate::geometry::camera::{Camera, Lens, Pinhole};
use crate::geometry::undistortion::Remap;
use nalgebra::{Isometry3, Point3, Rotation3, Unit, UnitQuaternion, Vector2, Vector3};
use ndarray::{Array1, Array2, Array3, Array4};
use std::collections::BTreeMap;
use std::sync::{Arc, OnceLock};

/// Colour and depth farther apart than this do not show the same moment (the paper's rule).
pub const DEPTH_APART: i64 = SECOND / 100;
/// Gaze outside of this range, in units of the picture, is a failure of the tracker (the ancestors' rule).
const GAZE_RANGE: std::ops::RangeInclusive<f64> = -0.2..=1.2;
/// Two frames are equally near when their distances differ by less than clocks are rounded, nanoseconds.
const TIE: i64 = 2000;
/// Nanoseconds of a clip.
const CLIP: i64 = CLIP_SECONDS as i64 * SECOND;

/// Colour pictures as stored (not turned), read when they are asked for.
pub trait ColourFrames: Send + Sync {
    /// Capture times in nanoseconds, ascending.
    fn times(&self) -> &[i64];
    /// Decodes pictures by ascending, distinct indices and hands them to `each` one at a time, with their index.
    ///
    /// # Errors
    /// When one cannot be read.
    fn read(
        &self,
        indices: &[usize],
        each: &mut dyn FnMut(usize, Image),
    ) -> Result<(), SourceError>;
}

/// Depth maps on the grid of the colour pictures, not turned.
pub trait DepthFrames: Send + Sync {
    /// Capture times in nanoseconds, ascending.
    fn times(&self) -> &[i64];
    /// Metres of z-depth, NaN where nothing was measured.
    ///
    /// # Errors
    /// When it cannot be read.
    fn read(&self, index: usize) -> Result<Array2<f32>, SourceError>;
}

/// A camera on the device, over time.
#[derive(Debug, Clone, PartialEq)]
pub struct MountedCamera {
    /// For the pictures as stored.
    pub camera: Camera,
    pub T_device_camera: Isometry3<f64>,
}

/// One recording. Times are nanoseconds on one clock, whichever the adapter chose.
pub struct Recording {
    /// Within the data set; clips are `source/id/000012`.
    pub id: String,
    pub source: String,
    /// From the stored picture to the upright one.
    pub turn: Turn,
    pub colour: Option<Box<dyn ColourFrames>>,
    pub depth: Option<Box<dyn DepthFrames>>,
    /// When clips begin and end if there are no pictures at hand.
    pub span: Option<(i64, i64)>,
    /// Calibrations over time, ascending, at least one; `None` where the camera is not known.
    pub cameras: Vec<(i64, MountedCamera)>,
    /// `T_world_device`.
    pub device: Option<Track<Isometry3<f64>>>,
    pub up_world: Option<Unit<Vector3<f64>>>,
    pub gaze: Option<Track<GazeSample>>,
    /// Left and right, in `hands_frame`.
    pub hands: [Option<Track<Joints>>; 2],
    pub hands_frame: JointFrame,
    /// In the world.
    pub body: Option<Track<Joints>>,
    /// The undistortion map, made once.
    pub remap: OnceLock<Arc<Remap>>,
}

impl std::fmt::Debug for Recording {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("Recording")
            .field("source", &self.source)
            .field("id", &self.id)
            .finish_non_exhaustive()
    }
}

/// What the coordinates of hands refer to.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum JointFrame {
    #[default]
    World,
    /// The upright camera of the same moment.
    Camera,
}

/// Where the wearer looks, as the adapter knows it.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum GazeSample {
    /// A direction from the central pupil frame of Aria glasses.
    Aria(super::aria::gaze::Gaze, Isometry3<f64>),
    /// A pixel of the upright picture, and that picture's width and height.
    Pixel { pixel: [f64; 2], size: [f64; 2] },
}

impl super::track::Blend for GazeSample {
    fn blend(&self, other: &Self, weight: f64) -> Option<Self> {
        match (self, other) {
            (GazeSample::Aria(a, pose), GazeSample::Aria(b, _)) => {
                Some(GazeSample::Aria(a.blend(b, weight)?, *pose))
            }
            (GazeSample::Pixel { pixel: a, size }, GazeSample::Pixel { pixel: b, .. }) => {
                Some(GazeSample::Pixel {
                    pixel: a.blend(b, weight)?,
                    size: *size,
                })
            }
            _ => None,
        }
    }
}

/// Colour and depth of a clip.
type ClipVideo = (Option<Rgb>, Option<Depth>);

impl Recording {
    /// A recording of which nothing is known yet.
    #[must_use]
    pub fn new(source: &str, id: &str) -> Self {
        Recording {
            id: id.to_owned(),
            source: source.to_owned(),
            turn: Turn::None,
            colour: None,
            depth: None,
            span: None,
            cameras: Vec::new(),
            device: None,
            up_world: None,
            gaze: None,
            hands: [None, None],
            hands_frame: JointFrame::World,
            body: None,
            remap: OnceLock::new(),
        }
    }

    /// First and last moment.
    fn extent(&self) -> Option<(i64, i64)> {
        let times = self.colour.as_ref().map(|colour| colour.times());
        match times {
            Some([first, .., last]) => {
                // The last frame is shown as long as the others.
                let count = times.map_or(1, <[i64]>::len) as i64;
                Some((*first, last + (last - first) / (count - 1)))
            }
            Some([only]) => Some((*only, *only)),
            _ => self.span,
        }
    }

    /// How many clips there are.
    #[must_use]
    pub fn clips(&self, settings: &CutSettings) -> usize {
        let Some((start, end)) = self.extent() else {
            return 0;
        };
        // A recording that ends within a video frame of the clip's end still has all of it.
        let slack = (SECOND as f64 / settings.fps / 2.0) as i64;
        let length = end.saturating_sub(start).saturating_add(slack);
        if length < CLIP {
            return usize::from(settings.pad_short);
        }
        let stride = (settings.stride * SECOND as f64) as i64;
        ((length - CLIP) / stride.max(1) + 1) as usize
    }

    /// The modalities that clips of this recording can have.
    #[must_use]
    pub fn modalities(&self) -> Vec<String> {
        let has_camera = self.device.is_some();
        let hands = has_camera || self.hands_frame == JointFrame::Camera;
        [
            ("rgb", self.colour.is_some()),
            ("depth", self.depth.is_some()),
            ("camera", has_camera),
            ("gaze", self.gaze.is_some()),
            ("left_hand", hands && self.hands[0].is_some()),
            ("right_hand", hands && self.hands[1].is_some()),
            ("body", has_camera && self.body.is_some()),
        ]
        .into_iter()
        .filter(|(_, there)| *there)
        .map(|(name, _)| name.to_owned())
        .collect()
    }

    /// Milliseconds from every colour frame to the depth frame nearest in time.
    #[must_use]
    pub fn depth_offsets_ms(&self) -> Vec<Option<f64>> {
        let (Some(colour), Some(depth)) = (&self.colour, &self.depth) else {
            return Vec::new();
        };
        colour
            .times()
            .iter()
            .map(|time| {
                let near = nearest(depth.times(), *time)?;
                Some((depth.times()[near] - time) as f64 / 1e6)
            })
            .collect()
    }

    /// `T_world_camera` of the upright picture.
    #[must_use]
    pub fn pose(&self, time: i64) -> Option<Isometry3<f64>> {
        let mounted = self.mounted(time)?;
        let T_world_device = self.device.as_ref()?.at(time)?;
        Some(T_world_device * mounted.T_device_camera * upright(self.turn))
    }

    fn mounted(&self, time: i64) -> Option<&MountedCamera> {
        let after = self.cameras.partition_point(|(t, _)| *t <= time);
        let before = after.checked_sub(1).map(|index| &self.cameras[index]);
        match (before, self.cameras.get(after)) {
            (Some(a), Some(b)) => Some(if time - a.0 <= b.0 - time { &a.1 } else { &b.1 }),
            (a, b) => a.or(b).map(|(_, camera)| camera),
        }
    }

    /// Where the wearer looks at `time`: in units of the square picture, unbounded. `None` where it is not known or the point is
    /// behind the camera.
    #[must_use]
    pub fn gaze_at(&self, time: i64, settings: &CutSettings) -> Option<[f64; 2]> {
        let sample = self.gaze.as_ref()?.at(time)?;
        let (u, v, width, height) = match sample {
            GazeSample::Pixel {
                pixel: [u, v],
                size: [width, height],
            } => (u, v, width, height),
            GazeSample::Aria(gaze, pupils) => {
                let mounted = self.mounted(time)?;
                let distance = if settings.gaze_vergence && gaze.depth > 0.0 {
                    gaze.depth
                } else {
                    settings.gaze_distance
                };
                let point = mounted.T_device_camera.inverse() * gaze.point(&pupils, distance);
                let camera = match settings.undistort {
                    Some(angle) => pinhole(
                        &mounted.camera,
                        angle,
                        mounted.camera.width.min(mounted.camera.height),
                    ),
                    None => mounted.camera.clone(),
                };
                let pixel = camera.project(&point.coords)?;
                let (w, h) = (f64::from(camera.width), f64::from(camera.height));
                let (u, v) = self.turn.pixel(pixel.x, pixel.y, w, h);
                let (width, height) = self.turn.size(camera.width, camera.height);
                (u, v, f64::from(width), f64::from(height))
            }
        };
        let side = width.min(height);
        Some([
            (u - (width - side) / 2.0) / side,
            (v - (height - side) / 2.0) / side,
        ])
    }

    /// Makes clip number `index` (less than [`Recording::clips`]).
    ///
    /// # Errors
    /// When pictures cannot be read.
    pub fn clip(&self, index: usize, settings: &CutSettings) -> Result<Outcome, SourceError> {
        let id = format!("{}/{}/{index:06}", self.source, self.id);
        let Some((first, _)) = self.extent() else {
            return Ok(Outcome::Dropped {
                id,
                reason: DropReason::NothingValid,
            });
        };
        let start = first + (index as f64 * settings.stride * SECOND as f64).round() as i64;
        let (rgb, depth) = match self.video(start, settings)? {
            Ok(video) => video,
            Err(reason) => return Ok(Outcome::Dropped { id, reason }),
        };
        let ticks: Vec<i64> = (0..SIGNAL_SAMPLES)
            .map(|k| start + (k as f64 / SIGNAL_RATE * SECOND as f64).round() as i64)
            .collect();
        let camera = self.camera_track(&ticks, settings);
        let gaze = self
            .gaze
            .is_some()
            .then(|| self.gaze_track(&ticks, settings));
        let hands = [0, 1].map(|side| {
            let joints = world_joints(self.hands[side].as_ref()?, &ticks);
            match self.hands_frame {
                JointFrame::World => joints_in_camera(&joints, camera.as_ref()?).ok(),
                JointFrame::Camera => Some(joints_in_frame(
                    &joints,
                    SIGNAL_RATE,
                    &Isometry3::identity(),
                )),
            }
        });
        let body = camera.as_ref().and_then(|camera| {
            let joints = self.body.as_ref()?;
            // A head tilted sideways has no heading: the clip goes without a body.
            let T_gravity_world = gravity_frame_of(camera).ok()?;
            Some(joints_in_frame(
                &world_joints(joints, &ticks),
                SIGNAL_RATE,
                &T_gravity_world,
            ))
        });
        let [left_hand, right_hand] = hands;
        let something = camera
            .as_ref()
            .is_some_and(|track| track.valid.contains(&true))
            || gaze
                .as_ref()
                .is_some_and(|track| track.valid.iter().any(|v| *v))
            || [&left_hand, &right_hand, &body]
                .into_iter()
                .flatten()
                .any(|track: &JointTrack| track.valid.iter().any(|v| *v));
        if !something && rgb.is_none() {
            return Ok(Outcome::Dropped {
                id,
                reason: DropReason::NothingValid,
            });
        }
        Ok(Outcome::Clip(Box::new(Clip {
            id,
            source: self.source.clone(),
            rgb,
            depth,
            camera,
            gaze,
            left_hand,
            right_hand,
            body,
            declared: BTreeMap::new(),
        })))
    }

    /// Colour and depth from `start` on; the inner error is why the clip is dropped.
    fn video(
        &self,
        start: i64,
        settings: &CutSettings,
    ) -> Result<Result<ClipVideo, DropReason>, SourceError> {
        let Some(colour) = &self.colour else {
            return Ok(Ok((None, None)));
        };
        let (times, missing) = match &self.depth {
            // Only frames whose depth was taken at the same moment take part.
            Some(depth) => (
                (0..colour.times().len())
                    .filter(|&frame| {
                        let time = colour.times()[frame];
                        nearest(depth.times(), time)
                            .is_some_and(|near| (depth.times()[near] - time).abs() <= DEPTH_APART)
                    })
                    .collect::<Vec<_>>(),
                DropReason::DepthApart,
            ),
            None => ((0..colour.times().len()).collect(), DropReason::VideoGap),
        };
        let kept: Vec<i64> = times.iter().map(|&frame| colour.times()[frame]).collect();
        let Some((_, end)) = self.extent() else {
            return Ok(Err(missing));
        };
        let period = (end - colour.times()[0]) / colour.times().len().max(1) as i64;
        let tolerance = period * 3 / 4 + SECOND / 1000;
        let mut chosen = Vec::with_capacity(settings.frames());
        for k in 0..settings.frames() {
            let tick = start + (k as f64 / settings.fps * SECOND as f64).round() as i64;
            let Some(mut near) = nearest(&kept, tick) else {
                return Ok(Err(missing));
            };
            // Half-way between two frames the release's rule rounds to even, counted from the clip's first frame.
            if let Some(next) = kept.get(near + 1) {
                let tie = ((next - tick) - (tick - kept[near])).abs() <= TIE;
                let from_first = times[near] - chosen.first().copied().unwrap_or(times[near]);
                near += usize::from(tie && from_first % 2 == 1);
            }
            let beyond = settings.pad_short && tick >= end - period;
            if (kept[near] - tick).abs() > tolerance && !beyond {
                return Ok(Err(missing));
            }
            chosen.push(times[near]);
        }
        let mut distinct = chosen.clone();
        distinct.dedup();
        let side = settings.side as usize;
        let mut squares = Vec::with_capacity(distinct.len());
        let mut depths = Vec::with_capacity(distinct.len());
        // One picture at a time: full-size pictures are not held.
        colour.read(&distinct, &mut |frame, picture| {
            squares.push(self.square(picture, colour.times()[frame], settings).data);
        })?;
        if squares.len() != distinct.len() {
            return Err(SourceError::Settings(format!(
                "{} of {} pictures were read",
                squares.len(),
                distinct.len()
            )));
        }
        if let Some(depth) = &self.depth {
            for &frame in &distinct {
                let time = colour.times()[frame];
                let near = nearest(depth.times(), time).unwrap_or(0);
                depths.push(self.square_depth(&depth.read(near)?, time, settings));
            }
        }
        let find = |frame: usize| distinct.binary_search(&frame).unwrap_or(0);
        let mut pixels = Vec::with_capacity(chosen.len() * side * side * 3);
        for &frame in &chosen {
            pixels.extend_from_slice(&squares[find(frame)]);
        }
        let shape = |error: ndarray::ShapeError| SourceError::Settings(error.to_string());
        let rgb = Rgb {
            rate: settings.fps,
            frames: Array4::from_shape_vec((chosen.len(), side, side, 3), pixels).map_err(shape)?,
        };
        let depth = if depths.is_empty() {
            None
        } else {
            let metres = chosen
                .iter()
                .flat_map(|&frame| depths[find(frame)].iter().copied())
                .collect();
            Some(Depth {
                rate: settings.fps,
                metres: Array3::from_shape_vec((chosen.len(), side, side), metres)
                    .map_err(shape)?,
            })
        };
        Ok(Ok((Some(rgb), depth)))
    }

    /// The undistortion map for pictures `side` pixels wide; made from the first calibration and kept.
    fn remap(&self, time: i64, angle: f64, side: u32) -> Option<Arc<Remap>> {
        let mounted = self.mounted(time)?;
        Some(Arc::clone(self.remap.get_or_init(|| {
            Arc::new(Remap::new(
                &mounted.camera,
                &pinhole(&mounted.camera, angle, side),
            ))
        })))
    }

    /// Sampled three times finer than the clip, then averaged: undistortion must not alias.
    fn fine_side(settings: &CutSettings) -> u32 {
        settings.side * 3
    }

    fn square(&self, picture: Image, time: i64, settings: &CutSettings) -> Image {
        let picture = match settings
            .undistort
            .and_then(|angle| self.remap(time, angle, Self::fine_side(settings)))
        {
            Some(remap) => Image {
                width: remap.size().0 as u32,
                height: remap.size().1 as u32,
                data: remap.colour(&picture.data),
            },
            None => picture,
        };
        picture.turned(self.turn).square(settings.side)
    }

    fn square_depth(&self, metres: &Array2<f32>, time: i64, settings: &CutSettings) -> Vec<f32> {
        let remapped;
        let metres = match settings
            .undistort
            .and_then(|angle| self.remap(time, angle, Self::fine_side(settings)))
        {
            Some(remap) => {
                let (width, height) = remap.size();
                let values = metres.as_standard_layout();
                let values = values.as_slice().unwrap_or(&[]);
                let flat = remap
                    .nearest(values)
                    .map(|d| d.unwrap_or(f32::NAN))
                    .collect();
                remapped = Array2::from_shape_vec((height, width), flat)
                    .unwrap_or_else(|_| metres.clone());
                &remapped
            }
            None => metres,
        };
        depth_square(metres, self.turn, settings.side)
    }

    fn camera_track(&self, ticks: &[i64], settings: &CutSettings) -> Option<CameraTrack> {
        self.device.as_ref()?;
        let poses: Vec<Option<Isometry3<f64>>> =
            ticks.iter().map(|tick| self.pose(*tick)).collect();
        let valid = poses.iter().map(Option::is_some).collect();
        // A missing pose repeats the last known one: readers that ignore validity get no jump to the origin.
        let mut last = poses
            .iter()
            .flatten()
            .next()
            .copied()
            .unwrap_or_else(Isometry3::identity);
        let T_world_camera = poses
            .into_iter()
            .map(|pose| {
                last = pose.unwrap_or(last);
                last
            })
            .collect();
        Some(CameraTrack {
            rate: SIGNAL_RATE,
            T_world_camera,
            valid,
            up_world: self.up_world,
            intrinsics: self.intrinsics(ticks[0], settings),
        })
    }

    /// Pinhole intrinsics of the clip's frames, where the frames are pinhole pictures.
    fn intrinsics(&self, time: i64, settings: &CutSettings) -> Option<Intrinsics> {
        let camera = &self.mounted(time)?.camera;
        let camera = match (settings.undistort, &camera.lens) {
            (Some(angle), _) => pinhole(camera, angle, settings.side),
            (None, Lens::Pinhole(_)) => {
                let fit = SquareFit::new(camera.width, camera.height, settings.side);
                let scale = f64::from(settings.side) / f64::from(camera.width.min(camera.height));
                camera.resized(scale).cropped(
                    f64::from(fit.left),
                    f64::from(fit.top),
                    fit.side,
                    fit.side,
                )
            }
            _ => return None,
        };
        let Lens::Pinhole(lens) = camera.lens else {
            return None;
        };
        let size = f64::from(settings.side);
        let (cx, cy) = self.turn.pixel(lens.cx, lens.cy, size, size);
        let (fx, fy) = match self.turn {
            Turn::None | Turn::Half => (lens.fx, lens.fy),
            Turn::Clockwise | Turn::CounterClockwise => (lens.fy, lens.fx),
        };
        Some(Intrinsics {
            fx,
            fy,
            cx,
            cy,
            width: settings.side,
            height: settings.side,
        })
    }

    fn gaze_track(&self, ticks: &[i64], settings: &CutSettings) -> GazeTrack {
        let mut points = Array2::zeros((ticks.len(), 2));
        let mut valid = Array1::from_elem(ticks.len(), false);
        for (k, tick) in ticks.iter().enumerate() {
            if let Some([u, v]) = self.gaze_at(*tick, settings)
                && GAZE_RANGE.contains(&u)
                && GAZE_RANGE.contains(&v)
            {
                points[[k, 0]] = u as f32;
                points[[k, 1]] = v as f32;
                valid[k] = true;
            }
        }
        GazeTrack {
            rate: SIGNAL_RATE,
            points,
            valid,
        }
    }
}

/// A pinhole camera with the axes of `camera` and the given horizontal field of view, `side` pixels a side.
fn pinhole(camera: &Camera, degrees: f64, side: u32) -> Camera {
    debug_assert!(camera.width > 0, "a camera has pixels");
    let size = f64::from(side);
    let focal = size / 2.0 / (degrees.to_radians() / 2.0).tan();
    Camera {
        lens: Lens::Pinhole(Pinhole {
            fx: focal,
            fy: focal,
            cx: (size - 1.0) / 2.0,
            cy: (size - 1.0) / 2.0,
        }),
        width: side,
        height: side,
        valid_radius: None,
    }
}

/// `R_stored_upright`: a picture turned clockwise has its new x along the old -y and its new y along the old x.
#[must_use]
pub fn upright(turn: Turn) -> Isometry3<f64> {
    let quarter = match turn {
        Turn::None => 0.0,
        Turn::Clockwise => -1.0,
        Turn::Half => 2.0,
        Turn::CounterClockwise => 1.0,
    };
    let rotation =
        Rotation3::from_axis_angle(&Vector3::z_axis(), quarter * std::f64::consts::FRAC_PI_2);
    Isometry3::from_parts(
        nalgebra::Translation3::identity(),
        UnitQuaternion::from_rotation_matrix(&rotation),
    )
}

fn world_joints(track: &Track<Joints>, ticks: &[i64]) -> WorldJoints {
    ticks
        .iter()
        .map(|tick| match track.at(*tick) {
            Some(joints) => joints.to_vec(),
            None => vec![None::<Point3<f64>>; 21],
        })
        .collect()
}

/// The centre square of a depth map, turned upright, by nearest neighbour: depth must not be averaged over edges.
#[must_use]
pub fn depth_square(metres: &Array2<f32>, turn: Turn, side: u32) -> Vec<f32> {
    let (height, width) = metres.dim();
    let (turned_width, turned_height) = turn.size(width as u32, height as u32);
    let fit = SquareFit::new(turned_width, turned_height, side);
    let mut out = Vec::with_capacity(side as usize * side as usize);
    // The turn that undoes `turn`.
    let back = match turn {
        Turn::Clockwise => Turn::CounterClockwise,
        Turn::CounterClockwise => Turn::Clockwise,
        other => other,
    };
    let scale = Vector2::new(
        f64::from(turned_width) / f64::from(fit.resized.0),
        f64::from(turned_height) / f64::from(fit.resized.1),
    );
    for row in 0..side {
        for column in 0..side {
            let u = ((f64::from(column + fit.left) + 0.5) * scale.x - 0.5).round();
            let v = ((f64::from(row + fit.top) + 0.5) * scale.y - 0.5).round();
            let (x, y) = back.pixel(u, v, f64::from(turned_width), f64::from(turned_height));
            let x = (x.max(0.0) as usize).min(width - 1);
            let y = (y.max(0.0) as usize).min(height - 1);
            out.push(metres[[y, x]]);
        }
    }
    out
}
