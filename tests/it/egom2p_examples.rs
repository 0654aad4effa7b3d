//! EgoM2P's example clips through tokenizers of our own.

use std::path::Path;

use nalgebra::{Matrix4, Vector2};
use ndarray::{ArrayD, IxDyn};
use reviv::clip::Signal;
use reviv::engine::{Compute, Initialise};
use reviv::formats::npy;
use reviv::modality::Shape;
use reviv::tokenizer::Tokenizer;
use reviv::tokenizer::normaliser::Normaliser;
use reviv::tokenizer::trained::{VqTokenizer, prepare};
use reviv::tokenizer::vq::{VqSettings, VqVae};
use reviv::training::epochs::Epochs;
use reviv::training::tokenizer::TokenizerTraining;
use reviv::training::{Trainer, TrainingError};

const SAMPLES: usize = 60;

/// Poses relative to the first, two rotation columns and translation.
fn camera(folder: &Path) -> Signal {
    let stored = npy::read(&folder.join("cam.npy"))
        .unwrap()
        .to::<f64>()
        .unwrap();
    let stored: Vec<f64> = stored.iter().copied().collect();
    let pose = |k: usize| Matrix4::from_row_slice(&stored[k * 16..][..16]);
    let first = pose(0).try_inverse().unwrap();
    let rows = (0..SAMPLES).flat_map(|k| {
        let relative = first * pose(k);
        [0, 1, 3]
            .map(|column| [0, 1, 2].map(|row| relative[(row, column)] as f32))
            .concat()
    });
    signal(rows.collect(), 9, None)
}

/// Pixels of 896 x 504 to the centre square of 480, with what is not there marked.
fn gaze(folder: &Path) -> Signal {
    let stored = npy::read(&folder.join("gaze.npy"))
        .unwrap()
        .to::<f64>()
        .unwrap();
    let stored: Vec<f64> = stored.iter().copied().collect();
    let points: Vec<Vector2<f64>> = stored
        .chunks(2)
        .map(|p| Vector2::new((p[0] - 208.0) / 480.0, (p[1] - 12.0) / 480.0))
        .collect();
    let valid: Vec<bool> = points
        .iter()
        .map(|p| p.iter().all(|x| (-0.2..=1.2).contains(x)))
        .collect();
    assert_eq!(valid.iter().filter(|valid| !**valid).count(), 2);
    assert!((points[0].x - 0.587_955_4).abs() < 1e-6 && (points[0].y - 0.495_558_6).abs() < 1e-6);
    let values = points
        .iter()
        .flat_map(|p| [p.x as f32, p.y as f32])
        .collect();
    signal(values, 2, Some(valid))
}

fn signal(values: Vec<f32>, channels: usize, valid: Option<Vec<bool>>) -> Signal {
    Signal {
        values: ArrayD::from_shape_vec(IxDyn(&[SAMPLES, channels]), values).unwrap(),
        valid: valid.map(|valid| ArrayD::from_shape_vec(IxDyn(&[SAMPLES]), valid).unwrap()),
    }
}

/// Variations of a clip to train on: faster, slower and larger or smaller motions, none of them the clip itself.
fn variations(clip: &Signal) -> Vec<Signal> {
    let channels = clip.values.shape()[1];
    (0..32)
        .map(|k| {
            let size = 0.55 + 0.03 * k as f32;
            let speed = 0.5 + 0.015 * k as f32;
            let at = |t: usize| ((t as f32 * speed) as usize).min(SAMPLES - 1);
            let mut varied = clip.clone();
            for t in 0..SAMPLES {
                for c in 0..channels {
                    let first = clip.values[[0, c]];
                    varied.values[[t, c]] = first + size * (clip.values[[at(t), c]] - first);
                }
                if let (Some(valid), Some(own)) = (&clip.valid, &mut varied.valid) {
                    own[[t]] = valid[[at(t)]];
                }
            }
            varied
        })
        .collect()
}

/// Trains briefly and gives the mean absolute errors of the tokenizer and of predicting the mean.
fn errors(modality: &str, clip: &Signal, normaliser: Option<Normaliser>) -> (f64, f64) {
    let compute = Compute::cpu();
    let channels = clip.values.shape()[1];
    let shape = Shape::Temporal {
        samples: SAMPLES,
        channels,
    };
    let sizes = VqSettings {
        codebook: 64,
        code_width: 8,
        width: 32,
        depth: 1,
        heads: 4,
        mlp_ratio: 2,
        ..VqSettings::default()
    };
    let model = VqVae::new(&Initialise::new(&compute, 0), &sizes, &shape).unwrap();
    let training = variations(clip);
    let normaliser =
        normaliser.unwrap_or_else(|| Normaliser::fit(training.iter(), channels, false).unwrap());
    let data = prepare(modality, &model, &normaliser, &training).unwrap();
    let settings = TokenizerTraining {
        steps: 150,
        batch: 8,
        learning_rate: 2e-3,
        warmup: 10,
        ..TokenizerTraining::default()
    };
    let mut trainer = Trainer::vq(model, &settings, 0).unwrap();
    let mut epochs = Epochs::of(&trainer, 0);
    for step in 0..trainer.total_steps() {
        let next = |micro| -> Result<_, TrainingError> {
            let chosen = epochs.choose(step, micro, data.len())?;
            Ok(chosen.into_iter().map(|i| data[i].clone()).collect())
        };
        trainer.step(next).unwrap();
    }
    let tokenizer = VqTokenizer::new(modality, shape, normaliser, trainer.model()).unwrap();
    let tokens = tokenizer.encode(std::slice::from_ref(clip)).unwrap();
    assert_eq!(
        (tokens[0].grid.as_slice(), tokens[0].ids.len()),
        ([30].as_slice(), 30)
    );
    let found = tokenizer.decode(&tokens).unwrap().remove(0);
    assert_eq!(found.values.shape(), clip.values.shape());
    assert!(found.values.iter().all(|value| value.is_finite()));

    let is_valid = |t: usize| clip.valid.as_ref().is_none_or(|valid| valid[[t]]);
    let valid: Vec<usize> = (0..SAMPLES).filter(|t| is_valid(*t)).collect();
    let count = (valid.len() * channels) as f64;
    let mean =
        |c: usize| valid.iter().map(|t| clip.values[[*t, c]]).sum::<f32>() / valid.len() as f32;
    let error = |predict: &dyn Fn(usize, usize) -> f32| -> f64 {
        let each = valid
            .iter()
            .flat_map(|t| (0..channels).map(move |c| (*t, c)));
        each.map(|(t, c)| f64::from((predict(t, c) - clip.values[[t, c]]).abs()))
            .sum::<f64>()
            / count
    };
    let (own, baseline) = (error(&|t, c| found.values[[t, c]]), error(&|_, c| mean(c)));
    println!("{modality}: mean absolute error {own:.4}, {baseline:.4} for the clip's mean");
    (own, baseline)
}

#[test]
fn the_camera_example_passes_through_a_tokenizer_of_our_own() {
    let Some(shared) = crate::shared::folder() else {
        return;
    };
    let clip = camera(&shared.join("data/egom2p_examples"));
    // Golden values of the last pose (technical reference, 10.3).
    for (c, value) in [
        0.925_946_1,
        -0.081_552_4,
        -0.368_745_2,
        0.014_523_9,
        0.983_373_2,
    ]
    .into_iter()
    .enumerate()
    {
        assert!((clip.values[[59, c]] - value).abs() < 1e-5);
    }
    let (own, baseline) = errors("camera", &clip, None);
    assert!(own < 0.6 * baseline, "{own} {baseline}");
}

#[test]
fn the_gaze_example_passes_through_a_tokenizer_of_our_own() {
    let Some(shared) = crate::shared::folder() else {
        return;
    };
    let clip = gaze(&shared.join("data/egom2p_examples"));
    let (own, baseline) = errors(
        "gaze",
        &clip,
        Some(Normaliser::constant(2, 0.5, 0.5).unwrap()),
    );
    assert!(own < 0.6 * baseline, "{own} {baseline}");
}
