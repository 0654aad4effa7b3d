//! H2O: camera, depth, and hands as they are written.

use std::path::Path;

use reviv::datasets::open::{Dataset, OpenWith, open};

use super::Outcome;
use super::compare::{self, Answer, Expected};
use super::report::Report;

const EXPECTED: Expected = Expected {
    camera: 1e-9,
    gaze: &[],
    left_hand: &[Answer::new("left_hand", "left_hand_valid", 1e-6)],
    right_hand: &[Answer::new("right_hand", "right_hand_valid", 1e-6)],
    body: &[],
    depth: 5e-4,
    times_missing: None,
    mono: false,
};

pub fn check(folder: &Path, report: &mut Report) -> Outcome {
    compare::check(
        folder,
        &|folder, cut| open(folder, Some(Dataset::H2o), cut, OpenWith::default()),
        &EXPECTED,
        report,
    )
}
