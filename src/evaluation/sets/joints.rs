//! Joint errors of the body, of each hand, and of the pair of hands.

use crate::clip::{BODY, Clip, Held, JointTrack, Key, LEFT_HAND, RIGHT_HAND};
use crate::evaluation::columns::{Column, ColumnInfo};
use crate::evaluation::joints::{HandMode, JointErrors, Valid, joint_errors, pair_of_hands};
use crate::evaluation::metric::{Baseline, ClipScore, MetricEntry, MetricSet, Pair, Samples};
use crate::evaluation::outcome::{MetricError, Outcome};
use ndarray::{Array2, Array3};

/// The pelvis, and a hand's wrist.
const ROOT: usize = 0;

struct JointMetrics {
    key: Key<'static, JointTrack>,
    columns: &'static [ColumnInfo],
}

inventory::submit! { MetricEntry(&JointMetrics {
    key: BODY,
    columns: &[
        ColumnInfo::lower("body.mpjpe", "mm", "mean joint distance, no alignment"),
        ColumnInfo::lower("body.ra_mpjpe", "mm", "pelvis subtracted per frame"),
        ColumnInfo::lower("body.ga_mpjpe", "mm", "one similarity per clip"),
        ColumnInfo::lower("body.pa_mpjpe", "mm", "one similarity per frame"),
    ],
}) }

inventory::submit! { MetricEntry(&JointMetrics {
    key: LEFT_HAND,
    columns: &[
        ColumnInfo::lower("left_hand.ra_mpjpe", "mm", "wrist subtracted per frame"),
        ColumnInfo::lower("left_hand.ga_mpjpe", "mm", "one similarity per clip"),
        ColumnInfo::lower("left_hand.pa_mpjpe", "mm", "one similarity per frame"),
    ],
}) }

inventory::submit! { MetricEntry(&JointMetrics {
    key: RIGHT_HAND,
    columns: &[
        ColumnInfo::lower("right_hand.ra_mpjpe", "mm", "wrist subtracted per frame"),
        ColumnInfo::lower("right_hand.ga_mpjpe", "mm", "one similarity per clip"),
        ColumnInfo::lower("right_hand.pa_mpjpe", "mm", "one similarity per frame"),
    ],
}) }

impl MetricSet for JointMetrics {
    fn name(&self) -> &'static str {
        self.key.name()
    }

    fn columns(&self) -> &'static [ColumnInfo] {
        self.columns
    }

    fn score(&self, pair: &Pair<'_>, columns: &[Column]) -> Result<ClipScore, MetricError> {
        let Some(errors) = errors(pair, self.key)? else {
            return Ok(ClipScore::default());
        };
        Ok(ClipScore::of(columns, |metric| outcome(&errors, metric)))
    }

    fn baselines(&self, _: &[Column]) -> Vec<Box<dyn Baseline>> {
        vec![Box::new(MeanPose(self.key))]
    }
}

fn errors(pair: &Pair<'_>, key: Key<'_, JointTrack>) -> Result<Option<JointErrors>, MetricError> {
    let of = |(truth, prediction): (&JointTrack, &JointTrack)| {
        let valid = Valid::Joints(truth.valid.view());
        joint_errors(prediction.joints.view(), truth.joints.view(), valid, ROOT)
    };
    pair.both(key).map(of).transpose()
}

fn outcome(errors: &JointErrors, metric: &str) -> Outcome {
    match metric {
        "mpjpe" => errors.mpjpe_outcome(),
        "ra_mpjpe" => errors.ra_outcome(),
        "ga_mpjpe" => errors.ga_outcome(),
        "pa_mpjpe" => errors.pa_outcome(),
        _ => Outcome::Null,
    }
}

/// Both hands as one number.
struct HandsMetrics;
inventory::submit! { MetricEntry(&HandsMetrics) }

const HANDS: [Key<'static, JointTrack>; 2] = [LEFT_HAND, RIGHT_HAND];
const COMPAT: &str = "a hand without a visible frame counts 0.0, as in the published table";

impl MetricSet for HandsMetrics {
    fn name(&self) -> &'static str {
        "hands"
    }

    fn columns(&self) -> &'static [ColumnInfo] {
        const {
            &[
                ColumnInfo::lower(
                    "hands.mpjpe",
                    "mm",
                    "mean of the hands that have a value, no alignment",
                ),
                ColumnInfo::lower("hands.ra_mpjpe", "mm", "wrist subtracted per frame"),
                ColumnInfo::lower("hands.ga_mpjpe", "mm", "one similarity per clip and hand"),
                ColumnInfo::lower("hands.pa_mpjpe", "mm", "one similarity per frame"),
                ColumnInfo::lower("hands.ra_mpjpe@compat", "mm", COMPAT),
                ColumnInfo::lower("hands.ga_mpjpe@compat", "mm", COMPAT),
                ColumnInfo::lower("hands.pa_mpjpe@compat", "mm", COMPAT),
            ]
        }
    }

    fn modalities<'a>(&self, _: &'a Column) -> Vec<&'a str> {
        HANDS.map(|key| key.name()).to_vec()
    }

    fn score(&self, pair: &Pair<'_>, columns: &[Column]) -> Result<ClipScore, MetricError> {
        let hands = [errors(pair, LEFT_HAND)?, errors(pair, RIGHT_HAND)?];
        // Compat counts a hand without a visible frame as 0.0; one that is visible and was not predicted does not count.
        let lacks_hand = HANDS.iter().any(|key| {
            let visible = |track: &JointTrack| track.valid.iter().any(|v| *v);
            pair.truth.get(*key).is_some_and(visible) && pair.prediction.get(*key).is_none()
        });
        Ok(ClipScore::of(columns, |metric| {
            let (metric, mode) = match metric.strip_suffix("@compat") {
                Some(_) if lacks_hand => return Outcome::Null,
                Some(metric) => (metric, HandMode::Compat),
                None => (metric, HandMode::Strict),
            };
            if hands.iter().all(Option::is_none) {
                return Outcome::Null;
            }
            let of = |hand: &Option<JointErrors>| {
                hand.as_ref().map_or(Outcome::Null, |e| outcome(e, metric))
            };
            pair_of_hands([of(&hands[0]), of(&hands[1])], mode)
        }))
    }

    fn baselines(&self, _: &[Column]) -> Vec<Box<dyn Baseline>> {
        let one = |key| Box::new(MeanPose(key)) as Box<dyn Baseline>;
        HANDS.map(one).into()
    }
}

/// The mean pose of the evaluated clips: it knows the answer's average.
pub(super) struct MeanPose(pub Key<'static, JointTrack>);

impl Baseline for MeanPose {
    fn name(&self) -> &'static str {
        "mean pose"
    }

    fn modality(&self) -> &str {
        self.0.name()
    }

    fn samples<'a>(&self, truth: &'a Clip) -> Option<Samples<'a>> {
        let track = truth.get(self.0)?;
        Some(Samples {
            values: track.joints.view(),
            valid: Some(track.valid.view()),
        })
    }

    fn predict(&self, truth: &Clip, mean: Option<&Array2<f64>>) -> Option<Held> {
        let (track, mean) = (truth.get(self.0)?, mean?);
        let (_, joints, axes) = track.joints.dim();
        (mean.dim() == (joints, axes)).then(|| {
            let at = |(_, j, axis)| mean[(j, axis)] as f32;
            Held::new(JointTrack {
                joints: Array3::from_shape_fn(track.joints.dim(), at),
                ..track.clone()
            })
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn compat_counts_a_hand_without_a_frame_as_zero_and_one_that_was_not_predicted_not_at_all() {
        let columns = ["hands.ra_mpjpe", "hands.ra_mpjpe@compat"];
        let columns = columns.map(|name| Column::named(name).unwrap());
        let track = |at: f32, valid: bool| {
            let joint = |(_, j, _)| if j == 0 { 0.0 } else { at };
            Some(JointTrack {
                rate: 30.0,
                joints: Array3::from_shape_fn((4, 21, 3), joint),
                valid: Array2::from_elem((4, 21), valid),
            })
        };
        let values = |seen: bool, predicted: bool| {
            let (mut truth, mut prediction) = (Clip::empty("a", "test"), Clip::empty("a", "test"));
            truth.set(LEFT_HAND, track(0.0, true));
            truth.set(RIGHT_HAND, track(0.0, seen));
            prediction.set(LEFT_HAND, track(0.1, true));
            prediction.set(RIGHT_HAND, track(0.1, true).filter(|_| predicted));
            let pair = Pair {
                truth: &truth,
                prediction: &prediction,
                depth: crate::evaluation::depth::Scored::default(),
            };
            let found = HandsMetrics.score(&pair, &columns).unwrap();
            [found.values[0].number(), found.values[1].number()]
                .map(|value| value.map(|v| (v * 10.0).round() / 10.0))
        };
        // Twenty of 21 joints are off by 0.1 m along each axis.
        assert_eq!(values(true, true), [Some(165.0), Some(165.0)]);
        assert_eq!(values(false, true), [Some(165.0), Some(82.5)]);
        assert_eq!(values(false, false), [Some(165.0), Some(82.5)]);
        assert_eq!(values(true, false), [Some(165.0), None]);
    }
}
