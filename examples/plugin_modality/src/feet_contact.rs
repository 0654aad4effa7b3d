//! `feet_contact`: which feet stand on the ground, `[60, 2]`, 1 where one does.
//!
//! Channels over time need no type of their own: storage, stitching, the reconstruction's arrays and the curves of its page are those of
//! every declared modality. It brings how it is computed, and a metric.

use ndarray::{Array2, ArrayView1};
use reviv::clip::{Clip, Key, Signal};
use reviv::evaluation::columns::{Column, ColumnInfo};
use reviv::evaluation::metric::{Baseline, ClipScore, MetricEntry, MetricSet, Pair};
use reviv::evaluation::sets::MeanValue;
use reviv::evaluation::{MetricError, Outcome};
use reviv::experiment::LinkedEntry;
use reviv::geometry::skeleton::BODY;
use reviv::modality::code::SignalCode;
use reviv::modality::{DeclaredSettings, ModalityError};

const NAME: &str = "feet_contact";
/// Metres above the lowest moment of the clip that still count as standing, and metres per second.
const HEIGHT: f32 = 0.04;
const SPEED: f32 = 0.3;

inventory::submit! { LinkedEntry { origin: "plugin_modality 0.1", text: include_str!("feet_contact.yaml") } }
inventory::submit! { SignalCode { name: NAME, about: "Feet that are low and slow.", derive } }
inventory::submit! { MetricEntry(&ContactMetrics) }

#[allow(clippy::unnecessary_wraps, reason = "the type of `SignalCode::derive`")]
fn derive(clip: &Clip, _: &DeclaredSettings) -> Result<Option<Signal>, ModalityError> {
    let Some(body) = clip.body() else {
        return Ok(None);
    };
    let feet =
        ["left_foot", "right_foot"].map(|name| BODY.joint(name).expect("a joint of the list"));
    let samples = body.joints.shape()[0];
    let foot = |t: usize, side: usize| body.joints.slice(ndarray::s![t, feet[side], ..]);
    let distance = |a: ArrayView1<f32>, b: ArrayView1<f32>| {
        a.iter()
            .zip(b)
            .map(|(a, b)| (a - b).powi(2))
            .sum::<f32>()
            .sqrt()
    };
    let mut lowest = f32::INFINITY;
    for t in 0..samples {
        lowest = lowest.min(foot(t, 0)[2]).min(foot(t, 1)[2]);
    }
    let values = Array2::from_shape_fn((samples, 2), |(t, side)| {
        let other = if t + 1 < samples {
            t + 1
        } else {
            t.saturating_sub(1)
        };
        let speed = distance(foot(t, side), foot(other, side)) * body.rate as f32;
        f32::from(u8::from(
            foot(t, side)[2] - lowest < HEIGHT && speed < SPEED,
        ))
    });
    let valid = body
        .valid
        .map_axis(ndarray::Axis(1), |row| feet.iter().all(|&foot| row[foot]));
    Ok(Some(Signal {
        values: values.into_dyn(),
        valid: Some(valid.into_dyn()),
    }))
}

/// How often the prediction, cut at one half, says the same as the truth.
struct ContactMetrics;

impl MetricSet for ContactMetrics {
    fn name(&self) -> &'static str {
        NAME
    }

    fn columns(&self) -> &'static [ColumnInfo] {
        const {
            &[ColumnInfo::higher(
                "feet_contact.accuracy",
                "%",
                "samples of a foot that are right",
            )]
        }
    }

    fn score(&self, pair: &Pair<'_>, columns: &[Column]) -> Result<ClipScore, MetricError> {
        let Some((truth, prediction)) = pair.both(Key::<Signal>::new(NAME)) else {
            return Ok(ClipScore::default());
        };
        if truth.values.shape() != prediction.values.shape() {
            return Err(MetricError::Shape {
                field: NAME,
                found: prediction.values.shape().to_vec(),
                expected: truth.values.shape().to_vec(),
            });
        }
        let (mut right, mut count) = (0_usize, 0_usize);
        for (at, value) in truth.values.indexed_iter() {
            if truth.valid.as_ref().is_none_or(|valid| valid[[at[0]]]) {
                right += usize::from((*value > 0.5) == (prediction.values[&at] > 0.5));
                count += 1;
            }
        }
        let share = (count > 0).then(|| 100.0 * right as f64 / count as f64);
        Ok(ClipScore::of(columns, |_| Outcome::of(share)))
    }

    fn baselines(&self, _: &[Column]) -> Vec<Box<dyn Baseline>> {
        vec![Box::new(MeanValue(NAME.to_owned()))]
    }
}
