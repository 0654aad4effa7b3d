//! Predictions on disk: what a system says about a set of clips, ours or anyone's.
//!
//! A folder with `predictions.json` and one npz per clip. Arrays of an npz, all optional:
//!
//! | array | shape | meaning |
//! |---|---|---|
//! | `camera` | `[T, 4, 4]` or `[T, 9]` | camera-to-world, OpenCV axes, metres; 9 = two rotation columns are made orthonormal, third ignored, then translation |
//! | `gaze` | `[T, 2]` | x right, y down, the square image is `[0, 1]^2` |
//! | `body` | `[T, 21, 3]` | metres |
//! | `left_hand`, `right_hand` | `[T, 21, 3]` | metres, camera of the same sample |
//! | `depth` | `[T, H, W]` | as predicted: depth or inverse depth, see its `unit` |
//! | `rgb` | `[T, H, W, 3]` u8 | colour |
//! | `declared.<name>` | `[T, C]` | a modality declared in YAML |
//! | `<modality>_valid` | the signal without its last axis | false = nothing predicted there |
//! | `certainty.<modality>` | `[T]` | from the token entropies, 0 to 1 |
//!
//! Other systems need no `predictions.json`: a folder of npz files is enough, the path of a file without `.npz` is its clip id,
//! and rates are the usual ones (video 8 Hz, everything else 30 Hz). [`arrays`] is one clip as arrays and back.

mod arrays;

use self::arrays::{from_npz, to_npz};
use crate::clip::Clip;
use crate::formats::FormatError;
use crate::formats::npz::Npz;
use crate::modality::{Lengths, Modality};
use ndarray::{Array1, Ix1};
use serde::{Deserialize, Serialize};
use std::path::{Path, PathBuf};
use std::{collections::BTreeMap, io};

/// The index of a folder of predictions.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct PredictionsIndex {
    /// Version of this layout.
    pub format: u32,
    /// Who predicted: `reviv`, `EgoAllo`, ...
    pub system: String,
    /// By modality name.
    pub signals: BTreeMap<String, SignalNote>,
    /// Every clip, in order.
    pub clips: Vec<PredictedClip>,
}

/// What must be known of a signal before its numbers mean anything.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct SignalNote {
    /// `m`, `image`, `1/m`, ...
    pub unit: String,
    /// In words: `camera of the same sample`, `first camera of the clip`.
    pub frame: String,
    /// Hz.
    pub rate: f64,
    /// Whether the numbers are metric, and by what.
    pub scale: ScaleStatus,
}

/// Whether lengths may be read as metres.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum ScaleStatus {
    /// In metres, and why: `learned from metric data`, `floor fit`, `anchor depth`.
    Metric {
        /// What makes the lengths metric.
        by: String,
    },
    /// Up to an unknown scale (and shift, for depth).
    Relative,
    /// Not a length.
    None,
}

impl ScaleStatus {
    /// Of the predictions of a modality.
    #[must_use]
    pub fn of(modality: &dyn Modality) -> Self {
        match modality.lengths() {
            Lengths::Metric => Self::Metric {
                by: "learning from metric data".into(),
            },
            Lengths::Relative => Self::Relative,
            Lengths::None => Self::None,
        }
    }
}

/// One clip of the index.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct PredictedClip {
    /// The id of the clip that was predicted.
    pub id: String,
    /// The data set of the clip.
    pub source: String,
    /// Relative to the folder.
    pub file: String,
}

/// The folder beside the index with the truth after a round trip through the model's tokenizers, itself of this form.
pub const RECONSTRUCTION_BOUND: &str = "reconstruction_bound";
/// The folder beside the index with samples, one folder of this form each: `samples/00`, `samples/01`, ...
pub const SAMPLES: &str = "samples";
/// The index's file name.
pub const INDEX: &str = "predictions.json";
/// The current [`PredictionsIndex::format`].
pub const FORMAT: u32 = 1;

/// Why predictions cannot be read or written.
#[derive(Debug, thiserror::Error)]
pub enum PredictionsError {
    /// The npz file of a clip cannot be read or written.
    #[error(transparent)]
    Format(#[from] FormatError),
    /// The folder or its index cannot be read or written.
    #[error("{path}: {source}")]
    Io {
        /// The file or folder.
        path: String,
        /// What the operating system says.
        source: io::Error,
    },
    /// The index or the file of a clip is of another form, or there are no predictions.
    #[error("{path}: {reason}")]
    Content {
        /// The file or folder.
        path: String,
        /// What is wrong with it.
        reason: String,
    },
}

impl PredictionsError {
    fn io(path: &Path) -> impl FnOnce(io::Error) -> Self {
        let path = path.display().to_string();
        move |source| Self::Io { path, source }
    }

    fn content(path: &Path, reason: impl Into<String>) -> Self {
        Self::Content {
            path: path.display().to_string(),
            reason: reason.into(),
        }
    }
}

/// Writes predictions clip by clip.
#[derive(Debug)]
pub struct PredictionsWriter {
    directory: PathBuf,
    index: PredictionsIndex,
}

impl PredictionsWriter {
    /// Starts (or continues) a folder. `signals` says what every modality's numbers are.
    ///
    /// # Errors
    /// When the folder cannot be made.
    pub fn create(
        directory: &Path,
        system: &str,
        signals: BTreeMap<String, SignalNote>,
    ) -> Result<Self, PredictionsError> {
        let clips = directory.join("clips");
        std::fs::create_dir_all(&clips).map_err(PredictionsError::io(&clips))?;
        Ok(Self {
            directory: directory.to_owned(),
            index: PredictionsIndex {
                format: FORMAT,
                system: system.to_owned(),
                signals,
                clips: Vec::new(),
            },
        })
    }

    /// Writes one clip's predicted signals; `certainty` by modality name, one value per sample.
    ///
    /// # Errors
    /// When the file cannot be written.
    pub fn add(
        &mut self,
        clip: &Clip,
        certainty: &BTreeMap<String, Vec<f32>>,
    ) -> Result<(), PredictionsError> {
        let next = self.index.clips.len();
        let entry = self.write(next, clip, certainty)?;
        self.index.clips.push(entry);
        Ok(())
    }

    /// Writes one clip's predicted signals as those of clip `number` of all, and gives its entry of the index: for several who write
    /// clips of one folder. [`PredictionsWriter::list`] takes the entries.
    ///
    /// # Errors
    /// When the file cannot be written.
    pub fn write(
        &self,
        number: usize,
        clip: &Clip,
        certainty: &BTreeMap<String, Vec<f32>>,
    ) -> Result<PredictedClip, PredictionsError> {
        let file = format!("clips/{number:06}.npz");
        let mut npz = to_npz(clip);
        for (modality, values) in certainty {
            npz = npz.with(
                &format!("certainty.{modality}"),
                Array1::from(values.clone()),
            );
        }
        npz.write(&self.directory.join(&file))?;
        Ok(PredictedClip {
            id: clip.id.clone(),
            source: clip.source.clone(),
            file,
        })
    }

    /// Lists clips that were written by themselves, in their order.
    pub fn list(&mut self, clips: impl IntoIterator<Item = PredictedClip>) {
        self.index.clips.extend(clips);
    }

    /// Writes the index.
    ///
    /// # Errors
    /// When it cannot be written.
    pub fn finish(self) -> Result<PredictionsIndex, PredictionsError> {
        let path = self.directory.join(INDEX);
        let text = serde_json::to_string_pretty(&self.index)
            .map_err(|e| PredictionsError::content(&path, e.to_string()))?;
        std::fs::write(&path, text).map_err(PredictionsError::io(&path))?;
        Ok(self.index)
    }
}

/// A folder of predictions, read clip by clip.
#[derive(Debug, Clone)]
pub struct Predictions {
    directory: PathBuf,
    /// What the folder says of itself.
    pub index: PredictionsIndex,
}

impl Predictions {
    /// Opens a folder with an index, or any folder of npz files.
    ///
    /// # Errors
    /// When the folder cannot be read, the index is of another format or names a file outside the folder, or nothing is there.
    pub fn open(directory: &Path) -> Result<Self, PredictionsError> {
        let path = directory.join(INDEX);
        let index = if path.is_file() {
            let text = std::fs::read_to_string(&path).map_err(PredictionsError::io(&path))?;
            let text = text.trim_start_matches('\u{feff}');
            let index: PredictionsIndex = serde_json::from_str(text)
                .map_err(|e| PredictionsError::content(&path, e.to_string()))?;
            if index.format != FORMAT {
                let reason = format!("format {}, this program reads {FORMAT}", index.format);
                return Err(PredictionsError::content(&path, reason));
            }
            let outside = |file: &str| !crate::formats::stays_inside(Path::new(file));
            if let Some(clip) = index.clips.iter().find(|clip| outside(&clip.file)) {
                let reason = format!("`{}` lies outside the folder", clip.file);
                return Err(PredictionsError::content(&path, reason));
            }
            index
        } else {
            PredictionsIndex {
                format: FORMAT,
                system: directory.file_name().map_or_else(
                    || "unnamed".to_owned(),
                    |name| name.to_string_lossy().into_owned(),
                ),
                signals: BTreeMap::new(),
                clips: npz_files(directory)?,
            }
        };
        if index.clips.is_empty() {
            let reason = format!("no predictions: neither {INDEX} nor any .npz file");
            return Err(PredictionsError::content(directory, reason));
        }
        Ok(Self {
            directory: directory.to_owned(),
            index,
        })
    }

    /// The reconstruction bound of the same clips; `None` where the system has none.
    ///
    /// # Errors
    /// As [`Predictions::open`].
    pub fn reconstruction_bound(&self) -> Result<Option<Self>, PredictionsError> {
        let folder = self.directory.join(RECONSTRUCTION_BOUND);
        folder
            .join(INDEX)
            .is_file()
            .then(|| Self::open(&folder))
            .transpose()
    }

    /// The samples of the same clips, each from a seed of its own; none where only one was asked for.
    ///
    /// # Errors
    /// As [`Predictions::open`].
    pub fn samples(&self) -> Result<Vec<Self>, PredictionsError> {
        let folder = |n: usize| sample_folder(&self.directory, n);
        (0..)
            .map(folder)
            .take_while(|folder| folder.join(INDEX).is_file())
            .map(|folder| Self::open(&folder))
            .collect()
    }

    /// The position of every clip of the index, by id.
    #[must_use]
    pub fn positions(&self) -> BTreeMap<String, usize> {
        let clips = self.index.clips.iter().enumerate();
        clips.map(|(i, clip)| (clip.id.clone(), i)).collect()
    }

    /// The signals of the clip at `position` of the index.
    ///
    /// # Errors
    /// When its file cannot be read, or an array has another shape than the format says.
    pub fn load(&self, position: usize) -> Result<Clip, PredictionsError> {
        let entry = self.index.clips.get(position).ok_or_else(|| {
            PredictionsError::content(&self.directory, format!("no clip {position}"))
        })?;
        let path = self.directory.join(&entry.file);
        let npz = Npz::read(&path)?;
        let rate = |modality: &str, usual: f64| {
            self.index
                .signals
                .get(modality)
                .map_or(usual, |note| note.rate)
        };
        from_npz(&npz, &entry.id, &entry.source, rate)
            .map_err(|reason| PredictionsError::content(&path, reason))
    }

    /// Token certainty of the clip at `position`, by modality.
    ///
    /// # Errors
    /// As [`Predictions::load`].
    pub fn certainty(
        &self,
        position: usize,
    ) -> Result<BTreeMap<String, Vec<f32>>, PredictionsError> {
        let Some(entry) = self.index.clips.get(position) else {
            return Ok(BTreeMap::new());
        };
        let npz = Npz::read(&self.directory.join(&entry.file))?;
        npz.arrays
            .iter()
            .filter_map(|(name, array)| Some((name.strip_prefix("certainty.")?, array)))
            .map(|(modality, array)| {
                Ok((modality.to_owned(), array.to_dim::<f32, Ix1>()?.to_vec()))
            })
            .collect()
    }
}

/// Where sample `n` of the predictions in `directory` lies.
#[must_use]
pub fn sample_folder(directory: &Path, n: usize) -> PathBuf {
    directory.join(SAMPLES).join(format!("{n:02}"))
}

/// Every `.npz` below `directory` (two levels of folders at most), in the order of their names.
fn npz_files(directory: &Path) -> Result<Vec<PredictedClip>, PredictionsError> {
    fn collect(
        root: &Path,
        inside: &str,
        depth: usize,
        found: &mut Vec<PredictedClip>,
    ) -> Result<(), PredictionsError> {
        let folder = root.join(inside);
        let mut names = Vec::new();
        for entry in std::fs::read_dir(&folder).map_err(PredictionsError::io(&folder))? {
            let entry = entry.map_err(PredictionsError::io(&folder))?;
            names.push((
                entry.file_name().to_string_lossy().into_owned(),
                entry.path().is_dir(),
            ));
        }
        names.sort();
        for (name, is_folder) in names {
            let file = if inside.is_empty() {
                name
            } else {
                format!("{inside}/{name}")
            };
            if is_folder && depth > 0 {
                collect(root, &file, depth - 1, found)?;
            } else if let Some(id) = file.strip_suffix(".npz") {
                found.push(PredictedClip {
                    id: id.to_owned(),
                    source: String::new(),
                    file: file.clone(),
                });
            }
        }
        Ok(())
    }
    let mut found = Vec::new();
    collect(directory, "", 2, &mut found)?;
    Ok(found)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::clip::{BODY, CAMERA, CameraTrack, GAZE, GazeTrack, JointTrack, Key, Signal};
    use nalgebra::{Isometry3, Translation3};
    use ndarray::{Array2, Array3, ArrayD};

    fn clip() -> Clip {
        let mut clip = Clip::empty("world/a/000001", "world");
        let turn = nalgebra::UnitQuaternion::from_euler_angles(0.1, 0.2, 0.3);
        clip.set(
            CAMERA,
            CameraTrack {
                rate: 30.0,
                T_world_camera: vec![
                    Isometry3::from_parts(Translation3::new(1.0, 2.0, 3.0), turn);
                    4
                ],
                valid: vec![true, false, true, true],
                up_world: None,
                intrinsics: None,
            },
        );
        clip.set(
            GAZE,
            GazeTrack {
                rate: 30.0,
                points: Array2::from_elem((4, 2), 0.25),
                valid: Array1::from_elem(4, true),
            },
        );
        clip.set(
            BODY,
            JointTrack {
                rate: 30.0,
                joints: Array3::from_elem((4, 21, 3), 0.5),
                valid: Array2::from_elem((4, 21), true),
            },
        );
        clip.set(
            Key::new("head_imu"),
            Signal {
                values: ArrayD::zeros(vec![4, 6]),
                valid: None,
            },
        );
        clip
    }

    #[test]
    fn a_clip_survives_the_disk() {
        let folder = tempfile::tempdir().unwrap();
        let mut writer =
            PredictionsWriter::create(folder.path(), "reviv", BTreeMap::new()).unwrap();
        let certainty = BTreeMap::from([("gaze".to_owned(), vec![0.5_f32; 4])]);
        writer.add(&clip(), &certainty).unwrap();
        writer.finish().unwrap();
        let predictions = Predictions::open(folder.path()).unwrap();
        let back = predictions.load(0).unwrap();
        let own = clip();
        let (a, b) = (own.camera().unwrap(), back.camera().unwrap());
        assert!(
            (a.T_world_camera[0].to_homogeneous() - b.T_world_camera[0].to_homogeneous()).amax()
                < 1e-12
        );
        assert_eq!(a.valid, b.valid);
        assert_eq!(
            (back.id.as_str(), back.gaze(), back.body()),
            ("world/a/000001", own.gaze(), own.body())
        );
        assert_eq!(back.signal("head_imu"), own.signal("head_imu"));
        assert_eq!(predictions.certainty(0).unwrap(), certainty);
    }

    #[test]
    fn a_folder_of_arrays_is_enough_and_nonsense_is_named() {
        let folder = tempfile::tempdir().unwrap();
        let file = folder.path().join("egom2p/a.npz");
        std::fs::create_dir(folder.path().join("egom2p")).unwrap();
        let nine = Array2::from_shape_fn(
            (60, 9),
            |(_, c)| if c == 0 || c == 4 { 0.7_f32 } else { 0.01 },
        );
        Npz::default().with("cam", nine).write(&file).unwrap();
        let predictions = Predictions::open(folder.path()).unwrap();
        assert_eq!(predictions.index.clips[0].id, "egom2p/a");
        assert_eq!(
            predictions
                .load(0)
                .unwrap()
                .camera()
                .unwrap()
                .T_world_camera
                .len(),
            60
        );
        for bad in [
            Npz::default().with("camera", Array3::<f64>::zeros((3, 4, 4))),
            Npz::default().with("gaze", Array2::<f32>::zeros((3, 3))),
            Npz::default()
                .with("body", Array3::<f32>::zeros((3, 21, 3)))
                .with("body_valid", Array1::from_elem(2, true)),
        ] {
            bad.write(&file).unwrap();
            let error = predictions.load(0).unwrap_err().to_string();
            assert!(error.contains("array `"), "{error}");
        }
        assert!(Predictions::open(&folder.path().join("nothing")).is_err());
    }
}
