//! The kinematics of MANO on a model with its structure: every convention of the data sets, from the pickle and from arrays.

use std::path::{Path, PathBuf};

use ndarray::{Array2, Array3, Ix2, Ix3};
use reviv::datasets::mano::{self, Mano};
use reviv::geometry::mano::{Convention, FingerPose, ManoModel, ManoPose};
use reviv::geometry::skeleton::HAND_FROM_COMMON;

use super::Outcome;
use super::golden::Golden;
use super::report::Report;

const TOLERANCE: f64 = 1e-7;

/// The folder of models beside that of a data set.
pub fn beside(folder: &Path) -> Option<PathBuf> {
    let models = folder.parent()?.join("fake_mano");
    models.is_dir().then_some(models)
}

pub fn check(folder: &Path, report: &mut Report) -> Outcome {
    let golden = Golden::read(&folder.join("golden.npz"))?;
    let fixed = Mano::open(folder)?.with_left_fix()?;
    for (side, name) in ["left", "right"].into_iter().enumerate() {
        let mut found = false;
        for kind in ["pkl", "npz"] {
            let path = folder.join(format!("MANO_{}.{kind}", name.to_uppercase()));
            if path.is_file() {
                found = true;
                let model = mano::read(&path)?;
                hand(&golden, name, side == 1, &model, kind, report)?;
            }
        }
        report.wrong(&format!("{name} hand there"), usize::from(!found), 1);
        if let Some(model) = fixed.hand(side) {
            let expected = format!("{name}_smplx_pca15_mean_fixed");
            let convention = Convention::SMPLX;
            let off = compare(&golden, name, model, &expected, convention, true, false)?;
            report.difference(&expected, off, TOLERANCE, "m");
        }
    }
    Ok(())
}

/// Every convention but the one with the mended left hand.
fn hand(
    golden: &Golden,
    name: &str,
    right: bool,
    model: &ManoModel,
    kind: &str,
    report: &mut Report,
) -> Outcome {
    let (smplx, manopth) = (Convention::SMPLX, Convention::manopth(right));
    let flat = Convention {
        add_mean: false,
        ..smplx
    };
    let centred = Convention {
        centre_on_wrist: true,
        ..manopth
    };
    let mean = Convention {
        add_mean: true,
        ..manopth
    };
    for (key, convention, components, common) in [
        ("smplx_axisangle_mean", smplx, false, false),
        ("smplx_axisangle_flat", flat, false, false),
        ("manopth_axisangle_flat_centre0", centred, false, true),
        ("manopth_axisangle_flat", manopth, false, true),
        ("manopth_pca15_mean", mean, true, true),
    ] {
        let expected = format!("{name}_{key}");
        let off = compare(
            golden, name, model, &expected, convention, components, common,
        )?;
        report.difference(&format!("{expected} ({kind})"), off, TOLERANCE, "m");
    }
    let expected = golden.array::<f64, Ix2>(&format!("{name}_vertices_case1_flat"))?;
    let cases = Cases::read(golden, name)?;
    let (shape, fingers) = (cases.shape(1), cases.fingers(1));
    let pose = ManoPose {
        translation: [0.0; 3],
        ..cases.pose(1, shape, FingerPose::AxisAngle(&fingers))
    };
    let mut worst = 0.0_f64;
    for (vertex, row) in model.vertices(&pose, &flat)?.iter().zip(expected.rows()) {
        for k in 0..3 {
            worst = worst.max((vertex[k] - row[k]).abs());
        }
    }
    // The golden vertices are rounded to 32 bits.
    report.difference(&format!("{name} vertices ({kind})"), worst, 1e-6, "m");
    Ok(())
}

/// The parameters of the golden file's hands.
struct Cases {
    betas: Array2<f64>,
    orientation: Array2<f64>,
    bent: Array2<f64>,
    translation: Array2<f64>,
    components: Array2<f64>,
}

impl Cases {
    fn read(golden: &Golden, name: &str) -> Outcome<Self> {
        let get = |key: &str| golden.array::<f64, Ix2>(&format!("{name}_{key}"));
        Ok(Self {
            betas: get("betas")?,
            orientation: get("global_orient")?,
            bent: get("hand_pose")?,
            translation: get("transl")?,
            components: get("pca15")?,
        })
    }

    fn shape(&self, case: usize) -> [f64; 10] {
        std::array::from_fn(|k| self.betas[[case, k]])
    }

    fn fingers(&self, case: usize) -> [f64; 45] {
        std::array::from_fn(|k| self.bent[[case, k]])
    }

    fn pose<'a>(&self, case: usize, shape: [f64; 10], fingers: FingerPose<'a>) -> ManoPose<'a> {
        ManoPose {
            shape,
            orientation: std::array::from_fn(|k| self.orientation[[case, k]]),
            fingers,
            translation: std::array::from_fn(|k| self.translation[[case, k]]),
        }
    }
}

/// The largest difference of a joint of any case, metres.
fn compare(
    golden: &Golden,
    name: &str,
    model: &ManoModel,
    expected: &str,
    convention: Convention,
    components: bool,
    common: bool,
) -> Outcome<f64> {
    let cases = Cases::read(golden, name)?;
    let expected: Array3<f64> = golden.array::<f64, Ix3>(expected)?;
    let mut worst = 0.0_f64;
    for (case, joints) in expected.outer_iter().enumerate() {
        let fingers = cases.fingers(case);
        let coefficients = cases.components.row(case).to_vec();
        let fingers = if components {
            FingerPose::Components(&coefficients)
        } else {
            FingerPose::AxisAngle(&fingers)
        };
        let found = model.joints(&cases.pose(case, cases.shape(case), fingers), &convention)?;
        for (joint, point) in found.iter().enumerate() {
            let row = if common {
                HAND_FROM_COMMON[joint]
            } else {
                joint
            };
            for k in 0..3 {
                worst = worst.max((point[k] - joints[[row, k]]).abs());
            }
        }
    }
    Ok(worst)
}
