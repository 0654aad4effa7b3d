//! Eye gaze of Machine Perception Services, in its three column sets: one yaw; a yaw per eye with one pitch; a yaw and a pitch per
//! eye (gen2).
//!
//! Directions are in the central pupil frame: x left, y up, z forward; direction = (tan yaw, tan pitch, 1). Where that frame
//! lies on the device is a constant of the frame's size, known from Aria's CAD.

use crate::datasets::csv::{Column, Row, Table};
use crate::datasets::track::{Blend, SECOND, Track};
use crate::formats::ReadError;
use crate::formats::read_error::Position;
use nalgebra::{Isometry3, Point3, Quaternion, Translation3, UnitQuaternion, Vector3};
use std::collections::BTreeMap;
use std::path::Path;

/// Gaze comes at 10 or 30 Hz; one lost row at 10 Hz is bridged.
const MAX_GAP: i64 = SECOND / 4;
const HOLD: i64 = SECOND / 20;
/// Half the distance between the eyes that the service assumes, metres.
const HALF_EYES: f64 = 0.0315;

/// Where the wearer looks, on the device.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Gaze {
    /// Radians, positive to the left.
    pub yaw: f64,
    /// Radians, positive up.
    pub pitch: f64,
    /// Metres along the ray, where the eyes converge; NaN when unknown.
    pub depth: f64,
}

impl Blend for Gaze {
    fn blend(&self, other: &Self, weight: f64) -> Option<Self> {
        let mix = |a: f64, b: f64| a + weight * (b - a);
        Some(Gaze {
            yaw: mix(self.yaw, other.yaw),
            pitch: mix(self.pitch, other.pitch),
            depth: mix(self.depth, other.depth),
        })
    }
}

impl Gaze {
    /// The point looked at in the device frame, `distance` metres along the ray.
    #[must_use]
    pub fn point(&self, T_device_pupils: &Isometry3<f64>, distance: f64) -> Point3<f64> {
        let direction = Vector3::new(self.yaw.tan(), self.pitch.tan(), 1.0).normalize();
        T_device_pupils * Point3::from(direction * distance)
    }
}

/// Whether the tags of a VRS file say that the glasses have the large frame; without the tag they count as small.
#[must_use]
pub fn large_frame(tags: &BTreeMap<String, String>) -> bool {
    tags.get("hardware_version")
        .is_some_and(|version| version == "DVT-L")
}

/// The central pupil frame on the device.
#[must_use]
pub fn pupils_on_device(large_frame: bool) -> Isometry3<f64> {
    let rotation = UnitQuaternion::from_quaternion(Quaternion::new(
        0.663_401_46,
        0.209_686_51,
        -0.244_741_70,
        0.675_301_09,
    ));
    let translation = if large_frame {
        Translation3::new(0.004_993_02, -0.051_460_09, -0.049_949_88)
    } else {
        Translation3::new(0.004_952_96, -0.049_148_37, -0.049_185_46)
    };
    Isometry3::from_parts(translation, rotation)
}

enum Columns {
    One {
        yaw: Column,
        pitch: Column,
    },
    PerEye {
        left: Column,
        right: Column,
        pitch: Pitch,
    },
}

enum Pitch {
    Shared(Column),
    PerEye(Column, Column),
}

/// Reads gaze over device time; rows without a direction are left out.
///
/// # Errors
/// When the table is damaged or has none of the three column sets.
pub fn read(path: &Path) -> Result<Track<Gaze>, ReadError> {
    let mut table = Table::open(path)?;
    let time = table.column("tracking_timestamp_us")?;
    let depth = table.find("depth_m");
    let columns = match (
        table.find("yaw_rads_cpf"),
        table.find("left_yaw_rads_cpf"),
        table.find("left_pitch_rads_cpf"),
    ) {
        (Some(yaw), _, _) => Columns::One {
            yaw,
            pitch: table.column("pitch_rads_cpf")?,
        },
        (None, Some(left), Some(left_pitch)) => Columns::PerEye {
            left,
            right: table.column("right_yaw_rads_cpf")?,
            pitch: Pitch::PerEye(left_pitch, table.column("right_pitch_rads_cpf")?),
        },
        (None, Some(left), None) => Columns::PerEye {
            left,
            right: table.column("right_yaw_rads_cpf")?,
            pitch: Pitch::Shared(table.column("pitch_rads_cpf")?),
        },
        (None, None, _) => {
            return Err(ReadError::malformed(
                path,
                Position::Line(1),
                "there is neither a column `yaw_rads_cpf` nor `left_yaw_rads_cpf`",
            ));
        }
    };
    let mut samples = Vec::new();
    while let Some(row) = table.next_row() {
        let row = row?;
        let time = row
            .integer(time)?
            .checked_mul(1000)
            .ok_or_else(|| row.error("a time beyond all clocks".to_owned()))?;
        let (yaw, pitch) = direction(&columns, &row)?;
        let depth = match depth {
            Some(column) => row.number(column)?,
            None => f64::NAN,
        };
        if yaw.is_finite() && pitch.is_finite() {
            samples.push((
                time,
                Gaze {
                    yaw,
                    pitch,
                    depth: if depth > 0.0 { depth } else { f64::NAN },
                },
            ));
        }
    }
    Ok(Track::new(samples, MAX_GAP, HOLD))
}

fn direction(columns: &Columns, row: &Row) -> Result<(f64, f64), ReadError> {
    match columns {
        Columns::One { yaw, pitch } => Ok((row.number(*yaw)?, row.number(*pitch)?)),
        Columns::PerEye { left, right, pitch } => {
            let yaw = combined_yaw(row.number(*left)?, row.number(*right)?);
            let pitch = match pitch {
                Pitch::Shared(pitch) => row.number(*pitch)?,
                Pitch::PerEye(left, right) => {
                    f64::midpoint(row.number(*left)?, row.number(*right)?)
                }
            };
            Ok((yaw, pitch))
        }
    }
}

/// The yaw of the point where the rays of both eyes meet, seen from between them. Eyes that diverge meet behind the head; the
/// arc tangent of the ratio still gives the direction forward.
#[must_use]
pub fn combined_yaw(left: f64, right: f64) -> f64 {
    let z = 2.0 * HALF_EYES / (right.tan() - left.tan());
    if !z.is_finite() {
        return left;
    }
    let x = HALF_EYES + z * left.tan();
    (x / z).atan()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn two_eyes_become_the_direction_between_them() {
        // A point 0.5 m ahead and 0.1 m to the left: x is left, the left eye stands at +31.5 mm.
        let (x, z) = (0.1, 0.5);
        let left = ((x - HALF_EYES) / z).atan();
        let right = ((x + HALF_EYES) / z).atan();
        assert!((combined_yaw(left, right) - (x / z).atan()).abs() < 1e-12);
        // Diverging eyes look forward all the same.
        assert!(combined_yaw(right, left).abs() < 0.5);
        assert_eq!(combined_yaw(0.3, 0.3), 0.3);
    }
}
