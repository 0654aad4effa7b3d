//! What a training takes, before anything is allocated.

use super::TrainTokenizerSettings;
use crate::engine::{Compute, Initialise, Parameters};
use crate::experiment::TokenFacts;
use crate::modality::Shape;
use crate::ops::tokenizer_entry::TokenizerEntry;
use crate::tokenizer::video::Network;
use crate::tokenizer::video::cost::Cost;
use crate::tokenizer::vq::VqVae;
use crate::training::tokenizer_fit::CALIBRATE;
use crate::training::{memory, video_kmeans};

/// Floating point operations of the whole stage on `clips` clips.
pub(super) fn flop(
    settings: &TrainTokenizerSettings,
    entry: &TokenizerEntry,
    shape: &Shape,
    tokens: &TokenFacts,
    clips: usize,
) -> Option<f64> {
    let forward = match entry {
        // One multiply-accumulate per parameter and token.
        TokenizerEntry::Vq(_) => parameters(entry, shape)? as f64 * tokens.count() as f64,
        TokenizerEntry::Video(video) => Cost::of(video, extent(shape)?).multiply_accumulates,
    };
    // The first clips go through the encoder, which is half of a network.
    let calibrated = if settings.calibrate {
        0.5 * CALIBRATE.min(clips) as f64
    } else {
        0.0
    };
    let signals = (settings.steps * settings.batch as u64) as f64;
    let [_, centres] = kmeans(settings, entry, tokens, clips);
    // A multiply-accumulate is two operations, and backward costs twice the forward.
    Some(2.0 * (forward * (3.0 * signals + calibrated) + centres))
}

/// Peak memory on `clips` clips, bytes.
pub(super) fn memory(
    settings: &TrainTokenizerSettings,
    entry: &TokenizerEntry,
    shape: &Shape,
    tokens: &TokenFacts,
    clips: usize,
) -> Option<u64> {
    let parameters = parameters(entry, shape)?;
    let at_once = match settings.micro_batch {
        0 => settings.batch,
        size => size.min(settings.batch),
    } as f64;
    match entry {
        TokenizerEntry::Vq(vq) => {
            let patches = vq.patches(shape).ok()?;
            let floats = memory::vq_floats(vq, patches.tokens(), patches.width());
            // All signals, and those of the other hand.
            let sets = 1 + usize::from(settings.other_hand().is_some());
            let held = (sets * clips * patches.tokens() * patches.width()) as f64;
            let training = memory::peak(parameters, floats * at_once, held);
            Some(training.max(memory::afterwards(2.0 * held)))
        }
        TokenizerEntry::Video(video) => {
            let floats = Cost::of(video, extent(shape)?).floats;
            let [held, _] = kmeans(settings, entry, tokens, clips);
            let training = memory::peak(parameters, floats * at_once, 0.0);
            Some(training.max(memory::afterwards(held)))
        }
    }
}

/// Numbers held, and multiply-accumulates, of the baseline of a video tokenizer.
fn kmeans(
    settings: &TrainTokenizerSettings,
    entry: &TokenizerEntry,
    tokens: &TokenFacts,
    clips: usize,
) -> [f64; 2] {
    match entry {
        TokenizerEntry::Video(video) if settings.kmeans => {
            let [codes, count] = [tokens.vocabulary, tokens.count()].map(|n| n as usize);
            video_kmeans::cost(video, codes, count, clips)
        }
        _ => [0.0; 2],
    }
}

/// Frames, height and width of a video.
fn extent(shape: &Shape) -> Option<[usize; 3]> {
    match shape {
        Shape::Video {
            frames,
            height,
            width,
        } => Some([*frames, *height, *width]),
        _ => None,
    }
}

/// Seconds of one core to make the tokens of a clip, an order of magnitude: products at 90 GFLOP/s for the encoder, which is half
/// of a VQ-VAE; a video tokenizer by its pixels and the square of its width beside Cosmos DV4x8x8 (benches/results.md).
pub(super) fn encode_seconds(
    entry: &TokenizerEntry,
    shape: &Shape,
    tokens: &TokenFacts,
) -> Option<f64> {
    match entry {
        TokenizerEntry::Vq(_) => {
            let parameters = parameters(entry, shape)?;
            Some(parameters as f64 * tokens.count() as f64 / 90e9)
        }
        TokenizerEntry::Video(settings) => {
            let pixels = extent(shape)?.iter().product::<usize>() as f64 / (17.0 * 256.0 * 256.0);
            Some(4.3 * pixels * (settings.channels as f64 / 128.0).powi(2))
        }
    }
}

/// How many trainable numbers the tokenizer has; nothing is allocated.
pub(super) fn parameters(entry: &TokenizerEntry, shape: &Shape) -> Option<u64> {
    let compute = Compute::cpu();
    let planned = Initialise::meta(&compute);
    let count = match entry {
        TokenizerEntry::Vq(settings) => VqVae::new(&planned, settings, shape).ok()?.count(),
        TokenizerEntry::Video(settings) => Network::new(&planned, settings).ok()?.count(),
    };
    Some(count as u64)
}
