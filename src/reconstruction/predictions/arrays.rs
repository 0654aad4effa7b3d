//! One predicted clip as the arrays of an npz, and back; arrays of other systems are checked and made ours.

use crate::clip::{Arrays, Clip};
use crate::formats::npz::Npz;
use crate::modality::{self, BUILT_IN};

/// What stands before the name of a modality that is not built in.
const DECLARED: &str = "declared.";

pub(super) fn to_npz(clip: &Clip) -> Npz {
    let mut npz = Npz::default();
    for modality in clip.modalities() {
        let Some(held) = clip.held(modality) else {
            continue;
        };
        let arrays = held.to_arrays();
        let prefix = if BUILT_IN.contains(&modality) {
            ""
        } else {
            DECLARED
        };
        let name = format!("{prefix}{modality}");
        npz = npz.with(&name, arrays.values);
        if let Some(valid) = arrays.valid {
            npz = npz.with(&format!("{name}_valid"), valid);
        }
    }
    npz
}

/// Names that other systems use for ours.
const ALIASES: [(&str, &str); 3] = [
    ("camera", "cam"),
    ("left_hand", "lhand"),
    ("right_hand", "rhand"),
];

/// The clip of these arrays; `rate` gives the rate of a modality whose usual one is its second argument.
pub(super) fn from_npz(
    npz: &Npz,
    id: &str,
    source: &str,
    rate: impl Fn(&str, f64) -> f64,
) -> Result<Clip, String> {
    let mut clip = Clip::empty(id, source);
    let format = modality::ClipFormat::default();
    let built_in = BUILT_IN.iter().map(|name| {
        let alias = ALIASES.iter().find(|(ours, _)| ours == name);
        let found = npz.arrays.get(*name);
        (*name, *name, found.or_else(|| npz.arrays.get(alias?.1)))
    });
    let declared = npz.arrays.iter().filter_map(|(name, array)| {
        let modality = name.strip_prefix(DECLARED)?;
        (!modality.ends_with("_valid")).then_some((modality, name.as_str(), Some(array)))
    });
    for (modality, name, array) in built_in.chain(declared) {
        let Some(array) = array else { continue };
        let usual = modality::built_in(modality, &format).map_or(format.signal_rate, |m| m.rate());
        let value = modality::form(modality).read(&Arrays {
            name: name.to_owned(),
            values: array.clone(),
            valid: npz.arrays.get(&format!("{name}_valid")).cloned(),
            rate: Some(rate(modality, usual)),
            more: Npz::default(),
            foreign: true,
        })?;
        clip.insert(modality, value);
    }
    Ok(clip)
}

#[cfg(test)]
mod tests {
    use super::*;
    use nalgebra::Isometry3;
    use ndarray::{Array2, Array3};

    #[test]
    fn a_pose_that_is_not_finite_has_no_place_and_the_others_stay() {
        let mut matrices = Array3::<f64>::zeros((3, 4, 4));
        for mut matrix in matrices.outer_iter_mut() {
            matrix.diag_mut().fill(1.0);
        }
        matrices[(1, 0, 0)] = f64::NAN;
        let nine = Array2::from_shape_fn((3, 9), |(i, c)| match (i, c) {
            (1, 7) => f64::INFINITY,
            (_, 0 | 4) => 1.0,
            _ => 0.0,
        });
        for npz in [
            Npz::default().with("camera", matrices),
            Npz::default().with("cam", nine),
        ] {
            let clip = from_npz(&npz, "a", "", |_, rate| rate).unwrap();
            let poses = &clip.camera().unwrap().T_world_camera;
            assert_eq!(poses[0], Isometry3::identity());
            assert!(poses[1].translation.vector.iter().all(|v| v.is_nan()));
            assert_eq!(poses[2], Isometry3::identity());
        }
    }
}
