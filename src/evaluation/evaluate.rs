//! An evaluation: every clip of a suite, the trivial baselines on the same clips, and what had to be left out.

use super::columns::Column;
use super::depth;
use super::metric::{AllClips, Baseline, ClipScore, Mean, MetricSet, OverClips, Pair, set_of};
use super::outcome::{MetricError, Outcome};
use super::samples;
use super::scores::{ColumnScores, FORMAT, RECONSTRUCTION_BOUND, ScoreSet, Scores, SetScore};
use super::suite::{Suite, UnknownMetric};
use crate::clip::Clip;
use ndarray::Array2;
use rayon::prelude::*;
use std::collections::{BTreeMap, BTreeSet};

pub use super::metric::Embeddings;

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
    fn reconstruction_bound(&self, _index: usize) -> Result<Option<Clip>, LoadError> {
        Ok(None)
    }

    /// Other predictions of the same clip, each from a seed of its own; none where the system was asked once.
    ///
    /// # Errors
    /// When they cannot be read.
    fn samples(&self, _index: usize) -> Result<Vec<Clip>, LoadError> {
        Ok(Vec::new())
    }
}

/// Why an evaluation stops.
#[derive(Debug, thiserror::Error)]
pub enum EvaluationError {
    /// The suite names a metric that is no column.
    #[error(transparent)]
    Metric(#[from] UnknownMetric),
    /// A clip could not be read: the truth, the prediction or the reconstruction bound.
    #[error("clip `{clip}`: {error}")]
    Load {
        /// Its id.
        clip: String,
        /// Why, in the words of whoever holds the clips.
        error: LoadError,
    },
    /// A metric refused to score a clip; nothing after it is evaluated.
    #[error("clip `{clip}`: refused: {refusal}")]
    Refused {
        /// Its id.
        clip: String,
        /// What was wrong with its values.
        refusal: MetricError,
    },
    /// What is computed over all clips was refused: embeddings or descriptors that do not fit or have no direction.
    #[error("motion embeddings: {0}")]
    Embeddings(MetricError),
    /// No clip of the suite has a prediction.
    #[error("none of the {truth} clips has a prediction; do the clip ids agree (`{example}`)?")]
    NoOverlap {
        /// How many true clips the suite chose.
        truth: usize,
        /// Id of the first true clip, to compare with those of the predictions; empty where there is none.
        example: String,
    },
    /// `progress` asked to stop.
    #[error("interrupted")]
    Interrupted,
}

/// Clips per step between two calls of `progress`; also the unit of parallel work, so results do not depend on threads.
const CHUNK: usize = 64;

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
    let plan = Plan::new(suite)?;
    let ids = pairs.ids();
    let chosen = suite.chosen(ids);
    let means = plan.means(pairs, &chosen)?;
    let mut rows: Vec<(usize, Row)> = Vec::with_capacity(chosen.len());
    let mut left_out: BTreeMap<String, usize> = BTreeMap::new();
    for chunk in chosen.chunks(CHUNK) {
        let scored: Vec<Result<Option<Row>, EvaluationError>> = chunk
            .par_iter()
            .map(|&index| plan.score(pairs, index, &means))
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
    let clips = rows.iter().map(|(index, _)| ids[*index].clone()).collect();
    let rows: Vec<Row> = rows.into_iter().map(|(_, row)| row).collect();
    for modality in rows.iter().flat_map(|row| &row.missing) {
        let reason = format!("no {modality} in the prediction");
        *left_out.entry(reason).or_default() += 1;
    }
    let own: Vec<Option<&Scored>> = rows.iter().map(|row| Some(&row.own)).collect();
    let names: BTreeSet<&str> = rows
        .iter()
        .flat_map(|r| r.baselines.keys().copied())
        .collect();
    let mut baselines = BTreeMap::new();
    for name in names {
        let of = rows.iter().map(|row| row.baselines.get(name));
        let set = without_empty(plan.collect(&of.collect::<Vec<_>>(), None)?);
        if !set.columns.is_empty() || !set.sets.is_empty() {
            baselines.insert(name.to_owned(), set);
        }
    }
    Ok(Scores {
        format: FORMAT,
        suite: suite_name.to_owned(),
        system: system.to_owned(),
        clips,
        own: plan.collect(&own, embeddings)?,
        baselines,
        left_out,
        notes: notes(&own),
        sample: suite.sample.clone(),
    })
}

/// What a reader must know of how the system was scored, with the number of clips it holds for.
fn notes(own: &[Option<&Scored>]) -> Vec<String> {
    let mut counts: BTreeMap<&str, usize> = BTreeMap::new();
    let scores = own.iter().flatten().flat_map(|scored| scored.iter());
    for note in scores.flat_map(|score| &score.notes) {
        *counts.entry(*note).or_default() += 1;
    }
    let of = own.len();
    let note = |(text, count)| format!("{count} of {of} clips: {text}");
    counts.into_iter().map(note).collect()
}

/// What a suite computes: its columns by the set that fills them, and the baselines of these sets.
struct Plan {
    groups: Vec<Group>,
    /// By name: those of several modalities that share a name make one prediction.
    baselines: Vec<Box<dyn Baseline>>,
    columns: Vec<Column>,
    depth: depth::Scored,
}

/// The columns of one set.
struct Group {
    set: &'static dyn MetricSet,
    columns: Vec<Column>,
}

/// Of one clip and one method: a score per group.
type Scored = Vec<ClipScore>;

/// Of one clip: the scores of the system and of every baseline, and what the prediction lacks.
struct Row {
    own: Scored,
    baselines: BTreeMap<&'static str, Scored>,
    missing: BTreeSet<String>,
}

impl Plan {
    fn new(suite: &Suite) -> Result<Self, UnknownMetric> {
        let columns = suite.columns()?;
        let mut groups: Vec<Group> = Vec::new();
        for column in &columns {
            // The suite has no column that no set fills.
            let Some(set) = set_of(&column.name) else {
                continue;
            };
            match groups
                .iter_mut()
                .find(|group| group.set.name() == set.name())
            {
                Some(group) => group.columns.push(column.clone()),
                None => groups.push(Group {
                    set,
                    columns: vec![column.clone()],
                }),
            }
        }
        groups.sort_by_key(|group| group.set.name());
        let mut baselines: Vec<Box<dyn Baseline>> = Vec::new();
        for baseline in groups.iter().flat_map(|g| g.set.baselines(&g.columns)) {
            let key = |b: &dyn Baseline| (b.name(), b.modality().to_owned());
            if !baselines
                .iter()
                .any(|known| key(known.as_ref()) == key(baseline.as_ref()))
            {
                baselines.push(baseline);
            }
        }
        Ok(Self {
            groups,
            baselines,
            columns,
            depth: depth::Scored::between(suite.depth_min, suite.depth_max),
        })
    }

    /// What each baseline averages, over the evaluated truth.
    fn means(
        &self,
        pairs: &dyn Pairs,
        chosen: &[usize],
    ) -> Result<Vec<Option<Array2<f64>>>, EvaluationError> {
        let mut all = vec![Mean::default(); self.baselines.len()];
        for chunk in chosen.chunks(CHUNK) {
            let parts: Vec<Result<Vec<Mean>, EvaluationError>> = chunk
                .par_iter()
                .map(|&index| {
                    let clip = pairs.truth(index).map_err(|error| EvaluationError::Load {
                        clip: pairs.ids()[index].clone(),
                        error,
                    })?;
                    let baselines = self.baselines.iter();
                    let parts = baselines.map(|baseline| {
                        let mut mean = Mean::default();
                        baseline
                            .samples(&clip)
                            .iter()
                            .for_each(|some| mean.add(some));
                        mean
                    });
                    Ok(parts.collect())
                })
                .collect();
            for part in parts {
                for (mean, more) in all.iter_mut().zip(part?) {
                    mean.merge(more);
                }
            }
        }
        Ok(all.iter().map(Mean::value).collect())
    }

    fn score(
        &self,
        pairs: &dyn Pairs,
        index: usize,
        means: &[Option<Array2<f64>>],
    ) -> Result<Option<Row>, EvaluationError> {
        let clip = || pairs.ids()[index].clone();
        let load = |error| EvaluationError::Load {
            clip: clip(),
            error,
        };
        let refused = |refusal| EvaluationError::Refused {
            clip: clip(),
            refusal,
        };
        let Some(prediction) = pairs.prediction(index).map_err(load)? else {
            return Ok(None);
        };
        let truth = pairs.truth(index).map_err(load)?;
        let score = |prediction: &Clip| -> Result<Scored, EvaluationError> {
            let pair = Pair {
                truth: &truth,
                prediction,
                depth: self.depth,
            };
            let groups = self.groups.iter();
            let scores = groups.map(|group| group.set.score(&pair, &group.columns));
            scores.collect::<Result<_, MetricError>>().map_err(refused)
        };
        let own = score(&prediction)?;
        let compared = self
            .groups
            .iter()
            .flat_map(|g| g.columns.iter().map(move |c| (g.set, c)));
        let missing = compared
            .flat_map(|(set, column)| set.modalities(column))
            .filter(|modality| truth.has(modality) && !prediction.has(modality))
            .map(str::to_owned)
            .collect();
        drop(prediction);
        let mut baselines: BTreeMap<&'static str, Scored> = BTreeMap::new();
        let mut predicted: BTreeMap<&'static str, Clip> = BTreeMap::new();
        for (baseline, mean) in self.baselines.iter().zip(means) {
            let empty = || Clip::empty(truth.id.clone(), truth.source.clone());
            let clip = predicted.entry(baseline.name()).or_insert_with(empty);
            if let Some(value) = baseline.predict(&truth, mean.as_ref()) {
                clip.insert(baseline.modality(), value);
            }
        }
        for (name, clip) in predicted {
            baselines.insert(name, score(&clip)?);
        }
        for (position, group) in self.groups.iter().enumerate() {
            let known = group.set.closed_form(&truth, &group.columns);
            if let Some((name, values)) = known.map_err(refused)? {
                let empty = || vec![ClipScore::default(); self.groups.len()];
                baselines.entry(name).or_insert_with(empty)[position].values = values;
            }
        }
        if let Some(bound) = pairs.reconstruction_bound(index).map_err(load)? {
            baselines.insert(RECONSTRUCTION_BOUND, score(&bound)?);
        }
        let samples = pairs.samples(index).map_err(load)?;
        let samples: Vec<Scored> = samples.iter().map(score).collect::<Result<_, _>>()?;
        if let Some(first) = samples.first() {
            baselines.insert(samples::ONE, first.clone());
            baselines.insert(samples::MEAN, self.over_samples(&samples, samples::mean_of));
            baselines.insert(samples::BEST, self.over_samples(&samples, samples::best_of));
        }
        Ok(Some(Row {
            own,
            baselines,
            missing,
        }))
    }

    /// What `of` makes of every column of the samples of one clip.
    fn over_samples(&self, samples: &[Scored], of: fn(&Column, &[Outcome]) -> Outcome) -> Scored {
        let group = |(position, group): (usize, &Group)| ClipScore {
            values: group
                .columns
                .iter()
                .enumerate()
                .map(|(index, column)| {
                    let all = samples.iter().map(|scored| scored[position].value(index));
                    of(column, &all.collect::<Vec<_>>())
                })
                .collect(),
            ..ClipScore::default()
        };
        self.groups.iter().enumerate().map(group).collect()
    }

    /// Turns one method's clips into columns, in the order of the suite; numbers of the whole set stand apart.
    fn collect(
        &self,
        rows: &[Option<&Scored>],
        embeddings: Option<&Embeddings>,
    ) -> Result<ScoreSet, EvaluationError> {
        let mut filled: BTreeMap<String, Vec<Outcome>> = BTreeMap::new();
        let mut sets: Vec<SetScore> = Vec::new();
        for (position, group) in self.groups.iter().enumerate() {
            for (index, column) in group.columns.iter().enumerate() {
                let values = rows
                    .iter()
                    .map(|row| row.map_or(Outcome::Null, |scored| scored[position].value(index)));
                filled.insert(column.name.clone(), values.collect());
            }
            let features = rows
                .iter()
                .map(|row| row.and_then(|s| s[position].features.as_ref()));
            let clips = AllClips {
                features: features.collect(),
                embeddings,
            };
            let over = group.set.over_clips(&group.columns, &clips);
            for (column, over) in over.map_err(EvaluationError::Embeddings)? {
                match over {
                    OverClips::PerClip(values) => drop(filled.insert(column.name, values)),
                    OverClips::Set(score) => sets.push(score),
                }
            }
        }
        let per_clip = self.columns.iter().filter(|column| !column.is_per_set());
        let scores = per_clip.map(|column| ColumnScores {
            column: column.clone(),
            values: filled.remove(&column.name).unwrap_or_default(),
        });
        Ok(ScoreSet {
            columns: scores.collect(),
            sets,
        })
    }
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
    use ndarray::Array1;
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
            assert!(!scores.baselines.contains_key(RECONSTRUCTION_BOUND));
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
