//! Nymeria: gaze as the point at 1 m, the body registered to the glasses.

use std::path::Path;

use reviv::datasets::open::{Dataset, OpenWith, open};

use super::Outcome;
use super::compare::{self, Answer, Expected};
use super::report::Report;

/// The segment whose origin is each joint of the body.
const SEGMENTS: [usize; 21] = [
    0, 19, 15, 20, 16, 3, 21, 17, 4, 22, 18, 5, 11, 7, 6, 12, 8, 13, 9, 14, 10,
];

const EXPECTED: Expected = Expected {
    camera: 1e-4,
    gaze: &[Answer::new("gaze", "gaze_valid", 1e-4)],
    body: &[
        Answer::new("body", "body_valid", 5e-3),
        // What the invented body really did, instead of what the official reader makes of its files.
        Answer {
            joints: Some(&SEGMENTS),
            ..Answer::new("body_xsens23_truth", "body_valid", 1e-2)
        },
    ],
    left_hand: &[],
    right_hand: &[],
    depth: 0.0,
    times_missing: None,
    mono: false,
};

pub fn check(folder: &Path, report: &mut Report) -> Outcome {
    compare::check(
        folder,
        &|folder, cut| open(folder, Some(Dataset::Nymeria), cut, OpenWith::default()),
        &EXPECTED,
        report,
    )
}
