//! HOT3D-Clips: hands by UmeTrack, and by MANO with a model beside the folder; each tar read in place.

use std::path::Path;

use reviv::datasets::open::{Dataset, HandModel, OpenWith, open};

use super::Outcome;
use super::compare::{self, Answer, Expected};
use super::fake_mano;
use super::report::Report;

const UMETRACK: Expected = Expected {
    camera: 1e-6,
    gaze: &[],
    left_hand: &[Answer::new("left_hand", "left_hand_valid", 1e-5)],
    right_hand: &[Answer::new("right_hand", "right_hand_valid", 1e-5)],
    body: &[],
    depth: 0.0,
    times_missing: None,
    // Quest's cameras have no colour, and their luma is that of the golden colours too.
    mono: true,
};
const MANO: Expected = Expected {
    left_hand: &[Answer::new("left_hand_mano", "left_hand_mano_valid", 1e-5)],
    right_hand: &[Answer::new(
        "right_hand_mano",
        "right_hand_mano_valid",
        1e-5,
    )],
    ..UMETRACK
};

pub fn check(folder: &Path, report: &mut Report) -> Outcome {
    let mano = fake_mano::beside(folder);
    let sets = [(HandModel::Umetrack, UMETRACK), (HandModel::Mano, MANO)];
    for (hands, expected) in sets {
        if hands == HandModel::Mano && mano.is_none() {
            continue;
        }
        let with = OpenWith {
            mano: mano.as_deref(),
            hands,
            ..OpenWith::default()
        };
        compare::check(
            folder,
            &|folder, cut| open(folder, Some(Dataset::Hot3dClips), cut, with),
            &expected,
            report,
        )?;
    }
    Ok(())
}
