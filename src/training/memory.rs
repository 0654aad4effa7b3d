//! How much memory a training needs, before anything is allocated: what the optimizer holds, and what a forward pass leaves for the
//! backward pass, counted from the layers. `cargo bench --bench plan` compares with what trainings were seen to take.

use crate::mget::MgetSpec;
use crate::tokenizer::vq::VqSettings;

/// Bytes of a number.
const F32: f64 = 4.0;
/// Copies of every parameter: the value, its gradient and two moments.
const COPIES: f64 = 4.0;
/// Gradients of activations that live at once, blocks of the allocator that are larger than what was asked for, and what it keeps
/// for the next step, as a share of what the forward pass leaves: an estimate, which `cargo bench --bench plan` puts to the test.
const BACKWARD: f64 = 1.25;
/// The program, its threads and its buffers: an estimate, likewise.
const PROGRAM: f64 = 30e6;

/// Peak bytes of a training with so many parameters, whose forward pass leaves `floats` numbers per step, beside `held` numbers that are
/// no activations.
#[must_use]
pub fn peak(parameters: u64, floats: f64, held: f64) -> u64 {
    (PROGRAM + F32 * (COPIES * parameters as f64 + BACKWARD * floats + held)) as u64
}

/// Peak bytes where `floats` numbers are held after the training, whose memory is free by then.
#[must_use]
pub fn afterwards(floats: f64) -> u64 {
    (PROGRAM + F32 * floats) as u64
}

/// Numbers that a forward pass of MGET leaves per sample, of which `visible` tokens of every modality are seen and `targets` asked for.
#[must_use]
pub fn mget_floats(spec: &MgetSpec, visible: &[f64], targets: &[f64]) -> f64 {
    let (d, h) = (spec.size.width as f64, spec.size.hidden() as f64);
    let (n, m): (f64, f64) = (visible.iter().sum(), targets.iter().sum());
    // Input and output of the norm, queries, keys, values, what attention gives, the sum, the second norm; two hidden states and
    // their product.
    let encoder = n * (8.0 * d + 3.0 * h);
    // The same for the targets, with queries of their own and what they get from the context; keys and values of the context.
    let decoder = m * (12.0 * d + 3.0 * h) + n * 3.0 * d;
    let tables: f64 = spec
        .modalities
        .iter()
        .zip(targets)
        .map(|(modality, count)| {
            // Logits and their gradient.
            2.0 * count * modality.vocabulary().unwrap_or(0) as f64
        })
        .sum();
    let pixels = mget_pixels(spec, visible);
    let ends = 4.0 * d * (n + m);
    spec.size.encoder_depth as f64 * encoder
        + spec.size.decoder_depth as f64 * decoder
        + tables
        + pixels
        + ends
}

/// Pixels of a sample that MGET sees, of which `visible` tokens of every modality are: what a batch holds that waits for its step.
#[must_use]
pub fn mget_pixels(spec: &MgetSpec, visible: &[f64]) -> f64 {
    spec.modalities
        .iter()
        .zip(visible)
        .map(|(modality, count)| count * modality.tubelet_values().unwrap_or(0) as f64)
        .sum()
}

/// Numbers that a forward pass of a VQ-VAE leaves per signal of `tokens` tokens that are patches of `patch` numbers.
#[must_use]
pub fn vq_floats(settings: &VqSettings, tokens: usize, patch: usize) -> f64 {
    let (w, n) = (settings.width as f64, tokens as f64);
    let block = n * w * (8.0 + 2.0 * settings.mlp_ratio as f64);
    let ends = n * (6.0 * patch as f64 + 6.0 * w + 4.0 * settings.code_width as f64);
    // Distances to all codes.
    let codes = 2.0 * n * settings.codebook as f64;
    2.0 * settings.depth as f64 * block + ends + codes
}
