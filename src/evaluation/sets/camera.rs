//! Trajectory errors of the head camera.

use crate::clip::{CAMERA, CameraTrack, Clip};
use crate::evaluation::columns::{Column, ColumnInfo};
use crate::evaluation::metric::{ClipScore, MetricEntry, MetricSet, Pair};
use crate::evaluation::outcome::{MetricError, Outcome, mean};
use crate::evaluation::trajectory::{
    Pose, TrajectoryErrors, masked_trajectory_errors, trajectory_errors,
};
use crate::geometry::alignment::Freedom;
use crate::geometry::rigid::{self, Rigid};

struct CameraMetrics;
inventory::submit! { MetricEntry(&CameraMetrics) }

const RESAMPLED: &str = "the estimated camera was resampled to the reference's rate (linear positions, slerp rotations)";

impl MetricSet for CameraMetrics {
    fn name(&self) -> &'static str {
        CAMERA.name()
    }

    fn columns(&self) -> &'static [ColumnInfo] {
        const {
            &[
                ColumnInfo::lower(
                    "camera.ate",
                    "m",
                    "RMSE of positions after one similarity per clip",
                ),
                ColumnInfo::lower(
                    "camera.ate_mean",
                    "m",
                    "mean position error after one similarity per clip",
                ),
                ColumnInfo::lower(
                    "camera.rte",
                    "m",
                    "RMSE of the translation between consecutive samples",
                ),
                ColumnInfo::lower(
                    "camera.rte_mean",
                    "m",
                    "mean translation error between consecutive samples",
                ),
                ColumnInfo::lower(
                    "camera.rre",
                    "deg",
                    "RMSE of the rotation between consecutive samples",
                ),
                ColumnInfo::lower(
                    "camera.rre_mean",
                    "deg",
                    "mean rotation error between consecutive samples",
                ),
                ColumnInfo::lower(
                    "camera.position",
                    "m",
                    "mean position error without any alignment, first poses laid on each other",
                ),
                ColumnInfo::lower(
                    "camera.rotation",
                    "deg",
                    "mean rotation error without any alignment, first poses laid on each other",
                ),
            ]
        }
    }

    fn score(&self, pair: &Pair<'_>, columns: &[Column]) -> Result<ClipScore, MetricError> {
        let Some((truth, prediction)) = pair.both(CAMERA) else {
            return Ok(ClipScore::default());
        };
        let resampled = resample(truth, prediction);
        let guess = resampled.as_ref().unwrap_or(&prediction.T_world_camera);
        let e = masked_trajectory_errors(
            &poses(guess),
            &poses(&truth.T_world_camera),
            Some(&truth.valid),
            1,
            Freedom::Similarity,
        )?;
        let scored: Vec<usize> = (0..truth.valid.len()).filter(|&i| truth.valid[i]).collect();
        let difference = |&i: &usize| {
            let first = scored[0];
            let q = rigid::relative(&truth.T_world_camera[first], &truth.T_world_camera[i]);
            rigid::relative(&q, &rigid::relative(&guess[first], &guess[i]))
        };
        let differences: Vec<Rigid> = scored.iter().map(difference).collect();
        let position = mean(differences.iter().map(|d| d.translation.vector.norm()));
        let rotation = mean(differences.iter().map(|d| d.rotation.angle().to_degrees()));
        let score = ClipScore::of(columns, |metric| match metric {
            "ate" => e.ate(),
            "rte" => e.rte(),
            "rre" => e.rre(),
            "ate_mean" => Outcome::unless(e.degenerate, e.ate_mean),
            "rte_mean" => Outcome::unless(e.degenerate, e.rte_mean),
            "rre_mean" => Outcome::unless(e.degenerate, e.rre_mean),
            "position" => Outcome::of(position),
            "rotation" => Outcome::of(rotation),
            _ => Outcome::Null,
        });
        let notes = resampled.map(|_| RESAMPLED).into_iter().collect();
        Ok(ClipScore { notes, ..score })
    }

    /// RTE and RRE of a camera that never moves, on the true trajectory; degenerate where the truth is.
    fn closed_form(
        &self,
        truth: &Clip,
        columns: &[Column],
    ) -> Result<Option<(&'static str, Vec<Outcome>)>, MetricError> {
        let errors = match truth.camera() {
            None => TrajectoryErrors::default(),
            Some(track) => {
                let all = poses(&track.T_world_camera);
                if track.valid.iter().all(|valid| *valid) {
                    trajectory_errors(&all, &all, 1, Freedom::Similarity)?
                } else {
                    masked_trajectory_errors(
                        &all,
                        &all,
                        Some(&track.valid),
                        1,
                        Freedom::Similarity,
                    )?
                }
            }
        };
        let still = ClipScore::of(columns, |metric| {
            let value = match metric {
                "rte" => errors.still_rte_rmse,
                "rte_mean" => errors.still_rte_mean,
                "rre" => errors.still_rre_rmse,
                "rre_mean" => errors.still_rre_mean,
                _ => return Outcome::Null,
            };
            Outcome::unless(errors.degenerate, value)
        });
        Ok(Some(("still camera", still.values)))
    }
}

fn poses(poses: &[Rigid]) -> Vec<Pose> {
    poses.iter().map(Pose::from).collect()
}

/// The prediction at the times of the truth, where it comes at another rate.
fn resample(truth: &CameraTrack, prediction: &CameraTrack) -> Option<Vec<Rigid>> {
    let (count, guess) = (truth.T_world_camera.len(), &prediction.T_world_camera);
    let last = guess.len().checked_sub(1)?;
    let at = |i: usize| {
        let position = (i as f64 / truth.rate * prediction.rate).min(last as f64);
        let below = position.floor() as usize;
        // A pose that is hit exactly does not depend on the next one.
        let above = (below + usize::from(position.fract() > 0.0)).min(last);
        rigid::interpolate(&guess[below], &guess[above], position.fract())
    };
    (guess.len() != count && prediction.rate != truth.rate).then(|| (0..count).map(at).collect())
}

#[cfg(test)]
mod tests {
    use super::*;

    fn clip(poses: usize, rate: f64) -> Clip {
        let mut clip = Clip::empty("a", "test");
        let pose = |i: usize| {
            let t = i as f64 / rate;
            Rigid::translation(t, (7.0 * t).sin(), (3.0 * t).cos())
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
        let lost = Rigid::translation(f64::NAN, f64::NAN, f64::NAN);
        clip.get_mut(CAMERA).unwrap().T_world_camera[index] = lost;
    }

    #[test]
    fn a_lost_pose_is_ignored_where_nothing_is_scored_and_refused_where_something_is() {
        let columns = ["camera.ate", "camera.rre", "camera.position"];
        let columns = columns.map(|name| Column::named(name).unwrap());
        let mut truth = clip(60, 30.0);
        truth.get_mut(CAMERA).unwrap().valid[20] = false;
        let score = |truth: &Clip, prediction: &Clip| {
            let pair = Pair {
                truth,
                prediction,
                depth: crate::evaluation::depth::Scored::default(),
            };
            CameraMetrics.score(&pair, &columns)
        };
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
        assert_eq!(scored.notes, [RESAMPLED]);
        assert!(scored.values.iter().all(|v| v.number().is_some()));
    }
}
