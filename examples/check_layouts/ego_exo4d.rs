//! Ego-Exo4D: inside a gap of the gaze a reader may hold the nearest row.

use std::path::Path;

use reviv::datasets::open::{Dataset, OpenWith, open};

use super::Outcome;
use super::compare::{self, Answer, Expected};
use super::report::Report;

const EXPECTED: Expected = Expected {
    camera: 1e-4,
    gaze: &[Answer {
        may_be_valid: Some("gaze_within_50ms_of_a_row"),
        ..Answer::new("gaze", "gaze_valid", 1e-4)
    }],
    body: &[],
    left_hand: &[],
    right_hand: &[],
    depth: 0.0,
    times_missing: Some("frame_time_missing"),
    mono: false,
};

pub fn check(folder: &Path, report: &mut Report) -> Outcome {
    compare::check(
        folder,
        &|folder, cut| open(folder, Some(Dataset::EgoExo4d), cut, OpenWith::default()),
        &EXPECTED,
        report,
    )
}
