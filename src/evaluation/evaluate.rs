//! An evaluation: every clip of a suite, the trivial baselines on the same clips, and what had to be left out.

use super::baselines::{Means, image_centre};
use super::columns::{Column, declared};
use super::motion::{KinScores, frechet_distance, kin_scores, mean_cosine};
use super::outcome::{MetricError, Outcome};
use super::score_clip::{ClipScore, score_clip, still_camera};
use super::scores::{ColumnScores, FLOOR, FORMAT, ScoreSet, Scores, SetScore};
use super::suite::{Suite, UnknownMetric};
use crate::clip::Clip;
use ndarray::{Array1, Array2, ArrayView2, Axis};
use rayon::prelude::*;
use std::collections::BTreeMap;

/// Any failure of whoever holds the clips.
pub type LoadError = Box<dyn std::error::Error + Send + Sync>;

/// True and predicted clips, loaded one at a time and from several threads.
pub trait Pairs: Sync {
    /// Ids of the true clips.
    fn ids(&self) -> &[String];

    /// The true clip.
    ///
    /// # Errors
    /// When it cannot be read.
    fn truth(&self, index: usize) -> Result<Clip, LoadError>;

    /// What the system predicted for it; `None` where it did not.
    ///
    /// # Errors
    /// When it cannot be read.
    fn prediction(&self, index: usize) -> Result<Option<Clip>, LoadError>;

    /// The truth after a round trip through the tokenizers: no model of tokens can do better.
    ///
    /// # Errors
    /// When it cannot be computed.
    fn tokenizer_floor(&self, _index: usize) -> Result<Option<Clip>, LoadError> {
        Ok(None)
    }
}

/// Motion embeddings that the user brings, one row per clip: TMR's 256-d mean vectors.
#[derive(Debug, Clone, PartialEq)]
pub struct Embeddings {
    pub predicted: Array2<f64>,
    pub truth: Array2<f64>,
}

/// Why an evaluation stops.
#[derive(Debug, thiserror::Error)]
pub enum EvaluationError {
    #[error(transparent)]
    Metric(#[from] UnknownMetric),
    #[error("clip `{clip}`: {error}")]
    Load { clip: String, error: LoadError },
    #[error("clip `{clip}`: refused: {refusal}")]
    Refused { clip: String, refusal: MetricError },
    #[error("motion embeddings: {0}")]
    Embeddings(MetricError),
    #[error("none of the {truth} clips has a prediction; do the clip ids agree (`{example}`)?")]
    NoOverlap { truth: usize, example: String },
    #[error("interrupted")]
    Interrupted,
}

/// Clips per step between two calls of `progress`; also the unit of parallel work, so results do not depend on threads.
pub(super) const CHUNK: usize = 64;

/// Scores `system`'s predictions on a suite.
///
/// `progress(done, total)` is called now and then; returning false stops with [`EvaluationError::Interrupted`].
///
/// # Errors
/// When a metric is unknown, a clip cannot be read, a prediction is refused, or nothing was predicted at all.
pub fn evaluate(
    suite_name: &str,
    suite: &Suite,
    system: &str,
    pairs: &dyn Pairs,
    embeddings: Option<&Embeddings>,
    progress: &mut dyn FnMut(usize, usize) -> bool,
) -> Result<Scores, EvaluationError> {
    let columns = suite.columns()?;
    let ids = pairs.ids();
    let chosen = match &suite.sample {
        Some(sample) => sample.draw(ids),
        None => (0..ids.len()).collect(),
    };
    let means = Means::of_truth(pairs, &chosen, &columns)?;
    let mut rows: Vec<(usize, Row)> = Vec::with_capacity(chosen.len());
    let mut left_out: BTreeMap<String, usize> = BTreeMap::new();
    for chunk in chosen.chunks(CHUNK) {
        let scored: Vec<Result<Option<Row>, EvaluationError>> = chunk
            .par_iter()
            .map(|&index| Row::score(pairs, index, &columns, suite.depth_max, &means))
            .collect();
        for (&index, row) in chunk.iter().zip(scored) {
            match row? {
                Some(row) => rows.push((index, row)),
                None => *left_out.entry("no prediction".to_owned()).or_default() += 1,
            }
        }
        if !progress(rows.len(), chosen.len()) {
            return Err(EvaluationError::Interrupted);
        }
    }
    if rows.is_empty() {
        return Err(EvaluationError::NoOverlap {
            truth: chosen.len(),
            example: ids.first().cloned().unwrap_or_default(),
        });
    }

    let mut notes = Vec::new();
    let mut note = |count: usize, text: &str| {
        if count > 0 {
            notes.push(format!("{count} of {} clips: {text}", rows.len()));
        }
    };
    note(
        rows.iter().filter(|(_, r)| r.own.resampled).count(),
        "the estimated camera was resampled to the reference's rate (linear positions, slerp rotations)",
    );
    note(
        rows.iter()
            .filter(|(_, r)| r.own.negative_depth_scale)
            .count(),
        "warning: the depth fit has a negative scale (the prediction looks like inverse depth)",
    );
    for (_, row) in &rows {
        for modality in &row.own.missing {
            *left_out
                .entry(format!("no {modality} in the prediction"))
                .or_default() += 1;
        }
    }

    let clip_ids = rows.iter().map(|(index, _)| ids[*index].clone()).collect();
    let rows: Vec<Row> = rows.into_iter().map(|(_, row)| row).collect();
    let mut own = collect(&columns, rows.iter().map(|r| Some(&r.own)));
    own.sets.extend(embedding_scores(&columns, embeddings)?);
    let mut baselines = BTreeMap::new();
    for (name, of) in BASELINES {
        let set = collect(&columns, rows.iter().map(|row| of(row)));
        let set = without_empty(set);
        if !set.columns.is_empty() || !set.sets.is_empty() {
            baselines.insert((*name).to_owned(), set);
        }
    }
    Ok(Scores {
        format: FORMAT,
        suite: suite_name.to_owned(),
        system: system.to_owned(),
        clips: clip_ids,
        own,
        baselines,
        left_out,
        notes,
        sample: suite.sample.clone(),
    })
}

/// A clip's scores of the system and of every baseline.
struct Row {
    own: ClipScore,
    still: ClipScore,
    centre: ClipScore,
    mean: ClipScore,
    mean_depth: ClipScore,
    mean_value: ClipScore,
    floor: Option<ClipScore>,
}

type BaselineOf = fn(&Row) -> Option<&ClipScore>;

/// What asks for no learning at all, by name.
const BASELINES: &[(&str, BaselineOf)] = &[
    ("still camera", |row| Some(&row.still)),
    ("image centre", |row| Some(&row.centre)),
    ("mean pose", |row| Some(&row.mean)),
    ("mean depth image", |row| Some(&row.mean_depth)),
    ("mean value", |row| Some(&row.mean_value)),
    (FLOOR, |row| row.floor.as_ref()),
];

impl Row {
    fn score(
        pairs: &dyn Pairs,
        index: usize,
        columns: &[Column],
        depth_max: Option<f64>,
        means: &Means,
    ) -> Result<Option<Self>, EvaluationError> {
        let clip = || pairs.ids()[index].clone();
        let load = |error| EvaluationError::Load {
            clip: clip(),
            error,
        };
        let Some(prediction) = pairs.prediction(index).map_err(load)? else {
            return Ok(None);
        };
        let truth = pairs.truth(index).map_err(load)?;
        let score = |columns: &[Column], prediction: &Clip| {
            score_clip(columns, depth_max, &truth, prediction).map_err(|refusal| {
                EvaluationError::Refused {
                    clip: clip(),
                    refusal,
                }
            })
        };
        let own = score(columns, &prediction)?;
        drop(prediction);
        let trivial = |modalities: &[&str], trivial: &Clip| -> Result<ClipScore, EvaluationError> {
            let mut scored = score(columns, trivial)?;
            for (value, column) in scored.values.iter_mut().zip(columns) {
                if !modalities.contains(&column.modality()) {
                    *value = Outcome::Null;
                }
            }
            Ok(scored)
        };
        let still = ClipScore {
            values: still_camera(columns, &truth).map_err(|refusal| EvaluationError::Refused {
                clip: clip(),
                refusal,
            })?,
            ..ClipScore::default()
        };
        let floor = match pairs.tokenizer_floor(index).map_err(load)? {
            Some(floor) => Some(score(columns, &floor)?),
            None => None,
        };
        let signals: Vec<&str> = columns.iter().filter_map(|c| declared(&c.name)).collect();
        Ok(Some(Self {
            own,
            still,
            centre: trivial(&["gaze"], &image_centre(&truth))?,
            mean: trivial(
                &["body", "hands", "left_hand", "right_hand"],
                &means.pose(&truth),
            )?,
            mean_depth: trivial(&["depth"], &means.depth(&truth))?,
            mean_value: trivial(&signals, &means.declared(&truth))?,
            floor,
        }))
    }
}

/// Turns rows into columns; set-wide kinematic scores are computed here.
fn collect<'a>(
    columns: &[Column],
    rows: impl Iterator<Item = Option<&'a ClipScore>> + Clone,
) -> ScoreSet {
    let mut set = ScoreSet::default();
    let described: Vec<Option<&(Array1<f64>, Array1<f64>)>> = rows
        .clone()
        .map(|row| row.and_then(|r| r.descriptors.as_ref()))
        .collect();
    let kin = kinematics(&described);
    for (position, column) in columns.iter().enumerate() {
        match column.name.as_str() {
            "body.kin_fid" => {
                let found = kin.as_ref().ok();
                set.sets.push(SetScore {
                    column: column.clone(),
                    value: found.and_then(|kin| kin.kin_fid),
                    n: found.map_or(0, |kin| kin.n),
                    dim: found.map_or(0, |kin| kin.dim),
                    floor: found.and_then(|kin| kin.floor),
                    unavailable: kin.as_ref().err().cloned(),
                });
            }
            "body.kin_cos" => {
                let mut cosines = kin
                    .as_ref()
                    .ok()
                    .map(|k| k.cosines.as_slice())
                    .unwrap_or_default()
                    .iter();
                let values = described
                    .iter()
                    .map(|d| Outcome::of(d.and_then(|_| cosines.next().copied())))
                    .collect();
                set.columns.push(ColumnScores {
                    column: column.clone(),
                    values,
                });
            }
            _ if column.is_per_set() => {}
            _ => set.columns.push(ColumnScores {
                column: column.clone(),
                values: rows
                    .clone()
                    .map(|row| row.map_or(Outcome::Null, |r| r.values[position]))
                    .collect(),
            }),
        }
    }
    set
}

/// Scores over the clips that have descriptors, or why there are none: fewer than two, or a clip without a direction (it sits
/// at the mean).
fn kinematics(described: &[Option<&(Array1<f64>, Array1<f64>)>]) -> Result<KinScores, String> {
    let pairs: Vec<_> = described.iter().flatten().collect();
    if pairs.len() < 2 {
        return Err("needs two clips with every joint valid".to_owned());
    }
    let stack = |views: Vec<_>| ndarray::stack(Axis(0), &views).map_err(|error| error.to_string());
    let predicted = stack(pairs.iter().map(|p| p.0.view()).collect())?;
    let truth = stack(pairs.iter().map(|p| p.1.view()).collect())?;
    kin_scores(predicted.view(), truth.view()).map_err(|refusal| refusal.to_string())
}

fn embedding_scores(
    columns: &[Column],
    embeddings: Option<&Embeddings>,
) -> Result<Vec<SetScore>, EvaluationError> {
    columns
        .iter()
        .filter(|column| column.name.starts_with("body.tmr_"))
        .map(|column| {
            let mut score = SetScore {
                column: column.clone(),
                value: None,
                n: 0,
                dim: 0,
                floor: None,
                unavailable: Some("unavailable: TMR weights not configured".to_owned()),
            };
            let Some(Embeddings { predicted, truth }) = embeddings else {
                return Ok(score);
            };
            let (p, t): (ArrayView2<f64>, ArrayView2<f64>) = (predicted.view(), truth.view());
            (score.n, score.dim, score.unavailable) = (predicted.nrows(), predicted.ncols(), None);
            score.value = match column.name.as_str() {
                "body.tmr_fid" => frechet_distance(p, t, true),
                "body.tmr_fid_raw" => frechet_distance(p, t, false),
                _ => mean_cosine(p, t),
            }
            .map_err(EvaluationError::Embeddings)?;
            Ok(score)
        })
        .collect()
}

/// Without the columns in which a baseline has nothing at all.
fn without_empty(mut set: ScoreSet) -> ScoreSet {
    set.columns
        .retain(|c| c.values.iter().any(|v| *v != Outcome::Null));
    set.sets.retain(|s| s.value.is_some());
    set
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::clip::{BODY, CAMERA, CameraTrack, DEPTH, Depth, GAZE, GazeTrack, JointTrack};
    use nalgebra::{Isometry3, Translation3, UnitQuaternion};
    use ndarray::Array3;
    use rand::RngExt;

    /// Ten walking clips and a system that adds `noise` to the truth, except where `predicted` says it did nothing. `joint` says
    /// whether a clip's first joint is valid.
    struct Walks {
        ids: Vec<String>,
        noise: f64,
        predicted: fn(usize) -> bool,
        joint: fn(usize) -> bool,
    }

    fn walks(noise: f64) -> Walks {
        Walks {
            ids: (0..10).map(|i| format!("walk/{i}")).collect(),
            noise,
            predicted: |_| true,
            joint: |_| true,
        }
    }

    impl Walks {
        fn clip(&self, index: usize, noise: f64) -> Clip {
            let mut rng = crate::random::stream(0, "evaluate.walk", index as u64, 0);
            let mut error = crate::random::stream(1, "evaluate.error", index as u64, 0);
            let mut next = || rng.random::<f64>() + noise * error.random::<f64>();
            let mut clip = Clip::empty(self.ids[index].clone(), "walks");
            let poses = (0..60)
                .map(|i| {
                    let turn =
                        UnitQuaternion::from_euler_angles(0.1 * next(), 0.1 * next(), 0.1 * next());
                    Isometry3::from_parts(
                        Translation3::new(0.05 * i as f64, 0.1 * next(), 0.1 * next()),
                        turn,
                    )
                })
                .collect();
            clip.set(
                CAMERA,
                CameraTrack {
                    rate: 30.0,
                    T_world_camera: poses,
                    valid: vec![true; 60],
                    up_world: None,
                    intrinsics: None,
                },
            );
            clip.set(
                BODY,
                JointTrack {
                    rate: 30.0,
                    joints: Array3::from_shape_fn((60, 21, 3), |_| next() as f32),
                    valid: Array2::from_shape_fn((60, 21), |at| {
                        at != (0, 0) || (self.joint)(index)
                    }),
                },
            );
            clip.set(
                GAZE,
                GazeTrack {
                    rate: 30.0,
                    points: Array2::from_shape_fn((60, 2), |_| next() as f32),
                    valid: Array1::from_elem(60, true),
                },
            );
            clip.set(
                DEPTH,
                Depth {
                    rate: 8.0,
                    metres: Array3::from_shape_fn((16, 4, 4), |_| 1.0 + next() as f32),
                },
            );
            clip
        }
    }

    impl Pairs for Walks {
        fn ids(&self) -> &[String] {
            &self.ids
        }
        fn truth(&self, index: usize) -> Result<Clip, LoadError> {
            Ok(self.clip(index, 0.0))
        }
        fn prediction(&self, index: usize) -> Result<Option<Clip>, LoadError> {
            Ok((self.predicted)(index).then(|| self.clip(index, self.noise)))
        }
    }

    fn scores(pairs: &dyn Pairs) -> Result<Scores, EvaluationError> {
        evaluate(
            "test",
            &Suite::default(),
            "walks",
            pairs,
            None,
            &mut |_, _| true,
        )
    }

    fn value(set: &ScoreSet, name: &str) -> f64 {
        super::super::statistics::summarise(&set.column(name).unwrap().values)
            .mean
            .unwrap()
    }

    #[test]
    fn a_good_prediction_beats_every_trivial_baseline_and_the_truth_itself_is_perfect() {
        let perfect = scores(&walks(0.0)).unwrap();
        for name in [
            "body.ga_mpjpe",
            "camera.ate",
            "camera.rre",
            "gaze.mse",
            "depth.abs_rel@depth",
        ] {
            assert!(value(&perfect.own, name) < 1e-5, "{name}");
        }
        assert_eq!(perfect.own.set("body.kin_fid").unwrap().value, Some(0.0));
        let good = scores(&walks(0.2)).unwrap();
        for (baseline, name) in [
            ("mean pose", "body.ga_mpjpe"),
            ("still camera", "camera.rte"),
            ("still camera", "camera.rre"),
            ("image centre", "gaze.mse"),
            ("mean depth image", "depth.abs_rel@depth"),
        ] {
            let trivial = value(&good.baselines[baseline], name);
            assert!(
                value(&good.own, name) < trivial,
                "{name} against {baseline}"
            );
        }
    }

    #[test]
    fn what_was_not_predicted_is_counted_and_nothing_at_all_is_an_error() {
        let some = Walks {
            predicted: |i| i % 3 == 0,
            ..walks(0.1)
        };
        let scores_of_some = scores(&some).unwrap();
        assert_eq!(
            (
                scores_of_some.clips.len(),
                scores_of_some.left_out["no prediction"]
            ),
            (4, 6)
        );
        let none = Walks {
            predicted: |_| false,
            ..walks(0.1)
        };
        assert!(matches!(
            scores(&none),
            Err(EvaluationError::NoOverlap { truth: 10, .. })
        ));
    }

    #[test]
    fn a_column_that_needs_whole_bodies_says_so_where_there_are_none() {
        let reason = |joint| {
            let walks = Walks {
                joint,
                ..walks(0.1)
            };
            let scores = scores(&walks).unwrap();
            let fid = scores.own.set("body.kin_fid").unwrap().clone();
            assert_eq!(fid.value.is_none(), fid.unavailable.is_some());
            assert!(!scores.baselines.contains_key(FLOOR));
            fid.unavailable
        };
        let needs = Some("needs two clips with every joint valid".to_owned());
        assert_eq!(reason(|_| false), needs);
        assert_eq!(reason(|index| index == 3), needs);
        assert_eq!(reason(|index| index < 4), None);
    }

    #[test]
    fn a_refused_prediction_names_its_clip() {
        let error = scores(&walks(f64::NAN)).unwrap_err().to_string();
        assert!(
            error.contains("walk/0") && error.contains("refused"),
            "{error}"
        );
    }

    #[test]
    fn scores_do_not_depend_on_the_number_of_threads_and_survive_the_disk() {
        let run = |threads| {
            let pool = rayon::ThreadPoolBuilder::new()
                .num_threads(threads)
                .build()
                .unwrap();
            pool.install(|| scores(&walks(0.3)).unwrap())
        };
        let one = run(1);
        assert_eq!(one, run(3));
        let folder = tempfile::tempdir().unwrap();
        one.write(folder.path()).unwrap();
        assert_eq!(Scores::read(folder.path()).unwrap(), one);
    }
}
