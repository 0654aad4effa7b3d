//! Between pixels and the network: the wavelet, and where a tokenizer has statistics, the units of its coefficients. Both are
//! one affine map of a block of pixels each way, so the statistics cost nothing.

use burn::tensor::{Device, Tensor, TensorData};

use super::settings::COLOURS;
use super::{VideoSettings, haar};
use crate::engine::ops;
use crate::tokenizer::normaliser::Normaliser;

/// An affine map of rows.
#[derive(Debug, Clone)]
pub(super) struct Map {
    /// `[out, in]`.
    weight: Tensor<2>,
    bias: Option<Tensor<1>>,
}

impl Map {
    pub(super) fn apply(&self, x: Tensor<2>) -> Tensor<2> {
        ops::linear(x, self.weight.clone(), self.bias.clone())
    }

    pub(super) fn device(&self) -> Device {
        self.weight.device()
    }
}

/// Pixels of a block to what the network works on, and back.
///
/// With statistics, the network sees coefficients around their means, the large ones brought halfway to the small ones: those
/// that make the picture stay the largest. Its output has a unit per coefficient, its deviation.
pub(super) fn maps(
    settings: &VideoSettings,
    statistics: Option<&Normaliser>,
    device: &Device,
) -> [Map; 2] {
    let side = settings.coefficients();
    let mut forward = haar::block_matrix(settings.patch, COLOURS);
    let scale = settings.patch.pow(3) as f32;
    let mut inverse = vec![0.0; forward.len()];
    for row in 0..side {
        for column in 0..side {
            inverse[column * side + row] = forward[row * side + column] * scale;
        }
    }
    let matrix =
        |values: Vec<f32>| Tensor::from_data(TensorData::new(values, [side, side]), device);
    let vector = |values: Vec<f32>| Tensor::from_data(TensorData::new(values, [side]), device);
    let Some(statistics) = statistics else {
        return [forward, inverse].map(|values| Map {
            weight: matrix(values),
            bias: None,
        });
    };
    let (mean, deviation) = (statistics.mean(), statistics.deviation());
    let most = deviation.iter().copied().fold(0.0_f32, f32::max);
    let mut to = vec![0.0; side];
    for (row, to) in to.iter_mut().enumerate() {
        let unit = (most * deviation[row]).sqrt();
        for value in &mut forward[row * side..(row + 1) * side] {
            *value /= unit;
        }
        *to = -mean[row] / unit;
    }
    let mut from = vec![0.0; side];
    for (row, from) in inverse.chunks_exact_mut(side).zip(&mut from) {
        *from = row.iter().zip(mean).map(|(value, mean)| value * mean).sum();
        for (value, deviation) in row.iter_mut().zip(deviation) {
            *value *= deviation;
        }
    }
    [(forward, to), (inverse, from)].map(|(weight, bias)| Map {
        weight: matrix(weight),
        bias: Some(vector(bias)),
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::engine::Compute;
    use crate::engine::parameters::to_host;

    #[test]
    fn the_network_s_output_has_the_statistics_units() {
        let settings = VideoSettings {
            patch: 2,
            ..VideoSettings::default()
        };
        let side = settings.coefficients();
        let compute = Compute::cpu();
        let device = compute.device();
        let mean: Vec<f32> = (0..side).map(|i| 0.1 * i as f32 - 0.4).collect();
        let deviation: Vec<f32> = (0..side).map(|i| 1.0 / (1.0 + i as f32)).collect();
        let statistics = Normaliser::new(mean.clone(), deviation.clone()).unwrap();
        let plain = maps(&settings, None, device);
        let scaled = maps(&settings, Some(&statistics), device);
        let row =
            |values: Vec<f32>| Tensor::<2>::from_data(TensorData::new(values, [1, side]), device);
        let pixels = row((0..side).map(|i| (i as f32).sin()).collect());
        let close = |a: Tensor<2>, b: Tensor<2>| {
            for (a, b) in to_host(a).into_iter().zip(to_host(b)) {
                assert!((a - b).abs() < 1e-5, "{a} {b}");
            }
        };
        let coefficients = plain[0].apply(pixels.clone());
        // The largest deviation is 1.
        let units = row(deviation.iter().map(|deviation| deviation.sqrt()).collect());
        close(
            scaled[0].apply(pixels),
            (coefficients - row(mean.clone())) / units,
        );
        let output = row((0..side).map(|i| (i as f32 * 0.3).cos()).collect());
        close(
            scaled[1].apply(output.clone()),
            plain[1].apply(output * row(deviation) + row(mean)),
        );
    }
}
