//! A video tokenizer as one safetensors file: the network's weights, the statistics of wavelet coefficients where it has some,
//! and what it works on as metadata.

use std::collections::BTreeMap;

use super::{Network, VideoSettings, VideoTokenizer};
use crate::engine::{Compute, EngineError, HostTensor, Initialise, Parameters, Values, Weights};
use crate::tokenizer::normaliser::Normaliser;
use crate::tokenizer::trained::{DEVIATION, MEAN};
use crate::tokenizer::{Tokenizer, TokenizerError};

/// What the file says it is.
pub const FORMAT: &str = "reviv video tokenizer 1";

impl VideoTokenizer {
    /// Weights by name; settings, modality and clip size as metadata.
    #[must_use]
    pub fn weights(&self) -> Weights {
        let mut weights = self.network().weights();
        if let Some(statistics) = self.statistics() {
            let parts = [
                (MEAN, statistics.mean()),
                (DEVIATION, statistics.deviation()),
            ];
            for (name, values) in parts {
                weights.insert_f32(name, values.to_vec(), &[values.len()]);
            }
        }
        weights.metadata = Self::describe(self.modality(), self.clip(), self.settings());
        weights
    }

    /// What the file of a tokenizer says of itself.
    #[must_use]
    pub fn describe(
        modality: &str,
        [frames, height, width]: [usize; 3],
        settings: &VideoSettings,
    ) -> BTreeMap<String, String> {
        [
            ("format", FORMAT.to_owned()),
            ("modality", modality.to_owned()),
            ("clip", format!("[{frames},{height},{width}]")),
            (
                "settings",
                serde_json::to_string(settings).unwrap_or_default(),
            ),
        ]
        .map(|(key, value)| (key.to_owned(), value))
        .into()
    }

    /// Rebuilds a tokenizer from [`VideoTokenizer::weights`].
    ///
    /// # Errors
    /// When the file is of another format, or its tensors are not those of its settings.
    pub fn from_weights(mut weights: Weights, compute: &Compute) -> Result<Self, TokenizerError> {
        let metadata = std::mem::take(&mut weights.metadata);
        let text = |key: &str| -> Result<&str, TokenizerError> {
            metadata.get(key).map(String::as_str).ok_or_else(|| {
                TokenizerError::Other(format!(
                    "the file does not say its `{key}`: it is no tokenizer of reviv"
                ))
            })
        };
        if text("format")? != FORMAT {
            return Err(TokenizerError::Other(format!(
                "the file is `{}`, expected `{FORMAT}`",
                text("format")?
            )));
        }
        let modality = text("modality")?.to_owned();
        let wrong = |what: &str, reason: String| {
            TokenizerError::Other(format!("{modality}: {what}: {reason}"))
        };
        let settings: VideoSettings = serde_json::from_str(text("settings")?)
            .map_err(|error| wrong("settings", error.to_string()))?;
        let clip: [usize; 3] = serde_json::from_str(text("clip")?)
            .map_err(|error| wrong("clip", error.to_string()))?;
        let statistics = [MEAN, DEVIATION].map(|name| weights.tensors.remove(name));
        let unfit = |error: EngineError| wrong("weights", error.to_string());
        Network::new(&Initialise::meta(compute), &settings)?
            .check_shapes(&weights)
            .map_err(unfit)?;
        let mut network = Network::new(&Initialise::empty(compute), &settings)?;
        network.load(&weights).map_err(unfit)?;
        let mut tokenizer = Self::new(&modality, clip, network, compute)?;
        match statistics {
            [None, None] => {}
            [Some(mean), Some(deviation)] => {
                let values = |tensor: HostTensor| match tensor.values {
                    Values::F32(values) => Ok(values),
                    other => Err(wrong("statistics", format!("{} numbers", other.kind()))),
                };
                tokenizer.standardise(Normaliser::new(values(mean)?, values(deviation)?)?)?;
            }
            _ => {
                return Err(wrong(
                    "statistics",
                    format!("`{MEAN}` or `{DEVIATION}` is missing"),
                ));
            }
        }
        Ok(tokenizer)
    }
}

#[cfg(test)]
mod tests {
    use super::super::testing::small;
    use super::*;
    use crate::clip::Signal;
    use ndarray::{ArrayD, IxDyn};

    #[test]
    fn a_stored_tokenizer_gives_the_same_tokens() {
        let mut one = small([4, 16, 16], [4, 4], &[4, 3], 2);
        let values = ArrayD::from_shape_fn(IxDyn(&[4, 16, 16, 3]), |at| {
            ((at[0] * 7 + at[1] * 3 + at[2]) as f32 * 0.1).sin()
        });
        let signal = Signal {
            values,
            valid: None,
        };
        let folder = tempfile::tempdir().unwrap();
        for calibrated in [false, true] {
            if calibrated {
                one.calibrate(1, |_| Ok::<_, TokenizerError>(Some(signal.clone())))
                    .unwrap();
            }
            one.write(folder.path()).unwrap();
            let other = crate::tokenizer::open(folder.path(), &Compute::cpu()).unwrap();
            assert_eq!(other.modality(), "rgb");
            let tokens = one.encode(std::slice::from_ref(&signal)).unwrap();
            let again = other.encode(std::slice::from_ref(&signal)).unwrap();
            assert_eq!(again, tokens);
            assert_eq!(other.decode(&tokens).unwrap(), one.decode(&tokens).unwrap());
        }
        // More memory than any machine has, or more blocks than can be named: refused before anything is allocated.
        for change in [
            |settings: &mut VideoSettings| settings.channels = 1 << 16,
            |settings: &mut VideoSettings| settings.blocks = 1 << 40,
        ] {
            let mut settings = one.settings().clone();
            change(&mut settings);
            let mut huge = one.weights();
            huge.metadata = VideoTokenizer::describe("rgb", one.clip(), &settings);
            assert!(VideoTokenizer::from_weights(huge, &Compute::cpu()).is_err());
        }
        let mut torn = one.weights();
        torn.tensors.remove(MEAN);
        let error = VideoTokenizer::from_weights(torn, &Compute::cpu()).unwrap_err();
        assert!(error.to_string().contains("statistics"), "{error}");
    }
}
