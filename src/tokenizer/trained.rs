//! A trained VQ-VAE with everything needed to use it: modality, shape, normalisation, weights. One safetensors file.

use std::collections::BTreeMap;
use std::path::Path;

use ndarray::{ArrayD, IxDyn};
use serde_json::{Value, json};

use super::normaliser::Normaliser;
use super::vq::{Batch, VqSettings, VqVae};
use super::{TokenGrid, Tokenizer, TokenizerError, check_tokens};
use crate::clip::Signal;
use crate::engine::parameters::to_host;
use crate::engine::{Compute, EngineError, HostTensor, Initialise, Parameters, Values, Weights};
use crate::modality::Shape;

/// The name of the file in a tokenizer's directory.
pub const FILE: &str = "tokenizer.safetensors";

/// What the file says it is.
const FORMAT: &str = "reviv vq tokenizer 1";

/// Signals per forward pass: memory stays flat in the number of signals.
const BATCH: usize = 16;

/// The names of the statistics beside the weights.
pub const MEAN: &str = "normalise.mean";
/// The name of the deviations.
pub const DEVIATION: &str = "normalise.deviation";

/// A normalised signal, row-major: what a model trains on.
#[derive(Debug, Clone, PartialEq)]
pub struct Prepared {
    /// As many as the signal has; 0 where invalid.
    pub values: Vec<f32>,
    /// One flag per sample or joint; `None`: all valid.
    pub valid: Option<Vec<bool>>,
}

/// A tokenizer of one modality.
#[derive(Debug, Clone)]
pub struct VqTokenizer {
    modality: String,
    shape: Shape,
    grid: Vec<usize>,
    normaliser: Normaliser,
    model: VqVae,
}

impl VqTokenizer {
    /// A tokenizer of `modality` from a model and the statistics it was trained with.
    ///
    /// # Errors
    /// When the statistics are not those of as many values as the model's samples have.
    pub fn new(
        modality: &str,
        shape: Shape,
        normaliser: Normaliser,
        model: &VqVae,
    ) -> Result<Self, TokenizerError> {
        let expected = model.patches().values_per_sample();
        if normaliser.width() != expected {
            return Err(TokenizerError::Other(format!(
                "{modality}: normalisation statistics of {} values, the model has {expected}",
                normaliser.width()
            )));
        }
        if normaliser.is_root_relative() != model.settings().root_relative {
            return Err(TokenizerError::Other(format!(
                "{modality}: the normalisation and the model do not agree on `root_relative`"
            )));
        }
        Ok(Self {
            modality: modality.to_owned(),
            shape,
            grid: model.patches().grid(),
            normaliser,
            model: model.frozen(),
        })
    }

    /// The network with its codebook.
    #[must_use]
    pub fn model(&self) -> &VqVae {
        &self.model
    }

    /// The statistics it was trained with.
    #[must_use]
    pub fn normaliser(&self) -> &Normaliser {
        &self.normaliser
    }

    /// The shape of its signals.
    #[must_use]
    pub fn shape(&self) -> &Shape {
        &self.shape
    }

    /// Weights and statistics by name; settings, modality and shape as metadata.
    #[must_use]
    pub fn weights(&self) -> Weights {
        let mut weights = self.model.weights();
        let statistics = [
            (MEAN, self.normaliser.mean()),
            (DEVIATION, self.normaliser.deviation()),
        ];
        for (name, values) in statistics {
            weights.insert_f32(name, values.to_vec(), &[values.len()]);
        }
        weights.metadata = Self::describe(&self.modality, &self.shape, self.model.settings());
        weights
    }

    /// What the file of a tokenizer says of itself.
    #[must_use]
    pub fn describe(
        modality: &str,
        shape: &Shape,
        settings: &VqSettings,
    ) -> BTreeMap<String, String> {
        let shape = match shape {
            Shape::Temporal { samples, channels } => {
                json!({"samples": samples, "channels": channels})
            }
            Shape::Kinematic { samples, joints } => json!({"samples": samples, "joints": joints}),
            Shape::Video { .. } => Value::Null,
        };
        let settings = serde_json::to_value(settings).unwrap_or(Value::Null);
        [
            ("format", FORMAT.to_owned()),
            ("modality", modality.to_owned()),
            ("shape", shape.to_string()),
            ("settings", settings.to_string()),
        ]
        .map(|(key, value)| (key.to_owned(), value))
        .into()
    }

    /// Rebuilds a tokenizer from [`VqTokenizer::weights`].
    ///
    /// # Errors
    /// When the file is of another format, its statistics are missing, or its tensors are not those of its settings.
    pub fn from_weights(mut weights: Weights, compute: &Compute) -> Result<Self, TokenizerError> {
        let text = |key: &str| -> Result<String, TokenizerError> {
            let found = weights.metadata.get(key).cloned();
            found.ok_or_else(|| {
                TokenizerError::Other(format!(
                    "the file does not say its `{key}`: it is no tokenizer of reviv"
                ))
            })
        };
        let format = text("format")?;
        if format != FORMAT {
            return Err(TokenizerError::Other(format!(
                "the file is `{format}`, expected `{FORMAT}`"
            )));
        }
        let modality = text("modality")?;
        let wrong = |what: &str, reason: String| {
            TokenizerError::Other(format!("{modality}: {what}: {reason}"))
        };
        let settings: VqSettings = serde_json::from_str(&text("settings")?)
            .map_err(|error| wrong("settings", error.to_string()))?;
        let stored: Value = serde_json::from_str(&text("shape")?)
            .map_err(|error| wrong("shape", error.to_string()))?;
        let size = |key: &str| stored[key].as_u64().map(|size| size as usize);
        let shape = match (size("samples"), size("channels"), size("joints")) {
            (Some(samples), Some(channels), None) => Shape::Temporal { samples, channels },
            (Some(samples), None, Some(joints)) => Shape::Kinematic { samples, joints },
            _ => return Err(wrong("shape", stored.to_string())),
        };
        let mut statistics = |name: &str| -> Result<Vec<f32>, TokenizerError> {
            match weights.tensors.remove(name) {
                Some(HostTensor {
                    values: Values::F32(values),
                    ..
                }) => Ok(values),
                _ => Err(TokenizerError::Other(format!(
                    "{modality}: normalisation statistics `{name}` are missing; imported weights need their `norm_stats` files"
                ))),
            }
        };
        let normaliser = Normaliser::new(statistics(MEAN)?, statistics(DEVIATION)?)?
            .of_joints(settings.root_relative)?;
        let unfit = |error: EngineError| wrong("weights", error.to_string());
        VqVae::new(&Initialise::meta(compute), &settings, &shape)?
            .check_shapes(&weights)
            .map_err(unfit)?;
        let mut model = VqVae::new(&Initialise::empty(compute), &settings, &shape)?;
        model.load(&weights).map_err(unfit)?;
        Self::new(&modality, shape, normaliser, &model)
    }

    /// Reads the tokenizer in `directory`, which must be one of `modality`.
    ///
    /// # Errors
    /// As [`VqTokenizer::from_weights`], or when it is of another modality.
    pub fn read(
        directory: &Path,
        modality: &str,
        compute: &Compute,
    ) -> Result<Self, TokenizerError> {
        let weights = Weights::read(&directory.join(FILE))
            .map_err(|error| TokenizerError::Other(error.to_string()))?;
        let tokenizer = Self::from_weights(weights, compute)?;
        if tokenizer.modality != modality {
            return Err(TokenizerError::Other(format!(
                "the tokenizer in {} is of `{}`, expected `{modality}`",
                directory.display(),
                tokenizer.modality
            )));
        }
        Ok(tokenizer)
    }

    /// Reconstructions of prepared signals, de-normalised, with their tokens.
    #[must_use]
    pub fn reconstruct(&self, signals: &[Prepared]) -> Vec<(Vec<u32>, Vec<f32>)> {
        let tokens = self.model.patches().tokens();
        let mut found = Vec::with_capacity(signals.len());
        for chunk in signals.chunks(BATCH) {
            let ids = self.model.encode(&batch(&self.model, chunk));
            let values = self.decode_values(&ids, chunk.len());
            found.extend(ids.chunks_exact(tokens).map(<[u32]>::to_vec).zip(values));
        }
        found
    }

    fn decode_values(&self, ids: &[u32], samples: usize) -> Vec<Vec<f32>> {
        let rows = to_host(self.model.decode(ids, samples));
        rows.chunks_exact(rows.len() / samples.max(1))
            .map(|patches| {
                let mut values = self.model.patches().join(patches);
                self.normaliser.undo(&mut values);
                values
            })
            .collect()
    }
}

/// A batch of prepared signals for `model`.
#[must_use]
pub fn batch(model: &VqVae, signals: &[Prepared]) -> Batch {
    model.batch(
        signals
            .iter()
            .map(|signal| (signal.values.as_slice(), signal.valid.as_deref())),
    )
}

/// Checks signals of `modality` against `model` and normalises them.
///
/// # Errors
/// On the first signal of another shape, or with a valid value that is not finite.
pub fn prepare(
    modality: &str,
    model: &VqVae,
    normaliser: &Normaliser,
    signals: &[Signal],
) -> Result<Vec<Prepared>, TokenizerError> {
    let shape_error = |index: usize, found: &[usize], expected: Vec<usize>| TokenizerError::Shape {
        modality: modality.to_owned(),
        index,
        found: found.to_vec(),
        expected,
    };
    let channels = model.patches().channels();
    let prepare_one = |(index, signal): (usize, &Signal)| {
        let expected = model.patches().signal_shape();
        if signal.values.shape() != expected {
            return Err(shape_error(index, signal.values.shape(), expected));
        }
        let mut valid = match &signal.valid {
            None => None,
            Some(valid) if valid.shape() == model.patches().valid_shape() => {
                Some(valid.iter().copied().collect::<Vec<bool>>())
            }
            Some(valid) => {
                return Err(shape_error(
                    index,
                    valid.shape(),
                    model.patches().valid_shape(),
                ));
            }
        };
        let mut values: Vec<f32> = signal.values.iter().copied().collect();
        for (i, value) in values.iter_mut().enumerate() {
            if valid.as_ref().is_some_and(|valid| !valid[i / channels]) {
                *value = 0.0;
            } else if !value.is_finite() {
                let mut position = Vec::new();
                let mut rest = i;
                for size in signal.values.shape().iter().rev() {
                    position.insert(0, rest % size);
                    rest /= size;
                }
                return Err(TokenizerError::NotFinite {
                    modality: modality.to_owned(),
                    index,
                    position,
                });
            }
        }
        if let Some(valid) = valid.as_mut().filter(|_| normaliser.is_root_relative()) {
            for sample in valid.chunks_mut(normaliser.width() / channels) {
                let root = sample.first().is_some_and(|valid| *valid);
                for valid in sample {
                    *valid &= root;
                }
            }
        }
        normaliser.apply(&mut values);
        Ok(Prepared { values, valid })
    };
    signals.iter().enumerate().map(prepare_one).collect()
}

impl Tokenizer for VqTokenizer {
    fn write(&self, directory: &Path) -> Result<(), TokenizerError> {
        self.weights()
            .write(&directory.join(FILE))
            .map_err(|error| TokenizerError::Other(error.to_string()))
    }

    fn modality(&self) -> &str {
        &self.modality
    }

    fn grid(&self) -> &[usize] {
        &self.grid
    }

    fn vocabulary(&self) -> usize {
        self.model.settings().codebook
    }

    fn encode(&self, signals: &[Signal]) -> Result<Vec<TokenGrid>, TokenizerError> {
        let prepared = prepare(&self.modality, &self.model, &self.normaliser, signals)?;
        let tokens = self.model.patches().tokens();
        let mut grids = Vec::with_capacity(signals.len());
        for chunk in prepared.chunks(BATCH) {
            let ids = self.model.encode(&batch(&self.model, chunk));
            grids.extend(ids.chunks_exact(tokens).map(|ids| TokenGrid {
                ids: ids.to_vec(),
                grid: self.grid.clone(),
            }));
        }
        Ok(grids)
    }

    fn decode(&self, tokens: &[TokenGrid]) -> Result<Vec<Signal>, TokenizerError> {
        check_tokens(self, tokens)?;
        let shape = self.model.patches().signal_shape();
        let mut signals = Vec::with_capacity(tokens.len());
        for chunk in tokens.chunks(BATCH) {
            let ids: Vec<u32> = chunk
                .iter()
                .flat_map(|grid| grid.ids.iter().copied())
                .collect();
            for values in self.decode_values(&ids, chunk.len()) {
                let values = ArrayD::from_shape_vec(IxDyn(&shape), values)
                    .map_err(|error| TokenizerError::Other(error.to_string()))?;
                signals.push(Signal {
                    values,
                    valid: None,
                });
            }
        }
        Ok(signals)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::tokenizer::vq::VqSettings;

    const SHAPE: Shape = Shape::Temporal {
        samples: 8,
        channels: 3,
    };

    fn tokenizer() -> VqTokenizer {
        let compute = Compute::cpu();
        let settings = VqSettings {
            codebook: 16,
            code_width: 4,
            width: 8,
            depth: 1,
            heads: 2,
            ..VqSettings::default()
        };
        let model = VqVae::new(&Initialise::new(&compute, 1), &settings, &SHAPE).unwrap();
        let normaliser = Normaliser::new(vec![1.0, 2.0, 3.0], vec![1.0, 2.0, 0.5]).unwrap();
        VqTokenizer::new("camera", SHAPE, normaliser, &model).unwrap()
    }

    fn signal(shape: &[usize]) -> Signal {
        let length = shape.iter().product();
        let values = (0..length).map(|i| (i as f32 * 0.7).sin()).collect();
        Signal {
            values: ArrayD::from_shape_vec(IxDyn(shape), values).unwrap(),
            valid: None,
        }
    }

    #[test]
    fn a_stored_tokenizer_gives_the_same_tokens_and_signals() {
        let folder = tempfile::tempdir().unwrap();
        let one = tokenizer();
        one.write(folder.path()).unwrap();
        let other = VqTokenizer::read(folder.path(), "camera", &Compute::cpu()).unwrap();
        let signals = vec![signal(&[8, 3]); 19];
        let tokens = one.encode(&signals).unwrap();
        assert_eq!(other.encode(&signals).unwrap(), tokens);
        assert_eq!(tokens[18].grid, [4]);
        assert_eq!(other.decode(&tokens).unwrap(), one.decode(&tokens).unwrap());
        assert_eq!(other.weights().to_bytes(), one.weights().to_bytes());
    }

    #[test]
    fn what_does_not_fit_is_refused_with_what_was_expected_and_found() {
        let one = tokenizer();
        let message = one
            .encode(&[signal(&[8, 3]), signal(&[8, 4])])
            .unwrap_err()
            .to_string();
        assert_eq!(
            message,
            "camera: signal 1 has shape [8, 4], expected [8, 3]"
        );

        let mut nan = signal(&[8, 3]);
        nan.values[[5, 1]] = f32::NAN;
        let message = one.encode(&[nan.clone()]).unwrap_err().to_string();
        assert!(message.contains("[5, 1]"), "{message}");
        nan.valid = Some(ArrayD::from_shape_fn(IxDyn(&[8]), |i| i[0] != 5));
        assert!(
            one.encode(&[nan]).is_ok(),
            "an invalid sample may hold anything"
        );

        let mut grid = one.encode(&[signal(&[8, 3])]).unwrap();
        grid[0].ids[2] = 16;
        assert!(
            one.decode(&grid)
                .unwrap_err()
                .to_string()
                .contains("vocabulary of 16")
        );
    }

    #[test]
    fn a_file_of_another_modality_size_or_without_statistics_is_refused() {
        let folder = tempfile::tempdir().unwrap();
        tokenizer().write(folder.path()).unwrap();
        let compute = Compute::cpu();
        let message = VqTokenizer::read(folder.path(), "gaze", &compute)
            .unwrap_err()
            .to_string();
        assert!(message.contains("`camera`, expected `gaze`"), "{message}");

        let mut bare = tokenizer().weights();
        bare.tensors.remove(MEAN);
        let message = VqTokenizer::from_weights(bare, &compute)
            .unwrap_err()
            .to_string();
        assert!(
            message.contains("statistics `normalise.mean` are missing"),
            "{message}"
        );

        let mut other = tokenizer().weights();
        let settings = other.metadata["settings"].replace("\"width\":8", "\"width\":12");
        other.metadata.insert("settings".into(), settings);
        let message = VqTokenizer::from_weights(other, &compute)
            .unwrap_err()
            .to_string();
        assert!(
            message.contains("has shape") && message.contains("expects"),
            "{message}"
        );

        // More memory than any machine has, or more blocks than can be named: refused before anything is allocated.
        for (from, to) in [
            ("\"codebook\":16", "\"codebook\":16777216"),
            ("\"depth\":1", "\"depth\":1000000000000"),
        ] {
            let mut huge = tokenizer().weights();
            let settings = huge.metadata["settings"].replace(from, to);
            assert_ne!(settings, huge.metadata["settings"]);
            huge.metadata.insert("settings".into(), settings);
            assert!(VqTokenizer::from_weights(huge, &compute).is_err(), "{to}");
        }

        assert!(VqTokenizer::from_weights(Weights::default(), &compute).is_err());
    }
}
