//! What a reconstruction holds, in memory: the wearer's motion, gaze, camera and depth, how sure they are, and what was assumed.

use super::depth::DepthSeam;
use super::export::ply::Point;
use super::floor::FloorFit;
use super::frame_buffer::DepthFrames;
use super::predictions::ScaleStatus;
use super::samples::spread;
use super::scale::{DepthFit, NEAREST};
use super::stitch::{Joints, Tracks, WindowBoundary};
use crate::clip::clock::SIGNAL_RATE;
use crate::clip::{Clip, Intrinsics};
use crate::geometry::rigid::Rigid;
use crate::geometry::skeleton::{HandJoint, Joint};
use crate::view::{Badge, Fact, VideoFrames};
use ndarray::{Array2, Array3};
use std::collections::BTreeMap;
use std::marker::PhantomData;

/// What is known, or assumed, before the first window.
#[derive(Debug, Clone)]
pub struct ReconstructionInfo {
    /// The video's or the clip's name.
    pub title: String,
    /// Where in the video it starts, seconds.
    pub start: f64,
    /// Hz of the model's video.
    pub video_rate: f64,
    /// Video frames and motion samples of the whole reconstruction.
    pub frames: usize,
    /// Motion samples of the whole reconstruction.
    pub samples: usize,
    /// Of the square frames that are pushed.
    pub intrinsics: Intrinsics,
    /// World pose of the first camera.
    pub first: Rigid,
    /// How depth becomes metric from the floor.
    pub floor_fit: FloorFit,
    /// `[T, S, S]` metric depth of another model at the frames of this video; NaN where unknown.
    pub anchor: Option<Array3<f32>>,
    /// What was assumed and where it came from, with the flag that overrides it.
    pub assumptions: Vec<Fact>,
    /// Beside the scale status: `synthetic`, ...
    pub badges: Vec<Badge>,
    /// The true clip, where it is known and the video is one clip.
    pub truth: Option<Clip>,
}

/// The wearer and the world of one recording, in memory; [`Reconstruction::write`] makes a folder of it.
///
/// The world has z up, metres, and the origin and heading of the first camera. Motion is sampled at 30 Hz.
#[derive(Debug)]
pub struct Reconstruction {
    pub(super) info: ReconstructionInfo,
    pub(super) tracks: Tracks,
    /// Of the true clip, where it is known.
    pub(super) truth: Option<Tracks>,
    /// Where several were asked for: one after the other, each from a seed of its own.
    pub(super) samples: Vec<Tracks>,
    pub(super) boundaries: Vec<WindowBoundary>,
    pub(super) depth: Depth,
    pub(super) certainty: BTreeMap<String, Vec<f32>>,
    pub(super) video: VideoFrames,
    /// Depth on the grid of the page.
    pub(super) grids: Vec<Array2<f32>>,
    pub(super) cloud: Vec<Point>,
    /// Height of the floor, metres.
    pub(super) floor: Option<f64>,
}

/// Why a value is not known.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum NotKnown {
    /// The motion that is asked for was not reconstructed.
    #[error("this was not reconstructed")]
    Absent,
    /// The time lies before the start or after the end, or is NaN.
    #[error("{seconds} s lies outside the recording of {length} s")]
    Outside {
        /// The time that is asked for, seconds from the start.
        seconds: f64,
        /// Length of what was reconstructed, seconds.
        length: f64,
    },
    /// The joint is unknown at a sample next to this time.
    #[error("it is not known at {seconds} s")]
    Invalid {
        /// The time that is asked for, seconds from the start.
        seconds: f64,
    },
}

impl Reconstruction {
    /// The name of the recording.
    #[must_use]
    pub fn title(&self) -> &str {
        &self.info.title
    }

    /// How long it is.
    #[must_use]
    pub fn seconds(&self) -> f64 {
        self.info.samples as f64 / SIGNAL_RATE
    }

    /// Frames per second of the video that the model saw, and of the depth.
    #[must_use]
    pub fn video_rate(&self) -> f64 {
        self.info.video_rate
    }

    /// `T_world_camera` (metres, OpenCV axes) at 30 Hz; empty where no camera was reconstructed.
    #[must_use]
    pub fn camera(&self) -> &[Rigid] {
        self.tracks.camera()
    }

    /// Intrinsics of the square frames that the model saw.
    #[must_use]
    pub fn intrinsics(&self) -> &Intrinsics {
        &self.info.intrinsics
    }

    /// Where the wearer looks, in the upright square image `[0, 1]^2` at 30 Hz, NaN where unknown; empty where no gaze was
    /// reconstructed.
    #[must_use]
    pub fn gaze(&self) -> &[[f32; 2]] {
        self.tracks.gaze()
    }

    /// The body, in the world.
    #[must_use]
    pub fn body(&self) -> Motion<'_, Joint> {
        Motion::of(self.tracks.body())
    }

    /// The left hand, in the camera of the same sample.
    #[must_use]
    pub fn left_hand(&self) -> Motion<'_, HandJoint> {
        Motion::of(self.tracks.left_hand())
    }

    /// The right hand, in the camera of the same sample.
    #[must_use]
    pub fn right_hand(&self) -> Motion<'_, HandJoint> {
        Motion::of(self.tracks.right_hand())
    }

    /// What was reconstructed, by modality; a plug-in's too.
    #[must_use]
    pub fn tracks(&self) -> &Tracks {
        &self.tracks
    }

    /// What else the video allows: reconstructions from seeds of their own, without depth; empty where one was asked for.
    #[must_use]
    pub fn samples(&self) -> &[Tracks] {
        &self.samples
    }

    /// How far the samples are apart, by modality.
    #[must_use]
    pub fn spread(&self) -> BTreeMap<&'static str, Array2<f32>> {
        spread(&self.samples)
    }

    /// Depth of every video frame, and whether it is metric.
    #[must_use]
    pub fn depth(&self) -> &Depth {
        &self.depth
    }

    /// By modality, 0 (a guess) to 1 (certain) at 30 Hz, from the entropies of the tokens. Not an accuracy.
    #[must_use]
    pub fn certainty(&self) -> &BTreeMap<String, Vec<f32>> {
        &self.certainty
    }

    /// How well neighbouring windows agree.
    #[must_use]
    pub fn boundaries(&self) -> &[WindowBoundary] {
        &self.boundaries
    }

    /// What was assumed, and where it came from.
    #[must_use]
    pub fn assumptions(&self) -> &[Fact] {
        &self.info.assumptions
    }
}

/// 21 joints over time.
#[derive(Debug, Clone, Copy)]
pub struct Motion<'a, J> {
    positions: &'a [Joints],
    joint: PhantomData<J>,
}

impl<'a, J: Copy + Into<usize>> Motion<'a, J> {
    fn of(positions: &'a [Joints]) -> Self {
        Self {
            positions,
            joint: PhantomData,
        }
    }

    /// Every joint of every sample at 30 Hz, metres, NaN where unknown; empty where nothing was reconstructed.
    #[must_use]
    pub fn positions(&self) -> &'a [Joints] {
        self.positions
    }

    /// Where a joint is, metres: linear between the samples around `seconds`.
    ///
    /// # Errors
    /// When nothing was reconstructed, `seconds` lies outside the recording, or the joint is unknown there.
    pub fn position(&self, joint: J, seconds: f64) -> Result<[f32; 3], NotKnown> {
        let Some(last) = self.positions.len().checked_sub(1) else {
            return Err(NotKnown::Absent);
        };
        let at = seconds * SIGNAL_RATE;
        let length = self.positions.len() as f64 / SIGNAL_RATE;
        // The last sample holds until the end.
        if !(0.0..=length * SIGNAL_RATE).contains(&at) {
            return Err(NotKnown::Outside { seconds, length });
        }
        let (before, share) = ((at as usize).min(last), at.fract() as f32);
        let after = (before + 1).min(last);
        let joint = joint.into();
        let (a, b) = (self.positions[before][joint], self.positions[after][joint]);
        let found: [f32; 3] = std::array::from_fn(|k| {
            // An unknown neighbour does not matter exactly at a sample.
            if share == 0.0 {
                a[k]
            } else {
                a[k] + share * (b[k] - a[k])
            }
        });
        if found.iter().all(|value| value.is_finite()) {
            Ok(found)
        } else {
            Err(NotKnown::Invalid { seconds })
        }
    }
}

/// Depth along the optical axis over the square image, one map per frame of the model's video.
#[derive(Debug)]
pub struct Depth {
    pub(super) frames: DepthFrames,
    pub(super) scale: ScaleStatus,
    pub(super) fit: Option<DepthFit>,
    pub(super) refused: Option<String>,
    pub(super) boundaries: Vec<DepthSeam>,
}

impl Depth {
    /// Whether depth is metric, and by what; relative depth has unknown scale and shift.
    #[must_use]
    pub fn scale(&self) -> &ScaleStatus {
        &self.scale
    }

    /// The fit that made depth metric.
    #[must_use]
    pub fn fit(&self) -> Option<&DepthFit> {
        self.fit.as_ref()
    }

    /// Why depth stayed relative.
    #[must_use]
    pub fn refused(&self) -> Option<&str> {
        self.refused.as_deref()
    }

    /// A depth as it is given out, of one as it was decoded.
    pub(super) fn value(&self, depth: f32) -> f32 {
        self.fit.map_or(depth.max(NEAREST), |fit| fit.apply(depth))
    }

    /// How many maps there are.
    #[must_use]
    pub fn len(&self) -> usize {
        self.frames.frames()
    }

    /// Whether no depth was reconstructed.
    #[must_use]
    pub fn is_empty(&self) -> bool {
        self.len() == 0
    }

    /// One map after the other, `[height, width]`: metres where [`Depth::scale`] is metric. They are read one at a time, so that
    /// memory does not grow where depth is held on disk.
    ///
    /// # Errors
    /// When the disk cannot be read.
    pub fn frames(&self) -> impl Iterator<Item = std::io::Result<Array2<f32>>> + '_ {
        let of = |depth: f32| self.value(depth);
        (0..self.len()).map(move |index| Ok(self.frames.frame(index)?.mapv(of)))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_joint_is_found_by_name_between_samples_and_only_where_it_is_known() {
        let mut samples = vec![[[0.0; 3]; 21]; 3];
        for (t, sample) in samples.iter_mut().enumerate() {
            sample[19] = [t as f32, 0.0, 1.0];
        }
        samples[2][20] = [f32::NAN; 3];
        let body: Motion<'_, Joint> = Motion::of(&samples);
        let left = |seconds| body.position(Joint::LeftWrist, seconds);
        assert_eq!(left(0.5 / 30.0), Ok([0.5, 0.0, 1.0]));
        assert_eq!(left(0.1), Ok([2.0, 0.0, 1.0]));
        assert!(matches!(left(0.2), Err(NotKnown::Outside { .. })));
        assert!(matches!(left(f64::NAN), Err(NotKnown::Outside { .. })));
        let right = |seconds| body.position(Joint::RightWrist, seconds);
        assert!(right(1.0 / 30.0).is_ok());
        assert!(matches!(right(0.05), Err(NotKnown::Invalid { .. })));
        let none: Motion<'_, Joint> = Motion::of(&[]);
        assert_eq!(none.position(Joint::Head, 0.0), Err(NotKnown::Absent));
    }
}
