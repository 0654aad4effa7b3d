//! One recording of a head-mounted camera, whatever made it, and how it is cut into clips of two seconds.
//!
//! An adapter (one file per data set) fills a [`Recording`]: pictures that are read when they are needed, and small tables that
//! are held. Everything else happens here, once for all data sets: the two clocks of a clip, the quarter turn of Aria's and
//! Quest's pictures, the fit to a square, projection of gaze, hands in the camera, the body in the gravity frame, and the rule
//! that colour and depth belong together only within 10 ms.

mod pictures;
mod signals;

pub use super::cut::CutSettings;
pub use pictures::depth_square;

use signals::world_joints;

use super::ReadError;
use super::track::{Joints, SECOND, Track, nearest};
use super::{DropReason, Outcome};
use crate::clip::clock::{CLIP_SECONDS, SIGNAL_RATE, SIGNAL_SAMPLES};
use crate::clip::frames::{FrameError, gravity_frame_of, joints_in_camera, joints_in_frame};
use crate::clip::{BODY, CAMERA, Clip, DEPTH, GAZE, JointTrack, LEFT_HAND, RGB, RIGHT_HAND};
use crate::geometry::camera::{Camera, KannalaBrandt, Lens};
use crate::geometry::undistortion::Remap;
use crate::video::image::{Image, Turn};
use nalgebra::{Isometry3, Rotation3, Unit, UnitQuaternion, Vector3};
use ndarray::Array2;
use std::sync::{Arc, OnceLock};

/// Colour and depth farther apart than this do not show the same moment (the paper's rule).
pub const DEPTH_APART: i64 = SECOND / 100;
/// Gaze outside of this range, in units of the picture, is a failure of the tracker (the ancestors' rule).
const GAZE_RANGE: std::ops::RangeInclusive<f64> = -0.2..=1.2;
/// Two frames are equally near when their distances differ by less than clocks are rounded, nanoseconds.
const TIE: i64 = 2000;
/// A signal that ends this long before the recording does, or begins as long after it, is there for a part of it.
const PARTLY: i64 = SECOND;
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
    fn read(&self, indices: &[usize], each: &mut dyn FnMut(usize, Image)) -> Result<(), ReadError>;
    /// What decodes them, where they are a video.
    fn decoder(&self) -> Option<String> {
        None
    }
}

/// Depth maps on the grid of the colour pictures, not turned.
pub trait DepthFrames: Send + Sync {
    /// Capture times in nanoseconds, ascending.
    fn times(&self) -> &[i64];
    /// Metres of z-depth, NaN where nothing was measured.
    ///
    /// # Errors
    /// When it cannot be read.
    fn read(&self, index: usize) -> Result<Array2<f32>, ReadError>;

    /// Several, by ascending, distinct indices, one at a time: for files in which one is as dear as many.
    ///
    /// # Errors
    /// When one cannot be read.
    fn read_several(
        &self,
        indices: &[usize],
        each: &mut dyn FnMut(Array2<f32>),
    ) -> Result<(), ReadError> {
        for &index in indices {
            each(self.read(index)?);
        }
        Ok(())
    }
}

/// A camera on the device, over time.
#[derive(Debug, Clone, PartialEq)]
pub struct MountedCamera {
    /// For the pictures as stored.
    pub camera: Camera,
    /// From the camera's `OpenCV` axes (of the picture as stored) to the device's, metres.
    pub T_device_camera: Isometry3<f64>,
}

impl MountedCamera {
    /// A stand-in where only poses are known: one pixel, and a fisheye, so that no pinhole intrinsics come out of it.
    #[must_use]
    pub fn without_lens() -> Self {
        MountedCamera {
            camera: Camera {
                lens: Lens::KannalaBrandt(KannalaBrandt {
                    fx: 1.0,
                    fy: 1.0,
                    cx: 0.0,
                    cy: 0.0,
                    radial: [0.0; 4],
                }),
                width: 1,
                height: 1,
                valid_radius: None,
            },
            T_device_camera: Isometry3::identity(),
        }
    }

    fn has_lens(&self) -> bool {
        self.camera != Self::without_lens().camera
    }
}

/// One recording. Times are nanoseconds on one clock, whichever the adapter chose.
pub struct Recording {
    /// Within the data set; clips are `source/id/000012`.
    pub id: String,
    /// The data set: `adt`, `hot3d_aria`, ...
    pub source: String,
    /// From the stored picture to the upright one.
    pub turn: Turn,
    /// The pictures that clips show; `None` where there are none.
    pub colour: Option<Box<dyn ColourFrames>>,
    /// Depth along the optical axis; `None` where there is none.
    pub depth: Option<Box<dyn DepthFrames>>,
    /// When clips begin and end if there are no pictures at hand.
    pub span: Option<(i64, i64)>,
    /// Calibrations over time, ascending, at least one; `None` where the camera is not known.
    pub cameras: Vec<(i64, MountedCamera)>,
    /// `T_world_device`.
    pub device: Option<Track<Isometry3<f64>>>,
    /// Against gravity in the world, unit length; `None` where it is not known: there is no body then.
    pub up_world: Option<Unit<Vector3<f64>>>,
    /// Where the wearer looks over time.
    pub gaze: Option<Track<GazeSample>>,
    /// Left and right, in `hands_frame`.
    pub hands: [Option<Track<Joints>>; 2],
    /// What the coordinates of `hands` refer to.
    pub hands_frame: JointFrame,
    /// In the world.
    pub body: Option<Track<Joints>>,
    /// What this recording lacks and what to supply for it, one sentence each.
    pub notes: Vec<String>,
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
    /// The world of the device's poses.
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
    Pixel {
        /// Column and row, in pixels of a picture of `size`.
        pixel: [f64; 2],
        /// Width and height in pixels, which need not be those of the stored picture.
        size: [f64; 2],
    },
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
            notes: Vec::new(),
            remap: OnceLock::new(),
        }
    }

    /// Notes what is absent, in one sentence.
    pub fn lacks(&mut self, what: impl Into<String>) {
        self.notes.push(what.into());
    }

    /// Signals that are known for a part of the recording or not at all, one sentence each: a file that was cut short at the end of a
    /// line or row is a whole file to its reader.
    #[must_use]
    pub fn partial(&self) -> Vec<String> {
        let depth = self.depth.as_ref().map(|depth| depth.times());
        // Hands come and go: only those that never come are worth a sentence.
        let [left, right] = [0, 1].map(|side| self.hands[side].as_ref().map(Track::times));
        let signals = [
            ("camera", self.device.as_ref().map(Track::times), true),
            ("gaze", self.gaze.as_ref().map(Track::times), true),
            ("body", self.body.as_ref().map(Track::times), true),
            ("depth", depth, true),
            ("left_hand", left, false),
            ("right_hand", right, false),
        ];
        let mut sentences = Vec::new();
        for (name, times, lasting) in signals {
            match (times, self.extent()) {
                (Some([]), _) => sentences.push(format!("not one sample of {name} is known")),
                (Some([first, rest @ ..]), Some((start, end))) if lasting => {
                    let last = rest.last().unwrap_or(first);
                    let late = first.saturating_sub(start) > PARTLY;
                    if late || end.saturating_sub(*last) > PARTLY {
                        sentences.push(format!(
                            "{name} is known for a part of the recording only: its samples begin late or end early by more than a second"
                        ));
                    }
                }
                _ => {}
            }
        }
        sentences
    }

    /// Whether clips can be cut as `settings` ask.
    ///
    /// # Errors
    /// When pictures shall be undistorted whose lens is not known.
    pub fn check(&self, settings: &CutSettings) -> Result<(), ReadError> {
        let camera = self.cameras.first().map(|(_, mounted)| mounted);
        let known = camera.is_some_and(MountedCamera::has_lens);
        if settings.undistort.is_some() && self.colour.is_some() && !known {
            return Err(ReadError::Settings(format!(
                "`undistort` needs a lens, and `{}/{}` has none",
                self.source, self.id
            )));
        }
        Ok(())
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

    /// The ticks of clip number `index`, whose first moment is `start`.
    fn ticks(start: i64) -> Vec<i64> {
        (0..SIGNAL_SAMPLES)
            .map(|k| start + (k as f64 / SIGNAL_RATE * SECOND as f64).round() as i64)
            .collect()
    }

    /// When clip number `index` begins.
    fn start(&self, index: usize, settings: &CutSettings) -> Option<i64> {
        let (first, _) = self.extent()?;
        Some(first + (index as f64 * settings.stride * SECOND as f64).round() as i64)
    }

    /// Signals that this recording has and clip number `index` goes without, each with the reason.
    #[must_use]
    pub fn lost(&self, index: usize, settings: &CutSettings) -> Vec<String> {
        let Some(start) = self.start(index, settings) else {
            return Vec::new();
        };
        let camera = self.camera_track(&Self::ticks(start), settings);
        let mut lost = Vec::new();
        if self.body.is_some() {
            let reason = match camera.as_ref().map(gravity_frame_of) {
                Some(Ok(_)) => None,
                None => Some("the recording has no camera poses"),
                Some(Err(FrameError::NoUp)) => Some("which way is up is not known"),
                Some(Err(FrameError::Degenerate { .. })) => {
                    Some("the head is tilted sideways, and the clip has no heading")
                }
                Some(Err(_)) => Some("the clip's first camera pose is missing"),
            };
            lost.extend(reason.map(|reason| format!("body: {reason}")));
        }
        if camera.is_none() && self.hands_frame == JointFrame::World {
            for (hand, name) in self.hands.iter().zip(["left_hand", "right_hand"]) {
                if hand.is_some() {
                    lost.push(format!("{name}: the recording has no camera poses"));
                }
            }
        }
        lost
    }

    /// Makes clip number `index` (less than [`Recording::clips`]).
    ///
    /// # Errors
    /// When pictures cannot be read.
    pub fn clip(&self, index: usize, settings: &CutSettings) -> Result<Outcome, ReadError> {
        let id = format!("{}/{}/{index:06}", self.source, self.id);
        let Some(start) = self.start(index, settings) else {
            return Ok(Outcome::Dropped {
                id,
                reason: DropReason::NothingValid,
            });
        };
        let (rgb, depth) = match self.video(start, settings)? {
            Ok(video) => video,
            Err(reason) => return Ok(Outcome::Dropped { id, reason }),
        };
        let ticks = Self::ticks(start);
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
        let mut clip = Clip::empty(id, self.source.clone());
        clip.set(RGB, rgb);
        clip.set(DEPTH, depth);
        clip.set(CAMERA, camera);
        clip.set(GAZE, gaze);
        clip.set(LEFT_HAND, left_hand);
        clip.set(RIGHT_HAND, right_hand);
        clip.set(BODY, body);
        Ok(Outcome::Clip(Box::new(clip)))
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
