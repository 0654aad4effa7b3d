//! One forward pass and one training step of MGET, and what packing saves.

use crate::measure::Meter;
use reviv::engine::{Gradients, Initialise, Parameters};
use reviv::masking::{Mask, Masking, MaskingSettings, Overflow, TokenBudget};
use reviv::mget::{Batch, Content, Loss, Mget, MgetSpec, ModalitySpec, Positions, Size};
use reviv::random::stream;
use reviv::training::{AdamW, AdamWSettings};

/// `registry/size/tiny.yaml`.
pub const TINY: Size = Size {
    width: 384,
    heads: 6,
    encoder_depth: 6,
    decoder_depth: 6,
    hidden: 0,
};

/// `registry/size/base.yaml`.
pub const BASE: Size = Size {
    width: 768,
    heads: 12,
    encoder_depth: 12,
    decoder_depth: 12,
    hidden: 0,
};

/// A model of body, camera, gaze and the two videos with their vocabularies in the paper.
pub fn spec(size: Size) -> MgetSpec {
    MgetSpec {
        size,
        positions: Positions::Released,
        modalities: vec![
            ModalitySpec::tokens("body", &[30, 7], 2048),
            ModalitySpec::tokens("camera", &[30], 256),
            ModalitySpec::tokens("depth", &[5, 32, 32], 64_000),
            ModalitySpec::tokens("gaze", &[30], 512),
            ModalitySpec::tokens("rgb", &[5, 32, 32], 64_000),
        ],
    }
}

/// Random weights.
pub fn model(spec: &MgetSpec) -> Mget {
    Mget::new(spec, &Initialise::new(&crate::compute(), 0)).expect("the spec can be built")
}

/// Ids that depend on sample, modality and position alone, `[modalities][tokens]`; the peer computes the same.
pub fn ids(spec: &MgetSpec, sample: usize) -> Vec<Vec<u32>> {
    spec.modalities
        .iter()
        .enumerate()
        .map(|(index, modality)| {
            let vocabulary = modality.vocabulary().unwrap_or(1) as u64;
            let seed = sample as u64 * 104_729 + index as u64 * 1_299_709;
            (0..modality.count() as u64)
                .map(|p| ((p * 7919 + seed) % vocabulary) as u32)
                .collect()
        })
        .collect()
}

/// A fixed mask: 30 camera tokens and the rest half rgb, half depth are given; 30 gaze and 34 body tokens and the rest half
/// rgb, half depth are asked for.
fn mask(tokens: usize) -> Mask {
    let range =
        |from: usize, count: usize| (from as u32..(from + count) as u32).collect::<Vec<u32>>();
    let given = (tokens - 30) / 2;
    let asked = (tokens - 64) / 2;
    Mask {
        input: vec![
            vec![],
            range(0, 30),
            range(0, given),
            vec![],
            range(0, tokens - 30 - given),
        ],
        target: vec![
            range(0, 34),
            vec![],
            range(2560, asked),
            range(0, 30),
            range(2560, tokens - 64 - asked),
        ],
    }
}

fn batch(spec: &MgetSpec, masks: &[Mask]) -> Batch {
    let ids: Vec<_> = (0..masks.len()).map(|sample| ids(spec, sample)).collect();
    let contents: Vec<Vec<Content<'_>>> = ids
        .iter()
        .map(|ids| ids.iter().map(|ids| Content::Ids(ids)).collect())
        .collect();
    Batch::new(spec, &contents, masks).expect("the batch is made for the spec")
}

/// Forward, backward, clipping, AdamW.
fn measure_step(meter: &Meter, name: &str, mut model: Mget, batch: &Batch) {
    model.start_training();
    let mut optimizer = AdamW::new(AdamWSettings::default(), &model);
    meter.measure_flop(name, flop(&model, batch), || {
        let losses = model.losses(batch, Loss::Mod);
        let gradients = Gradients::of(&losses.total.expect("something is asked for"), &model);
        optimizer
            .step(&mut model, gradients, 1e-4)
            .expect("the gradients are finite");
    });
}

/// Operations of a step over samples that are all alike: backward costs twice the forward, a multiply-accumulate is two.
fn flop(model: &Mget, batch: &Batch) -> Option<f64> {
    let [given, asked] = [&batch.visible.sequence, &batch.targets.sequence];
    let alike = |lengths: &[usize]| lengths.windows(2).all(|pair| pair[0] == pair[1]);
    if !alike(&given.lengths) || !alike(&asked.lengths) {
        return None;
    }
    let samples = given.lengths.len();
    let targets: Vec<usize> = batch
        .targets
        .ids
        .iter()
        .map(|ids| ids.len() / samples)
        .collect();
    let forward = (model.spec()).multiply_accumulates(*given.lengths.first()?, &targets);
    Some(6.0 * forward * samples as f64)
}

/// `samples` samples of `tokens` given and as many asked tokens.
pub fn run(meter: &Meter, size: Size, samples: usize, tokens: usize) {
    let spec = spec(size);
    let model = model(&spec);
    let batch = batch(&spec, &vec![mask(tokens); samples]);
    meter.measure("forward", || {
        assert!(model.losses(&batch, Loss::Mod).values().total.is_finite());
    });
    measure_step(meter, "train step", model, &batch);
}

/// A step with all activations kept, and one that computes them again in backward.
pub fn activation_checkpointing(meter: &Meter) {
    let spec = spec(TINY);
    let batch = batch(&spec, &vec![mask(1024); 8]);
    measure_step(meter, "train step, all kept", model(&spec), &batch);
    let mut model = model(&spec);
    model.start_training();
    let mut optimizer = AdamW::new(AdamWSettings::default(), &model);
    meter.measure("train step, recomputed", || {
        let (_, gradients) = model.recomputed(&batch, Loss::Mod, 1.0, &mut |_, _| ());
        optimizer
            .step(&mut model, gradients.expect("something is asked for"), 1e-4)
            .expect("the gradients are finite");
    });
}

/// A step on samples as the paper's mixture draws them, which are shorter than the budget, and on as many that fill it, as
/// padding would.
pub fn packing(meter: &Meter) {
    let spec = spec(TINY);
    for (name, overflow) in [
        ("packed", Overflow::Drop),
        ("padded", Overflow::Redistribute),
    ] {
        let settings = MaskingSettings {
            input_tokens: TokenBudget::Fixed(512),
            target_tokens: TokenBudget::Fixed(512),
            overflow,
            ..MaskingSettings::default()
        };
        let masking = Masking::new(&settings, &spec.slots()).expect("the paper's settings");
        let masks: Vec<Mask> = (0..8)
            .map(|sample| masking.draw(&[true; 5], &mut stream(0, "bench.mask", 0, sample)))
            .collect();
        let batch = batch(&spec, &masks);
        let rows = batch.visible.sequence.len() + batch.targets.sequence.len();
        let name = format!("train step, {name} ({rows} rows)");
        measure_step(meter, &name, model(&spec), &batch);
    }
}
