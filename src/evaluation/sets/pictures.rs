//! Errors of depth, in every space a fit can be made in, and of colour.

use crate::clip::{Clip, DEPTH, Depth, Held, RGB, Rgb};
use crate::evaluation::columns::{Column, ColumnInfo};
use crate::evaluation::depth::{DepthErrors, Space, depth_errors};
use crate::evaluation::metric::{Baseline, ClipScore, MetricEntry, MetricSet, Pair, Samples};
use crate::evaluation::outcome::{MetricError, Outcome, mean};
use ndarray::{Array2, Array3};

struct DepthMetrics;
inventory::submit! { MetricEntry(&DepthMetrics) }

const SPACES: [(&str, Space); 4] = [
    ("depth", Space::Depth),
    ("disparity", Space::Disparity),
    ("median", Space::Median),
    ("none", Space::None),
];
const NEGATIVE: &str =
    "warning: the depth fit has a negative scale (the prediction looks like inverse depth)";

impl MetricSet for DepthMetrics {
    fn name(&self) -> &'static str {
        DEPTH.name()
    }

    fn columns(&self) -> &'static [ColumnInfo] {
        const {
            &[
                ColumnInfo::lower("depth.abs_rel@depth", "", "scale and shift fitted to depth"),
                ColumnInfo::lower(
                    "depth.abs_rel@disparity",
                    "",
                    "scale and shift fitted to inverse depth",
                ),
                ColumnInfo::lower("depth.abs_rel@median", "", "scaled by the median"),
                ColumnInfo::lower("depth.abs_rel@none", "", "as predicted, for metric models"),
                ColumnInfo::higher(
                    "depth.delta@depth",
                    "%",
                    "pixels within a factor 1.25, fitted to depth",
                ),
                ColumnInfo::higher(
                    "depth.delta@disparity",
                    "%",
                    "pixels within a factor 1.25, fitted to inverse depth",
                ),
                ColumnInfo::higher(
                    "depth.delta@median",
                    "%",
                    "pixels within a factor 1.25, scaled by the median",
                ),
                ColumnInfo::higher(
                    "depth.delta@none",
                    "%",
                    "pixels within a factor 1.25, as predicted",
                ),
            ]
        }
    }

    fn score(&self, pair: &Pair<'_>, columns: &[Column]) -> Result<ClipScore, MetricError> {
        let Some((truth, prediction)) = pair.both(DEPTH) else {
            return Ok(ClipScore::default());
        };
        let gt = on_grid(&truth.metres, prediction.metres.dim());
        let mut by_space: Vec<(&str, DepthErrors)> = Vec::new();
        for (name, space) in SPACES {
            let space_of = |c: &Column| c.name.split_once('@').is_some_and(|(_, s)| s == name);
            if columns.iter().any(space_of) {
                let metres = prediction.metres.view();
                let errors = depth_errors(metres, gt.view(), None, space, pair.depth)?;
                by_space.push((name, errors));
            }
        }
        let score = ClipScore::of(columns, |metric| {
            let (metric, space) = metric.split_once('@').unwrap_or_default();
            match (metric, by_space.iter().find(|(name, _)| *name == space)) {
                ("abs_rel", Some((_, e))) => Outcome::unless(e.degenerate, e.abs_rel),
                ("delta", Some((_, e))) => Outcome::unless(e.degenerate, e.delta_1_25),
                _ => Outcome::Null,
            }
        });
        let mut fits = by_space.iter().filter(|(name, _)| *name == "depth");
        let negative = fits.any(|(_, e)| e.scale.is_some_and(|s| s < 0.0));
        let notes = negative.then_some(NEGATIVE).into_iter().collect();
        Ok(ClipScore { notes, ..score })
    }

    fn baselines(&self, _: &[Column]) -> Vec<Box<dyn Baseline>> {
        vec![Box::new(MeanDepth)]
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

/// The mean depth image of the evaluated clips.
struct MeanDepth;

impl Baseline for MeanDepth {
    fn name(&self) -> &'static str {
        "mean depth image"
    }

    fn modality(&self) -> &str {
        DEPTH.name()
    }

    fn samples<'a>(&self, truth: &'a Clip) -> Option<Samples<'a>> {
        Some(Samples {
            values: truth.depth()?.metres.view(),
            valid: None,
        })
    }

    fn predict(&self, truth: &Clip, mean: Option<&Array2<f64>>) -> Option<Held> {
        let (depth, mean) = (truth.depth()?, mean?);
        let (_, h, w) = depth.metres.dim();
        (mean.dim() == (h, w)).then(|| {
            let at = |(_, y, x)| mean[(y, x)] as f32;
            Held::new(Depth {
                rate: depth.rate,
                metres: Array3::from_shape_fn(depth.metres.dim(), at),
            })
        })
    }
}

struct RgbMetrics;
inventory::submit! { MetricEntry(&RgbMetrics) }

impl MetricSet for RgbMetrics {
    fn name(&self) -> &'static str {
        RGB.name()
    }

    fn columns(&self) -> &'static [ColumnInfo] {
        const {
            &[ColumnInfo::higher(
                "rgb.psnr",
                "dB",
                "peak signal-to-noise ratio of the colour video",
            )]
        }
    }

    fn score(&self, pair: &Pair<'_>, columns: &[Column]) -> Result<ClipScore, MetricError> {
        let found = pair
            .both(RGB)
            .and_then(|(truth, prediction)| psnr(truth, prediction));
        Ok(ClipScore::of(columns, |_| Outcome::of(found)))
    }
}

fn psnr(truth: &Rgb, prediction: &Rgb) -> Option<f64> {
    if truth.frames.dim() != prediction.frames.dim() {
        return None;
    }
    let squares = truth.frames.iter().zip(&prediction.frames);
    let error = mean(squares.map(|(a, b)| (f64::from(*a) - f64::from(*b)).powi(2)))?;
    Some(10.0 * (255.0_f64.powi(2) / error.max(1e-10)).log10())
}
