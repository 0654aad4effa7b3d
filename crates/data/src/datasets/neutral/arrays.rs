//! Arrays of a recording: values, the times of their rows, poses and joints.

use super::FILE;
use super::manifest::{CameraEntry, Direction, JointEntry};
use crate::datasets::track::{Joints, SECOND, Track};
use crate::formats::ReadError;
use crate::formats::npy::{self, NpyArray};
use crate::formats::npz::Npz;
use crate::formats::read_error::Position;
use crate::formats::stays_inside;
use crate::geometry::rigid;
use nalgebra::{Isometry3, Point3, Rotation3, UnitQuaternion};
use std::path::{Path, PathBuf};

pub(super) fn nanoseconds(path: &Path, seconds: f64) -> Result<i64, ReadError> {
    // A century on either side.
    if seconds.abs() < 3.2e9 {
        Ok((seconds * SECOND as f64).round() as i64)
    } else {
        Err(ReadError::malformed(
            path,
            Position::File,
            format!("a time of {seconds} seconds"),
        ))
    }
}

pub(super) fn array(path: &Path, key: Option<&str>) -> Result<NpyArray, ReadError> {
    if path.extension().is_some_and(|extension| extension == "npy") {
        return Ok(npy::read(path)?);
    }
    let key = key.unwrap_or("arr_0");
    let mut npz = Npz::read_some(path, &[key])?;
    npz.arrays
        .remove(key)
        .ok_or_else(|| ReadError::missing(path, format!("there is no array `{key}`")))
}

/// A file that the manifest names: of the recording's own folder.
pub(super) fn inside(root: &Path, file: &Path) -> Result<PathBuf, ReadError> {
    if stays_inside(file) {
        return Ok(root.join(file));
    }
    Err(ReadError::malformed(
        &root.join(FILE),
        Position::File,
        format!(
            "`{}` is outside of the recording: files are named by their path below its folder, without `..`",
            file.display()
        ),
    ))
}

/// An array and the times of its rows.
pub(super) fn load(
    root: &Path,
    file: &Path,
    key: Option<&str>,
    start: f64,
    rate: Option<f64>,
    times: Option<&str>,
) -> Result<(NpyArray, Vec<i64>), ReadError> {
    let path = inside(root, file)?;
    let values = array(&path, key)?;
    let count = values.shape.first().copied().unwrap_or(0);
    if count == 0 {
        return Err(ReadError::malformed(
            &path,
            Position::File,
            "the array has no rows",
        ));
    }
    let times: Vec<i64> = match (times, rate) {
        (Some(times), _) => array(&path, Some(times))?
            .to::<f64>()
            .map_err(|error| error.in_file(&path))?
            .iter()
            .map(|seconds| nanoseconds(&path, *seconds))
            .collect::<Result<_, _>>()?,
        (None, Some(rate)) if rate > 0.0 && rate.is_finite() => (0..count)
            .map(|k| nanoseconds(&path, start + k as f64 / rate))
            .collect::<Result<_, _>>()?,
        _ => {
            return Err(ReadError::malformed(
                &root.join(FILE),
                Position::File,
                format!(
                    "`{}` needs a `rate` or the name of an array of `times`",
                    file.display()
                ),
            ));
        }
    };
    if times.len() != count || !times.is_sorted() {
        return Err(ReadError::malformed(
            &path,
            Position::File,
            format!(
                "{} times for {count} rows, or they do not ascend",
                times.len()
            ),
        ));
    }
    Ok((values, times))
}

pub(super) fn shape(path: &Path, found: &[usize], wanted: &[usize]) -> Result<(), ReadError> {
    if found == wanted {
        return Ok(());
    }
    Err(ReadError::malformed(
        path,
        Position::File,
        format!("an array of shape {found:?} instead of {wanted:?}"),
    ))
}

/// Gaps and holds that fit the spacing of the samples.
pub(super) fn track<T: crate::datasets::track::Blend>(
    samples: Vec<(i64, T)>,
    times: &[i64],
) -> Track<T> {
    let period = (times[times.len() - 1] - times[0]) / (times.len() as i64 - 1).max(1);
    Track::new(samples, period * 5 / 2 + 1, period * 3 / 5 + 1)
}

pub(super) fn poses(
    path: &Path,
    array: &NpyArray,
    entry: &CameraEntry,
) -> Result<Vec<Option<Isometry3<f64>>>, ReadError> {
    let matrices = array
        .to_dim::<f64, ndarray::Ix3>()
        .map_err(|error| error.in_file(path))?;
    let rows = matrices.shape()[1];
    shape(
        path,
        &matrices.shape()[1..],
        &[if rows == 3 { 3 } else { 4 }, 4],
    )?;
    matrices
        .outer_iter()
        .enumerate()
        .map(|(index, m)| {
            if m.iter().any(|v| !v.is_finite()) {
                return Ok(None);
            }
            let mut values = [0.0; 16];
            values[15] = 1.0;
            values.iter_mut().zip(&m).for_each(|(slot, &v)| *slot = v);
            let pose = rigid::from_row_major(&values).map_err(|error| {
                ReadError::malformed(path, Position::Frame(index as u64), error.to_string())
            })?;
            let pose = match entry.direction {
                Direction::CameraToWorld => pose,
                Direction::WorldToCamera => pose.inverse(),
            };
            let axes = Rotation3::from_matrix_unchecked(entry.axes.opencv_in());
            Ok(Some(pose * UnitQuaternion::from_rotation_matrix(&axes)))
        })
        .collect()
}

pub(super) fn joints(
    root: &Path,
    entry: &JointEntry,
) -> Result<(Track<Joints>, Vec<i64>), ReadError> {
    let (array, times) = load(
        root,
        &entry.file,
        entry.key.as_deref(),
        entry.start,
        entry.rate,
        entry.times.as_deref(),
    )?;
    let values = array
        .to_dim::<f64, ndarray::Ix3>()
        .map_err(|error| error.in_file(&root.join(&entry.file)))?;
    let (map, count) = entry.order.map();
    shape(
        &root.join(&entry.file),
        values.shape(),
        &[times.len(), count, 3],
    )?;
    let scale = entry.unit.metres();
    let samples = times
        .iter()
        .zip(values.outer_iter())
        .map(|(time, row)| {
            let joints = map.map(|joint| {
                let p = Point3::new(row[[joint, 0]], row[[joint, 1]], row[[joint, 2]]) * scale;
                p.iter().all(|v| v.is_finite()).then_some(p)
            });
            (*time, joints)
        })
        .collect();
    Ok((track(samples, &times), times))
}
