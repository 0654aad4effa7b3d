//! Normalisation files that travel with the weights: `norm_stats/{cam,body,lhand,rhand}_{mean,std}.npy`.
//!
//! Statistics of one set with weights of another decode to plausible nonsense, so a set is bound together by the hashes of
//! all its files.

use super::ImportError;
use super::hash::Hashes;
use crate::formats::npy;
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

/// Statistics of 63 numbers have less than a kilobyte.
const MAX_BYTES: u64 = 1 << 16;

/// Mean and deviation of one modality, row-major over channels (camera) or joints and axes.
#[derive(Debug, Clone, PartialEq, serde::Serialize, serde::Deserialize)]
pub struct Statistics {
    /// What is subtracted from the values before they are divided.
    pub mean: Vec<f32>,
    /// What the centred values are divided by; as many numbers as [`Self::mean`].
    pub deviation: Vec<f32>,
    /// SHA-256 of the two files, where they came from files.
    pub sha256: Vec<String>,
}

/// What EgoM2P's camera tokenizer was trained with; its files carry no statistics.
const EGOM2P_CAMERA: [[f32; 9]; 2] = [
    [
        0.933_050_4,
        0.004_411_310_5,
        -0.004_745_505,
        -0.004_031_105,
        0.967_022_2,
        0.012_297_441,
        0.002_536_698,
        -0.002_534_521,
        0.036_870_885,
    ],
    [
        0.224_102_83,
        0.154_095_95,
        0.235_387_63,
        0.151_592_39,
        0.098_908_54,
        0.178_710_6,
        0.162_297_5,
        0.113_059_945,
        0.224_501_56,
    ],
];

/// The statistics of EgoM2P's camera.
pub fn egom2p_camera() -> Statistics {
    let [mean, deviation] = EGOM2P_CAMERA.map(|values| values.to_vec());
    Statistics {
        mean,
        deviation,
        sha256: Vec::new(),
    }
}

/// Gaze in [0, 1] becomes [-1, 1] in every release.
pub fn gaze() -> Statistics {
    Statistics {
        mean: vec![0.5; 2],
        deviation: vec![0.5; 2],
        sha256: Vec::new(),
    }
}

/// Reads statistics files. Every modality needs both of its files.
pub(super) fn read(
    files: &[PathBuf],
    hashes: &mut Hashes,
) -> Result<BTreeMap<String, Statistics>, ImportError> {
    let mut halves: BTreeMap<(&'static str, bool), (Vec<f32>, PathBuf)> = BTreeMap::new();
    for path in files {
        let (modality, is_mean) = name(path).ok_or_else(|| {
            ImportError::refused(
                path,
                "not a statistics file: they are called `{cam,body,lhand,rhand}_{mean,std}.npy`",
            )
        })?;
        let values = values(path, modality, is_mean)?;
        if halves
            .insert((modality, is_mean), (values, path.clone()))
            .is_some()
        {
            return Err(ImportError::refused(path, "given twice"));
        }
    }
    let mut all = BTreeMap::new();
    for ((modality, is_mean), (values, path)) in &halves {
        let Some((other, other_path)) = halves.get(&(*modality, !is_mean)) else {
            let half = if *is_mean { "std" } else { "mean" };
            return Err(ImportError::refused(
                path,
                format!("its `{half}` file is missing"),
            ));
        };
        if *is_mean {
            all.insert(
                (*modality).to_owned(),
                Statistics {
                    mean: values.clone(),
                    deviation: other.clone(),
                    sha256: vec![hashes.get(path)?.sha256, hashes.get(other_path)?.sha256],
                },
            );
        }
    }
    Ok(all)
}

/// The modality a file belongs to, and whether it holds the mean.
fn name(path: &Path) -> Option<(&'static str, bool)> {
    let stem = path.file_stem()?.to_str()?;
    let (modality, half) = stem.rsplit_once('_')?;
    let modality = match modality {
        "cam" => "camera",
        "body" => "body",
        "lhand" => "left_hand",
        "rhand" => "right_hand",
        _ => return None,
    };
    match half {
        "mean" => Some((modality, true)),
        "std" => Some((modality, false)),
        _ => None,
    }
}

fn values(path: &Path, modality: &str, is_mean: bool) -> Result<Vec<f32>, ImportError> {
    let length = std::fs::metadata(path)
        .map_err(ImportError::io(path))?
        .len();
    if length > MAX_BYTES {
        return Err(ImportError::refused(path, format!("{length} bytes")));
    }
    let array = npy::read(path)?
        .to::<f32>()
        .map_err(|error| error.in_file(path))?;
    let expected: &[usize] = if modality == "camera" { &[9] } else { &[21, 3] };
    let count: usize = expected.iter().product();
    if array.len() != count {
        let reason = format!("shape {:?}, expected {expected:?}", array.shape());
        return Err(ImportError::refused(path, reason));
    }
    let values: Vec<f32> = array.iter().copied().collect();
    if let Some(bad) = values
        .iter()
        .find(|v| !v.is_finite() || (!is_mean && **v <= 0.0))
    {
        let what = if is_mean { "mean" } else { "deviation" };
        return Err(ImportError::refused(path, format!("a {what} of {bad}")));
    }
    Ok(values)
}
