//! Trajectories in the TUM format (`timestamp tx ty tz qx qy qz qw` per line) and their comparison as `evo` does it.

use super::outcome::MetricError;
use super::trajectory::{Pose, TrajectoryErrors, trajectory_errors};
use crate::formats::ReadError;
use crate::formats::text::{Lines, is_space, trim};
use crate::geometry::alignment::Freedom;
use nalgebra::{Quaternion, UnitQuaternion, Vector3};
use std::path::Path;

/// Poses with their times in seconds; times never go back.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct TimedPoses {
    /// Seconds, one per pose, as the file has them.
    pub times: Vec<f64>,
    /// One per time.
    pub poses: Vec<Pose>,
}

/// Why a trajectory file cannot be used.
#[derive(Debug, thiserror::Error)]
pub enum TumError {
    /// The file cannot be read as lines of text.
    #[error(transparent)]
    Read(#[from] ReadError),
    /// A line does not hold a pose, or is earlier than the line before.
    #[error("{path}:{line}: {reason}")]
    Line {
        /// The trajectory file.
        path: String,
        /// Number of the line, from 1.
        line: u64,
        /// What is wrong with it, in words.
        reason: String,
    },
    /// The file has nothing but comments and empty lines.
    #[error("{path}: no poses: a TUM trajectory has lines `timestamp tx ty tz qx qy qz qw`")]
    Empty {
        /// The trajectory file.
        path: String,
    },
    /// No pose of one trajectory has a simultaneous one in the other.
    #[error(
        "no two timestamps lie within {max_difference} s of each other; are both in seconds of the same clock?"
    )]
    NoMatch {
        /// Seconds within which two timestamps count as simultaneous.
        max_difference: f64,
    },
    /// The matched poses cannot be scored.
    #[error(transparent)]
    Refused(#[from] MetricError),
}

/// Reads a trajectory file. Lines that are empty or start with `#` are comments.
///
/// # Errors
/// When the file cannot be read, a line does not hold eight finite numbers, a quaternion has length zero, or time goes back.
pub fn read_tum(path: &Path) -> Result<TimedPoses, TumError> {
    let name = || path.display().to_string();
    let mut trajectory = TimedPoses::default();
    for line in Lines::open(path)? {
        let (number, line) = line?;
        let line = trim(&line);
        if line.is_empty() || line.starts_with('#') {
            continue;
        }
        let (time, pose) = parse_line(line).map_err(|reason| TumError::Line {
            path: name(),
            line: number,
            reason,
        })?;
        if trajectory.times.last().is_some_and(|&last| time < last) {
            return Err(TumError::Line {
                path: name(),
                line: number,
                reason: format!("time goes back to {time}"),
            });
        }
        trajectory.times.push(time);
        trajectory.poses.push(pose);
    }
    if trajectory.times.is_empty() {
        return Err(TumError::Empty { path: name() });
    }
    Ok(trajectory)
}

fn parse_line(line: &str) -> Result<(f64, Pose), String> {
    let separators = |c: char| is_space(c) || matches!(c, ',' | ';');
    let numbers: Vec<f64> = line
        .split(separators)
        .filter(|word| !word.is_empty())
        .map(|word| match word.parse::<f64>() {
            Ok(number) if number.is_finite() => Ok(number),
            _ => Err(format!("`{word}` is not a finite number")),
        })
        .collect::<Result<_, _>>()?;
    if numbers.len() == 12 {
        return Err(
            "12 numbers, as KITTI writes poses, without times: write `timestamp tx ty tz qx qy qz qw`"
                .to_owned(),
        );
    }
    let &[time, x, y, z, qx, qy, qz, qw] = numbers.as_slice() else {
        return Err(format!(
            "{} numbers, expected 8: timestamp tx ty tz qx qy qz qw",
            numbers.len()
        ));
    };
    let rotation = UnitQuaternion::try_new(Quaternion::new(qw, qx, qy, qz), 1e-6)
        .ok_or("the quaternion has length zero")?
        .to_rotation_matrix();
    let pose = Pose {
        rotation: *rotation.matrix(),
        position: Vector3::new(x, y, z),
    };
    Ok((time, pose))
}

/// Seconds within which two poses count as simultaneous, `evo`'s default.
pub const MAX_DIFFERENCE: f64 = 0.01;

/// Index pairs of simultaneous poses: every pose of the shorter trajectory takes the nearest in time of the longer one, if it
/// lies within `max_difference`. Pairs are `(index in a, index in b)`.
#[must_use]
pub fn associate(a: &[f64], b: &[f64], max_difference: f64) -> Vec<(usize, usize)> {
    let b_is_longer = b.len() > a.len();
    let (short, long) = if b_is_longer { (a, b) } else { (b, a) };
    let mut pairs = Vec::with_capacity(short.len());
    for (i, &time) in short.iter().enumerate() {
        let Some(j) = nearest(long, time) else { break };
        if (long[j] - time).abs() <= max_difference {
            pairs.push(if b_is_longer { (i, j) } else { (j, i) });
        }
    }
    pairs
}

/// The nearest of `times` (ascending); the earlier of two equally near.
fn nearest(times: &[f64], time: f64) -> Option<usize> {
    let after = times.partition_point(|&t| t < time);
    let before = after.checked_sub(1).map(|last| {
        // The first of several equal timestamps.
        times.partition_point(|&t| t < times[last])
    });
    match (before, times.get(after)) {
        (Some(before), Some(next)) if (next - time).abs() < (time - times[before]).abs() => {
            Some(after)
        }
        (Some(before), _) => Some(before),
        (None, Some(_)) => Some(after),
        (None, None) => None,
    }
}

/// Errors of `estimate` against `reference`, matched in time and aligned with `freedom`, over pairs one sample apart.
///
/// With [`Freedom::Rigid`] these are `evo_ape --align` and `evo_rpe --align`, with [`Freedom::Similarity`] the same commands
/// with `--correct_scale`.
///
/// # Errors
/// When no timestamps match.
pub fn compare(
    reference: &TimedPoses,
    estimate: &TimedPoses,
    max_difference: f64,
    freedom: Freedom,
) -> Result<TrajectoryErrors, TumError> {
    let pairs = associate(&reference.times, &estimate.times, max_difference);
    if pairs.is_empty() {
        return Err(TumError::NoMatch { max_difference });
    }
    let truth: Vec<Pose> = pairs.iter().map(|&(i, _)| reference.poses[i]).collect();
    let guess: Vec<Pose> = pairs.iter().map(|&(_, j)| estimate.poses[j]).collect();
    Ok(trajectory_errors(&guess, &truth, 1, freedom)?)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_shorter_trajectory_is_matched_to_the_nearest_of_the_longer() {
        let long = [0.0, 0.1, 0.2, 0.2, 0.3];
        let short = [0.104, 0.15, 0.25, 0.9];
        assert_eq!(associate(&long, &short, 0.06), [(1, 0), (1, 1), (2, 2)]);
        assert_eq!(associate(&short, &long, 0.01), [(0, 1)]);
        assert!(associate(&[], &long, 1.0).is_empty());
    }

    #[test]
    fn a_trajectory_is_the_same_however_an_editor_saved_it() {
        let file = tempfile::NamedTempFile::new().unwrap();
        let read = |text: &str| {
            std::fs::write(file.path(), text).unwrap();
            read_tum(file.path()).unwrap()
        };
        let plain = read("1 0 0 0 0 0 0 1\n2 1 2 3 0 0 0 1\n");
        for text in [
            "\u{feff}1 0 0 0 0 0 0 1\r\n2 1 2 3 0 0 0 1\r\n",
            "\u{feff}# a comment\r1 0 0 0 0 0 0 1\r2 1 2 3 0 0 0 1",
            "1\u{a0}0\u{2007}0 0 0 0 0 1\u{a0}\n\u{a0}\n2 1 2 3 0 0 0 1\u{feff}\n",
            "1,0,0,0,0,0,0,1,\n2, 1, 2, 3, 0, 0, 0, 1,\n",
            "1\t0\t0\t0\t0\t0\t0\t1\n2;1;2;3;0;0;0;1\n",
        ] {
            assert_eq!(read(text), plain, "{text:?}");
        }
        std::fs::write(file.path(), b"\xff\xfe1\0 \0").unwrap();
        let error = read_tum(file.path()).unwrap_err().to_string();
        assert!(error.contains("UTF-16"), "{error}");
    }

    #[test]
    fn a_bad_line_is_named() {
        let file = tempfile::NamedTempFile::new().unwrap();
        for (text, reason) in [
            ("# only a comment\n", "no poses"),
            ("0 0 0 0 0 0 0 1\n1 2 3\n", ":2: 3 numbers"),
            ("1 0 0 0 0 1 0 0 0 0 1 0\n", ":1: 12 numbers, as KITTI"),
            ("0 0 0 0 0 0 0 0\n", ":1: the quaternion"),
            ("0 0 nan 0 0 0 0 1\n", "`nan` is not a finite number"),
            ("2 0 0 0 0 0 0 1\n1 0 0 0 0 0 0 1\n", ":2: time goes back"),
        ] {
            std::fs::write(file.path(), text).unwrap();
            let error = read_tum(file.path()).unwrap_err().to_string();
            assert!(error.contains(reason), "{error}");
        }
    }
}
