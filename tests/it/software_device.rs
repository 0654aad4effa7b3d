//! Everything that computes, on a GPU through WGSL, in hardware or played by a program (Mesa's lavapipe): trainings, tokens, predictions,
//! a reconstruction. Devices agree within rounding, and one of them with itself to the bit.
//!
//! `cargo test --release --features wgpu --test it software_device`; without such a device the tests skip, and say so.

use crate::run_text::artifacts;
use crate::training::Setup;
use reviv::engine::{
    Compute, DeviceChoice, DeviceKind, Initialise, Parameters, Precision, Weights,
};
use reviv::mget::Mget;
use reviv::modality::Shape;
use reviv::tokenizer::trained::Prepared;
use reviv::tokenizer::video::{Network, VideoSettings, VideoTokenizer};
use reviv::tokenizer::vq::{VqSettings, VqVae};
use reviv::training::tokenizer::TokenizerTraining;
use reviv::training::{Objective, Trainer, TrainingError};
use serde_json::Value;
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

/// The device, or a note that there is none.
pub fn device() -> Option<Compute> {
    match Compute::new(DeviceChoice::first(DeviceKind::Wgpu), Precision::F32) {
        Ok(compute) => Some(compute),
        Err(error) => {
            crate::skipped::skipped(&error.to_string());
            None
        }
    }
}

/// One stage of every kind that computes; `TOKENIZERS`, `MGET` and `USE` are devices.
const EXPERIMENT: &str = "
experiment: on_a_device
about: Every stage that computes, at the smallest size.
stages:
  clips:
    op: clips
    source: {use: world_small, world: {size: 16, rooms: 3}}
    train: 24
    validation: 6
    test: 4
  tok_camera:
    op: train_tokenizer
    clips: clips
    modality: camera
    tokenizer: {use: vq_temporal_small, codebook: 16, width: 16, depth: 1, heads: 2, dead_below: 0}
    steps: 12
    warmup: {steps: 0}
    device: TOKENIZERS
  tok_body:
    op: train_tokenizer
    clips: clips
    modality: body
    tokenizer: {use: vq_kinematic_small, codebook: 16, width: 16, depth: 1, heads: 2, dead_below: 0}
    steps: 6
    batch: 4
    micro_batch: 2
    warmup: {steps: 0}
    device: TOKENIZERS
  tok_rgb:
    op: train_tokenizer
    clips: clips
    modality: rgb
    tokenizer: {use: video_tiny, channels: 4}
    steps: 4
    batch: 2
    warmup: {steps: 0}
    device: TOKENIZERS
  tokens:
    op: tokenize
    clips: clips
    tokenizers: [tok_camera, tok_body, tok_rgb]
    pixels: rgb
    device: USE
  mget:
    op: train_mget
    tokens: [tokens]
    size: {use: laptop_small, width: 24, heads: 2, encoder_depth: 1, decoder_depth: 2}
    masking: {use: dirichlet_mixture, input_tokens: 64, target_tokens: 64}
    positions: aligned
    pixels: rgb
    tubelet: [4, 8, 8]
    steps: 12
    batch: 4
    optimizer: {muon: true}
    warmup: {steps: 2}
    validate_every: 6
    device: MGET
  predictions:
    op: predict
    model: mget
    clips: clips
    inputs: [pixels]
    decoding: mean
    split: test
    device: USE
  scores:
    op: evaluate
    predictions: predictions
    clips: clips
    split: test
    suite: {use: world_all, metrics: [body.ga_mpjpe, camera.ate]}
  view: {op: reconstruct, model: mget, clips: clips, inputs: [pixels], decoding: mean, device: USE}
";

/// What an experiment made, by op and modality: the folder, and what its manifest says.
type Made = BTreeMap<String, (PathBuf, Value)>;

fn made(folder: &Path, [tokenizers, mget, used]: [&str; 3]) -> Made {
    let text = EXPERIMENT.replace("TOKENIZERS", tokenizers);
    let text = text.replace("MGET", mget).replace("USE", used);
    let made: Made = artifacts(folder, &text)
        .into_iter()
        .map(|(name, path, contents)| (name.trim().to_owned(), (path, contents)))
        .collect();
    assert_eq!(made.len(), 9, "{:?}", made.keys());
    made
}

/// Arrays of a folder, by file: what no clock and no path stands in.
fn arrays(folder: &Path) -> BTreeMap<String, Vec<u8>> {
    let mut found = BTreeMap::new();
    let mut left = vec![folder.to_path_buf()];
    while let Some(folder_of) = left.pop() {
        for entry in std::fs::read_dir(folder_of).unwrap() {
            let path = entry.unwrap().path();
            let kind = path.extension().and_then(|kind| kind.to_str());
            if path.is_dir() {
                left.push(path);
            } else if matches!(kind, Some("safetensors" | "tar" | "npz" | "npy" | "tum")) {
                let name = path
                    .strip_prefix(folder)
                    .unwrap()
                    .to_string_lossy()
                    .into_owned();
                found.insert(name, std::fs::read(&path).unwrap());
            }
        }
    }
    found
}

/// `||a - b|| / ||b||` over all weights.
fn distance(a: &Weights, b: &Weights) -> f64 {
    let (mut off, mut size) = (0.0, 0.0);
    for (name, expected) in &b.tensors {
        let expected = expected.f32(name).unwrap();
        for (a, b) in a.tensors[name].f32(name).unwrap().iter().zip(expected) {
            off += f64::from(a - b).powi(2);
            size += f64::from(*b).powi(2);
        }
    }
    (off / size).sqrt()
}

#[test]
fn every_stage_agrees_with_the_processor_and_gives_the_same_bytes_twice() {
    if device().is_none() {
        return;
    }
    let folder = || tempfile::tempdir().unwrap();
    let (a, b, c, d) = (folder(), folder(), folder(), folder());
    let here = made(a.path(), ["cpu"; 3]);
    let weights = |path: &Path, file: &str| Weights::read(&path.join(file)).unwrap();

    // Tokenizers of the processor, and everything behind them on the device.
    let used = made(b.path(), ["cpu", "wgpu", "wgpu"]);
    let tokens = |made: &Made| arrays(&made["tokenize"].0.join("train"));
    assert!(tokens(&here) == tokens(&used), "other tokens");
    let mget = |made: &Made| weights(&made["train_mget"].0, "weights.safetensors");
    let off = distance(&mget(&used), &mget(&here));
    assert!(off < 1e-2, "MGET's weights: {off}");
    let [found, expected] = [&used, &here].map(|made| &made["evaluate"].1);
    assert!(alike(found, expected), "{found}\ninstead of {expected}");

    let there = made(c.path(), ["wgpu"; 3]);
    for name in ["camera", "body", "rgb"].map(|name| format!("train_tokenizer {name}")) {
        let tokenizer = |made: &Made| weights(&made[&name].0, "tokenizer.safetensors");
        let off = distance(&tokenizer(&there), &tokenizer(&here));
        assert!(off < 1e-3, "{name}: {off}");
    }

    let again = made(d.path(), ["wgpu"; 3]);
    for (name, (path, _)) in &there {
        assert!(
            arrays(path) == arrays(&again[name].0),
            "{name}: other bytes the second time"
        );
    }
}

/// Whether two JSON values are the same but for 1 % of every number.
fn alike(found: &Value, expected: &Value) -> bool {
    match (found, expected) {
        (Value::Object(a), Value::Object(b)) => {
            a.len() == b.len()
                && a.iter()
                    .all(|(key, a)| b.get(key).is_some_and(|b| alike(a, b)))
        }
        (Value::Array(a), Value::Array(b)) => {
            a.len() == b.len() && a.iter().zip(b).all(|(a, b)| alike(a, b))
        }
        (Value::Number(a), Value::Number(b)) => {
            let [a, b] = [a, b].map(|number| number.as_f64().unwrap());
            (a - b).abs() <= 1e-6 + 1e-2 * b.abs()
        }
        (a, b) => a == b,
    }
}

/// As many steps with their reports read at once as one by one: the same reports, and the same bits.
fn read_late<O: Objective<Batch: Clone>>(start: impl Fn() -> Trainer<O>, batches: &[O::Batch]) {
    let (mut each, mut late) = (start(), start());
    let mut expected = Vec::new();
    for (index, batch) in batches.iter().enumerate() {
        let step = |_| Ok::<_, TrainingError>(batch.clone());
        expected.push(each.step(step).unwrap());
        late.advance(step).unwrap();
        assert_eq!(late.waits(), Some(index as u64 + 1), "nobody has waited");
    }
    let mut found = late.read().unwrap();
    for report in &mut found {
        assert_eq!(report.behind, batches.len() as u64 - report.step);
        report.behind = 0;
    }
    assert_eq!(found, expected);
    assert!(late.model().weights() == each.model().weights());
    assert_eq!(late.waits(), None);
}

#[test]
fn steps_wait_for_nothing_and_reports_that_are_read_late_are_the_same() {
    let Some(compute) = device() else { return };
    let setup = Setup::new(5, 0, 1);
    let batches: Vec<_> = setup.batches(5);
    read_late(|| setup.trainer_on(&compute), &batches);
    read_late(|| vq(&compute), &vec![signals(1.0); 5]);
    read_late(|| video(&compute), &vec![vec![clip(0), clip(3)]; 3]);
}

fn vq(compute: &Compute) -> Trainer<reviv::training::tokenizer::VqReconstruction> {
    let sizes = VqSettings {
        codebook: 32,
        code_width: 4,
        width: 16,
        depth: 1,
        heads: 2,
        ..VqSettings::default()
    };
    let shape = Shape::Temporal {
        samples: 8,
        channels: 2,
    };
    let model = VqVae::new(&Initialise::new(compute, 4), &sizes, &shape).unwrap();
    Trainer::vq(model, &training(), 4).unwrap()
}

fn video(compute: &Compute) -> Trainer<reviv::training::tokenizer::VideoReconstruction> {
    let settings = VideoSettings {
        channels: 4,
        ..VideoSettings::tiny()
    };
    let network = Network::new(&Initialise::new(compute, 4), &settings).unwrap();
    let model = VideoTokenizer::new("rgb", [4, 16, 16], network, compute).unwrap();
    Trainer::video(model, &training()).unwrap()
}

fn training() -> TokenizerTraining {
    TokenizerTraining {
        steps: 9,
        batch: 8,
        warmup: 0,
        ..TokenizerTraining::default()
    }
}

fn signals(scale: f32) -> Vec<Prepared> {
    let signal = |signal: usize| Prepared {
        values: (0..16)
            .map(|i| (signal as f32 * 0.8 + i as f32 * 0.4).sin() * scale)
            .collect(),
        valid: None,
    };
    (0..8).map(signal).collect()
}

fn clip(phase: usize) -> reviv::clip::Signal {
    let values = ndarray::ArrayD::from_shape_fn(ndarray::IxDyn(&[4, 16, 16, 3]), |at| {
        ((at[0] + 2 * at[1] + at[2] + 5 * phase) as f32 * 0.2).sin()
    });
    reviv::clip::Signal {
        values,
        valid: None,
    }
}

#[test]
fn a_step_whose_loss_is_not_finite_changes_no_weight_and_is_named_when_it_is_read() {
    let Some(compute) = device() else { return };
    let mut trainer = vq(&compute);
    let batch = |scale: f32| move |_| Ok::<_, TrainingError>(signals(scale));
    trainer.step(batch(1.0)).unwrap();
    let before = trainer.model().weights();
    trainer.advance(batch(1e30)).unwrap();
    assert!(trainer.model().weights() == before);
    trainer.advance(batch(1.0)).unwrap();
    let message = trainer.read().unwrap_err().to_string();
    assert!(message.contains("loss of step 2 is"), "{message}");
}

#[test]
fn a_model_opens_on_the_device_and_says_so() {
    let Some(compute) = device() else { return };
    let model = Mget::new(&crate::training::spec(), &Initialise::new(&compute, 1)).unwrap();
    let here = Mget::new(
        &crate::training::spec(),
        &Initialise::new(&Compute::cpu(), 1),
    )
    .unwrap();
    assert!(model.weights() == here.weights());
    assert!(compute.name().starts_with("wgpu"), "{}", compute.name());
}
