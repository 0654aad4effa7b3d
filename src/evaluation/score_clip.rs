//! One clip, every column: a predicted clip against the true one.

use super::columns::{Column, declared};
use super::depth::{DepthErrors, Space, depth_errors};
use super::gaze::{GazeErrors, gaze_errors};
use super::joints::{HandMode, JointErrors, Valid, joint_errors, pair_of_hands};
use super::motion::kinematic_descriptor;
use super::outcome::{MetricError, Outcome, mean};
use super::trajectory::{Pose, TrajectoryErrors, masked_trajectory_errors, trajectory_errors};
use crate::clip::{CameraTrack, Clip, Depth, JointTrack, Rgb, Signal};
use crate::geometry::alignment::Freedom;
use crate::geometry::rigid;
use ndarray::{Array1, Array3};

/// The body frame's vertical axis (z up) and the pelvis.
const UP: usize = 2;
const ROOT: usize = 0;

/// What one clip gives.
#[derive(Debug, Clone, Default)]
pub(crate) struct ClipScore {
    /// One per column, in their order; set-wide columns are `Null` here.
    pub values: Vec<Outcome>,
    /// Kinematic descriptors of the predicted and the true body, where both exist and every joint is valid.
    pub descriptors: Option<(Array1<f64>, Array1<f64>)>,
    /// Modalities that the truth has and the prediction has not.
    pub missing: Vec<&'static str>,
    /// The estimated camera came at other times and was resampled.
    pub resampled: bool,
    /// Depth had to be flipped to fit.
    pub negative_depth_scale: bool,
}

/// Scores `prediction` against `truth` in every one of `columns`.
///
/// Only the truth's validity decides what is scored: a system cannot leave out what it finds hard.
pub(crate) fn score_clip(
    columns: &[Column],
    depth_max: Option<f64>,
    truth: &Clip,
    prediction: &Clip,
) -> Result<ClipScore, MetricError> {
    let mut score = ClipScore::default();
    let wanted = |modalities: &[&str]| columns.iter().any(|c| modalities.contains(&c.modality()));
    let missing = &mut score.missing;

    let hands = |hand| wanted(&["hands", hand]);
    let body = both(
        missing,
        "body",
        wanted(&["body"]),
        truth.body(),
        prediction.body(),
    );
    let left = both(
        missing,
        "left_hand",
        hands("left_hand"),
        truth.left_hand(),
        prediction.left_hand(),
    );
    let right = both(
        missing,
        "right_hand",
        hands("right_hand"),
        truth.right_hand(),
        prediction.right_hand(),
    );
    let camera = both(
        missing,
        "camera",
        wanted(&["camera"]),
        truth.camera(),
        prediction.camera(),
    );
    let gaze = both(
        missing,
        "gaze",
        wanted(&["gaze"]),
        truth.gaze(),
        prediction.gaze(),
    );
    let depth = both(
        missing,
        "depth",
        wanted(&["depth"]),
        truth.depth(),
        prediction.depth(),
    );
    let rgb = both(
        missing,
        "rgb",
        wanted(&["rgb"]),
        truth.rgb(),
        prediction.rgb(),
    );

    if let Some((truth, prediction)) = body
        && columns.iter().any(|c| c.name.starts_with("body.kin_"))
        && truth.valid.iter().all(|v| *v)
        && truth.joints.dim() == prediction.joints.dim()
    {
        score.descriptors = Some((
            kinematic_descriptor(prediction.joints.view(), truth.rate, ROOT, UP),
            kinematic_descriptor(truth.joints.view(), truth.rate, ROOT, UP),
        ));
    }
    let body = body.map(track_errors).transpose()?;
    let left = left.map(track_errors).transpose()?;
    let right = right.map(track_errors).transpose()?;
    let camera = camera.map(|(t, p)| CameraScore::of(t, p)).transpose()?;
    let gaze = gaze
        .map(|(t, p)| gaze_errors(p.points.view(), t.points.view(), Some(t.valid.view())))
        .transpose()?;
    let depth = match depth {
        Some((truth, prediction)) => DepthScore::of(columns, depth_max, truth, prediction)?,
        None => DepthScore::default(),
    };
    let rgb = Outcome::of(rgb.and_then(|(truth, prediction)| psnr(truth, prediction)));

    // Compat counts a hand without a visible frame as 0.0; one that is visible and was not predicted is no such hand.
    let lacks_hand = [
        (truth.left_hand(), prediction.left_hand()),
        (truth.right_hand(), prediction.right_hand()),
    ]
    .into_iter()
    .any(|(truth, prediction)| {
        let visible = truth.is_some_and(|t| t.valid.iter().any(|v| *v));
        visible && prediction.is_none()
    });
    score.values = columns
        .iter()
        .map(|column| {
            let (modality, metric) = column.name.split_once('.').unwrap_or((&column.name, ""));
            match modality {
                "body" => body
                    .as_ref()
                    .map_or(Outcome::Null, |e| joint_outcome(e, metric)),
                "left_hand" => left
                    .as_ref()
                    .map_or(Outcome::Null, |e| joint_outcome(e, metric)),
                "right_hand" => right
                    .as_ref()
                    .map_or(Outcome::Null, |e| joint_outcome(e, metric)),
                "hands" if metric.ends_with("@compat") && lacks_hand => Outcome::Null,
                "hands" => hands_outcome(&left, &right, metric),
                "camera" => camera.as_ref().map_or(Outcome::Null, |e| e.outcome(metric)),
                "gaze" => gaze
                    .as_ref()
                    .map_or(Outcome::Null, |e| gaze_outcome(e, metric)),
                "depth" => depth.outcome(metric),
                "rgb" => rgb,
                _ => Outcome::Null,
            }
        })
        .collect();
    for (value, column) in score.values.iter_mut().zip(columns) {
        let signals = declared(&column.name).map(|m| (truth.signal(m), prediction.signal(m)));
        if let Some((Some(truth), Some(prediction))) = signals {
            *value = Outcome::of(declared_rmse(truth, prediction)?);
        }
    }
    score.resampled = camera.is_some_and(|c| c.resampled);
    score.negative_depth_scale = depth.negative_scale();
    Ok(score)
}

/// Both signals, if the modality is wanted; a prediction that lacks it is noted in `missing`.
fn both<'a, T>(
    missing: &mut Vec<&'static str>,
    modality: &'static str,
    wanted: bool,
    truth: Option<&'a T>,
    prediction: Option<&'a T>,
) -> Option<(&'a T, &'a T)> {
    let truth = truth.filter(|_| wanted)?;
    if prediction.is_none() {
        missing.push(modality);
    }
    Some((truth, prediction?))
}

fn track_errors(
    (truth, prediction): (&JointTrack, &JointTrack),
) -> Result<JointErrors, MetricError> {
    let valid = Valid::Joints(truth.valid.view());
    joint_errors(prediction.joints.view(), truth.joints.view(), valid, ROOT)
}

fn joint_outcome(errors: &JointErrors, metric: &str) -> Outcome {
    match metric {
        "mpjpe" => errors.mpjpe_outcome(),
        "ra_mpjpe" => errors.ra_outcome(),
        "ga_mpjpe" => errors.ga_outcome(),
        "pa_mpjpe" => errors.pa_outcome(),
        _ => Outcome::Null,
    }
}

fn hands_outcome(left: &Option<JointErrors>, right: &Option<JointErrors>, metric: &str) -> Outcome {
    if left.is_none() && right.is_none() {
        return Outcome::Null;
    }
    let (metric, mode) = match metric.strip_suffix("@compat") {
        Some(metric) => (metric, HandMode::Compat),
        None => (metric, HandMode::Strict),
    };
    let of = |hand: &Option<JointErrors>| {
        hand.as_ref()
            .map_or(Outcome::Null, |e| joint_outcome(e, metric))
    };
    pair_of_hands([of(left), of(right)], mode)
}

fn gaze_outcome(errors: &GazeErrors, metric: &str) -> Outcome {
    match metric {
        "mse" => Outcome::of(errors.mse),
        "l2" => Outcome::of(errors.l2),
        _ => Outcome::Null,
    }
}

struct CameraScore {
    errors: TrajectoryErrors,
    /// Metres and degrees, first poses laid on each other.
    position: Option<f64>,
    rotation: Option<f64>,
    resampled: bool,
}

impl CameraScore {
    fn of(truth: &CameraTrack, prediction: &CameraTrack) -> Result<Self, MetricError> {
        let count = truth.T_world_camera.len();
        let mut guess = prediction.T_world_camera.clone();
        let resampled = guess.len() != count && prediction.rate != truth.rate && !guess.is_empty();
        if resampled {
            let last = guess.len() - 1;
            guess = (0..count)
                .map(|i| {
                    let position = (i as f64 / truth.rate * prediction.rate).min(last as f64);
                    let below = position.floor() as usize;
                    // A pose that is hit exactly does not depend on the next one.
                    let above = (below + usize::from(position.fract() > 0.0)).min(last);
                    rigid::interpolate(&guess[below], &guess[above], position.fract())
                })
                .collect();
        }
        let poses = |poses: &[rigid::Rigid]| poses.iter().map(Pose::from).collect::<Vec<_>>();
        let errors = masked_trajectory_errors(
            &poses(&guess),
            &poses(&truth.T_world_camera),
            Some(&truth.valid),
            1,
            Freedom::Similarity,
        )?;
        let scored: Vec<usize> = (0..count).filter(|&i| truth.valid[i]).collect();
        let differences: Vec<rigid::Rigid> = scored
            .iter()
            .map(|&i| {
                let first = scored[0];
                let q = rigid::relative(&truth.T_world_camera[first], &truth.T_world_camera[i]);
                let p = rigid::relative(&guess[first], &guess[i]);
                rigid::relative(&q, &p)
            })
            .collect();
        Ok(Self {
            errors,
            position: mean(differences.iter().map(|d| d.translation.vector.norm())),
            rotation: mean(differences.iter().map(|d| d.rotation.angle().to_degrees())),
            resampled,
        })
    }

    fn outcome(&self, metric: &str) -> Outcome {
        let e = &self.errors;
        match metric {
            "ate" => e.ate(),
            "rte" => e.rte(),
            "rre" => e.rre(),
            "ate_mean" => Outcome::unless(e.degenerate, e.ate_mean),
            "rte_mean" => Outcome::unless(e.degenerate, e.rte_mean),
            "rre_mean" => Outcome::unless(e.degenerate, e.rre_mean),
            "position" => Outcome::of(self.position),
            "rotation" => Outcome::of(self.rotation),
            _ => Outcome::Null,
        }
    }
}

/// RTE and RRE of a camera that never moves, on the true trajectory; degenerate where the truth is.
pub(crate) fn still_camera(columns: &[Column], truth: &Clip) -> Result<Vec<Outcome>, MetricError> {
    let errors = match truth.camera() {
        None => TrajectoryErrors::default(),
        Some(track) => {
            let poses: Vec<Pose> = track
                .T_world_camera
                .iter()
                .zip(&track.valid)
                .filter(|(_, valid)| **valid)
                .map(|(pose, _)| Pose::from(pose))
                .collect();
            if poses.len() == track.valid.len() {
                trajectory_errors(&poses, &poses, 1, Freedom::Similarity)?
            } else {
                let all: Vec<Pose> = track.T_world_camera.iter().map(Pose::from).collect();
                masked_trajectory_errors(&all, &all, Some(&track.valid), 1, Freedom::Similarity)?
            }
        }
    };
    let outcome = |value| Outcome::unless(errors.degenerate, value);
    Ok(columns
        .iter()
        .map(|column| match column.name.as_str() {
            "camera.rte" => outcome(errors.still_rte_rmse),
            "camera.rte_mean" => outcome(errors.still_rte_mean),
            "camera.rre" => outcome(errors.still_rre_rmse),
            "camera.rre_mean" => outcome(errors.still_rre_mean),
            _ => Outcome::Null,
        })
        .collect())
}

#[derive(Default)]
struct DepthScore {
    by_space: Vec<(&'static str, DepthErrors)>,
}

impl DepthScore {
    const SPACES: [(&'static str, Space); 4] = [
        ("depth", Space::Depth),
        ("disparity", Space::Disparity),
        ("median", Space::Median),
        ("none", Space::None),
    ];

    fn of(
        columns: &[Column],
        depth_max: Option<f64>,
        truth: &Depth,
        prediction: &Depth,
    ) -> Result<Self, MetricError> {
        let gt = on_grid(&truth.metres, prediction.metres.dim());
        let mut by_space = Vec::new();
        for (name, space) in Self::SPACES {
            if columns
                .iter()
                .any(|c| c.modality() == "depth" && c.name.ends_with(&format!("@{name}")))
            {
                let errors =
                    depth_errors(prediction.metres.view(), gt.view(), None, space, depth_max)?;
                by_space.push((name, errors));
            }
        }
        Ok(Self { by_space })
    }

    fn outcome(&self, metric: &str) -> Outcome {
        let Some((metric, space)) = metric.split_once('@') else {
            return Outcome::Null;
        };
        let Some((_, errors)) = self.by_space.iter().find(|(name, _)| *name == space) else {
            return Outcome::Null;
        };
        match metric {
            "abs_rel" => Outcome::unless(errors.degenerate, errors.abs_rel),
            "delta" => Outcome::unless(errors.degenerate, errors.delta_1_25),
            _ => Outcome::Null,
        }
    }

    fn negative_scale(&self) -> bool {
        self.by_space
            .iter()
            .any(|(name, e)| *name == "depth" && e.scale.is_some_and(|s| s < 0.0))
    }
}

/// The truth on the prediction's grid, by nearest neighbour; the prediction is never resized.
fn on_grid(truth: &Array3<f32>, (frames, height, width): (usize, usize, usize)) -> Array3<f32> {
    let (t, h, w) = truth.dim();
    if t != frames || (h, w) == (height, width) || h * w * height * width == 0 {
        return truth.clone();
    }
    let nearest = |i: usize, to: usize, from: usize| (2 * i + 1) * from / (2 * to);
    Array3::from_shape_fn((frames, height, width), |(k, y, x)| {
        truth[(k, nearest(y, height, h), nearest(x, width, w))]
    })
}

fn psnr(truth: &Rgb, prediction: &Rgb) -> Option<f64> {
    if truth.frames.dim() != prediction.frames.dim() {
        return None;
    }
    let error = mean(
        truth
            .frames
            .iter()
            .zip(&prediction.frames)
            .map(|(a, b)| (f64::from(*a) - f64::from(*b)).powi(2)),
    )?;
    Some(10.0 * (255.0_f64.powi(2) / error.max(1e-10)).log10())
}

/// Root mean square error over the valid elements of a declared modality.
fn declared_rmse(truth: &Signal, prediction: &Signal) -> Result<Option<f64>, MetricError> {
    if truth.values.shape() != prediction.values.shape() {
        return Err(MetricError::Shape {
            field: "declared signal",
            found: prediction.values.shape().to_vec(),
            expected: truth.values.shape().to_vec(),
        });
    }
    let channels = truth.values.shape().last().copied().unwrap_or(1).max(1);
    let valid: Option<Vec<bool>> = truth.valid.as_ref().map(|v| v.iter().copied().collect());
    let (mut sum, mut count) = (0.0, 0_usize);
    for (i, (p, g)) in prediction.values.iter().zip(&truth.values).enumerate() {
        if !g.is_finite() || valid.as_ref().is_some_and(|v| !v[i / channels]) {
            continue;
        }
        if !p.is_finite() {
            return Err(MetricError::NotFinite {
                field: "declared signal",
                position: vec![i / channels, i % channels],
            });
        }
        sum += (f64::from(*p) - f64::from(*g)).powi(2);
        count += 1;
    }
    Ok((count > 0).then(|| (sum / count as f64).sqrt()))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::clip::{CAMERA, LEFT_HAND, RIGHT_HAND};
    use ndarray::Array2;

    fn clip(poses: usize, rate: f64) -> Clip {
        let mut clip = Clip::empty("a", "test");
        let pose = |i: usize| {
            let t = i as f64 / rate;
            rigid::Rigid::translation(t, (7.0 * t).sin(), (3.0 * t).cos())
        };
        clip.set(
            CAMERA,
            CameraTrack {
                rate,
                T_world_camera: (0..poses).map(pose).collect(),
                valid: vec![true; poses],
                up_world: None,
                intrinsics: None,
            },
        );
        clip
    }

    fn lose(clip: &mut Clip, index: usize) {
        let lost = rigid::Rigid::translation(f64::NAN, f64::NAN, f64::NAN);
        clip.get_mut(CAMERA).unwrap().T_world_camera[index] = lost;
    }

    #[test]
    fn a_lost_pose_is_ignored_where_nothing_is_scored_and_refused_where_something_is() {
        let columns = ["camera.ate", "camera.rre", "camera.position"];
        let columns = columns.map(|name| Column::named(name).unwrap());
        let mut truth = clip(60, 30.0);
        truth.get_mut(CAMERA).unwrap().valid[20] = false;
        let score = |truth: &Clip, prediction: &Clip| score_clip(&columns, None, truth, prediction);
        let mut prediction = clip(60, 30.0);
        let whole = score(&truth, &prediction).unwrap().values;
        lose(&mut prediction, 20);
        assert_eq!(score(&truth, &prediction).unwrap().values, whole);
        lose(&mut prediction, 31);
        assert!(matches!(
            score(&truth, &prediction),
            Err(MetricError::NotFinite { .. })
        ));
        // At half the rate, pose 10 is needed for samples 19, 20 and 21.
        let mut prediction = clip(30, 15.0);
        lose(&mut prediction, 10);
        assert!(score(&truth, &prediction).is_err());
        truth.get_mut(CAMERA).unwrap().valid[19..=21].fill(false);
        let scored = score(&truth, &prediction).unwrap();
        assert!(scored.resampled && scored.values.iter().all(|v| v.number().is_some()));
    }

    #[test]
    fn compat_counts_a_hand_without_a_frame_as_zero_and_one_that_was_not_predicted_not_at_all() {
        let columns = ["hands.ra_mpjpe", "hands.ra_mpjpe@compat"];
        let columns = columns.map(|name| Column::named(name).unwrap());
        let track = |at: f32, valid: bool| {
            Some(JointTrack {
                rate: 30.0,
                joints: Array3::from_shape_fn(
                    (4, 21, 3),
                    |(_, j, _)| if j == 0 { 0.0 } else { at },
                ),
                valid: Array2::from_elem((4, 21), valid),
            })
        };
        let values = |seen: bool, predicted: bool| {
            let (mut truth, mut prediction) = (clip(4, 30.0), clip(4, 30.0));
            truth.set(LEFT_HAND, track(0.0, true));
            truth.set(RIGHT_HAND, track(0.0, seen));
            prediction.set(LEFT_HAND, track(0.1, true));
            prediction.set(RIGHT_HAND, track(0.1, true).filter(|_| predicted));
            let found = score_clip(&columns, None, &truth, &prediction).unwrap();
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
