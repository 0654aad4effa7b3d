//! Nymeria: gaze as the point at 1 m, the body registered to the glasses.

use std::path::Path;

use reviv::datasets::open::{Dataset, OpenWith, open};

use super::Outcome;
use super::compare::{self, Answer, Expected};
use super::report::Report;

const EXPECTED: Expected = Expected {
    camera: 1e-4,
    gaze: &[Answer::new("gaze", "gaze_valid", 1e-4)],
    body: &[Answer::new("body", "body_valid", 5e-3)],
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
