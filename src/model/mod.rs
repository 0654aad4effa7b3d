//! A [`Model`]: MGET with its tokenizers, as one function from clips to the signals they lack (Sec. 4.1).
//!
//! It comes out of a model folder ([`Model::open`]), out of training (`Model::train`) or out of imported weights. A model folder
//! holds MGET (`mget.json`, `weights.safetensors`), the tokenizers it was trained on (`tokenizers/<modality>/`), and [`FILE`],
//! which says what clips it takes and names the tokenizers by their bytes, so that a model and tokenizers that do not belong
//! together are found before anything is decoded into nonsense.

mod error;
mod evaluate;
mod manifest;
mod tokenizers;

pub use error::ModelError;
pub use evaluate::{EvaluateError, EvaluateOptions, evaluate, table};
pub use manifest::{FILE, ModelManifest, TOKENIZERS};
pub use tokenizers::Tokenizers;

use self::error::{not_a_model, wrong_clip};
use self::manifest::digest;
use crate::clip::{Clip, Signal};
use crate::decoding::{
    DecodingSettings, Generated, GeneratedTokens, MgetTokens, Sample, Slot, generate_samples,
};
use crate::engine::{Compute, Parameters};
use crate::masking::PIXELS;
use crate::mget::{Content, Mget, ModalitySpec};
use crate::modality::{ClipFormat, Modality};
use crate::tokenizer::{self, TokenGrid, Tokenizer};
use rand::RngExt;
use std::collections::BTreeMap;
use std::path::Path;

/// A model with its tokenizers.
#[derive(Clone)]
pub struct Model {
    mget: Mget,
    tokenizers: Tokenizers,
}

impl std::fmt::Debug for Model {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("Model")
            .field("spec", self.mget.spec())
            .field("tokenizers", &self.tokenizers)
            .finish()
    }
}

/// What to generate, and how.
#[derive(Debug, Clone)]
pub struct GenerationRequest<'a> {
    /// Modalities that every clip has and the model sees; `rgb` gives raw video too where the model takes it, `pixels` raw video
    /// alone.
    pub inputs: &'a [String],
    /// Modalities to generate.
    pub targets: &'a [String],
    /// How tokens are generated.
    pub decoding: &'a DecodingSettings,
    /// Of the random numbers.
    pub seed: u64,
}

/// What the model sees of a batch of clips.
#[derive(Default)]
pub struct Conditioning<'a> {
    tokens: BTreeMap<&'a str, Vec<TokenGrid>>,
    pixels: Vec<Vec<f32>>,
}

/// A generated clip.
#[derive(Debug, Clone)]
pub struct Reconstructed {
    /// Holds the wanted modalities and nothing else.
    pub clip: Clip,
    /// Per modality and sample, 0 (a guess) to 1 (certain), from the entropies of the tokens. Not an accuracy.
    pub confidence: BTreeMap<String, Vec<f32>>,
}

impl Model {
    /// Opens a model folder and checks that its parts belong together.
    ///
    /// # Errors
    /// When a part is missing, damaged, or another one than the model was trained on.
    pub fn open(folder: impl AsRef<Path>, compute: &Compute) -> Result<Self, ModelError> {
        let folder = folder.as_ref();
        let manifest = ModelManifest::read(folder)?;
        let mget = Mget::open(folder, compute).map_err(|error| not_a_model(folder, error))?;
        let mut tokenizers = Tokenizers::new(manifest.clips);
        for slot in &mget.spec().modalities {
            let name = &slot.name;
            // Raw video has no tokens; video of the release's other size is none of these clips'.
            if slot.vocabulary().is_none() || !tokenizers.knows(name) {
                continue;
            }
            let path = folder.join(TOKENIZERS).join(name);
            let expected = manifest.tokenizers.get(name).ok_or_else(|| {
                not_a_model(
                    folder,
                    format_args!("`{FILE}` names no tokenizer of `{name}`"),
                )
            })?;
            if !path.is_dir() {
                return Err(not_a_model(
                    folder,
                    format_args!("the tokenizer of `{name}` is missing"),
                ));
            }
            let found = digest(&path)?;
            if *expected != found {
                return Err(ModelError::OtherTokenizer {
                    path,
                    modality: name.clone(),
                    expected: expected.clone(),
                    found,
                });
            }
            tokenizers.insert_as(name, tokenizer::open(&path, compute)?.into());
        }
        Self::new(mget, tokenizers)
    }

    /// A transformer and the tokenizers it was trained on.
    ///
    /// # Errors
    /// When a tokenizer has other tokens than the transformer predicts.
    pub fn new(mget: Mget, tokenizers: Tokenizers) -> Result<Self, ModelError> {
        for slot in &mget.spec().modalities {
            let Some(tokenizer) = tokenizers.get(&slot.name) else {
                continue;
            };
            let count: usize = tokenizer.grid().iter().product();
            if count != slot.count() {
                return Err(ModelError::OtherGrid {
                    modality: slot.name.clone(),
                    found: count.to_string(),
                    vocabulary: tokenizer.vocabulary(),
                    expected: slot.count().to_string(),
                });
            }
        }
        Ok(Self {
            mget: mget.frozen(),
            tokenizers,
        })
    }

    /// Writes a model folder, which [`Model::open`] reads; equal models give equal bytes.
    ///
    /// # Errors
    /// When a file cannot be written.
    pub fn write(&self, folder: impl AsRef<Path>) -> Result<(), ModelError> {
        let folder = folder.as_ref();
        let io = |error| ModelError::Io {
            path: folder.to_owned(),
            error,
        };
        std::fs::create_dir_all(folder).map_err(io)?;
        self.mget.save(folder)?;
        self.tokenizers.write(&folder.join(TOKENIZERS))?;
        ModelManifest::of(folder, self.format().clone())?.write(folder)
    }

    /// The sizes of the clips the model takes.
    #[must_use]
    pub fn format(&self) -> &ClipFormat {
        self.tokenizers.format()
    }

    /// The transformer.
    #[must_use]
    pub fn mget(&self) -> &Mget {
        &self.mget
    }

    /// The tokenizers.
    #[must_use]
    pub fn tokenizers(&self) -> &Tokenizers {
        &self.tokenizers
    }

    /// Whether raw video is an input beside the tokens.
    #[must_use]
    pub fn takes_pixels(&self) -> bool {
        self.mget.spec().index(PIXELS).is_some()
    }

    /// The modalities it knows, raw video aside.
    pub fn names(&self) -> impl Iterator<Item = &str> {
        self.tokenizers.names()
    }

    /// One of its modalities.
    ///
    /// # Errors
    /// When it has none of this name.
    pub fn modality(&self, name: &str) -> Result<&dyn Modality, ModelError> {
        let found = self.tokenizers.modality(name);
        found.ok_or_else(|| self.unknown(name))
    }

    fn tokenizer(&self, name: &str) -> Result<&dyn Tokenizer, ModelError> {
        let found = self.tokenizers.get(name);
        found.ok_or_else(|| self.unknown(name))
    }

    fn unknown(&self, name: &str) -> ModelError {
        ModelError::UnknownModality {
            name: name.to_owned(),
            known: self.names().collect::<Vec<_>>().join(", "),
        }
    }

    /// Generates the targets of a batch of clips. `ids` name their random numbers: a clip's result does not depend on the
    /// others of its batch.
    ///
    /// # Errors
    /// When a modality is unknown, a clip lacks a given one, or a signal has another form than the model was trained on.
    pub fn predict(
        &self,
        clips: &[Clip],
        ids: &[u64],
        request: &GenerationRequest<'_>,
    ) -> Result<Vec<Reconstructed>, ModelError> {
        let conditioning = self.encode_inputs(clips, request.inputs)?;
        let generated = self.generate(&conditioning, ids, request)?;
        self.decode(clips, &generated, request)
    }

    /// Generates the tokens of the targets, once per sample that is averaged; the middle of [`Model::predict`].
    ///
    /// # Errors
    /// When a modality is unknown.
    pub fn generate(
        &self,
        conditioning: &Conditioning<'_>,
        ids: &[u64],
        request: &GenerationRequest<'_>,
    ) -> Result<Vec<Vec<Generated>>, ModelError> {
        let samples: Vec<Sample<'_>> = ids
            .iter()
            .enumerate()
            .map(|(clip, &id)| Sample {
                id,
                slots: self.slots(conditioning, clip),
            })
            .collect();
        let targets: Vec<&str> = request.targets.iter().map(String::as_str).collect();
        let model = MgetTokens::new(&self.mget);
        let seeds: Vec<u64> = (0..request.decoding.samples.max(1))
            .map(|round| seed_of_round(request.seed, round))
            .collect();
        Ok(generate_samples(
            &model,
            request.decoding,
            &samples,
            &targets,
            &seeds,
        )?)
    }

    /// Turns generated tokens of `clips` into signals; the end of [`Model::predict`].
    ///
    /// # Errors
    /// When tokens and tokenizer do not fit.
    pub fn decode(
        &self,
        clips: &[Clip],
        rounds: &[Vec<Generated>],
        request: &GenerationRequest<'_>,
    ) -> Result<Vec<Reconstructed>, ModelError> {
        let mut made: Vec<Reconstructed> = clips
            .iter()
            .map(|clip| Reconstructed {
                clip: Clip::empty(clip.id.clone(), clip.source.clone()),
                confidence: BTreeMap::new(),
            })
            .collect();
        for name in request.targets {
            let modality = self.modality(name)?;
            let tokenizer = self.tokenizer(name)?;
            let mut mean = Mean::default();
            for generated in rounds.iter().take(request.decoding.samples_of(name)) {
                let own: Vec<&GeneratedTokens> = generated
                    .iter()
                    .filter_map(|g| g.targets.get(name))
                    .collect();
                let grids: Vec<TokenGrid> = own
                    .iter()
                    .map(|tokens| TokenGrid {
                        ids: tokens.ids.clone(),
                        grid: tokenizer.grid().to_vec(),
                    })
                    .collect();
                let confidence = own.iter().map(|tokens| tokens.confidence.clone()).collect();
                mean.add(tokenizer.decode(&grids)?, confidence);
            }
            let (signals, confidence) = mean.finish();
            for ((one, signal), tokens) in made.iter_mut().zip(signals).zip(confidence) {
                let steps = tokenizer.grid()[0];
                let each = per_sample(&tokens, steps, signal.values.shape()[0]);
                one.confidence.insert(name.clone(), each);
                modality
                    .insert(signal, &mut one.clip)
                    .map_err(|error| wrong_clip(&one.clip, error))?;
            }
        }
        Ok(made)
    }

    /// The clips' own signals of `names` after a round trip through the tokenizers, where they have them: no model of these tokens
    /// can do better.
    ///
    /// # Errors
    /// When a modality is unknown, or a signal has another form than the model was trained on.
    pub fn round_trip(&self, clips: &[Clip], names: &[String]) -> Result<Vec<Clip>, ModelError> {
        let empty = |clip: &Clip| Clip::empty(clip.id.clone(), clip.source.clone());
        let mut made: Vec<Clip> = clips.iter().map(empty).collect();
        for name in names {
            let (modality, tokenizer) = (self.modality(name)?, self.tokenizer(name)?);
            let (mut places, mut signals) = (Vec::new(), Vec::new());
            for (place, clip) in clips.iter().enumerate() {
                let signal = modality.extract(clip);
                if let Some(signal) = signal.map_err(|error| wrong_clip(clip, error))? {
                    places.push(place);
                    signals.push(signal);
                }
            }
            let decoded = tokenizer.decode(&tokenizer.encode(&signals)?)?;
            for (place, signal) in places.into_iter().zip(decoded) {
                modality
                    .insert(signal, &mut made[place])
                    .map_err(|error| wrong_clip(&clips[place], error))?;
            }
        }
        Ok(made)
    }

    /// Encodes what is given; the beginning of [`Model::predict`].
    ///
    /// # Errors
    /// When a modality is unknown, or a clip lacks a given one.
    pub fn encode_inputs<'a>(
        &self,
        clips: &[Clip],
        inputs: &'a [String],
    ) -> Result<Conditioning<'a>, ModelError> {
        let mut conditioning = Conditioning::default();
        for name in inputs {
            let takes_pixels = self.takes_pixels();
            if takes_pixels && (name == PIXELS || name == "rgb") {
                let rgb = self.tokenizers.known("rgb");
                let rgb = rgb.ok_or_else(|| self.unknown(name))?;
                let floats = |signal: &Signal| signal.values.iter().copied().collect();
                conditioning.pixels = signals(rgb, clips)?.iter().map(floats).collect();
            }
            if takes_pixels && name == PIXELS {
                continue;
            }
            let signals = signals(self.modality(name)?, clips)?;
            conditioning
                .tokens
                .insert(name, self.tokenizer(name)?.encode(&signals)?);
        }
        Ok(conditioning)
    }

    /// One slot per modality of the model, for one clip.
    fn slots<'a>(&self, conditioning: &'a Conditioning<'_>, clip: usize) -> Vec<Slot<'a>> {
        let of = |slot: &ModalitySpec| match conditioning.tokens.get(slot.name.as_str()) {
            Some(grids) => Slot::input(grids[clip].ids.clone()),
            None if slot.vocabulary().is_none() => {
                Slot::Pixels(match conditioning.pixels.get(clip) {
                    Some(values) if slot.name == PIXELS => Content::Floats(values),
                    _ => Content::Absent,
                })
            }
            None => Slot::masked(slot.count()),
        };
        self.mget.spec().modalities.iter().map(of).collect()
    }
}

fn signals(modality: &dyn Modality, clips: &[Clip]) -> Result<Vec<Signal>, ModelError> {
    let of = |clip: &Clip| {
        let signal = modality
            .extract(clip)
            .map_err(|error| wrong_clip(clip, error))?;
        signal.ok_or_else(|| ModelError::MissingInput {
            clip: clip.id.clone(),
            modality: modality.name().to_owned(),
        })
    };
    clips.iter().map(of).collect()
}

/// The first round has the seed itself.
fn seed_of_round(seed: u64, round: usize) -> u64 {
    match round {
        0 => seed,
        _ => crate::random::stream(seed, "decoding.round", round as u64, 0).random(),
    }
}

/// The mean over rounds of every clip's signal and confidence.
#[derive(Default)]
struct Mean {
    rounds: usize,
    signals: Vec<Signal>,
    confidence: Vec<Vec<f32>>,
}

impl Mean {
    fn add(&mut self, signals: Vec<Signal>, confidence: Vec<Vec<f32>>) {
        self.rounds += 1;
        if self.rounds == 1 {
            (self.signals, self.confidence) = (signals, confidence);
            return;
        }
        for (sum, signal) in self.signals.iter_mut().zip(signals) {
            sum.values += &signal.values;
        }
        for (sum, values) in self.confidence.iter_mut().zip(confidence) {
            for (sum, value) in sum.iter_mut().zip(values) {
                *sum += value;
            }
        }
    }

    fn finish(mut self) -> (Vec<Signal>, Vec<Vec<f32>>) {
        let rounds = self.rounds.max(1) as f32;
        for signal in &mut self.signals {
            signal.values /= rounds;
        }
        for value in self.confidence.iter_mut().flatten() {
            *value /= rounds;
        }
        (self.signals, self.confidence)
    }
}

/// The mean confidence of the tokens of each of `steps` time steps, spread over `samples`.
fn per_sample(tokens: &[f32], steps: usize, samples: usize) -> Vec<f32> {
    let each = (tokens.len() / steps.max(1)).max(1);
    let means: Vec<f32> = tokens
        .chunks(each)
        .map(|chunk| chunk.iter().sum::<f32>() / chunk.len() as f32)
        .collect();
    let of = |sample: usize| means.get(sample * steps / samples.max(1)).copied();
    (0..samples)
        .map(|sample| of(sample).unwrap_or(f32::NAN))
        .collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn confidence_of_tokens_is_spread_over_samples() {
        let tokens = [1.0, 0.0, 0.5, 0.5];
        assert_eq!(per_sample(&tokens, 2, 6), [0.5, 0.5, 0.5, 0.5, 0.5, 0.5]);
        assert_eq!(per_sample(&[0.25, 0.75], 2, 4), [0.25, 0.25, 0.75, 0.75]);
    }

    #[test]
    fn rounds_are_averaged_and_the_first_has_the_seed_itself() {
        assert_eq!(seed_of_round(7, 0), 7);
        assert_ne!(seed_of_round(7, 1), seed_of_round(7, 2));
        let signal = |value: f32| Signal {
            values: ndarray::ArrayD::from_elem(vec![2, 1], value),
            valid: None,
        };
        let mut mean = Mean::default();
        mean.add(vec![signal(1.0)], vec![vec![0.5]]);
        mean.add(vec![signal(2.0)], vec![vec![1.0]]);
        let (signals, confidence) = mean.finish();
        assert_eq!(signals[0].values, signal(1.5).values);
        assert_eq!(confidence, [[0.75]]);
    }

    #[test]
    fn a_folder_that_is_no_model_says_so() {
        let folder = tempfile::tempdir().unwrap();
        let error = ModelManifest::read(folder.path()).unwrap_err().to_string();
        assert!(error.contains("no model folder"), "{error}");
    }

    #[test]
    fn another_tokenizer_has_another_digest() {
        let folder = tempfile::tempdir().unwrap();
        std::fs::write(folder.path().join("tokenizer.safetensors"), b"one").unwrap();
        let one = digest(folder.path()).unwrap();
        assert_eq!(one, digest(folder.path()).unwrap());
        std::fs::write(folder.path().join("tokenizer.safetensors"), b"two").unwrap();
        assert_ne!(one, digest(folder.path()).unwrap());
    }
}
