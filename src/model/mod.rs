//! A [`Model`]: MGET with its tokenizers, as one function from clips to the signals they lack (Sec. 4.1).
//!
//! It comes out of a model folder ([`Model::open`]), out of training (`Model::train`) or out of imported weights. A model folder
//! holds MGET (`mget.json`, `weights.safetensors`), the tokenizers it was trained on (`tokenizers/<modality>/`), and [`FILE`],
//! which says what clips it takes and names the tokenizers by their bytes, so that a model and tokenizers that do not belong
//! together are found before anything is decoded into nonsense.

mod error;
mod evaluate;
mod manifest;
mod mean;
mod pathway;
pub mod shipped;
mod tokenizers;

pub use error::ModelError;
pub use evaluate::{EvaluateError, EvaluateOptions, evaluate, table};
pub use manifest::{FILE, ModelManifest, TOKENIZERS};
pub use tokenizers::Tokenizers;

use self::error::{not_a_model, wrong_clip};
use self::manifest::digest;
use self::mean::{Mean, per_sample, seed_of_round};
use self::pathway::Pathway;
use crate::clip::{Clip, DEPTH, RGB, Signal};
use crate::decoding::{
    DecodingSettings, Generated, GeneratedTokens, MgetTokens, Sample, Slot, generate_samples,
};
use crate::engine::{Compute, Parameters};
use crate::masking::PIXELS;
use crate::mget::{Content, Mget, ModalitySpec};
use crate::modality::{ClipFormat, Modality};
use crate::tokenizer::{self, TokenGrid, Tokenizer};
use std::collections::BTreeMap;
use std::path::Path;

/// A model with its tokenizers.
#[derive(Clone)]
pub struct Model {
    mget: Mget,
    tokenizers: Tokenizers,
    trained_on: Vec<String>,
    pathway: Pathway,
}

impl std::fmt::Debug for Model {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("Model")
            .field("spec", self.mget.spec())
            .field("tokenizers", &self.tokenizers)
            .finish_non_exhaustive()
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
    pub certainty: BTreeMap<String, Vec<f32>>,
}

impl Model {
    /// Opens a model folder and checks that its parts belong together. The precision of `compute` is that of the transformer; its
    /// tokenizers are f32.
    ///
    /// # Errors
    /// When a part is missing, damaged, or another one than the model was trained on.
    pub fn open(folder: impl AsRef<Path>, compute: &Compute) -> Result<Self, ModelError> {
        let folder = folder.as_ref();
        let manifest = ModelManifest::read(folder)?;
        let mget = Mget::open(folder, compute).map_err(|error| not_a_model(folder, error))?;
        let pathway = Pathway::of(mget.spec(), &manifest.clips);
        let mut tokenizers = Tokenizers::new(manifest.clips);
        for slot in &mget.spec().modalities {
            let Some(name) = pathway.modality(&slot.name) else {
                continue;
            };
            // Raw video has no tokens; video of the release's other size is none of these clips'.
            if slot.vocabulary().is_none() || !tokenizers.knows(name) {
                continue;
            }
            let path = folder.join(TOKENIZERS).join(&slot.name);
            let expected = manifest.tokenizers.get(&slot.name).ok_or_else(|| {
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
                    modality: name.to_owned(),
                    expected: expected.clone(),
                    found,
                });
            }
            tokenizers.insert_as(name, tokenizer::open(&path, &compute.in_f32())?.into());
        }
        Ok(Self::new(mget, tokenizers)?.with_trained_on(manifest.trained_on))
    }

    /// A transformer and the tokenizers it was trained on.
    ///
    /// # Errors
    /// When a tokenizer has other tokens than the transformer predicts: another number of them, or of other kinds.
    pub fn new(mget: Mget, tokenizers: Tokenizers) -> Result<Self, ModelError> {
        let pathway = Pathway::of(mget.spec(), tokenizers.format());
        for slot in &mget.spec().modalities {
            let own = pathway.modality(&slot.name);
            let Some(tokenizer) = own.and_then(|name| tokenizers.get(name)) else {
                continue;
            };
            // Raw video has no tokens, and none of its kinds.
            let Some(expected_vocabulary) = slot.vocabulary() else {
                continue;
            };
            let found: usize = tokenizer.grid().iter().product();
            let vocabulary = tokenizer.vocabulary();
            if (found, vocabulary) != (slot.count(), expected_vocabulary) {
                return Err(ModelError::OtherGrid {
                    modality: slot.name.clone(),
                    found,
                    vocabulary,
                    expected: slot.count(),
                    expected_vocabulary,
                });
            }
        }
        Ok(Self {
            mget: mget.frozen(),
            tokenizers,
            trained_on: Vec::new(),
            pathway,
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
        let place = |name: &str| folder.join(TOKENIZERS).join(&*self.pathway.slot(name));
        self.tokenizers.write_each(place)?;
        let manifest = ModelManifest::of(folder, self.format().clone())?;
        manifest.trained_on(self.trained_on.clone()).write(folder)
    }

    /// The same model, which says what it was trained on.
    #[must_use]
    pub fn with_trained_on(self, trained_on: Vec<String>) -> Self {
        Self { trained_on, ..self }
    }

    /// The data sets it was trained on, `world` for the synthetic one; empty where nobody said.
    #[must_use]
    pub fn trained_on(&self) -> &[String] {
        &self.trained_on
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
        self.mget.spec().index(&self.pathway.slot(PIXELS)).is_some()
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

    /// As [`Model::predict`], and beside it `count` samples of every clip, each from a seed of its own. What is given is encoded once,
    /// and passes the encoder once where the decoding takes a single step. Samples have no video and no depth.
    ///
    /// # Errors
    /// As [`Model::predict`].
    pub fn predict_samples(
        &self,
        clips: &[Clip],
        ids: &[u64],
        request: &GenerationRequest<'_>,
        count: usize,
    ) -> Result<(Vec<Reconstructed>, Vec<Vec<Reconstructed>>), ModelError> {
        let conditioning = self.encode_inputs(clips, request.inputs)?;
        let rounds = self.generate_rounds(&conditioning, ids, request, count)?;
        let made = self.decode(clips, &rounds, request)?;
        Ok((made, self.decode_samples(clips, &rounds, request, count)?))
    }

    /// Every one of the first `count` rounds by itself, without video and depth, whose decoding takes longest.
    ///
    /// # Errors
    /// As [`Model::decode`].
    pub fn decode_samples(
        &self,
        clips: &[Clip],
        rounds: &[Vec<Generated>],
        request: &GenerationRequest<'_>,
        count: usize,
    ) -> Result<Vec<Vec<Reconstructed>>, ModelError> {
        let pictures = [RGB.name(), DEPTH.name()];
        let targets: Vec<String> = request
            .targets
            .iter()
            .filter(|target| !pictures.contains(&target.as_str()))
            .cloned()
            .collect();
        let request = GenerationRequest {
            targets: &targets,
            ..request.clone()
        };
        let rounds = rounds.iter().take(count);
        rounds
            .map(|round| self.decode(clips, std::slice::from_ref(round), &request))
            .collect()
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
        self.generate_rounds(conditioning, ids, request, 1)
    }

    /// As [`Model::generate`], at least `least` times; every time has a seed of its own.
    ///
    /// # Errors
    /// When a modality is unknown.
    pub fn generate_rounds(
        &self,
        conditioning: &Conditioning<'_>,
        ids: &[u64],
        request: &GenerationRequest<'_>,
        least: usize,
    ) -> Result<Vec<Vec<Generated>>, ModelError> {
        let samples: Vec<Sample<'_>> = ids
            .iter()
            .enumerate()
            .map(|(clip, &id)| Sample {
                id,
                slots: self.slots(conditioning, clip),
            })
            .collect();
        let slots: Vec<_> = (request.targets.iter())
            .map(|name| self.pathway.slot(name))
            .collect();
        let targets: Vec<&str> = slots.iter().map(AsRef::as_ref).collect();
        let model = MgetTokens::new(&self.mget);
        let seeds: Vec<u64> = (0..request.decoding.samples.max(least).max(1))
            .map(|round| seed_of_round(request.seed, round))
            .collect();
        Ok(generate_samples(
            &model,
            &self.pathway.decoding(request.decoding),
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
                certainty: BTreeMap::new(),
            })
            .collect();
        for name in request.targets {
            let modality = self.modality(name)?;
            let tokenizer = self.tokenizer(name)?;
            let mut mean = Mean::default();
            for generated in rounds.iter().take(request.decoding.samples_of(name)) {
                let own: Vec<&GeneratedTokens> = generated
                    .iter()
                    .filter_map(|g| g.targets.get(&*self.pathway.slot(name)))
                    .collect();
                let grids: Vec<TokenGrid> = own
                    .iter()
                    .map(|tokens| TokenGrid {
                        ids: tokens.ids.clone(),
                        grid: tokenizer.grid().to_vec(),
                    })
                    .collect();
                let certainty = own.iter().map(|tokens| tokens.certainty.clone()).collect();
                mean.add(tokenizer.decode(&grids)?, certainty);
            }
            let (signals, certainty) = mean.finish();
            for ((one, signal), tokens) in made.iter_mut().zip(signals).zip(certainty) {
                let steps = tokenizer.grid()[0];
                let each = per_sample(&tokens, steps, signal.values.shape()[0]);
                one.certainty.insert(name.clone(), each);
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
        let of = |slot: &ModalitySpec| {
            let name = self.pathway.modality(&slot.name);
            match name.and_then(|name| conditioning.tokens.get(name)) {
                Some(grids) => Slot::input(grids[clip].ids.clone()),
                None if slot.vocabulary().is_none() => {
                    Slot::Pixels(match conditioning.pixels.get(clip) {
                        Some(values) if name == Some(PIXELS) => Content::Floats(values),
                        _ => Content::Absent,
                    })
                }
                None => Slot::masked(slot.count()),
            }
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

#[cfg(test)]
mod tests {
    use super::*;
    use crate::engine::Initialise;
    use crate::mget::{MgetSpec, Positions, Size};
    use crate::tokenizer::TokenizerError;
    use std::sync::Arc;

    /// Says how its tokens are, and makes none.
    struct Described(Vec<usize>, usize);

    impl Tokenizer for Described {
        fn modality(&self) -> &'static str {
            "gaze"
        }
        fn grid(&self) -> &[usize] {
            &self.0
        }
        fn vocabulary(&self) -> usize {
            self.1
        }
        fn encode(&self, _: &[Signal]) -> Result<Vec<TokenGrid>, TokenizerError> {
            Ok(Vec::new())
        }
        fn decode(&self, _: &[TokenGrid]) -> Result<Vec<Signal>, TokenizerError> {
            Ok(Vec::new())
        }
        fn write(&self, _: &Path) -> Result<(), TokenizerError> {
            Ok(())
        }
    }

    #[test]
    fn a_tokenizer_of_another_codebook_is_refused_as_one_of_another_length_is() {
        let spec = MgetSpec {
            size: Size {
                width: 12,
                heads: 2,
                encoder_depth: 1,
                decoder_depth: 1,
                hidden: 0,
            },
            positions: Positions::Aligned,
            modalities: vec![ModalitySpec::tokens("gaze", &[4], 7)],
        };
        let mget = Mget::new(&spec, &Initialise::new(&Compute::cpu(), 0)).unwrap();
        let model = |tokens: usize, vocabulary: usize| {
            let mut tokenizers = Tokenizers::new(ClipFormat::default());
            tokenizers.insert(Arc::new(Described(vec![tokens], vocabulary)));
            Model::new(mget.clone(), tokenizers)
        };
        assert!(model(4, 7).is_ok());
        for (tokens, vocabulary) in [(5, 7), (4, 8), (4, 6)] {
            let message = model(tokens, vocabulary).unwrap_err().to_string();
            let said = format!("{tokens} tokens a clip of {vocabulary} kinds");
            assert!(
                message.contains(&said) && message.ends_with("4 of 7"),
                "{message}"
            );
        }
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
