//! Predictions that need no learning, made from the evaluated truth itself: what every system has to beat.

use super::columns::{Column, declared};
use super::evaluate::{CHUNK, EvaluationError, Pairs};
use crate::clip::{
    BODY, Clip, DEPTH, Depth, GAZE, GazeTrack, JointTrack, Key, LEFT_HAND, RIGHT_HAND, Signal,
};
use ndarray::{Array2, Array3, ArrayD, ArrayView3};
use rayon::prelude::*;
use std::collections::{BTreeMap, BTreeSet};

pub(super) fn image_centre(truth: &Clip) -> Clip {
    let mut clip = Clip::empty(truth.id.clone(), truth.source.clone());
    let centre = |gaze: &GazeTrack| GazeTrack {
        rate: gaze.rate,
        points: Array2::from_elem(gaze.points.raw_dim(), 0.5),
        valid: gaze.valid.clone(),
    };
    clip.set(GAZE, truth.gaze().map(centre));
    clip
}

/// The mean pose and the mean depth image of the evaluated clips: baselines that know the answer's average.
#[derive(Default)]
pub(super) struct Means {
    body: Mean<Array2<f64>>,
    left: Mean<Array2<f64>>,
    right: Mean<Array2<f64>>,
    depth: Mean<Array2<f64>>,
    /// Per channel, by modality.
    declared: BTreeMap<String, Mean<Array2<f64>>>,
}

#[derive(Default, Clone)]
struct Mean<A> {
    sum: Option<A>,
    count: Option<A>,
}

impl Mean<Array2<f64>> {
    /// Adds `[T, a, b]` values where they are finite and `valid(t, a, b)`. Another `[a, b]` than the first is left alone.
    fn add(&mut self, values: ArrayView3<f32>, valid: impl Fn(usize, usize) -> bool) {
        let (_, a, b) = values.dim();
        let sum = self.sum.get_or_insert_with(|| Array2::zeros((a, b)));
        let count = self.count.get_or_insert_with(|| Array2::zeros((a, b)));
        if sum.dim() != (a, b) {
            return;
        }
        for ((t, i, j), value) in values.indexed_iter() {
            if value.is_finite() && valid(t, i) {
                sum[(i, j)] += f64::from(*value);
                count[(i, j)] += 1.0;
            }
        }
    }

    fn merge(&mut self, other: Self) {
        match (&mut self.sum, &mut self.count, other.sum, other.count) {
            (Some(sum), Some(count), Some(more), Some(n)) if sum.dim() == more.dim() => {
                *sum += &more;
                *count += &n;
            }
            (None, None, sum, count) => (self.sum, self.count) = (sum, count),
            _ => {}
        }
    }

    /// The mean; where nothing was seen, the mean of everything else.
    fn value(&self) -> Option<Array2<f64>> {
        let (sum, count) = (self.sum.as_ref()?, self.count.as_ref()?);
        let total = count.sum();
        let overall = sum.sum() / total;
        (total > 0.0).then(|| {
            ndarray::Zip::from(sum)
                .and(count)
                .map_collect(|s, n| if *n > 0.0 { s / n } else { overall })
        })
    }
}

impl Means {
    /// # Errors
    /// When a true clip cannot be read.
    pub(super) fn of_truth(
        pairs: &dyn Pairs,
        chosen: &[usize],
        columns: &[Column],
    ) -> Result<Self, EvaluationError> {
        let wants =
            |modalities: &[&str]| columns.iter().any(|c| modalities.contains(&c.modality()));
        let (poses, depth) = (
            wants(&["body", "hands", "left_hand", "right_hand"]),
            wants(&["depth"]),
        );
        let mut all = Self::default();
        let signals: BTreeSet<&str> = columns.iter().filter_map(|c| declared(&c.name)).collect();
        if !poses && !depth && signals.is_empty() {
            return Ok(all);
        }
        for chunk in chosen.chunks(CHUNK) {
            let parts: Vec<Result<Self, EvaluationError>> = chunk
                .par_iter()
                .map(|&index| {
                    let clip = pairs.truth(index).map_err(|error| EvaluationError::Load {
                        clip: pairs.ids()[index].clone(),
                        error,
                    })?;
                    let mut part = Self::default();
                    if poses {
                        for (mean, track) in [
                            (&mut part.body, clip.body()),
                            (&mut part.left, clip.left_hand()),
                            (&mut part.right, clip.right_hand()),
                        ] {
                            if let Some(track) = track {
                                mean.add(track.joints.view(), |t, j| track.valid[(t, j)]);
                            }
                        }
                    }
                    if let Some(depth) = clip.depth().filter(|_| depth) {
                        part.depth.add(depth.metres.view(), |_, _| true);
                    }
                    for name in &signals {
                        if let Some(signal) = clip.signal(name) {
                            part.add_declared(name, signal);
                        }
                    }
                    Ok(part)
                })
                .collect();
            for part in parts {
                let part = part?;
                all.body.merge(part.body);
                all.left.merge(part.left);
                all.right.merge(part.right);
                all.depth.merge(part.depth);
                for (name, mean) in part.declared {
                    all.declared.entry(name).or_default().merge(mean);
                }
            }
        }
        Ok(all)
    }

    fn add_declared(&mut self, name: &str, signal: &Signal) {
        let &[samples, channels] = signal.values.shape() else {
            return;
        };
        let Ok(values) = signal
            .values
            .view()
            .into_shape_with_order((samples, 1, channels))
        else {
            return;
        };
        let mean = self.declared.entry(name.to_owned()).or_default();
        mean.add(values, |t, _| signal.valid.as_ref().is_none_or(|v| v[[t]]));
    }

    /// Every sample at the mean of its channel.
    pub(super) fn declared(&self, truth: &Clip) -> Clip {
        let mut clip = Clip::empty(truth.id.clone(), truth.source.clone());
        for (name, mean) in &self.declared {
            let (Some(signal), Some(mean)) = (truth.signal(name), mean.value()) else {
                continue;
            };
            if signal.values.ndim() == 2 && signal.values.shape()[1] == mean.ncols() {
                let values =
                    ArrayD::from_shape_fn(signal.values.raw_dim(), |at| mean[(0, at[1])] as f32);
                let signal = Signal {
                    values,
                    valid: None,
                };
                clip.set(Key::new(name), signal);
            }
        }
        clip
    }

    pub(super) fn pose(&self, truth: &Clip) -> Clip {
        let track = |track: Option<&JointTrack>, mean: &Mean<Array2<f64>>| {
            let (track, mean) = (track?, mean.value()?);
            let same = track.joints.dim().1 == mean.nrows() && track.joints.dim().2 == mean.ncols();
            same.then(|| JointTrack {
                joints: Array3::from_shape_fn(track.joints.dim(), |(_, j, axis)| {
                    mean[(j, axis)] as f32
                }),
                ..track.clone()
            })
        };
        let mut clip = Clip::empty(truth.id.clone(), truth.source.clone());
        clip.set(BODY, track(truth.body(), &self.body));
        clip.set(LEFT_HAND, track(truth.left_hand(), &self.left));
        clip.set(RIGHT_HAND, track(truth.right_hand(), &self.right));
        clip
    }

    pub(super) fn depth(&self, truth: &Clip) -> Clip {
        let mut clip = Clip::empty(truth.id.clone(), truth.source.clone());
        if let (Some(depth), Some(mean)) = (truth.depth(), self.depth.value()) {
            let (_, h, w) = depth.metres.dim();
            if mean.dim() == (h, w) {
                clip.set(
                    DEPTH,
                    Depth {
                        rate: depth.rate,
                        metres: Array3::from_shape_fn(depth.metres.dim(), |(_, y, x)| {
                            mean[(y, x)] as f32
                        }),
                    },
                );
            }
        }
        clip
    }
}
