//! Gaze errors in the image.

use crate::clip::{Clip, GAZE, GazeTrack, Held};
use crate::evaluation::columns::{Column, ColumnInfo};
use crate::evaluation::gaze::gaze_errors;
use crate::evaluation::metric::{Baseline, ClipScore, MetricEntry, MetricSet, Pair};
use crate::evaluation::outcome::{MetricError, Outcome};
use ndarray::Array2;

struct GazeMetrics;
inventory::submit! { MetricEntry(&GazeMetrics) }

impl MetricSet for GazeMetrics {
    fn name(&self) -> &'static str {
        GAZE.name()
    }

    fn columns(&self) -> &'static [ColumnInfo] {
        const {
            &[
                ColumnInfo::lower(
                    "gaze.mse",
                    "",
                    "mean squared error in image widths, both coordinates",
                ),
                ColumnInfo::lower("gaze.l2", "", "mean distance in image widths"),
            ]
        }
    }

    fn score(&self, pair: &Pair<'_>, columns: &[Column]) -> Result<ClipScore, MetricError> {
        let Some((truth, prediction)) = pair.both(GAZE) else {
            return Ok(ClipScore::default());
        };
        let valid = Some(truth.valid.view());
        let errors = gaze_errors(prediction.points.view(), truth.points.view(), valid)?;
        Ok(ClipScore::of(columns, |metric| match metric {
            "mse" => Outcome::of(errors.mse),
            "l2" => Outcome::of(errors.l2),
            _ => Outcome::Null,
        }))
    }

    fn baselines(&self, _: &[Column]) -> Vec<Box<dyn Baseline>> {
        vec![Box::new(ImageCentre)]
    }
}

/// Always straight ahead.
struct ImageCentre;

impl Baseline for ImageCentre {
    fn name(&self) -> &'static str {
        "image centre"
    }

    fn modality(&self) -> &str {
        GAZE.name()
    }

    fn predict(&self, truth: &Clip, _: Option<&Array2<f64>>) -> Option<Held> {
        let gaze = truth.gaze()?;
        Some(Held::new(GazeTrack {
            points: Array2::from_elem(gaze.points.raw_dim(), 0.5),
            ..gaze.clone()
        }))
    }
}
