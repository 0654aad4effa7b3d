//! The tables of a session: camera poses, hands, eyes, and the two small files about the video.

use super::rows::{Row, each_line, each_row};
use crate::datasets::track::Joints;
use crate::formats::ReadError;
use crate::formats::read_error::Position;
use crate::geometry::camera::Pinhole;
use crate::geometry::rigid::{self, PoseError};
use crate::geometry::skeleton::{COMMON_FROM_HOLOLENS, HAND_FROM_COMMON};
use nalgebra::{Isometry3, Matrix3, Point3, Rotation3, UnitQuaternion, Vector3};
use std::path::Path;

/// Joints of a hand of HoloLens 2.
const JOINTS: usize = 26;
/// Numbers of a joint: a 4 x 4 matrix, row by row.
const MATRIX: usize = 16;
/// What follows the columns about the whole hand: joints, then a valid and a tracked flag per joint.
const AFTER_STATE: usize = JOINTS * MATRIX + 2 * JOINTS;

/// A row of `Pose_sync.txt`.
pub(super) struct PoseRow {
    /// On the shared clock, nanoseconds.
    pub time: i64,
    /// Of the picture.
    pub tick: i64,
    /// `None` where the stream had none.
    pub T_world_camera: Option<Isometry3<f64>>,
}

/// Camera poses in `OpenCV` axes.
pub(super) fn poses(path: &Path) -> Result<Vec<PoseRow>, ReadError> {
    // Platform for Situated Intelligence: x forward, y left, z up.
    let axes = Matrix3::new(0.0, 0.0, 1.0, -1.0, 0.0, 0.0, 0.0, -1.0, 0.0);
    let opencv = UnitQuaternion::from_rotation_matrix(&Rotation3::from_matrix_unchecked(axes));
    let mut rows: Vec<PoseRow> = Vec::new();
    each_row(path, &|columns| columns == 2 + MATRIX, |time, row| {
        let tick = row.tick(1)?;
        if rows.last().is_some_and(|last| last.tick > tick) {
            return Err(row.error("its tick is before that of the row before".to_owned()));
        }
        let matrix = row.numbers::<MATRIX>(2)?;
        let pose = match rigid::from_row_major(&matrix) {
            Ok(pose) => Some(pose * opencv),
            Err(PoseError::NotFinite) => None,
            Err(_) if matrix.iter().all(|value| *value == 0.0) => None,
            Err(error) => return Err(row.error(error.to_string())),
        };
        rows.push(PoseRow {
            time,
            tick,
            T_world_camera: pose,
        });
        Ok(())
    })?;
    Ok(rows)
}

/// One hand over time, in the world.
pub(super) struct Hand {
    /// Of the last row, whether the hand is in it or not, nanoseconds.
    pub last: i64,
    pub samples: Vec<(i64, Joints)>,
    /// Not one joint of one row is flagged as valid: the export did not fill the flags.
    pub flags_unused: bool,
}

/// Columns: time, tick, one to four about the whole hand (`IsActive`; an older export has three others), 26 joints, 52 flags.
pub(super) fn hand(path: &Path) -> Result<Hand, ReadError> {
    let state_columns = |columns: usize| columns.checked_sub(AFTER_STATE + 2);
    let fits = |columns: usize| state_columns(columns).is_some_and(|n| (1..=4).contains(&n));
    let mut samples: Vec<(i64, Joints, u32)> = Vec::new();
    let mut last = i64::MIN;
    each_row(path, &fits, |time, row| {
        last = time;
        let first = row.len() - AFTER_STATE;
        let mut active = false;
        for column in 2..first {
            active |= row.flag(column)?;
        }
        let mut joints: Joints = [None; 21];
        let mut flags = 0;
        for (at, joint) in HAND_FROM_COMMON
            .map(|common| COMMON_FROM_HOLOLENS[common])
            .into_iter()
            .enumerate()
        {
            joints[at] = position(row, first + joint * MATRIX)?;
            let valid = row.flag(first + JOINTS * MATRIX + joint)?;
            flags |= u32::from(valid) << at;
        }
        // A hand that is not tracked is NaN, or all its joints lie in one place.
        let mut known = joints.iter().flatten();
        let first = known.next();
        let together = first.is_none_or(|first| known.all(|joint| joint == first));
        if active && !together {
            samples.push((time, joints, flags));
        }
        Ok(())
    })?;
    let flags_unused = !samples.is_empty() && samples.iter().all(|(_, _, flags)| *flags == 0);
    let samples = samples
        .into_iter()
        .map(|(time, mut joints, flags)| {
            for (at, joint) in joints.iter_mut().enumerate() {
                if !flags_unused && flags >> at & 1 == 0 {
                    *joint = None;
                }
            }
            (time, joints)
        })
        .collect();
    Ok(Hand {
        last,
        samples,
        flags_unused,
    })
}

/// The last column of a matrix; `None` where it is not finite.
fn position(row: &Row<'_>, first: usize) -> Result<Option<Point3<f64>>, ReadError> {
    let point = Point3::new(
        row.number(first + 3)?,
        row.number(first + 7)?,
        row.number(first + 11)?,
    );
    Ok(point.iter().all(|value| value.is_finite()).then_some(point))
}

/// Time, origin and unit direction of a ray.
pub(super) type Ray = (i64, Point3<f64>, Vector3<f64>);

/// The rays that are known.
pub(super) fn rays(path: &Path) -> Result<Vec<Ray>, ReadError> {
    let mut rays = Vec::new();
    each_row(path, &|columns| matches!(columns, 8 | 9), |time, row| {
        row.tick(1)?;
        let [ox, oy, oz, x, y, z] = row.numbers::<6>(2)?;
        // The last column, where there is one, says whether the eyes are calibrated.
        let calibrated = row.len() < 9 || row.flag(8)?;
        let origin = Point3::new(ox, oy, oz);
        let direction = Vector3::new(x, y, z).try_normalize(1e-6);
        if let Some(direction) = direction
            && calibrated
            && origin.iter().chain(direction.iter()).all(|v| v.is_finite())
        {
            rays.push((time, origin, direction));
        }
        Ok(())
    })?;
    Ok(rays)
}

/// Pixels as the official script writes them: its tick is a rounded float, and is not used.
pub(super) fn pixels(path: &Path) -> Result<Vec<(i64, [f64; 2])>, ReadError> {
    let mut pixels = Vec::new();
    each_row(path, &|columns| columns == 4, |time, row| {
        let pixel = row.numbers::<2>(2)?;
        if pixel.iter().all(|value| value.is_finite()) {
            pixels.push((time, pixel));
        }
        Ok(())
    })?;
    Ok(pixels)
}

/// The lens of the full picture; the official code ignores its distortion.
#[derive(Debug, Clone, Copy)]
pub(super) struct Intrinsics {
    pub lens: Pinhole,
    pub width: u32,
    pub height: u32,
}

impl Intrinsics {
    /// Where a point of the camera's frame falls; `None` behind the camera.
    pub fn pixel(&self, point: &Point3<f64>) -> Option<[f64; 2]> {
        let Pinhole { fx, fy, cx, cy } = self.lens;
        (point.z > 1e-6).then(|| [fx * point.x / point.z + cx, fy * point.y / point.z + cy])
    }
}

/// One line: the 3 x 3 matrix first, width and height last.
pub(super) fn intrinsics(path: &Path) -> Result<Intrinsics, ReadError> {
    let mut found = None;
    each_line(path, |row| {
        if found.is_some() {
            return Ok(());
        }
        if row.len() < 11 {
            let reason = format!("{} columns instead of 25", row.len());
            return Err(row.error(reason));
        }
        let [fx, _, cx, _, fy, cy] = row.numbers::<6>(0)?;
        let [width, height] = row.numbers::<2>(row.len() - 2)?;
        let sizes = [width, height]
            .iter()
            .all(|size| (1.0..=16384.0).contains(size));
        let lens = [fx, fy].iter().all(|f| *f > 0.0 && f.is_finite())
            && [cx, cy].iter().all(|c| c.is_finite());
        if !(sizes && lens) {
            return Err(row.error("its numbers are no lens".to_owned()));
        }
        found = Some(Intrinsics {
            lens: Pinhole { fx, fy, cx, cy },
            width: width as u32,
            height: height as u32,
        });
        Ok(())
    })?;
    found.ok_or_else(|| ReadError::malformed(path, Position::Line(1), "the file is empty"))
}

/// The tick at which the video starts: the first line; the second is where it ends.
pub(super) fn timing(path: &Path) -> Result<i64, ReadError> {
    let mut ticks: Vec<i64> = Vec::new();
    each_line(path, |row| {
        let tick = row.tick(0)?;
        if ticks.last().is_some_and(|before| *before > tick) {
            return Err(row.error("the video ends before it begins".to_owned()));
        }
        ticks.push(tick);
        Ok(())
    })?;
    ticks
        .first()
        .copied()
        .ok_or_else(|| ReadError::malformed(path, Position::Line(1), "the file is empty"))
}
