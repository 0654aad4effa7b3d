//! EgoGen as EgoM2P stores it: files of four seconds.

use std::path::Path;

use reviv::datasets::open::{Dataset, OpenWith, open};

use super::Outcome;
use super::compare::{self, Expected};
use super::report::Report;

const EXPECTED: Expected = Expected {
    // Files may hold f32.
    camera: 1e-5,
    gaze: &[],
    left_hand: &[],
    right_hand: &[],
    body: &[],
    depth: 1e-6,
    times_missing: None,
    mono: false,
};

pub fn check(folder: &Path, report: &mut Report) -> Outcome {
    compare::check(
        folder,
        &|folder, cut| open(folder, Some(Dataset::Egogen), cut, OpenWith::default()),
        &EXPECTED,
        report,
    )
}
