//! How natural the motion of the body is, over all clips: kinematic descriptors, and embeddings that the user brings.

use super::joints::MeanPose;
use crate::clip::BODY;
use crate::evaluation::columns::{Column, ColumnInfo};
use crate::evaluation::metric::{
    AllClips, Baseline, ClipScore, Embeddings, Features, MetricEntry, MetricSet, OverClips, Pair,
};
use crate::evaluation::motion::{
    KinScores, frechet_distance, kin_scores, kinematic_descriptor, mean_cosine, score01,
};
use crate::evaluation::outcome::{MetricError, Outcome};
use crate::evaluation::scores::SetScore;
use ndarray::Axis;

/// The body frame's vertical axis (z up) and the pelvis.
const UP: usize = 2;
const ROOT: usize = 0;

struct KinematicMetrics;
inventory::submit! { MetricEntry(&KinematicMetrics) }

impl MetricSet for KinematicMetrics {
    fn name(&self) -> &'static str {
        "kinematics"
    }

    fn columns(&self) -> &'static [ColumnInfo] {
        const FID: ColumnInfo = ColumnInfo::lower(
            "body.kin_fid",
            "",
            "Fréchet distance of kinematic descriptors (no weights); not FID",
        );
        const {
            &[
                ColumnInfo::higher(
                    "body.kin_cos",
                    "",
                    "cosine of kinematic descriptors (no weights)",
                ),
                FID.per_set(),
            ]
        }
    }

    /// A clip has descriptors where every joint of the truth is valid.
    fn score(&self, pair: &Pair<'_>, _: &[Column]) -> Result<ClipScore, MetricError> {
        let both = pair.both(BODY).filter(|(truth, prediction)| {
            truth.valid.iter().all(|v| *v) && truth.joints.dim() == prediction.joints.dim()
        });
        let features = both.map(|(truth, prediction)| Features {
            predicted: kinematic_descriptor(prediction.joints.view(), truth.rate, ROOT, UP),
            truth: kinematic_descriptor(truth.joints.view(), truth.rate, ROOT, UP),
        });
        Ok(ClipScore {
            features,
            ..ClipScore::default()
        })
    }

    fn over_clips(
        &self,
        columns: &[Column],
        clips: &AllClips<'_>,
    ) -> Result<Vec<(Column, OverClips)>, MetricError> {
        let found = kinematics(&clips.features);
        let kin = found.as_ref().ok();
        let one = |column: &Column| {
            let filled = if column.metric() == "kin_cos" {
                let mut cosines = kin.map(|k| k.cosines.iter()).into_iter().flatten();
                let described = clips.features.iter();
                let next = described.map(|d| d.and_then(|_| cosines.next().copied()));
                OverClips::PerClip(next.map(Outcome::of).collect())
            } else {
                OverClips::Set(SetScore {
                    column: column.clone(),
                    value: kin.and_then(|kin| kin.kin_fid),
                    n: kin.map_or(0, |kin| kin.n),
                    dim: kin.map_or(0, |kin| kin.dim),
                    floor: kin.and_then(|kin| kin.floor),
                    unavailable: found.as_ref().err().cloned(),
                })
            };
            (column.clone(), filled)
        };
        Ok(columns.iter().map(one).collect())
    }

    fn baselines(&self, _: &[Column]) -> Vec<Box<dyn Baseline>> {
        vec![Box::new(MeanPose(BODY))]
    }
}

/// Scores over the clips that have descriptors, or why there are none: fewer than two, or a clip without a direction (it sits
/// at the mean).
fn kinematics(described: &[Option<&Features>]) -> Result<KinScores, String> {
    let pairs: Vec<&Features> = described.iter().copied().flatten().collect();
    if pairs.len() < 2 {
        return Err("needs two clips with every joint valid".to_owned());
    }
    let stack = |views: Vec<_>| ndarray::stack(Axis(0), &views).map_err(|error| error.to_string());
    let predicted = stack(pairs.iter().map(|p| p.predicted.view()).collect())?;
    let truth = stack(pairs.iter().map(|p| p.truth.view()).collect())?;
    kin_scores(predicted.view(), truth.view()).map_err(|refusal| refusal.to_string())
}

struct EmbeddingMetrics;
inventory::submit! { MetricEntry(&EmbeddingMetrics) }

impl MetricSet for EmbeddingMetrics {
    fn name(&self) -> &'static str {
        "tmr"
    }

    fn columns(&self) -> &'static [ColumnInfo] {
        const UNIT: &str = "Fréchet distance of TMR embeddings of the body, rows of unit length";
        const RAW: &str = "Fréchet distance of TMR embeddings of the body, rows as they are";
        const SHIFTED: &str = "mean of (cos + 1)/2 of TMR embeddings of the body";
        const COSINE: &str = "mean cosine of TMR embeddings of the body";
        const {
            &[
                ColumnInfo::lower("motion.fid", "", UNIT).per_set(),
                ColumnInfo::lower("motion.fid_raw", "", RAW).per_set(),
                ColumnInfo::higher("motion.similarity", "", SHIFTED).per_set(),
                ColumnInfo::higher("motion.cosine", "", COSINE).per_set(),
            ]
        }
    }

    fn modalities<'a>(&self, _: &'a Column) -> Vec<&'a str> {
        vec![BODY.name()]
    }

    /// The body is embedded beforehand, by [`crate::evaluation::tmr`] or the user; a clip has nothing to score.
    fn score(&self, _: &Pair<'_>, _: &[Column]) -> Result<ClipScore, MetricError> {
        Ok(ClipScore::default())
    }

    fn over_clips(
        &self,
        columns: &[Column],
        clips: &AllClips<'_>,
    ) -> Result<Vec<(Column, OverClips)>, MetricError> {
        let one = |column: &Column| {
            let mut score = SetScore {
                column: column.clone(),
                value: None,
                n: 0,
                dim: 0,
                floor: None,
                unavailable: Some(
                    "unavailable: no `motion_encoder` and no `embeddings`".to_owned(),
                ),
            };
            if let Some(Embeddings { predicted, truth }) = clips.embeddings {
                let (p, t) = (predicted.view(), truth.view());
                (score.n, score.dim) = (p.nrows(), p.ncols());
                score.unavailable = None;
                score.value = match column.metric() {
                    "fid" => frechet_distance(p, t, true),
                    "fid_raw" => frechet_distance(p, t, false),
                    "similarity" => mean_cosine(p, t).map(|cosine| cosine.map(score01)),
                    _ => mean_cosine(p, t),
                }?;
            }
            Ok((column.clone(), OverClips::Set(score)))
        };
        columns.iter().map(one).collect()
    }
}
