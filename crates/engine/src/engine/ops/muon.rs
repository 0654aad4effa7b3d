//! Muon: the momentum of a matrix, made orthogonal before it is a step (Jordan et al. 2024; scaled as by Liu et al. 2025,
//! arXiv 2502.16982, so that learning rate and weight decay are those of AdamW). Not in the paper.

use burn::tensor::Tensor;

use super::{Norm, fused, linear, sum};

/// How much of the momentum is kept from step to step.
pub(super) const MOMENTUM: f64 = 0.95;

/// Rounds of the Newton-Schulz iteration, and the coefficients of its odd polynomial of degree five: singular values between 0.001
/// and 1 end between 0.7 and 1.2.
pub(super) const ROUNDS: usize = 5;
pub(super) const COEFFICIENTS: [f64; 3] = [3.4445, -4.7750, 2.0315];

/// Added to the norm that a matrix is divided by, so that zeros stay zeros.
pub(super) const NORM_EPSILON: f32 = 1e-7;

/// Root mean square of a step at learning rate 1: about that of AdamW.
const SCALE: f64 = 0.2;

/// One parameter that Muon moves: matrices of one shape, stacked over their rows.
#[derive(Debug, Clone)]
pub struct MuonParameter {
    /// `[rows, columns]`, flat.
    pub values: Tensor<1>,
    /// As the values.
    pub gradient: Tensor<1>,
    /// The running mean of gradients, as the values.
    pub momentum: Tensor<1>,
    /// Rows and columns of the parameter.
    pub shape: [usize; 2],
    /// How many matrices are stacked; divides the rows.
    pub matrices: usize,
    /// Learning rate times weight decay.
    pub decay: f64,
}

impl MuonParameter {
    /// Rows and columns of one matrix.
    pub(super) fn matrix(&self) -> [usize; 2] {
        [self.shape[0] / self.matrices, self.shape[1]]
    }
}

/// One step of each parameter, at learning rate `rate`: its new values and momentum, in place where nobody else holds them. `norm` is
/// that of all gradients together; where a device has it and it is not finite, nothing changes.
///
/// # Panics
/// When a parameter is no stack of matrices, or its gradient or momentum has another length.
#[must_use]
pub fn muon(parameters: Vec<MuonParameter>, rate: f64, norm: &Norm) -> Vec<(Tensor<1>, Tensor<1>)> {
    for parameter in &parameters {
        let [rows, columns] = parameter.shape;
        let whole = parameter.matrices > 0 && rows.is_multiple_of(parameter.matrices);
        assert!(whole && rows * columns > 0, "matrices of one shape");
        let arrays = [&parameter.values, &parameter.gradient, &parameter.momentum];
        let fit = arrays.map(|array| array.dims() == [rows * columns]);
        assert_eq!(fit, [true; 3], "arrays of the parameter's size");
    }
    if parameters.iter().all(|one| fused::takes(&one.values)) {
        return fused::muon(parameters, rate);
    }
    let refused = match norm {
        Norm::Host(_) => None,
        Norm::Device(norm) => Some(norm.clone().is_finite().bool_not()),
    };
    let each = parameters.into_iter().map(|parameter| {
        let before = [parameter.values.clone(), parameter.momentum.clone()];
        let (values, momentum) = unfused(parameter, rate);
        let Some(refused) = &refused else {
            return (values, momentum);
        };
        let [old_values, old_momentum] = before;
        let refused = refused.clone().expand(old_values.dims());
        (
            values.mask_where(refused.clone(), old_values),
            momentum.mask_where(refused, old_momentum),
        )
    });
    each.collect()
}

/// What an orthogonal matrix of this shape is multiplied by, at learning rate 1.
pub(super) fn step_scale([rows, columns]: [usize; 2]) -> f64 {
    SCALE * (rows.max(columns) as f64).sqrt()
}

fn unfused(parameter: MuonParameter, rate: f64) -> (Tensor<1>, Tensor<1>) {
    let matrix = parameter.matrix();
    let gradient = parameter.gradient * (1.0 - MOMENTUM);
    let momentum = parameter.momentum * MOMENTUM + gradient.clone();
    // Nesterov: where the momentum will be after the same gradient once more.
    let ahead = momentum.clone() * MOMENTUM + gradient;
    let steps = ahead
        .reshape(parameter.shape)
        .chunk(parameter.matrices, 0)
        .into_iter()
        .map(orthogonal)
        .collect();
    let [rows, columns] = parameter.shape;
    let step = Tensor::cat(steps, 0).reshape([rows * columns]);
    let values = parameter.values * (1.0 - parameter.decay) - step * (rate * step_scale(matrix));
    (values, momentum)
}

/// The orthogonal matrix nearest to `x`, about: its singular vectors, with singular values near 1.
fn orthogonal(x: Tensor<2>) -> Tensor<2> {
    let [rows, columns] = x.dims();
    let tall = rows > columns;
    let x = if tall { x.transpose() } else { x };
    let norm = sum(x.clone().square()).sqrt() + NORM_EPSILON;
    let mut x = x / norm.reshape([1, 1]);
    let [a, b, c] = COEFFICIENTS;
    for _ in 0..ROUNDS {
        let gram = linear(x.clone(), x.clone(), None);
        let polynomial = gram.clone() * b + linear(gram.clone(), gram, None) * c;
        x = x.clone() * a + linear(polynomial, x.transpose(), None);
    }
    if tall { x.transpose() } else { x }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::engine::Compute;
    use crate::engine::parameters::to_host;
    use burn::tensor::TensorData;

    fn waves(length: usize, pace: f32) -> Tensor<1> {
        let values: Vec<f32> = (0..length).map(|i| ((i * i) as f32 * pace).sin()).collect();
        Tensor::from_data(TensorData::new(values, [length]), Compute::cpu().device())
    }

    fn parameter(shape: [usize; 2], matrices: usize) -> MuonParameter {
        let length = shape[0] * shape[1];
        MuonParameter {
            values: waves(length, 0.31),
            gradient: waves(length, 1.7),
            momentum: waves(length, 0.9),
            shape,
            matrices,
            decay: 0.01,
        }
    }

    #[test]
    fn singular_values_come_near_one_and_zeros_stay() {
        for (rows, columns) in [(6, 24), (24, 6), (12, 12)] {
            let x = orthogonal(waves(rows * columns, 0.77).reshape([rows, columns]));
            let gram = if rows > columns {
                x.clone().transpose().matmul(x)
            } else {
                x.clone().matmul(x.transpose())
            };
            let side = rows.min(columns);
            let gram = to_host(gram);
            // The sum of squared singular values, and that of their fourth powers.
            let trace: f32 = (0..side).map(|i| gram[i * side + i]).sum();
            let fourth: f32 = gram.iter().map(|v| v * v).sum();
            let (mean, square) = (trace / side as f32, fourth / side as f32);
            assert!((0.6..1.3).contains(&mean), "{rows} x {columns}: {mean}");
            assert!(square - mean * mean < 0.2, "{rows} x {columns}: {square}");
        }
        let zeros = orthogonal(Tensor::zeros([3, 5], Compute::cpu().device()));
        assert_eq!(zeros.abs().sum().into_scalar::<f32>(), 0.0);
    }

    #[test]
    fn the_fused_step_is_the_composed_one() {
        let parameters = vec![
            parameter([36, 12], 3),
            parameter([20, 48], 1),
            parameter([48, 20], 1),
            parameter([16, 16], 2),
        ];
        let fused = muon(parameters.clone(), 0.02, &Norm::Host(1.0));
        for (parameter, fused) in parameters.into_iter().zip(fused) {
            let shape = parameter.shape;
            let composed = unfused(parameter, 0.02);
            for (found, expected) in [(fused.0, composed.0), (fused.1, composed.1)] {
                let pairs = to_host(found).into_iter().zip(to_host(expected));
                let worst = pairs.map(|(a, b)| (a - b).abs()).fold(0.0, f32::max);
                assert!(worst < 1e-5, "{shape:?}: {worst}");
            }
        }
    }

    #[test]
    fn a_step_has_the_same_bytes_on_any_number_of_threads() {
        let run = |threads: usize| {
            let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build();
            let step = || {
                let parameters = vec![parameter([96, 32], 3), parameter([32, 64], 1)];
                muon(parameters, 0.02, &Norm::Host(1.0))
            };
            let moved = pool.unwrap().install(step).into_iter();
            moved
                .flat_map(|(values, _)| to_host(values))
                .collect::<Vec<f32>>()
        };
        assert_eq!(run(1), run(3));
    }
}
