//! Training MGET (Sec. 4.3, Supp. B): the masked prediction of tokens as an [`Objective`].

use super::schedule::Schedule;
use super::settings::TrainingSettings;
use super::trainer::{Found, Objective, Progress, Trainer, TrainingError};
use crate::engine::Gradients;
use crate::engine::gradients::Complete;
use crate::mget::{Batch, Loss, Losses, Mget};

/// MGET, trained to predict target tokens from input tokens and raw video.
#[derive(Debug, Clone)]
pub struct MaskedPrediction {
    model: Mget,
    loss: Loss,
    activation_checkpointing: bool,
}

impl Trainer<MaskedPrediction> {
    /// Starts to train `model`.
    #[must_use]
    pub fn new(model: Mget, settings: &TrainingSettings, schedule: Schedule) -> Self {
        let objective = MaskedPrediction {
            model,
            loss: settings.loss,
            activation_checkpointing: settings.activation_checkpointing,
        };
        Self::start(
            objective,
            settings.optimizer.clone(),
            schedule,
            settings.micro_batches(),
            settings.keep,
        )
    }
}

impl MaskedPrediction {
    /// The losses of a batch, and the gradients of `share` times their total, if it has any.
    fn gradients(
        &self,
        batch: &Batch,
        share: f64,
        complete: Option<&mut Complete<'_>>,
    ) -> (Losses, Option<Gradients>) {
        let (model, loss) = (&self.model, self.loss);
        if self.activation_checkpointing {
            return match complete {
                Some(complete) => model.recomputed(batch, loss, share, complete),
                None => model.recomputed(batch, loss, share, &mut |_, _| ()),
            };
        }
        if let Some(complete) = complete {
            return model.gradients_in_parts(batch, loss, share, complete);
        }
        let losses = self.model.losses(batch, self.loss);
        let total = losses.total.clone().filter(|_| !losses.is_known_bad());
        let gradients = total.map(|total| Gradients::of(&(total * share), &self.model));
        (losses, gradients)
    }
}

impl Objective for MaskedPrediction {
    type Module = Mget;
    type Batch = Batch;
    type Trace = ();

    fn module(&self) -> &Mget {
        &self.model
    }

    fn module_mut(&mut self) -> &mut Mget {
        &mut self.model
    }

    fn backward_order(&self) -> Vec<String> {
        self.model.backward_order()
    }

    fn micro_step(
        &self,
        batch: &Batch,
        share: f64,
        complete: Option<&mut Complete<'_>>,
    ) -> Result<Found<()>, TrainingError> {
        let (losses, gradients) = self.gradients(batch, share, complete);
        let modalities = self.model.spec().modalities.iter();
        let modalities = modalities.zip(&losses.modalities);
        Ok(Found {
            numbers: losses.reading(),
            // Nothing where a modality was not asked for.
            parts: modalities
                .filter_map(|(modality, loss)| {
                    let tokens = loss.as_ref()?.tokens as f64;
                    Some((format!("loss/{}", modality.name), tokens))
                })
                .collect(),
            gradients,
            used: Progress {
                step: 0,
                samples: batch.samples() as u64,
                input_tokens: batch.visible.sequence.len() as u64,
                target_tokens: batch.targets.sequence.len() as u64,
            },
            trace: (),
        })
    }
}
