//! What every modality has that brings no metrics of its own: the root mean square error, and the mean value to beat.

use crate::clip::{Clip, Held, Key, Signal};
use crate::evaluation::columns::{Better, Column, ColumnInfo};
use crate::evaluation::metric::{
    Baseline, ClipScore, MetricEntry, MetricSet, Pair, Samples, metrics_of,
};
use crate::evaluation::outcome::{MetricError, Outcome};
use crate::modality::BUILT_IN;
use ndarray::{Array2, ArrayD};

struct SignalMetrics;
inventory::submit! { MetricEntry(&SignalMetrics) }

impl MetricSet for SignalMetrics {
    fn name(&self) -> &'static str {
        "signal"
    }

    fn columns(&self) -> &'static [ColumnInfo] {
        &[]
    }

    /// `<modality>.rmse`, in the units of the modality.
    fn column(&self, name: &str) -> Option<Column> {
        let modality = name
            .strip_suffix(".rmse")
            .filter(|m| !m.is_empty() && !m.contains('.'))?;
        let own = BUILT_IN.contains(&modality) || !metrics_of(modality).is_empty();
        (!own).then(|| Column {
            name: name.to_owned(),
            unit: String::new(),
            better: Better::Lower,
        })
    }

    fn score(&self, pair: &Pair<'_>, columns: &[Column]) -> Result<ClipScore, MetricError> {
        let mut score = ClipScore::default();
        for column in columns {
            let both = pair.both(Key::<Signal>::new(column.modality()));
            let value = both
                .map(|(truth, prediction)| rmse(truth, prediction))
                .transpose()?;
            score.values.push(Outcome::of(value.flatten()));
        }
        Ok(score)
    }

    fn baselines(&self, columns: &[Column]) -> Vec<Box<dyn Baseline>> {
        let one = |c: &Column| Box::new(MeanValue(c.modality().to_owned())) as Box<dyn Baseline>;
        columns.iter().map(one).collect()
    }
}

/// Root mean square error over the valid elements of a signal; `None` where there is none.
///
/// # Errors
/// When the shapes differ, or a value that is needed is not finite.
pub fn rmse(truth: &Signal, prediction: &Signal) -> Result<Option<f64>, MetricError> {
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

/// Every sample at the mean of its channel: the baseline of a modality, by name, whose clips hold a [`Signal`] `[T, C]`.
pub struct MeanValue(pub String);

impl Baseline for MeanValue {
    fn name(&self) -> &'static str {
        "mean value"
    }

    fn modality(&self) -> &str {
        &self.0
    }

    fn samples<'a>(&self, truth: &'a Clip) -> Option<Samples<'a>> {
        let signal = truth.signal(&self.0)?;
        let &[samples, channels] = signal.values.shape() else {
            return None;
        };
        let values = signal
            .values
            .view()
            .into_shape_with_order((samples, 1, channels));
        let valid = signal
            .valid
            .as_ref()
            .map(|v| v.view().into_shape_with_order((samples, 1)));
        Some(Samples {
            values: values.ok()?,
            valid: valid.transpose().ok()?,
        })
    }

    fn predict(&self, truth: &Clip, mean: Option<&Array2<f64>>) -> Option<Held> {
        let (signal, mean) = (truth.signal(&self.0)?, mean?);
        let fits = signal.values.ndim() == 2 && signal.values.shape()[1] == mean.ncols();
        fits.then(|| {
            let at = |at: ndarray::IxDyn| mean[(0, at[1])] as f32;
            Held::new(Signal {
                values: ArrayD::from_shape_fn(signal.values.raw_dim(), at),
                valid: None,
            })
        })
    }
}
