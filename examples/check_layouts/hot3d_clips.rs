//! HOT3D-Clips: hands by UmeTrack, and by MANO with a model beside the folder; each tar read in place.

use std::path::Path;

use ndarray::Ix1;
use reviv::datasets::open::{Dataset, HandModel, OpenWith, open};

use super::Outcome;
use super::compare::{self, Answer, Expected};
use super::fake_mano;
use super::golden::{Golden, golden_files};
use super::report::Report;

const UMETRACK: Expected = Expected {
    camera: 1e-6,
    gaze: &[],
    left_hand: &[Answer::new("left_hand", "left_hand_valid", 1e-5)],
    right_hand: &[Answer::new("right_hand", "right_hand_valid", 1e-5)],
    body: &[],
    depth: 0.0,
    times_missing: None,
    mono: false,
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

/// Quest's cameras have no colour; its world has y up.
fn is_quest(golden: &Golden) -> Outcome<bool> {
    if !golden.has("up_world") {
        return Ok(false);
    }
    Ok(golden.array::<f64, Ix1>("up_world")?[1] > 0.5)
}

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
        for path in golden_files(folder)? {
            let expected = Expected {
                mono: is_quest(&Golden::read(&path)?)?,
                ..expected
            };
            compare::check_one(
                &path,
                folder,
                &|folder, cut| open(folder, Some(Dataset::Hot3dClips), cut, with),
                &expected,
                report,
            )?;
        }
    }
    Ok(())
}
