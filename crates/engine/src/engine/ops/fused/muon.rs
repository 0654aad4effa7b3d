//! Muon on the processor: a task per matrix, in place.

use burn::backend::Flex;
use burn::tensor::Tensor;
use burn_flex::FlexTensor;
use rayon::prelude::*;

use super::super::gemm::{Matrix, Threads, gemm_into};
use super::super::muon::{COEFFICIENTS, MOMENTUM, MuonParameter, NORM_EPSILON, ROUNDS, step_scale};
use super::flat::host;
use super::{Array, vector};

/// One matrix of a parameter.
struct Task<'a> {
    values: &'a mut [f32],
    momentum: &'a mut [f32],
    gradient: &'a [f32],
    shape: [usize; 2],
    decay: f64,
}

/// New values and momentum of every parameter.
pub fn muon(parameters: Vec<MuonParameter>, rate: f64) -> Vec<(Tensor<1>, Tensor<1>)> {
    let mut arrays: Vec<(FlexTensor, FlexTensor, Array)> = Vec::with_capacity(parameters.len());
    let mut shapes = Vec::with_capacity(parameters.len());
    for parameter in parameters {
        shapes.push((parameter.matrix(), parameter.decay));
        arrays.push((
            host(parameter.values),
            host(parameter.momentum),
            Array::dense(&host(parameter.gradient)),
        ));
    }
    let mut tasks = Vec::new();
    for ((values, momentum, gradient), (shape, decay)) in arrays.iter_mut().zip(shapes) {
        let length = shape[0] * shape[1];
        let values = values.storage_mut::<f32>().chunks_exact_mut(length);
        let momentum = momentum.storage_mut::<f32>().chunks_exact_mut(length);
        let gradient = gradient.values().chunks_exact(length);
        tasks.extend(
            values
                .zip(momentum)
                .zip(gradient)
                .map(|((values, momentum), gradient)| Task {
                    values,
                    momentum,
                    gradient,
                    shape,
                    decay,
                }),
        );
    }
    tasks
        .into_par_iter()
        .with_max_len(1)
        .for_each(|task| task.run(rate));
    let tensor = Tensor::from_primitive::<Flex>;
    arrays
        .into_iter()
        .map(|(values, momentum, _)| (tensor(values), tensor(momentum)))
        .collect()
}

impl Task<'_> {
    fn run(self, rate: f64) {
        let (keep, learn) = (MOMENTUM as f32, (1.0 - MOMENTUM) as f32);
        let mut ahead = vec![0.0; self.values.len()];
        vector::vectorised(
            #[inline(always)]
            || {
                let gradients = self.momentum.iter_mut().zip(self.gradient);
                for (ahead, (momentum, gradient)) in ahead.iter_mut().zip(gradients) {
                    let gradient = gradient * learn;
                    *momentum = *momentum * keep + gradient;
                    *ahead = *momentum * keep + gradient;
                }
            },
        );
        let step = orthogonal(ahead, self.shape);
        let (keep, scale) = (
            (1.0 - self.decay) as f32,
            (rate * step_scale(self.shape)) as f32,
        );
        vector::vectorised(
            #[inline(always)]
            || {
                for (value, step) in self.values.iter_mut().zip(&step) {
                    *value = *value * keep - step * scale;
                }
            },
        );
    }
}

/// The orthogonal matrix nearest to `x`, about. The polynomial is multiplied from the side where it is smaller.
fn orthogonal(mut x: Vec<f32>, [rows, columns]: [usize; 2]) -> Vec<f32> {
    let side = rows.min(columns);
    let wide = rows <= columns;
    let norm = vector::vectorised(
        #[inline(always)]
        || vector::dot(&x, &x),
    );
    let scale = 1.0 / (norm.sqrt() + NORM_EPSILON);
    for value in &mut x {
        *value *= scale;
    }
    let [a, b, c] = COEFFICIENTS.map(|coefficient| coefficient as f32);
    let (mut gram, mut polynomial) = (vec![0.0; side * side], vec![0.0; side * side]);
    let mut next = vec![0.0; x.len()];
    let product = |to: &mut [f32], a: Matrix<'_>, b: Matrix<'_>, alpha: f32, add: bool| {
        gemm_into(to, b.columns(), a, b, alpha, add, Threads::One);
    };
    for _ in 0..ROUNDS {
        let values = Matrix::rows(&x, rows, columns);
        let (left, right) = if wide {
            (values, values.transposed())
        } else {
            (values.transposed(), values)
        };
        product(&mut gram, left, right, 1.0, false);
        for (polynomial, gram) in polynomial.iter_mut().zip(&gram) {
            *polynomial = gram * b;
        }
        for place in 0..side {
            polynomial[place * side + place] += a;
        }
        let square = Matrix::rows(&gram, side, side);
        product(&mut polynomial, square, square, c, true);
        let polynomial = Matrix::rows(&polynomial, side, side);
        let (left, right) = if wide {
            (polynomial, values)
        } else {
            (values, polynomial)
        };
        product(&mut next, left, right, 1.0, false);
        std::mem::swap(&mut x, &mut next);
    }
    x
}
