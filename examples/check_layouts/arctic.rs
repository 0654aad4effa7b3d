//! ARCTIC: hands of the processed splits, and the same ones from the raw labels with a MANO model beside the folder.

use std::path::Path;

use reviv::datasets::open::{Dataset, OpenWith, open};

use super::Outcome;
use super::compare::{self, Answer, Expected};
use super::fake_mano;
use super::report::Report;

const EXPECTED: Expected = Expected {
    camera: 1e-5,
    gaze: &[],
    left_hand: &[Answer::new("left_hand", "left_hand_valid", 1e-5)],
    right_hand: &[Answer::new("right_hand", "right_hand_valid", 1e-5)],
    body: &[],
    depth: 0.0,
    times_missing: None,
    mono: false,
};

pub fn check(folder: &Path, report: &mut Report) -> Outcome {
    for mano in [None, fake_mano::beside(folder)] {
        let with = OpenWith {
            mano: mano.as_deref(),
            ..OpenWith::default()
        };
        compare::check(
            folder,
            &|folder, cut| open(folder, Some(Dataset::Arctic), cut, with),
            &EXPECTED,
            report,
        )?;
    }
    Ok(())
}
