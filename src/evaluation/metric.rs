//! What a modality brings to an evaluation: a [`MetricSet`] fills its columns, a [`Baseline`] is what it has to beat.
//!
//! Sets are found because they are linked in: `inventory::submit! { MetricEntry(&GazeMetrics) }`, the product's own
//! ([`super::sets`]) as those of a plug-in crate. A modality without a set of its own has `<modality>.rmse`.

use super::columns::{Column, ColumnInfo};
use super::outcome::{MetricError, Outcome};
use super::scores::SetScore;
use crate::clip::{Clip, Held, Key, Value};
use ndarray::{Array1, Array2, ArrayView2, ArrayView3};

/// Metrics that belong together: those of one modality, or of several.
pub trait MetricSet: Sync {
    /// Unique; sets stand in the order of their names.
    fn name(&self) -> &'static str;

    /// Every column it can fill.
    fn columns(&self) -> &'static [ColumnInfo];

    /// The column of this name, if the set fills it.
    fn column(&self, name: &str) -> Option<Column> {
        let mut columns = self.columns().iter();
        columns
            .find(|info| info.name == name)
            .map(ColumnInfo::column)
    }

    /// The modalities that a column compares.
    fn modalities<'a>(&self, column: &'a Column) -> Vec<&'a str> {
        vec![column.modality()]
    }

    /// One clip: an outcome for each of `columns`, in their order. Only the truth's validity decides what is scored: a system cannot
    /// leave out what it finds hard.
    ///
    /// # Errors
    /// When the prediction cannot be scored: another shape, or a value that is not finite where one is needed.
    fn score(&self, pair: &Pair<'_>, columns: &[Column]) -> Result<ClipScore, MetricError>;

    /// What only all clips together give, by column: those of [`ColumnInfo::per_set`], and values per clip that depend on the others.
    ///
    /// # Errors
    /// When embeddings do not fit.
    fn over_clips(
        &self,
        _columns: &[Column],
        _clips: &AllClips<'_>,
    ) -> Result<Vec<(Column, OverClips)>, MetricError> {
        Ok(Vec::new())
    }

    /// Predictions that need no learning.
    fn baselines(&self, _columns: &[Column]) -> Vec<Box<dyn Baseline>> {
        Vec::new()
    }

    /// A baseline whose scores follow from the truth without a prediction: its name, and an outcome for each of `columns`.
    ///
    /// # Errors
    /// As [`MetricSet::score`].
    fn closed_form(
        &self,
        _truth: &Clip,
        _columns: &[Column],
    ) -> Result<Option<(&'static str, Vec<Outcome>)>, MetricError> {
        Ok(None)
    }
}

/// A true and a predicted clip.
#[derive(Debug, Clone, Copy)]
pub struct Pair<'a> {
    /// The ground truth; its validity says what is scored.
    pub truth: &'a Clip,
    /// What is scored: of the system, of a baseline, or of the tokenizers.
    pub prediction: &'a Clip,
    /// Which true depths are scored.
    pub depth: super::depth::Scored,
}

impl<'a> Pair<'a> {
    /// The true and the predicted value, where both are there.
    #[must_use]
    pub fn both<T: Value>(&self, key: Key<'_, T>) -> Option<(&'a T, &'a T)> {
        Some((self.truth.get(key)?, self.prediction.get(key)?))
    }
}

/// What one clip gives.
#[derive(Debug, Clone, Default)]
pub struct ClipScore {
    /// One per column; none at all stands for [`Outcome::Null`] everywhere.
    pub values: Vec<Outcome>,
    /// What [`MetricSet::over_clips`] needs of this clip.
    pub features: Option<Features>,
    /// What a reader of the numbers must know; counted over the clips.
    pub notes: Vec<&'static str>,
}

impl ClipScore {
    /// An outcome for each of `columns` by the name of its metric.
    pub fn of(columns: &[Column], outcome: impl Fn(&str) -> Outcome) -> Self {
        Self {
            values: columns.iter().map(|c| outcome(c.metric())).collect(),
            ..Self::default()
        }
    }

    /// The outcome of column number `index`.
    #[must_use]
    pub fn value(&self, index: usize) -> Outcome {
        self.values.get(index).copied().unwrap_or(Outcome::Null)
    }
}

/// Descriptors of one clip.
#[derive(Debug, Clone)]
pub struct Features {
    /// Of the predicted clip; as many numbers as [`Self::truth`].
    pub predicted: Array1<f64>,
    /// Of the true clip.
    pub truth: Array1<f64>,
}

/// All clips of one method.
#[derive(Debug)]
pub struct AllClips<'a> {
    /// Of every clip, in order.
    pub features: Vec<Option<&'a Features>>,
    /// Embeddings that the user brings; only of the system itself.
    pub embeddings: Option<&'a Embeddings>,
}

/// Motion embeddings that the user brings, one row per clip: TMR's 256-d mean vectors.
#[derive(Debug, Clone, PartialEq)]
pub struct Embeddings {
    /// Of the predictions, `[n, d]`.
    pub predicted: Array2<f64>,
    /// Of the true clips, `[n, d]`, in the same order.
    pub truth: Array2<f64>,
}

/// A column that was filled over all clips.
#[derive(Debug, Clone)]
pub enum OverClips {
    /// One outcome per clip, in order: values that depend on the other clips too.
    PerClip(Vec<Outcome>),
    /// One number for the whole set of clips.
    Set(SetScore),
}

/// A prediction that needs no learning, made from the evaluated truth itself: what every system has to beat.
pub trait Baseline: Send + Sync {
    /// The row of the table; baselines of several modalities that share a name are one row.
    fn name(&self) -> &'static str;

    /// What it predicts.
    fn modality(&self) -> &str;

    /// What it averages over time and clips; `None` for one that needs no average.
    fn samples<'a>(&self, _truth: &'a Clip) -> Option<Samples<'a>> {
        None
    }

    /// The prediction for a clip, given the average.
    fn predict(&self, truth: &Clip, mean: Option<&Array2<f64>>) -> Option<Held>;
}

/// Values `[T, a, b]` and which of them count, `[T, a]`; without validity every finite one does.
#[derive(Debug)]
pub struct Samples<'a> {
    /// `[T, a, b]`, frames first.
    pub values: ArrayView3<'a, f32>,
    /// `[T, a]`; `None` counts every finite value.
    pub valid: Option<ArrayView2<'a, bool>>,
}

/// The mean of [`Samples`] over time and clips.
#[derive(Debug, Default, Clone)]
pub(super) struct Mean {
    sum: Option<Array2<f64>>,
    count: Option<Array2<f64>>,
}

impl Mean {
    /// Adds the finite and valid values. Another `[a, b]` than the first is left alone.
    pub fn add(&mut self, samples: &Samples) {
        let (_, a, b) = samples.values.dim();
        let sum = self.sum.get_or_insert_with(|| Array2::zeros((a, b)));
        let count = self.count.get_or_insert_with(|| Array2::zeros((a, b)));
        if sum.dim() != (a, b) {
            return;
        }
        for ((t, i, j), value) in samples.values.indexed_iter() {
            if value.is_finite() && samples.valid.is_none_or(|valid| valid[(t, i)]) {
                sum[(i, j)] += f64::from(*value);
                count[(i, j)] += 1.0;
            }
        }
    }

    /// Adds what was summed apart.
    pub fn merge(&mut self, other: Self) {
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
    pub fn value(&self) -> Option<Array2<f64>> {
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

/// A set that is linked in.
pub struct MetricEntry(pub &'static dyn MetricSet);
inventory::collect!(MetricEntry);

/// Every set, by name.
#[must_use]
pub fn sets() -> Vec<&'static dyn MetricSet> {
    let mut sets: Vec<_> = inventory::iter::<MetricEntry>()
        .map(|entry| entry.0)
        .collect();
    sets.sort_by_key(|set| set.name());
    sets
}

/// The set that fills a column.
#[must_use]
pub fn set_of(column: &str) -> Option<&'static dyn MetricSet> {
    sets().into_iter().find(|set| set.column(column).is_some())
}

/// The metrics that a modality brings, by the part of the name after the dot; none for one that has only `rmse`.
#[must_use]
pub fn metrics_of(modality: &str) -> Vec<&'static str> {
    let columns = sets().into_iter().flat_map(MetricSet::columns);
    let of = |info: &ColumnInfo| info.name.split_once('.').filter(|(m, _)| *m == modality);
    columns.filter_map(|info| Some(of(info)?.1)).collect()
}

/// Every column name, for messages and lists.
#[must_use]
pub fn names() -> Vec<&'static str> {
    let columns = sets().into_iter().flat_map(MetricSet::columns);
    columns.map(|info| info.name).collect()
}

impl Column {
    /// The column called `name`: one of [`names`], or `<modality>.rmse` of a modality that brings no metrics.
    #[must_use]
    pub fn named(name: &str) -> Option<Self> {
        set_of(name)?.column(name)
    }

    /// Whether it has one number per set of clips instead of one per clip.
    #[must_use]
    pub fn is_per_set(&self) -> bool {
        let mut columns = sets().into_iter().flat_map(MetricSet::columns);
        columns.any(|info| info.name == self.name && info.per_set)
    }
}
