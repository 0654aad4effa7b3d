//! Hand tracking of Machine Perception Services: 21 landmarks a hand in the device frame, about 10 or 30 rows a second.

use crate::datasets::csv::{Column, Table};
use crate::datasets::track::{Joints, SECOND, Track};
use crate::formats::ReadError;
use crate::geometry::skeleton::HAND_FROM_COMMON;
use nalgebra::Point3;
use std::path::Path;

const MAX_GAP: i64 = SECOND / 4;
const HOLD: i64 = SECOND / 20;

/// UmeTrack's and Aria's landmarks (tips 0-4, wrist 5, then two of the thumb and three of each finger) in the order wrist,
/// thumb, index, middle, ring, pinky from knuckle to tip. They have no joint at the thumb's base.
pub const COMMON_FROM_LANDMARKS: [Option<usize>; 21] = [
    Some(5),
    None,
    Some(6),
    Some(7),
    Some(0),
    Some(8),
    Some(9),
    Some(10),
    Some(1),
    Some(11),
    Some(12),
    Some(13),
    Some(2),
    Some(14),
    Some(15),
    Some(16),
    Some(3),
    Some(17),
    Some(18),
    Some(19),
    Some(4),
];

/// A hand in our order from 21 landmarks and, where it is known, the base of the thumb.
#[must_use]
pub fn from_landmarks(landmarks: &[Point3<f64>; 21], thumb_base: Option<Point3<f64>>) -> Joints {
    HAND_FROM_COMMON.map(|common| match COMMON_FROM_LANDMARKS[common] {
        Some(landmark) => Some(landmarks[landmark]),
        None => thumb_base,
    })
}

/// Left and right hand over device time, in the device frame.
///
/// # Errors
/// When the table is damaged; the line is named.
pub fn read(path: &Path) -> Result<[Track<Joints>; 2], ReadError> {
    let mut table = Table::open(path)?;
    let time = table.column("tracking_timestamp_us")?;
    let mut hands: Vec<(Column, Vec<[Column; 3]>)> = Vec::new();
    for side in ["left", "right"] {
        let confidence = table.column(&format!("{side}_tracking_confidence"))?;
        let landmarks = (0..21)
            .map(|k| {
                table.columns(
                    &format!("t{{}}_{side}_landmark_{k}_device"),
                    ["x", "y", "z"],
                )
            })
            .collect::<Result<_, _>>()?;
        hands.push((confidence, landmarks));
    }
    let mut samples = [Vec::new(), Vec::new()];
    while let Some(row) = table.next_row() {
        let row = row?;
        let time = row
            .integer(time)?
            .checked_mul(1000)
            .ok_or_else(|| row.error("a time beyond all clocks".to_owned()))?;
        for ((confidence, columns), samples) in hands.iter().zip(&mut samples) {
            let confidence = row.number(*confidence)?;
            if confidence.is_nan() || confidence < 0.0 {
                continue;
            }
            let mut landmarks = [Point3::origin(); 21];
            for (landmark, columns) in landmarks.iter_mut().zip(columns) {
                *landmark = Point3::from(row.numbers(*columns)?);
            }
            samples.push((time, from_landmarks(&landmarks, None)));
        }
    }
    Ok(samples.map(|samples| Track::new(samples, MAX_GAP, HOLD)))
}
