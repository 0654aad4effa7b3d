//! HoloAssist: hands and gaze row by row; the flags of the files may be honoured or not.

use std::path::Path;

use reviv::datasets::open::{Dataset, OpenWith, open};

use super::Outcome;
use super::compare::{self, Answer, Expected};
use super::report::Report;

const EXPECTED: Expected = Expected {
    camera: 1e-6,
    gaze: &[
        Answer::new("gaze", "gaze_valid_flag", 1e-5),
        Answer::new("gaze", "gaze_valid", 1e-5),
    ],
    left_hand: &[
        Answer::new("left_hand", "left_hand_valid_flags", 1e-5),
        Answer::new("left_hand", "left_hand_valid", 1e-5),
    ],
    right_hand: &[
        Answer::new("right_hand", "right_hand_valid_flags", 1e-5),
        Answer::new("right_hand", "right_hand_valid", 1e-5),
    ],
    body: &[],
    depth: 0.0,
    times_missing: None,
    mono: false,
};

pub fn check(folder: &Path, report: &mut Report) -> Outcome {
    compare::check(
        folder,
        &|folder, cut| open(folder, Some(Dataset::Holoassist), cut, OpenWith::default()),
        &EXPECTED,
        report,
    )
}
