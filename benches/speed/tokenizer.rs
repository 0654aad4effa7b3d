//! The VQ-VAE of bodies at the paper's size (ViT-B): encode, forward pass, train step.

use crate::measure::Meter;
use reviv::engine::{Compute, Initialise};
use reviv::modality::Shape;
use reviv::tokenizer::trained::{Prepared, batch};
use reviv::tokenizer::vq::{Loss, VqSettings, VqVae};
use reviv::training::tokenizer::TokenizerTraining;
use reviv::training::{Trainer, TrainingError};

/// Clips per step.
const BATCH: usize = 8;
const SAMPLES: usize = 60;
const JOINTS: usize = 21;

fn model(compute: &Compute) -> VqVae {
    let settings = VqSettings {
        codebook: 2048,
        compression: vec![2, 3],
        loss: Loss::Mse,
        ..VqSettings::default()
    };
    let shape = Shape::Kinematic {
        samples: SAMPLES,
        joints: JOINTS,
    };
    VqVae::new(&Initialise::new(compute, 0), &settings, &shape).expect("the paper's size fits")
}

fn data() -> Vec<Prepared> {
    let values = SAMPLES * JOINTS * 3;
    let value = |clip: usize, i: usize| ((clip * values + i) as f32 * 0.017).sin();
    (0..BATCH)
        .map(|clip| Prepared {
            values: (0..values).map(|i| value(clip, i)).collect(),
            valid: None,
        })
        .collect()
}

pub fn run(meter: &Meter) {
    let compute = crate::compute();
    let (model, data) = (model(&compute), data());
    let clips = batch(&model, &data);
    meter.measure("encode", || {
        std::hint::black_box(model.encode(&clips));
    });
    meter.measure("forward", || {
        let ids = model.encode(&clips);
        std::hint::black_box(model.decode(&ids, BATCH).into_data());
    });
    let settings = TokenizerTraining {
        steps: 1000,
        batch: BATCH,
        ..TokenizerTraining::default()
    };
    let mut trainer = Trainer::vq(model, &settings, 0).expect("warm-up is shorter than 1000 steps");
    meter.measure("train step", || {
        let next = |_| Ok::<_, TrainingError>(data.clone());
        trainer.step(next).expect("the data are finite");
    });
}
