//! How natural a set of motions is (Sec. 5): Fréchet distance and similarity of embeddings.
//!
//! The paper embeds with TMR, whose weights a user brings; `kin_fid` and `kin_cos` need no weights. They rest on a kinematic
//! descriptor and are never called FID: the two are different numbers.

use super::outcome::{MetricError, mean};
use nalgebra::DMatrix;
use ndarray::{Array1, Array2, ArrayView2, ArrayView3, Axis, Zip, s};

/// Fréchet distance between the Gaussians of the rows of `a` `[n, d]` and `b` `[m, d]`, with unbiased covariances.
///
/// The trace of the root of the product is the nuclear norm of `A_c B_cᵀ / sqrt((n-1)(m-1))`: exact, also for n < d.
/// `None` when either side has fewer than two rows. `normalize` scales every row to unit length first.
///
/// # Errors
/// When the widths differ, a value is not finite, or a row of length zero should be normalised.
pub fn frechet_distance(
    a: ArrayView2<f64>,
    b: ArrayView2<f64>,
    normalize: bool,
) -> Result<Option<f64>, MetricError> {
    check_widths(&a, &b)?;
    let (a, b) = if normalize {
        (unit_rows(a)?, unit_rows(b)?)
    } else {
        (a.to_owned(), b.to_owned())
    };
    if a.nrows() < 2 || b.nrows() < 2 {
        return Ok(None);
    }
    let center = |x: &Array2<f64>| {
        let mean = x.mean_axis(Axis(0)).expect("at least two rows");
        (x - &mean, mean)
    };
    let ((a_centred, a_mean), (b_centred, b_mean)) = (center(&a), center(&b));
    let (n1, m1) = ((a.nrows() - 1) as f64, (b.nrows() - 1) as f64);
    let trace = |x: &Array2<f64>, dof: f64| x.iter().map(|v| v * v).sum::<f64>() / dof;
    let cross = reduced(&a_centred) * reduced(&b_centred).transpose();
    let nuclear: f64 = cross.singular_values().iter().sum::<f64>() / (n1 * m1).sqrt();
    let shift = Zip::from(&a_mean)
        .and(&b_mean)
        .fold(0.0, |sum, x, y| sum + (x - y).powi(2));
    let distance = shift + trace(&a_centred, n1) + trace(&b_centred, m1) - 2.0 * nuclear;
    Ok(Some(distance.max(0.0)))
}

/// A matrix with the same `xᵀx` and at most as many rows as columns: the nuclear norm does not see the difference.
fn reduced(x: &Array2<f64>) -> DMatrix<f64> {
    let full = DMatrix::from_row_iterator(x.nrows(), x.ncols(), x.iter().copied());
    if x.nrows() > x.ncols() {
        full.qr().r()
    } else {
        full
    }
}

/// The mean cosine between rows of `a` and `b` of the same index; `None` without rows.
///
/// # Errors
/// When the shapes differ, a value is not finite, or a row has length zero.
pub fn mean_cosine(a: ArrayView2<f64>, b: ArrayView2<f64>) -> Result<Option<f64>, MetricError> {
    Ok(mean(cosines(a, b)?))
}

/// A cosine, from -1 to 1, as a score from 0 to 1.
#[must_use]
pub fn score01(cosine: f64) -> f64 {
    f64::midpoint(cosine, 1.0)
}

/// The cosine of every pair of rows.
///
/// # Errors
/// As [`mean_cosine`].
pub fn cosines(a: ArrayView2<f64>, b: ArrayView2<f64>) -> Result<Vec<f64>, MetricError> {
    check_widths(&a, &b)?;
    if a.nrows() != b.nrows() {
        return Err(MetricError::Shape {
            field: "embeddings",
            found: a.shape().to_vec(),
            expected: b.shape().to_vec(),
        });
    }
    let (a, b) = (unit_rows(a)?, unit_rows(b)?);
    Ok(a.outer_iter()
        .zip(b.outer_iter())
        .map(|(x, y)| x.dot(&y))
        .collect())
}

fn check_widths(a: &ArrayView2<f64>, b: &ArrayView2<f64>) -> Result<(), MetricError> {
    if a.ncols() != b.ncols() {
        return Err(MetricError::Shape {
            field: "embeddings",
            found: a.shape().to_vec(),
            expected: b.shape().to_vec(),
        });
    }
    for x in [a, b] {
        if let Some(((row, column), _)) = x.indexed_iter().find(|(_, v)| !v.is_finite()) {
            return Err(MetricError::NotFinite {
                field: "embedding",
                position: vec![row, column],
            });
        }
    }
    Ok(())
}

fn unit_rows(x: ArrayView2<f64>) -> Result<Array2<f64>, MetricError> {
    let mut x = x.to_owned();
    for (row, mut lane) in x.outer_iter_mut().enumerate() {
        let length = lane.dot(&lane).sqrt();
        if length == 0.0 {
            return Err(MetricError::ZeroEmbedding { row });
        }
        lane /= length;
    }
    Ok(x)
}

/// The kinematic descriptor of a motion `[T, J, 3]` in metres: 5J + 2 numbers that do not change with yaw or place.
///
/// Per joint mean and standard deviation of speed (m/s), mean height above the clip's lowest coordinate, mean and standard
/// deviation of the distance to the root; then the root's horizontal path length and net displacement. `up` is the index of the
/// vertical axis.
#[must_use]
pub fn kinematic_descriptor<T: Copy + Into<f64>>(
    motion: ArrayView3<T>,
    rate: f64,
    root: usize,
    up: usize,
) -> Array1<f64> {
    let motion = motion.mapv(Into::into);
    let (frames, joints, _) = motion.dim();
    let lowest = motion
        .slice(s![.., .., up])
        .iter()
        .copied()
        .fold(f64::INFINITY, f64::min);
    let distance = |a: (usize, usize), b: (usize, usize), skip: Option<usize>| {
        (0..3)
            .filter(|axis| Some(*axis) != skip)
            .map(|axis| (motion[(a.0, a.1, axis)] - motion[(b.0, b.1, axis)]).powi(2))
            .sum::<f64>()
            .sqrt()
    };
    let mut descriptor = Array1::zeros(5 * joints + 2);
    for j in 0..joints {
        let speeds: Vec<f64> = (1..frames)
            .map(|t| distance((t, j), (t - 1, j), None) * rate)
            .collect();
        let reach: Vec<f64> = (0..frames)
            .map(|t| distance((t, j), (t, root), None))
            .collect();
        let height = mean((0..frames).map(|t| motion[(t, j, up)] - lowest));
        let (speed_mean, speed_std) = mean_and_deviation(&speeds);
        let (reach_mean, reach_std) = mean_and_deviation(&reach);
        descriptor[j] = speed_mean;
        descriptor[joints + j] = speed_std;
        descriptor[2 * joints + j] = height.unwrap_or(0.0);
        descriptor[3 * joints + j] = reach_mean;
        descriptor[4 * joints + j] = reach_std;
    }
    let horizontal = |a: usize, b: usize| distance((a, root), (b, root), Some(up));
    descriptor[5 * joints] = (1..frames).map(|t| horizontal(t, t - 1)).sum();
    descriptor[5 * joints + 1] = if frames > 0 {
        horizontal(frames - 1, 0)
    } else {
        0.0
    };
    descriptor
}

fn mean_and_deviation(values: &[f64]) -> (f64, f64) {
    let Some(m) = mean(values.iter().copied()) else {
        return (0.0, 0.0);
    };
    let variance = mean(values.iter().map(|v| (v - m).powi(2))).unwrap_or(0.0);
    (m, variance.sqrt())
}

/// `kin_fid` and `kin_cos` of a set of predicted motions against the true ones.
#[derive(Debug, Clone, PartialEq)]
pub struct KinScores {
    /// Clips in the set.
    pub n: usize,
    /// Width of the descriptor.
    pub dim: usize,
    /// Fréchet distance of the standardised descriptors divided by their width. `None` below two clips.
    pub kin_fid: Option<f64>,
    /// Mean cosine of the standardised descriptors. `None` below two clips.
    pub kin_cos: Option<f64>,
    /// The cosine of every clip, in order; empty below two clips.
    pub cosines: Vec<f64>,
    /// Fréchet distance, per width, of two random halves of the truth: what sampling alone costs. `None` below four clips.
    pub floor: Option<f64>,
}

/// Scores of descriptors `[n, 5J + 2]`, standardised with the truth's mean and population standard deviation.
///
/// # Errors
/// When the shapes differ, a value is not finite, or a clip sits exactly at the truth's mean (it has no direction).
pub fn kin_scores(pred: ArrayView2<f64>, gt: ArrayView2<f64>) -> Result<KinScores, MetricError> {
    if pred.dim() != gt.dim() {
        return Err(MetricError::Shape {
            field: "descriptors",
            found: pred.shape().to_vec(),
            expected: gt.shape().to_vec(),
        });
    }
    let (n, dim) = gt.dim();
    if n < 2 {
        return Ok(KinScores {
            n,
            dim,
            kin_fid: None,
            kin_cos: None,
            cosines: Vec::new(),
            floor: None,
        });
    }
    let center = gt.mean_axis(Axis(0)).expect("at least two rows");
    let deviation = gt
        .std_axis(Axis(0), 0.0)
        .mapv(|s| if s < 1e-6 { 1.0 } else { s });
    let standardise = |x: ArrayView2<f64>| (&x - &center) / &deviation;
    let (pred, gt) = (standardise(pred), standardise(gt));
    let cosines = cosines(pred.view(), gt.view())?;
    let per_width = |distance: Option<f64>| distance.map(|d| d / dim as f64);
    Ok(KinScores {
        n,
        dim,
        kin_fid: per_width(frechet_distance(pred.view(), gt.view(), false)?),
        kin_cos: mean(cosines.iter().copied()),
        cosines,
        floor: if n < 4 {
            None
        } else {
            let (first, second) = halves(n);
            let part = |rows: &[usize]| gt.select(Axis(0), rows);
            per_width(frechet_distance(
                part(&first).view(),
                part(&second).view(),
                false,
            )?)
        },
    })
}

/// Two disjoint random halves of `0..n`, always the same for the same `n`.
fn halves(n: usize) -> (Vec<usize>, Vec<usize>) {
    use rand::seq::SliceRandom;
    let mut order: Vec<usize> = (0..n).collect();
    order.shuffle(&mut crate::random::stream(0, "evaluation.halves", 0, 0));
    let second = order.split_off(n / 2);
    (order, second)
}

#[cfg(test)]
mod tests {
    use super::*;
    use ndarray::Array3;
    use rand::RngExt;

    fn cloud(rows: usize, name: &str) -> Array2<f64> {
        let mut rng = crate::random::stream(0, name, 0, 0);
        Array2::from_shape_fn((rows, 6), |_| rng.random::<f64>())
    }

    #[test]
    fn the_distance_is_symmetric_and_zero_on_itself_in_any_order() {
        let (a, b) = (cloud(20, "a"), cloud(15, "b"));
        let d = |x: &Array2<f64>, y: &Array2<f64>| {
            frechet_distance(x.view(), y.view(), false)
                .unwrap()
                .unwrap()
        };
        assert!((d(&a, &b) - d(&b, &a)).abs() < 1e-12);
        let reversed = a.slice(s![..;-1, ..]).to_owned();
        assert!(d(&a, &reversed) < 1e-12);
        assert!(d(&a, &b) > 1e-3);
    }

    #[test]
    fn the_descriptor_does_not_see_yaw_or_place() {
        let mut rng = crate::random::stream(0, "motion", 0, 0);
        let motion = Array3::from_shape_fn((30, 5, 3), |_| rng.random::<f64>());
        let mut turned = motion.clone();
        let (sin, cos) = 0.8_f64.sin_cos();
        for mut joint in turned.rows_mut() {
            let (x, y) = (joint[0], joint[1]);
            (joint[0], joint[1], joint[2]) = (
                cos * x - sin * y + 4.0,
                sin * x + cos * y - 1.0,
                joint[2] + 0.7,
            );
        }
        let a = kinematic_descriptor(motion.view(), 30.0, 0, 2);
        let b = kinematic_descriptor(turned.view(), 30.0, 0, 2);
        assert!((&a - &b).iter().all(|d| d.abs() < 1e-9));
    }
}
