//! The values of the built-in modalities, and [`Signal`], the value of every modality that brings none of its own.
//!
//! In shards: `rgb {frames, rate}`, `depth {metres, rate}`, `camera {T_world_camera [T,4,4], valid, rate, up_world?, intrinsics?
//! (fx fy cx cy width height)}`, `gaze {points, valid, rate}`, hands and body `{joints, valid, rate}`, signals `{values, valid?}`.

use super::value::{Arrays, Value, expect_shape};
use crate::geometry::rigid::{self, PoseError};
use crate::modality::camera::row_to_pose;
use nalgebra::{Isometry3, Matrix3, Unit, Vector3};
use ndarray::{Array1, Array2, Array3, Array4, ArrayD, Ix1, Ix2, Ix3};

/// Colour video, upright, square.
#[derive(Debug, Clone, PartialEq)]
pub struct Rgb {
    /// Hz.
    pub rate: f64,
    /// `[T, H, W, 3]`, sRGB.
    pub frames: Array4<u8>,
}

impl Value for Rgb {
    const VALUES: &'static str = "frames";

    fn to_arrays(&self) -> Arrays {
        Arrays::new(&self.frames).rate(self.rate)
    }

    fn from_arrays(arrays: &Arrays) -> Result<Self, String> {
        Ok(Self {
            rate: arrays.read_rate()?,
            frames: arrays.read()?,
        })
    }
}

/// Depth along the optical axis, aligned with the colour video.
#[derive(Debug, Clone, PartialEq)]
pub struct Depth {
    /// Hz.
    pub rate: f64,
    /// `[T, H, W]`, metres of z-depth; NaN where nothing was measured.
    pub metres: Array3<f32>,
}

impl Value for Depth {
    const VALUES: &'static str = "metres";

    fn to_arrays(&self) -> Arrays {
        Arrays::new(&self.metres).rate(self.rate)
    }

    fn from_arrays(arrays: &Arrays) -> Result<Self, String> {
        Ok(Self {
            rate: arrays.read_rate()?,
            metres: arrays.read()?,
        })
    }
}

/// The head camera: where it is, and how it projects.
#[derive(Debug, Clone, PartialEq)]
pub struct CameraTrack {
    /// Hz.
    pub rate: f64,
    /// `T_world_camera` per sample; `OpenCV` axes (x right, y down, z forward) of the upright image.
    pub T_world_camera: Vec<Isometry3<f64>>,
    /// `[T]`.
    pub valid: Vec<bool>,
    /// Up (against gravity) in the world of the poses, unit length; `None` where the source does not know it.
    pub up_world: Option<Unit<Vector3<f64>>>,
    /// Pinhole intrinsics of the clip's square frames, in pixels of their resolution.
    pub intrinsics: Option<Intrinsics>,
}

/// Pinhole intrinsics in pixels; the centre of the top-left pixel is (0, 0).
#[derive(
    Debug, Clone, Copy, PartialEq, serde::Serialize, serde::Deserialize, schemars::JsonSchema,
)]
#[serde(deny_unknown_fields)]
pub struct Intrinsics {
    /// Focal length along x, pixels.
    pub fx: f64,
    /// Focal length along y, pixels.
    pub fy: f64,
    /// Column of the principal point, pixels.
    pub cx: f64,
    /// Row of the principal point, pixels.
    pub cy: f64,
    /// Width of the pictures that these numbers are for, pixels.
    pub width: u32,
    /// Height of the pictures that these numbers are for, pixels.
    pub height: u32,
}

impl Value for CameraTrack {
    const VALUES: &'static str = "T_world_camera";

    fn to_arrays(&self) -> Arrays {
        let mut arrays = Arrays::new(pose_matrices(&self.T_world_camera))
            .valid(Array1::from(self.valid.clone()))
            .rate(self.rate);
        if let Some(up) = &self.up_world {
            arrays = arrays.with("up_world", Array1::from(vec![up.x, up.y, up.z]));
        }
        if let Some(k) = &self.intrinsics {
            let size = [k.width, k.height].map(f64::from);
            let values = vec![k.fx, k.fy, k.cx, k.cy, size[0], size[1]];
            arrays = arrays.with("intrinsics", Array1::from(values));
        }
        arrays
    }

    /// Other programs may give `[T, 9]` (two rotation columns, made orthonormal, and the translation), and a pose that is not
    /// finite where they know none: it becomes one without a place, so that scoring refuses it where something is scored.
    fn from_arrays(arrays: &Arrays) -> Result<Self, String> {
        let name = &arrays.name;
        let count = arrays.values.shape.first().copied().unwrap_or(0);
        let valid = arrays.read_valid::<Ix1>(&[count])?.to_vec();
        let nowhere = || Isometry3::translation(f64::NAN, f64::NAN, f64::NAN);
        let poses: Result<Vec<_>, String> = if arrays.foreign && arrays.values.shape.len() == 2 {
            let rows = arrays.read::<f64, Ix2>()?;
            expect_shape(name, &[rows.ncols()], &[9])?;
            let pose = |(t, row): (usize, ndarray::ArrayView1<f64>)| {
                if !row.iter().all(|value| value.is_finite()) {
                    return Ok(nowhere());
                }
                row_to_pose(&std::array::from_fn(|c| row[c])).ok_or_else(|| {
                    format!("array `{name}`: the rotation of pose {t} has no direction")
                })
            };
            rows.outer_iter().enumerate().map(pose).collect()
        } else {
            let matrices = arrays.read::<f64, Ix3>()?;
            expect_shape(name, matrices.shape(), &[count, 4, 4])?;
            let pose = |(t, matrix): (usize, ndarray::ArrayView2<f64>)| {
                let flat = std::array::from_fn(|k| matrix[[k / 4, k % 4]]);
                let turn = Matrix3::from_fn(|r, c| matrix[[r, c]]);
                match rigid::from_row_major(&flat) {
                    Err(PoseError::NotFinite) if arrays.foreign => Ok(nowhere()),
                    Err(_) if !arrays.foreign && !valid[t] => Ok(Isometry3::identity()),
                    Ok(_)
                        if arrays.foreign
                            && (turn.transpose() * turn - Matrix3::identity()).amax() > 1e-4 =>
                    {
                        Err(format!(
                            "array `{name}`: pose {t}: its rotation part is not a rotation (1e-4)"
                        ))
                    }
                    found => found.map_err(|e| format!("array `{name}`: pose {t}: {e}")),
                }
            };
            matrices.outer_iter().enumerate().map(pose).collect()
        };
        let numbers = |name: &str, count: usize| -> Result<Option<Vec<f64>>, String> {
            let Some(array) = arrays.more.arrays.get(name) else {
                return Ok(None);
            };
            let refuse = |reason: &str| format!("array `{name}`: {reason}");
            let values = array.to_dim::<f64, Ix1>();
            let values = values.map_err(|e| refuse(&e.to_string()))?.to_vec();
            expect_shape(name, &[values.len()], &[count])?;
            if !values.iter().all(|v| v.is_finite()) {
                return Err(refuse("a value is not finite"));
            }
            Ok(Some(values))
        };
        let up = numbers("up_world", 3)?.map(|v| Vector3::new(v[0], v[1], v[2]));
        if up.is_some_and(|up| (up.norm() - 1.0).abs() > 1e-3) {
            return Err("array `up_world`: not of unit length".to_owned());
        }
        let intrinsics = numbers("intrinsics", 6)?.map(|v| Intrinsics {
            fx: v[0],
            fy: v[1],
            cx: v[2],
            cy: v[3],
            width: v[4] as u32,
            height: v[5] as u32,
        });
        Ok(Self {
            rate: arrays.read_rate()?,
            T_world_camera: poses?,
            valid,
            up_world: up.map(Unit::new_unchecked),
            intrinsics,
        })
    }
}

/// Poses as `[T, 4, 4]`.
#[must_use]
pub fn pose_matrices(poses: &[Isometry3<f64>]) -> Array3<f64> {
    let flat = poses.iter().flat_map(rigid::to_row_major).collect();
    Array3::from_shape_vec((poses.len(), 4, 4), flat).expect("sixteen numbers per pose")
}

/// Where the wearer looks, in the upright square image.
#[derive(Debug, Clone, PartialEq)]
pub struct GazeTrack {
    /// Hz.
    pub rate: f64,
    /// `[T, 2]`: x right, y down, the image is `[0, 1]^2`.
    pub points: Array2<f32>,
    /// `[T]`.
    pub valid: Array1<bool>,
}

impl Value for GazeTrack {
    const VALUES: &'static str = "points";

    fn to_arrays(&self) -> Arrays {
        Arrays::new(&self.points).valid(&self.valid).rate(self.rate)
    }

    fn from_arrays(arrays: &Arrays) -> Result<Self, String> {
        let points = arrays.read::<f32, Ix2>()?;
        expect_shape(&arrays.name, &[points.ncols()], &[2])?;
        Ok(Self {
            rate: arrays.read_rate()?,
            valid: arrays.read_valid(&[points.nrows()])?,
            points,
        })
    }
}

/// Joints over time. Hands: camera frame of the same sample. Body: gravity frame of the clip's first camera.
#[derive(Debug, Clone, PartialEq)]
pub struct JointTrack {
    /// Hz.
    pub rate: f64,
    /// `[T, 21, 3]`, metres, in the order of [`crate::geometry::skeleton`].
    pub joints: Array3<f32>,
    /// `[T, 21]`.
    pub valid: Array2<bool>,
}

impl Value for JointTrack {
    const VALUES: &'static str = "joints";

    fn to_arrays(&self) -> Arrays {
        Arrays::new(&self.joints).valid(&self.valid).rate(self.rate)
    }

    fn from_arrays(arrays: &Arrays) -> Result<Self, String> {
        let joints = arrays.read::<f32, Ix3>()?;
        let (frames, count, axes) = joints.dim();
        expect_shape(&arrays.name, &[axes], &[3])?;
        Ok(Self {
            rate: arrays.read_rate()?,
            valid: arrays.read_valid(&[frames, count])?,
            joints,
        })
    }
}

/// A modality's values as its tokenizer sees them, before normalisation: the common currency of tokenizers, decoding,
/// reconstruction and evaluation.
#[derive(Debug, Clone, PartialEq)]
pub struct Signal {
    /// Camera `[T, 9]`, gaze `[T, 2]`, joints `[T, 21, 3]`, video `[T, H, W, 3]` in [-1, 1], declared `[T, C]`.
    pub values: ArrayD<f32>,
    /// The shape of `values` without its last axis (gaze `[T]`, joints `[T, 21]`); `None` means all valid.
    pub valid: Option<ArrayD<bool>>,
}

impl Value for Signal {
    fn to_arrays(&self) -> Arrays {
        let arrays = Arrays::new(&self.values);
        match &self.valid {
            Some(valid) => arrays.valid(valid),
            None => arrays,
        }
    }

    fn from_arrays(arrays: &Arrays) -> Result<Self, String> {
        let refuse = |error| format!("array `{}`: {error}", arrays.name);
        let values: ArrayD<f32> = arrays.values.to().map_err(refuse)?;
        let shape = &values.shape()[..values.ndim().saturating_sub(1)];
        let valid = arrays.valid.as_ref().map(|_| arrays.read_valid(shape));
        Ok(Self {
            valid: valid.transpose()?,
            values,
        })
    }
}
