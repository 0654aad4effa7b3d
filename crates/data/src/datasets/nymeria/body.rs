//! The body: XSens segments of `xdata.npz`, repaired, placed in time, and brought into the glasses' world.
//!
//! The suit's world drifts against the glasses', so every frame is anchored on the head: `T_world_suit(t) = T_world_device(t)
//! T_device_head T_suit_head(t)^-1`. Only what is needed is held: the head at 240 Hz for the registration, the joints at 60 Hz.

use super::registration::HandEye;
use crate::datasets::track::{ClockMap, Joints, SECOND, Track};
use crate::formats::npy::Rows;
use crate::formats::npz::Npz;
use crate::formats::read_error::Position;
use crate::formats::{FormatError, ReadError};
use nalgebra::{Isometry3, Point3, Quaternion, Translation3, UnitQuaternion};
use std::io::Read;
use std::path::Path;

/// Segments of XSens.
const SEGMENTS: usize = 23;
/// The segment that wears the glasses.
const HEAD: usize = 6;
/// The segment whose origin is each of our joints. XSens has one vertebra more: `spine2` is its T12, `spine3` its T8.
const SEGMENT_OF_JOINT: [usize; 21] = [
    0, 19, 15, 20, 16, 3, 21, 17, 4, 22, 18, 5, 11, 7, 6, 12, 8, 13, 9, 14, 10,
];
/// Nanoseconds between samples at 240 Hz, and by how much a step may differ before it counts as written wrongly.
const STEP: i64 = 4_166_667;
const STEP_OFF: i64 = 1_000_000;
/// The step that takes the place of a wrong one; the official reader counts whole microseconds.
const STEP_REPAIRED: i64 = 4_166_000;
/// If repair moves the end by more, steps were not written wrongly, but samples are missing.
const MOST_MOVED: i64 = SECOND / 100;
/// Joints are held at 60 Hz, dense enough for 30 Hz.
const THINNED: i64 = SECOND / 60 - SECOND / 1000;
/// Quaternions shorter than the first stand for a repair of all shorter than the second.
const LOST: f64 = 0.1;
const SHORT: f64 = 0.5;
/// Left out at both ends of the overlap for the registration: a second, then 240 samples.
const MARGIN: i64 = SECOND;
const MARGIN_SAMPLES: usize = 240;
/// Samples from one pose of a relative movement to the other.
const STRIDE: usize = 2;

/// The joints in the glasses' world over device time. The inner error is a sentence that says why the body cannot be placed.
///
/// `clock` maps timecode to device time; `recorded` is the time that the glasses recorded.
///
/// # Errors
/// When the file is damaged.
pub(super) fn read(
    path: &Path,
    clock: &ClockMap,
    device: &Track<Isometry3<f64>>,
    recorded: (i64, i64),
) -> Result<Result<Track<Joints>, String>, ReadError> {
    let times = match repaired(path, &timestamps(path)?) {
        Ok(times) => times,
        Err(reason) => return Ok(Err(reason)),
    };
    let times: Vec<i64> = times.into_iter().map(|time| clock.map(time)).collect();
    if times.len() < 2 || times.windows(2).any(|pair| pair[1] <= pair[0]) {
        return Err(ReadError::malformed(
            path,
            Position::File,
            "`timestamps_us` does not ascend",
        ));
    }
    // Only where the glasses recorded, a second more on either side.
    let from = times.partition_point(|time| *time < recorded.0.saturating_sub(MARGIN));
    let to = times.partition_point(|time| *time <= recorded.1.saturating_add(MARGIN));
    let positions = positions(path, &times, from..to)?;
    let rotations = head_rotations(path, times.len())?;
    let head = |k: usize| -> Option<Isometry3<f64>> {
        let position = positions.head.get(k.checked_sub(from)?)?;
        let [x, y, z] = (*position)?;
        Some(Isometry3::from_parts(
            Translation3::new(x, y, z),
            rotations[k]?,
        ))
    };

    let first = times.partition_point(|time| *time < recorded.0.saturating_add(MARGIN));
    let last = times.partition_point(|time| *time <= recorded.1.saturating_sub(MARGIN));
    let (first, last) = (first + MARGIN_SAMPLES, last.saturating_sub(MARGIN_SAMPLES));
    let mut problem = HandEye::default();
    for k in (first..last.saturating_sub(STRIDE)).step_by(STRIDE) {
        let poses = (
            device.at(times[k]),
            device.at(times[k + STRIDE]),
            head(k),
            head(k + STRIDE),
        );
        if let (Some(device1), Some(device2), Some(head1), Some(head2)) = poses {
            problem.add(&device1.inv_mul(&device2), &head1.inv_mul(&head2));
        }
    }
    let Some(T_device_head) = problem.solve() else {
        return Ok(Err(
            "glasses and suit move together too shortly or too little to be registered".to_owned(),
        ));
    };
    let mut samples = Vec::with_capacity(positions.joints.len());
    for (k, joints) in positions.joints {
        if let (Some(T_world_device), Some(T_suit_head)) = (device.at(times[k]), head(k)) {
            let T_world_suit = T_world_device * T_device_head * T_suit_head.inverse();
            samples.push((times[k], joints.map(|joint| Some(T_world_suit * joint?))));
        }
    }
    if samples.is_empty() {
        return Ok(Err(
            "body and glasses were not recorded at the same time".to_owned()
        ));
    }
    Ok(Ok(Track::new(samples, SECOND / 10, SECOND / 50)))
}

/// Timecode of each sample, nanoseconds.
fn timestamps(path: &Path) -> Result<Vec<i64>, ReadError> {
    let key = "timestamps_us";
    let array = Npz::read_some(path, &[key])?;
    let times = array
        .get(key)?
        .to_dim::<i64, ndarray::Ix1>()
        .map_err(|error| error.in_file(path))?;
    times
        .iter()
        .map(|us| us.checked_mul(1000))
        .collect::<Option<_>>()
        .ok_or_else(|| {
            ReadError::malformed(
                path,
                Position::File,
                format!("`{key}`: a time beyond all clocks"),
            )
        })
}

/// The official repair: a step that is off by more than a millisecond is replaced, and everything after it moves.
fn repaired(path: &Path, times: &[i64]) -> Result<Vec<i64>, String> {
    let mut out: Vec<i64> = Vec::with_capacity(times.len());
    out.extend(times.first());
    for pair in times.windows(2) {
        let step = pair[1].saturating_sub(pair[0]);
        let right = step.saturating_sub(STEP).abs() <= STEP_OFF;
        let last = out[out.len() - 1];
        out.push(last.saturating_add(if right { step } else { STEP_REPAIRED }));
    }
    let moved = times
        .last()
        .zip(out.last())
        .map_or(0, |(before, after)| after.saturating_sub(*before));
    if moved.abs() > MOST_MOVED {
        let name = path.file_name().unwrap_or_default().to_string_lossy();
        return Err(format!(
            "samples are missing in `{name}`: its clock is off by {} ms",
            moved / 1_000_000
        ));
    }
    Ok(out)
}

/// What is kept of the segments' positions.
struct Positions {
    /// Of the head, sample by sample.
    head: Vec<Option<[f64; 3]>>,
    /// Of all joints at 60 Hz, with the number of the sample.
    joints: Vec<(usize, Joints)>,
}

fn positions(
    path: &Path,
    times: &[i64],
    range: std::ops::Range<usize>,
) -> Result<Positions, ReadError> {
    let mut positions = Positions {
        head: Vec::with_capacity(range.len()),
        joints: Vec::new(),
    };
    let mut next = i64::MIN;
    let mut k = 0;
    Npz::rows(path, "segment_tXYZ", |rows| {
        expect(rows, times.len(), SEGMENTS * 3)?;
        while let Some(row) = rows.next_row()? {
            if range.contains(&k) {
                let at = |segment: usize| -> Option<[f64; 3]> {
                    let p = [row[3 * segment], row[3 * segment + 1], row[3 * segment + 2]];
                    p.iter().all(|v| v.is_finite()).then_some(p)
                };
                positions.head.push(at(HEAD));
                if times[k] >= next {
                    next = times[k].saturating_add(THINNED);
                    let joints = SEGMENT_OF_JOINT.map(|segment| at(segment).map(Point3::from));
                    positions.joints.push((k, joints));
                }
            }
            k += 1;
        }
        Ok(())
    })?;
    Ok(positions)
}

/// The head's rotations; where the suit lost it for a moment, `None`.
fn head_rotations(
    path: &Path,
    count: usize,
) -> Result<Vec<Option<UnitQuaternion<f64>>>, ReadError> {
    let mut quaternions: Vec<Quaternion<f64>> = Vec::with_capacity(count);
    Npz::rows(path, "segment_qWXYZ", |rows| {
        expect(rows, count, SEGMENTS * 4)?;
        while let Some(row) = rows.next_row()? {
            let [w, x, y, z] = [
                row[4 * HEAD],
                row[4 * HEAD + 1],
                row[4 * HEAD + 2],
                row[4 * HEAD + 3],
            ];
            quaternions.push(Quaternion::new(w, x, y, z));
        }
        Ok(())
    })?;
    // The official repair holds the sample before; a gap of some milliseconds is bridged better.
    let lost = quaternions.iter().any(|q| q.norm() < LOST);
    Ok(quaternions
        .into_iter()
        .map(|q| {
            let norm = q.norm();
            let usable = norm.is_finite() && norm > if lost { SHORT } else { LOST };
            usable.then(|| UnitQuaternion::from_quaternion(q))
        })
        .collect())
}

/// The array must have a row per time.
fn expect<R: Read>(rows: &Rows<R>, count: usize, columns: usize) -> Result<(), FormatError> {
    if rows.shape() == [count, columns] {
        return Ok(());
    }
    Err(FormatError::Conversion {
        reason: format!(
            "its shape is {:?} instead of [{count}, {columns}]",
            rows.shape()
        ),
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn wrong_steps_are_replaced_and_missing_samples_are_noticed() {
        let path = Path::new("xdata.npz");
        let mut times: Vec<i64> = (0..100).map(|k| k * STEP).collect();
        times[40] += 3_100_000;
        let fixed = repaired(path, &times).unwrap();
        for (k, time) in fixed.iter().enumerate() {
            assert!((time - k as i64 * STEP).abs() < 10_000, "{k}: {time}");
        }
        for time in &mut times[60..] {
            *time += SECOND;
        }
        let reason = repaired(path, &times).unwrap_err();
        assert!(reason.contains("-1000 ms"), "{reason}");
    }
}
