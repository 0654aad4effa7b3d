//! What the camera's path says of the scale of depth: a point seen from two places has one position, and with the path in metres that
//! holds for one scale only.

use super::cloud::ray;
use super::floor_view::View;
use super::scale::DepthFit;
use crate::clip::Intrinsics;
use nalgebra::{Isometry3, Point3};
use ndarray::Array2;

/// Factors by which the fitted depth is scaled for comparison; the middle one is the fit.
const FACTORS: [f64; 7] = [0.4, 0.55, 0.74, 1.0, 1.35, 1.8, 2.5];
const FIT: usize = 3;
/// Two cameras nearer to each other say nothing, metres.
const BASELINE: f64 = 0.08;
/// Frames that are compared with each other.
const FRAMES: usize = 10;
/// An error of the logarithm of depth beyond this is an occlusion or something that moves.
const CAP: f64 = 0.3;

/// The factor that explains the parallax clearly better than the fit, if there is one.
pub(super) fn other_scale(
    views: &[View<'_>],
    intrinsics: &Intrinsics,
    fit: &DepthFit,
) -> Option<f64> {
    let step = views.len().div_ceil(FRAMES).max(1);
    let frames: Vec<(Array2<f32>, Isometry3<f64>)> = views
        .iter()
        .step_by(step)
        .map(|view| (view.depth.mapv(|d| fit.apply(d)), view.T_world_camera))
        .collect();
    let mut costs = [0.0; FACTORS.len()];
    let mut count = 0;
    for (i, (from, a)) in frames.iter().enumerate() {
        for (to, b) in frames.iter().skip(i + 1) {
            let T_b_a = b.inv_mul(a);
            if T_b_a.translation.vector.norm() < BASELINE {
                continue;
            }
            for (row, column) in cells(from.dim()) {
                let [x, y] = ray(intrinsics, [from.nrows(), from.ncols()], row, column);
                let z = f64::from(from[[row, column]]);
                let errors = FACTORS
                    .map(|factor| mismatch(to, intrinsics, &T_b_a, [x, y], z * factor, factor));
                // Only points that all factors put into the other picture compare them.
                if z.is_finite() && errors.iter().all(Option::is_some) {
                    for (cost, error) in costs.iter_mut().zip(errors) {
                        *cost += error.unwrap_or(CAP);
                    }
                    count += 1;
                }
            }
        }
    }
    if count < 500 {
        return None;
    }
    let means = costs.map(|cost| cost / f64::from(count));
    let best = (0..means.len()).min_by(|&a, &b| means[a].total_cmp(&means[b]))?;
    // A path too short, or depth too coarse, to tell the factors apart contradicts none of them.
    let told_apart = means[FIT] > 1.15 * means[best] && means[FIT] - means[best] > 0.004;
    (best != FIT && told_apart).then_some(FACTORS[best])
}

fn cells((rows, columns): (usize, usize)) -> impl Iterator<Item = (usize, usize)> {
    (0..rows)
        .step_by(3)
        .flat_map(move |row| (0..columns).step_by(3).map(move |column| (row, column)))
}

/// How far, in the logarithm of depth, a point of one frame is from what the other frame shows there.
fn mismatch(
    to: &Array2<f32>,
    intrinsics: &Intrinsics,
    T_b_a: &Isometry3<f64>,
    [x, y]: [f64; 2],
    z: f64,
    factor: f64,
) -> Option<f64> {
    let p = T_b_a * Point3::new(x * z, y * z, z);
    if !(p.z.is_finite() && p.z > 0.05) {
        return None;
    }
    let cell = |at: f64, pixels: u32, cells: usize| {
        let cell = (at + 0.5) / f64::from(pixels) * cells as f64;
        (cell >= 0.0 && cell < cells as f64).then_some(cell as usize)
    };
    let column = cell(
        intrinsics.fx * p.x / p.z + intrinsics.cx,
        intrinsics.width,
        to.ncols(),
    )?;
    let row = cell(
        intrinsics.fy * p.y / p.z + intrinsics.cy,
        intrinsics.height,
        to.nrows(),
    )?;
    let seen = f64::from(to[[row, column]]) * factor;
    seen.is_finite().then(|| (seen / p.z).ln().abs().min(CAP))
}
