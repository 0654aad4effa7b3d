//! Aria's calibration JSON: factory calibration in VRS files, one line a moment in `online_calibration.jsonl`.

use crate::formats::ReadError;
use crate::formats::read_error::Position;
use crate::formats::text::{Lines, json_line};
use crate::geometry::camera::{Camera, Fisheye624, Lens};
use nalgebra::{Isometry3, Quaternion, Translation3, UnitQuaternion};
use serde::Deserialize;
use std::path::Path;

/// A camera of the device.
#[derive(Debug, Clone, PartialEq)]
pub struct DeviceCamera {
    /// On the grid of the stored image.
    pub camera: Camera,
    /// From the camera's `OpenCV` axes (of the stored, unturned image) to the device's, metres.
    pub T_device_camera: Isometry3<f64>,
}

#[derive(Deserialize)]
struct Calibration {
    tracking_timestamp_us: Option<i64>,
    #[serde(rename = "CameraCalibrations")]
    cameras: Vec<CameraCalibration>,
}

#[derive(Deserialize)]
struct CameraCalibration {
    #[serde(rename = "Label")]
    label: String,
    #[serde(rename = "Projection")]
    projection: Projection,
    #[serde(rename = "T_Device_Camera")]
    pose: Pose,
}

#[derive(Deserialize)]
struct Projection {
    #[serde(rename = "Name")]
    name: String,
    #[serde(rename = "Params")]
    parameters: Vec<f64>,
}

#[derive(Deserialize)]
struct Pose {
    #[serde(rename = "Translation")]
    translation: [f64; 3],
    #[serde(rename = "UnitQuaternion")]
    quaternion: (f64, [f64; 3]),
}

/// A rotation from a quaternion that a file claims to be of unit length.
pub fn unit_quaternion(w: f64, x: f64, y: f64, z: f64) -> Option<UnitQuaternion<f64>> {
    let quaternion = Quaternion::new(w, x, y, z);
    let norm = quaternion.norm();
    // Written with six digits or more; anything else is no rotation.
    (norm.is_finite() && (norm - 1.0).abs() < 1e-2)
        .then(|| UnitQuaternion::from_quaternion(quaternion))
}

impl Pose {
    fn isometry(&self) -> Option<Isometry3<f64>> {
        let (w, [x, y, z]) = self.quaternion;
        let [tx, ty, tz] = self.translation;
        Some(Isometry3::from_parts(
            Translation3::new(tx, ty, tz),
            unit_quaternion(w, x, y, z)?,
        ))
    }
}

/// The colour camera on an image of `side` x `side` pixels, from the text of a calibration.
///
/// # Errors
/// A sentence that says what is wrong.
pub fn colour_camera(text: &str, side: u32) -> Result<DeviceCamera, String> {
    let calibration: Calibration = serde_json::from_str(text).map_err(|error| error.to_string())?;
    find_colour(&calibration, side)
}

fn find_colour(calibration: &Calibration, side: u32) -> Result<DeviceCamera, String> {
    let camera = calibration
        .cameras
        .iter()
        .find(|camera| camera.label == "camera-rgb")
        .ok_or("there is no camera `camera-rgb`")?;
    if camera.projection.name != "FisheyeRadTanThinPrism" {
        return Err(format!(
            "projection `{}` of camera-rgb is not read",
            camera.projection.name
        ));
    }
    let lens = Fisheye624::from_parameters(&camera.projection.parameters)
        .ok_or("camera-rgb has parameters that are no lens")?;
    let T_device_camera = camera
        .pose
        .isometry()
        .ok_or("camera-rgb has a pose that is no rotation")?;
    Ok(DeviceCamera {
        camera: on_image(lens, side)?,
        T_device_camera,
    })
}

/// The colour sensor has 2880 pixels a side, with f about 1220; stored images are its middle 2816 pixels binned by two (1408)
/// or four (704). Which grid a calibration speaks of is not written in it: the focal length tells.
fn on_image(lens: Fisheye624, side: u32) -> Result<Camera, String> {
    // A third octave around each of the three focal lengths that occur.
    let grid = match lens.fx {
        f if (1000.0..1500.0).contains(&f) => 2880,
        f if (500.0..750.0).contains(&f) => 1408,
        f if (250.0..375.0).contains(&f) => 704,
        f => {
            return Err(format!(
                "camera-rgb has a focal length of {f} pixels, which no Aria grid has"
            ));
        }
    };
    let full = Camera {
        lens: Lens::Fisheye624(lens),
        width: grid,
        height: grid,
        valid_radius: Some(match grid {
            2880 => 1415.0,
            1408 => 707.5,
            _ => 353.75,
        }),
    };
    match (grid, side) {
        (2880, 2880) | (1408, 1408) | (704, 704) => Ok(full),
        (2880, 1408) => Ok(full.cropped(32.0, 32.0, 2816, 2816).resized(0.5)),
        (2880, 704) => Ok(full.cropped(32.0, 32.0, 2816, 2816).resized(0.25)),
        (1408, 704) => Ok(full.resized(0.5)),
        (704, 1408) => Ok(full.resized(2.0)),
        _ => Err(format!(
            "images of {side} pixels a side do not fit a calibration for {grid}"
        )),
    }
}

/// The colour camera over time (nanoseconds on the device's clock), from `online_calibration.jsonl`.
///
/// # Errors
/// When a line is damaged; it is named.
pub fn online(path: &Path, side: u32) -> Result<Vec<(i64, DeviceCamera)>, ReadError> {
    let mut cameras = Vec::new();
    for line in Lines::open(path)? {
        let (number, text) = line?;
        let Some(text) = json_line(&text) else {
            continue;
        };
        let fail = |reason: String| ReadError::malformed(path, Position::Line(number), reason);
        let calibration: Calibration =
            serde_json::from_str(text).map_err(|error| fail(error.to_string()))?;
        let time = calibration
            .tracking_timestamp_us
            .and_then(|us| us.checked_mul(1000))
            .ok_or_else(|| fail("there is no `tracking_timestamp_us`".to_owned()))?;
        cameras.push((time, find_colour(&calibration, side).map_err(fail)?));
    }
    if cameras.is_empty() {
        return Err(ReadError::malformed(
            path,
            Position::File,
            "there is no calibration in it",
        ));
    }
    cameras.sort_by_key(|(time, _)| *time);
    Ok(cameras)
}
