//! TACO: hands of the side file, and the same ones from the pickles with a MANO model beside the folder. Sequences that the official
//! code skips have to be left out.

use std::path::Path;

use ndarray::Ix0;
use reviv::datasets::open::{Dataset, OpenWith, open};
use reviv::datasets::recording::CutSettings;

use super::Outcome;
use super::compare::{self, Answer, Expected};
use super::fake_mano;
use super::golden::{Golden, golden_files};
use super::report::Report;

const EXPECTED: Expected = Expected {
    camera: 1e-9,
    gaze: &[],
    left_hand: &[Answer::new("left_hand", "left_hand_valid", 1e-5)],
    right_hand: &[Answer::new("right_hand", "right_hand_valid", 1e-5)],
    body: &[],
    depth: 2.5e-4,
    times_missing: None,
    mono: false,
};

pub fn check(folder: &Path, report: &mut Report) -> Outcome {
    for mano in [None, fake_mano::beside(folder)] {
        let with = OpenWith {
            mano: mano.as_deref(),
            ..OpenWith::default()
        };
        for path in golden_files(folder)? {
            let golden = Golden::read(&path)?;
            let expect_read =
                !golden.has("expect_read") || golden.array::<bool, Ix0>("expect_read")?[[]];
            let opened = |cut: &CutSettings| open(folder, Some(Dataset::Taco), cut, with);
            if expect_read {
                compare::check_one(&path, folder, &|_, cut| opened(cut), &EXPECTED, report)?;
            } else {
                let source = opened(&CutSettings::default())?;
                let name = golden.recording();
                let read = source.recordings();
                let wrong = read
                    .iter()
                    .filter(|(known, _)| known.contains(name))
                    .count();
                report.wrong(&format!("{} left out", golden.name), wrong, 1);
            }
        }
    }
    Ok(())
}
