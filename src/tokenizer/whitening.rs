//! What a new tokenizer is given before its first step: quiet branches, and latents made white by a change of the projection to
//! them, fitted to the first signals.
//!
//! Drawn at random, the latents of all tokens lie close together, and a few codes take them all; the first hundreds of steps go
//! into spreading them. Data-dependent initialisation, as in Krähenbühl et al. 2016 (arXiv 1511.06856).

use nalgebra::{DMatrix, DVector, SymmetricEigen};

use super::TokenizerError;
use crate::engine::{HostTensor, Values, Weights};

/// Directions that vary less than this share of the one that varies most (as variances) are not blown up further: their gain
/// would multiply every step of the encoder.
const LEAST: f64 = 1e-2;

/// Mean and covariance of latents.
#[derive(Debug, Clone)]
pub struct Whitening {
    count: f64,
    sum: DVector<f64>,
    products: DMatrix<f64>,
}

impl Whitening {
    /// Of latents of `width` values.
    #[must_use]
    pub fn new(width: usize) -> Self {
        Self {
            count: 0.0,
            sum: DVector::zeros(width),
            products: DMatrix::zeros(width, width),
        }
    }

    /// Adds latents, `[rows, width]`.
    pub fn add(&mut self, latents: &[f32]) {
        for row in latents.chunks_exact(self.sum.len()) {
            let z = DVector::from_iterator(row.len(), row.iter().map(|v| f64::from(*v)));
            self.count += 1.0;
            self.products += &z * z.transpose();
            self.sum += z;
        }
    }

    /// Changes the projection `<name>.weight` (`[width, ...]`) and `<name>.bias` so that the latents seen have mean 0,
    /// deviation `spread` and no correlation.
    ///
    /// # Errors
    /// When the projection is not there or has another width, or the latents seen are none or not finite.
    pub fn apply(
        &self,
        weights: &mut Weights,
        name: &str,
        spread: f64,
    ) -> Result<(), TokenizerError> {
        let width = self.sum.len();
        let mean = &self.sum / self.count.max(1.0);
        let covariance = &self.products / self.count.max(1.0) - &mean * mean.transpose();
        if self.count < 2.0 || covariance.iter().any(|value| !value.is_finite()) {
            return Err(TokenizerError::Other(
                "the first latents are not finite, or there are none".to_owned(),
            ));
        }
        let eigen = SymmetricEigen::new(covariance);
        let most = eigen.eigenvalues.max().max(f64::MIN_POSITIVE);
        let scales = eigen
            .eigenvalues
            .map(|value| spread / value.max(LEAST * most).sqrt());
        let map =
            &eigen.eigenvectors * DMatrix::from_diagonal(&scales) * eigen.eigenvectors.transpose();

        let weight = floats(weights, &format!("{name}.weight"), width)?;
        let columns = weight.len() / width;
        let values = weight.iter().map(|value| f64::from(*value));
        let new = &map * DMatrix::from_row_iterator(width, columns, values);
        for (place, value) in weight.iter_mut().enumerate() {
            *value = new[(place / columns, place % columns)] as f32;
        }
        let bias = floats(weights, &format!("{name}.bias"), width)?;
        let old = DVector::from_iterator(width, bias.iter().map(|value| f64::from(*value)));
        for (value, new) in bias.iter_mut().zip((map * (old - mean)).iter()) {
            *value = *new as f32;
        }
        Ok(())
    }
}

/// Multiplies all values of the tensors whose names `chosen` picks: branches that start quiet leave the path beside them open.
pub fn scale(weights: &mut Weights, by: f32, chosen: impl Fn(&str) -> bool) {
    for (name, tensor) in &mut weights.tensors {
        if let (true, Values::F32(values)) = (chosen(name), &mut tensor.values) {
            for value in values {
                *value *= by;
            }
        }
    }
}

/// The values of the tensor `name`, whose first size is `rows`.
///
/// # Errors
/// When there is none, or it has another size.
pub fn floats<'a>(
    weights: &'a mut Weights,
    name: &str,
    rows: usize,
) -> Result<&'a mut Vec<f32>, TokenizerError> {
    match weights.tensors.get_mut(name) {
        Some(HostTensor {
            shape,
            values: Values::F32(values),
        }) if shape.first() == Some(&rows) => Ok(values),
        _ => Err(TokenizerError::Other(format!(
            "`{name}` with {rows} rows is missing"
        ))),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn latents_become_white() {
        // Latents W h + b of hidden states h, far from white.
        let (w, b) = ([2.0_f32, 1.0, 0.5, 1.2], [5.0_f32, -3.0]);
        let hidden: Vec<[f32; 2]> = (0..400)
            .map(|i| [(i as f32 * 0.7).sin(), (i as f32 * 1.3).cos() + 0.5])
            .collect();
        let project = |w: &[f32], b: &[f32]| -> Vec<f32> {
            let rows = hidden.iter();
            rows.flat_map(|h| [0, 1].map(|i| w[2 * i] * h[0] + w[2 * i + 1] * h[1] + b[i]))
                .collect()
        };
        let mut weights = Weights::default();
        weights.insert_f32("to.weight", w.to_vec(), &[2, 2]);
        weights.insert_f32("to.bias", b.to_vec(), &[2]);
        let mut whitening = Whitening::new(2);
        whitening.add(&project(&w, &b));
        whitening.apply(&mut weights, "to", 0.5).unwrap();
        let (w, b) = (
            floats(&mut weights, "to.weight", 2).unwrap().clone(),
            floats(&mut weights, "to.bias", 2).unwrap().clone(),
        );
        let mut after = Whitening::new(2);
        after.add(&project(&w, &b));
        assert!(after.sum.norm() / 400.0 < 1e-4);
        let covariance = after.products / 400.0;
        let off = covariance - DMatrix::identity(2, 2) * 0.25;
        assert!(off.norm() < 1e-3, "{off}");
        assert!(whitening.apply(&mut weights, "other", 1.0).is_err());
    }
}
