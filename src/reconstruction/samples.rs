//! Several reconstructions of one video: what a generative model knows of a video is all that it draws, not one draw.

use super::export::manifest::ArrayFacts;
use super::predictions::ScaleStatus;
use super::stitch::{Joints, Tracks};
use crate::clip::clock::SIGNAL_RATE;
use crate::formats::npz::Npz;
use ndarray::{Array2, Array3, Array4};
use std::collections::BTreeMap;

/// The file of a folder that holds them.
pub const FILE: &str = "samples.npz";

/// Points over time: `[T][points][values]`.
type Points = Vec<Vec<Vec<f64>>>;

/// Root mean square distance of the samples from their mean, per moment and point, by modality: metres for `camera` `[T, 1]`, `body`
/// and hands `[T, 21]`; of the image for `gaze` `[T, 1]`. Unknown values are left out; NaN where nothing is known.
#[must_use]
pub fn spread(samples: &[Tracks]) -> BTreeMap<&'static str, Array2<f32>> {
    let mut found = BTreeMap::new();
    for (name, of) in SIGNALS {
        let all: Vec<Points> = samples.iter().map(of).collect();
        let moments = all.iter().map(Vec::len).min().unwrap_or(0);
        let points = all.iter().flatten().map(Vec::len).max().unwrap_or(0);
        if moments > 0 && points > 0 {
            let at = |(t, point): (usize, usize)| {
                deviation(all.iter().map(|sample| &sample[t][point])) as f32
            };
            found.insert(name, Array2::from_shape_fn((moments, points), at));
        }
    }
    found
}

/// A name, the frame it is in, and where tracks have it.
type Motion = (&'static str, &'static str, fn(&Tracks) -> &[Joints]);

/// A name and how its points come out of tracks.
type Signal = (&'static str, fn(&Tracks) -> Points);

const SIGNALS: [Signal; 5] = [
    ("camera", |tracks| {
        let at = |pose: &crate::geometry::rigid::Rigid| {
            vec![pose.translation.vector.iter().copied().collect()]
        };
        tracks.camera().iter().map(at).collect()
    }),
    ("gaze", |tracks| {
        let at = |point: &[f32; 2]| vec![point.map(f64::from).to_vec()];
        tracks.gaze().iter().map(at).collect()
    }),
    ("body", |tracks| joints(tracks.body())),
    ("left_hand", |tracks| joints(tracks.left_hand())),
    ("right_hand", |tracks| joints(tracks.right_hand())),
];

fn joints(motion: &[Joints]) -> Points {
    let at = |joint: &[f32; 3]| joint.map(f64::from).to_vec();
    motion
        .iter()
        .map(|joints| joints.iter().map(at).collect())
        .collect()
}

fn deviation<'a>(values: impl Iterator<Item = &'a Vec<f64>>) -> f64 {
    let known: Vec<&Vec<f64>> = values
        .filter(|value| value.iter().all(|v| v.is_finite()))
        .collect();
    let Some(first) = known.first() else {
        return f64::NAN;
    };
    let n = known.len() as f64;
    let square: f64 = (0..first.len())
        .map(|axis| {
            let mean = known.iter().map(|v| v[axis]).sum::<f64>() / n;
            known.iter().map(|v| (v[axis] - mean).powi(2)).sum::<f64>() / n
        })
        .sum();
    square.sqrt()
}

/// The arrays of all samples and their spread, and what they are.
pub(super) fn arrays(samples: &[Tracks]) -> (Npz, Vec<ArrayFacts>) {
    let mut npz = Npz::default();
    let mut facts = Vec::new();
    let mut say = |name: &str, shape: &[usize], unit: &str, frame: &str| {
        let metric = unit == "m" || unit == "m, orthonormal axes";
        let by = "learning from metric data".into();
        facts.push(ArrayFacts {
            file: FILE.into(),
            name: name.into(),
            shape: shape.to_vec(),
            unit: unit.into(),
            frame: frame.into(),
            rate: Some(SIGNAL_RATE),
            scale: if metric {
                ScaleStatus::Metric { by }
            } else {
                ScaleStatus::None
            },
            validity: None,
        });
    };
    let n = samples.len();
    let poses = samples.iter().map(|s| s.camera().len()).min().unwrap_or(0);
    if poses > 0 {
        let of = |(sample, t, row, column): (usize, usize, usize, usize)| {
            samples[sample].camera()[t].to_homogeneous()[(row, column)]
        };
        let array = Array4::from_shape_fn((n, poses, 4, 4), of);
        say(
            "T_world_camera",
            array.shape(),
            "m, orthonormal axes",
            "world, z up",
        );
        npz = npz.with("T_world_camera", array);
    }
    let looks = samples.iter().map(|s| s.gaze().len()).min().unwrap_or(0);
    if looks > 0 {
        let of = |(sample, t, axis): (usize, usize, usize)| samples[sample].gaze()[t][axis];
        let array = Array3::from_shape_fn((n, looks, 2), of);
        say(
            "gaze",
            array.shape(),
            "of the image",
            "the square image, x right, y down",
        );
        npz = npz.with("gaze", array);
    }
    let motions: [Motion; 3] = [
        ("body", "world, z up", Tracks::body),
        ("left_hand", "camera of the same sample", Tracks::left_hand),
        (
            "right_hand",
            "camera of the same sample",
            Tracks::right_hand,
        ),
    ];
    for (name, frame, of) in motions {
        let length = samples.iter().map(|s| of(s).len()).min().unwrap_or(0);
        if length == 0 {
            continue;
        }
        let count = of(&samples[0])[0].len();
        let at = |(s, t, j, k): (usize, usize, usize, usize)| of(&samples[s])[t][j][k];
        let array = Array4::from_shape_fn((n, length, count, 3), at);
        say(name, array.shape(), "m", frame);
        npz = npz.with(name, array);
    }
    for (name, values) in spread(samples) {
        let own = format!("{name}_spread");
        let unit = if name == "gaze" { "of the image" } else { "m" };
        say(
            &own,
            values.shape(),
            unit,
            "root mean square distance from the mean of the samples",
        );
        npz = npz.with(&own, values);
    }
    (npz, facts)
}

/// Mean of the known values.
pub(super) fn mean_of(values: &Array2<f32>) -> Option<f64> {
    let known: Vec<f64> = values
        .iter()
        .filter(|v| v.is_finite())
        .map(|&v| f64::from(v))
        .collect();
    (!known.is_empty()).then(|| known.iter().sum::<f64>() / known.len() as f64)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn spread_is_the_distance_from_the_mean_over_what_is_known() {
        let values = [vec![1.0, 0.0], vec![3.0, 0.0], vec![f64::NAN, 0.0]];
        assert!((deviation(values.iter()) - 1.0).abs() < 1e-12);
        assert!(deviation([vec![f64::NAN]].iter()).is_nan());
        assert_eq!(deviation([vec![2.0, 5.0]].iter()), 0.0);
    }
}
