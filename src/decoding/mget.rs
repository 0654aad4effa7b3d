//! MGET as a [`TokenModel`].

use super::model::{DecodingError, Sample, Slot, TargetPositions, TokenModality, TokenModel};
use crate::engine::Tensor;
use crate::engine::parameters::to_host;
use crate::mget::{Content, Context, EncoderInput, Mget, Sequence};
use std::ops::Range;

/// A model with the list of its modalities.
#[derive(Debug)]
pub struct MgetTokens<'m> {
    model: &'m Mget,
    modalities: Vec<TokenModality>,
}

impl<'m> MgetTokens<'m> {
    /// The model, answering for tokens.
    #[must_use]
    pub fn new(model: &'m Mget) -> Self {
        let modalities = model
            .spec()
            .modalities
            .iter()
            .map(|modality| TokenModality {
                name: modality.name.clone(),
                tokens: modality.count(),
                vocabulary: modality.vocabulary(),
            })
            .collect();
        Self { model, modalities }
    }
}

/// The decoder's output and which rows are whose.
#[derive(Debug, Clone)]
pub struct MgetOutput {
    /// `None` when there was no target.
    y_MD: Option<Tensor<2>>,
    target_positions: Sequence,
}

impl TokenModel for MgetTokens<'_> {
    type Context = Context;
    type DecoderOutput = MgetOutput;

    fn modalities(&self) -> &[TokenModality] {
        &self.modalities
    }

    fn encode(&self, samples: &[Sample<'_>], hidden: &[bool]) -> Result<Context, DecodingError> {
        let contents: Vec<Vec<Content<'_>>> = samples
            .iter()
            .map(|sample| {
                sample
                    .slots
                    .iter()
                    .map(|slot| match slot {
                        Slot::Tokens { ids, .. } => Content::Ids(ids),
                        Slot::Pixels(content) => *content,
                    })
                    .collect()
            })
            .collect();
        let given: Vec<Vec<Vec<u32>>> = samples
            .iter()
            .map(|sample| {
                sample
                    .slots
                    .iter()
                    .zip(hidden)
                    .zip(&self.modalities)
                    .map(|((slot, hidden), modality)| match slot {
                        _ if *hidden || !slot.is_known() => Vec::new(),
                        Slot::Tokens { known, .. } => (0..known.len() as u32)
                            .filter(|&p| known[p as usize])
                            .collect(),
                        Slot::Pixels(_) => (0..modality.tokens as u32).collect(),
                    })
                    .collect()
            })
            .collect();
        let visible = EncoderInput::new(
            self.model.spec(),
            &contents,
            given.iter().map(Vec::as_slice),
        )
        .map_err(|error| DecodingError::Model(error.to_string()))?;
        Ok(self.model.encode(&visible))
    }

    fn decode(
        &self,
        context: &Context,
        target_positions: &TargetPositions,
    ) -> Result<MgetOutput, DecodingError> {
        for (m, modality) in self.modalities.iter().enumerate() {
            let outside = target_positions
                .iter()
                .flat_map(|sample| &sample[m])
                .find(|&&p| p as usize >= modality.tokens);
            if let Some(position) = outside {
                let reason = format!("`{}` has no position {position}", modality.name);
                return Err(DecodingError::Model(reason));
            }
        }
        let target_positions = Sequence::new(
            self.modalities.len(),
            target_positions.iter().map(Vec::as_slice),
        );
        let y_MD = self.model.decode(context, &target_positions);
        Ok(MgetOutput {
            y_MD,
            target_positions,
        })
    }

    fn logits(
        &self,
        decoder_output: &MgetOutput,
        modality: usize,
        rows: Range<usize>,
    ) -> Result<Vec<f32>, DecodingError> {
        let missing = || {
            DecodingError::Model(format!(
                "rows {rows:?} of modality {modality} were not among the targets"
            ))
        };
        let own = decoder_output
            .target_positions
            .rows
            .get(modality)
            .and_then(|own| own.get(rows.clone()));
        let mut part = Sequence {
            rows: vec![Vec::new(); self.modalities.len()],
            ..Sequence::default()
        };
        part.rows[modality] = own.ok_or_else(missing)?.to_vec();
        let y_MD = decoder_output.y_MD.as_ref().ok_or_else(missing)?;
        let logits = self
            .model
            .logits(y_MD, &part, modality)
            .ok_or_else(missing)?;
        Ok(to_host(logits))
    }
}
