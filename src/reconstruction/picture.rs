//! Whether a video shows a place: a model gives depth for black frames and for noise too, from what it knows of places.

use super::floor_view::View;
use super::scale::ScaleRefusal;
use ndarray::ArrayView3;

/// Levels of brightness that a picture has to vary by (standard deviation).
const LEAST_CONTRAST: f64 = 2.0;
/// Correlation that neighbouring frames of a video have at least.
const LEAST_CORRELATION: f64 = 0.2;

/// Whether the video shows anything: frames without contrast, or that have nothing to do with their neighbours, show no floor.
pub(super) fn shows_something(views: &[View<'_>]) -> Result<(), ScaleRefusal> {
    let pictures: Vec<Vec<f64>> = views
        .iter()
        .filter_map(|view| view.picture.map(blocks))
        .collect();
    let median = |mut values: Vec<f64>| {
        values.sort_by(f64::total_cmp);
        values.get(values.len() / 2).copied()
    };
    let contrast = median(pictures.iter().map(|p| covariance(p, p).sqrt()).collect());
    if contrast.is_some_and(|contrast| contrast < LEAST_CONTRAST) {
        return Err(ScaleRefusal::Blank);
    }
    let alike = pictures.windows(2).map(|pair| {
        let both = covariance(&pair[0], &pair[1]);
        let own = covariance(&pair[0], &pair[0]) * covariance(&pair[1], &pair[1]);
        both / own.sqrt().max(1e-9)
    });
    if median(alike.collect()).is_some_and(|alike| alike < LEAST_CORRELATION) {
        return Err(ScaleRefusal::Noise);
    }
    Ok(())
}

/// Brightness, 0 to 255, as means over at most 16 x 16 blocks.
fn blocks(picture: ArrayView3<'_, u8>) -> Vec<f64> {
    let (rows, columns, _) = picture.dim();
    let [high, wide] = [rows, columns].map(|n| n.min(16));
    let mut sums = vec![(0.0, 0.0); high * wide];
    for ((row, column, _), &value) in picture.indexed_iter() {
        let sum = &mut sums[row * high / rows * wide + column * wide / columns];
        *sum = (sum.0 + f64::from(value), sum.1 + 1.0);
    }
    sums.into_iter().map(|(sum, n)| sum / n).collect()
}

fn covariance(a: &[f64], b: &[f64]) -> f64 {
    let n = a.len().max(1) as f64;
    let mean = |v: &[f64]| v.iter().sum::<f64>() / n;
    let (ma, mb) = (mean(a), mean(b));
    let sum: f64 = a.iter().zip(b).map(|(x, y)| (x - ma) * (y - mb)).sum();
    sum / n
}
