//! What `recording.yaml` says, as it is written.

use crate::geometry::skeleton::{BODY_FROM_SMPL22, COMMON_FROM_HOLOLENS, HAND_FROM_COMMON};
use nalgebra::{Matrix3, Vector3};
use serde::Deserialize;
use std::path::PathBuf;

#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct Manifest {
    pub(super) format: String,
    /// The data set; becomes the source of the clips.
    #[serde(default)]
    pub(super) source: Option<String>,
    #[serde(default)]
    pub(super) name: Option<String>,
    #[serde(default)]
    pub(super) colour: Option<ColourEntry>,
    #[serde(default)]
    pub(super) depth: Option<DepthEntry>,
    #[serde(default)]
    pub(super) camera: Option<CameraEntry>,
    #[serde(default)]
    pub(super) gaze: Option<GazeEntry>,
    #[serde(default)]
    pub(super) left_hand: Option<JointEntry>,
    #[serde(default)]
    pub(super) right_hand: Option<JointEntry>,
    #[serde(default)]
    pub(super) body: Option<JointEntry>,
}

#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct ColourEntry {
    /// A video, or a folder of png or jpg pictures.
    pub(super) file: PathBuf,
    /// Seconds of the first frame on the recording's clock.
    #[serde(default)]
    pub(super) start: f64,
    /// Frames per second; needed for a folder, else the video says it.
    #[serde(default)]
    pub(super) rate: Option<f64>,
    /// Degrees clockwise that make the pictures upright.
    #[serde(default)]
    pub(super) turn: u32,
    #[serde(default)]
    pub(super) lens: Option<LensEntry>,
}

#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields, tag = "model", rename_all = "snake_case")]
pub(super) enum LensEntry {
    /// `fx fy cx cy` in pixels of the stored pictures.
    Pinhole {
        parameters: [f64; 4],
        size: [u32; 2],
    },
    /// `fx fy cx cy k0..k3`
    KannalaBrandt {
        parameters: [f64; 8],
        size: [u32; 2],
    },
    /// `fx fy cx cy k1 k2 p1 p2 k3 k4 k5 k6`, OpenCV's rational model
    Rational {
        parameters: [f64; 12],
        size: [u32; 2],
    },
    /// `f cx cy k0..k5 p0 p1 s0..s3`
    Fisheye624 {
        parameters: [f64; 15],
        size: [u32; 2],
    },
}

#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct DepthEntry {
    /// An array `[T, H, W]`, or a folder of 16-bit png pictures.
    pub(super) file: PathBuf,
    #[serde(default)]
    pub(super) key: Option<String>,
    pub(super) unit: LengthUnit,
    #[serde(default)]
    pub(super) start: f64,
    #[serde(default)]
    pub(super) rate: Option<f64>,
    #[serde(default)]
    pub(super) times: Option<String>,
}

#[derive(Debug, Clone, Copy, Deserialize)]
pub(super) enum LengthUnit {
    #[serde(rename = "m")]
    Metres,
    #[serde(rename = "mm")]
    Millimetres,
}

impl LengthUnit {
    pub(super) fn metres(self) -> f64 {
        match self {
            LengthUnit::Metres => 1.0,
            LengthUnit::Millimetres => 1e-3,
        }
    }
}

/// Which array, and when its rows were taken: `rate` with `start`, or `times` (seconds, an array of the same file).
#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct CameraEntry {
    pub(super) file: PathBuf,
    #[serde(default)]
    pub(super) key: Option<String>,
    #[serde(default)]
    pub(super) start: f64,
    #[serde(default)]
    pub(super) rate: Option<f64>,
    #[serde(default)]
    pub(super) times: Option<String>,
    pub(super) direction: Direction,
    pub(super) axes: Axes,
    /// Against gravity, in the world.
    #[serde(default)]
    pub(super) up: Option<[f64; 3]>,
}

#[derive(Debug, Clone, Copy, Deserialize)]
#[serde(rename_all = "snake_case")]
pub(super) enum Direction {
    CameraToWorld,
    WorldToCamera,
}

#[derive(Debug, Clone, Copy, Deserialize)]
#[serde(rename_all = "lowercase")]
pub(super) enum Axes {
    /// x right, y down, z forward.
    Opencv,
    /// x right, y up, z backward.
    Opengl,
    /// x forward, y left, z up.
    Psi,
}

impl Axes {
    /// Columns: the axes of OpenCV in these.
    pub(super) fn opencv_in(self) -> Matrix3<f64> {
        match self {
            Axes::Opencv => Matrix3::identity(),
            Axes::Opengl => Matrix3::from_diagonal(&Vector3::new(1.0, -1.0, -1.0)),
            Axes::Psi => Matrix3::new(0.0, 0.0, 1.0, -1.0, 0.0, 0.0, 0.0, -1.0, 0.0),
        }
    }
}

#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct GazeEntry {
    pub(super) file: PathBuf,
    #[serde(default)]
    pub(super) key: Option<String>,
    #[serde(default)]
    pub(super) start: f64,
    #[serde(default)]
    pub(super) rate: Option<f64>,
    #[serde(default)]
    pub(super) times: Option<String>,
    /// `pixel` of the upright picture of `size`, or `fraction` of its width and height.
    pub(super) unit: GazeUnit,
    /// Width and height of the upright picture.
    pub(super) size: [u32; 2],
}

#[derive(Debug, Clone, Copy, Deserialize)]
#[serde(rename_all = "lowercase")]
pub(super) enum GazeUnit {
    Pixel,
    Fraction,
}

#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct JointEntry {
    pub(super) file: PathBuf,
    #[serde(default)]
    pub(super) key: Option<String>,
    #[serde(default)]
    pub(super) start: f64,
    #[serde(default)]
    pub(super) rate: Option<f64>,
    #[serde(default)]
    pub(super) times: Option<String>,
    pub(super) unit: LengthUnit,
    pub(super) frame: JointFrameEntry,
    pub(super) order: JointOrder,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq, Deserialize)]
#[serde(rename_all = "lowercase")]
pub(super) enum JointFrameEntry {
    World,
    /// Hands only: the upright camera of the same moment.
    Camera,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq, Deserialize)]
#[serde(rename_all = "lowercase")]
pub(super) enum JointOrder {
    /// Ours, 21 joints.
    Reviv,
    /// Hands: wrist, thumb, index, middle, ring, pinky from knuckle to tip.
    Common,
    /// Body: the 22 joints of SMPL.
    Smpl22,
    /// Hands: the 26 joints of HoloLens 2.
    Hololens,
}

impl JointOrder {
    /// For each of our joints the one in this order.
    pub(super) fn map(self) -> ([usize; 21], usize) {
        match self {
            JointOrder::Reviv => (std::array::from_fn(|k| k), 21),
            JointOrder::Common => (HAND_FROM_COMMON, 21),
            JointOrder::Smpl22 => (BODY_FROM_SMPL22, 22),
            JointOrder::Hololens => (HAND_FROM_COMMON.map(|k| COMMON_FROM_HOLOLENS[k]), 26),
        }
    }
}
