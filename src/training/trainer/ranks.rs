//! One step on several ranks: who computes which micro-batch, and how what they found becomes one step on all of them.
//!
//! The unit of work is the micro-batch: rank `r` of `n` computes micro-batches `r`, `r + n`, ... Whatever is averaged or added
//! over a step is folded in the order of micro-batches on every rank, so that the report, the running means of codebooks and
//! the choice of dead codes are those of one rank. Gradients are added as [`Reduction`] says, while backward goes on.

use super::super::settings::micro_batches;
use super::{MicroStep, Progress, TrainingError};
use crate::engine::communicator::reduce::{Reduction, Sum};
use crate::engine::gradients::Complete;
use crate::engine::{Communicator, Gradients, Parameters, RankError, Tensor};
use crate::tokenizer::quantizer::Assignment;
use std::sync::atomic::{AtomicU64, Ordering};

/// The ranks of a training, and how they add up gradients.
#[derive(Debug, Default)]
pub struct Ranks {
    communicator: Communicator,
    reduction: Reduction,
    /// The names of the parameters, about as backward completes their gradients.
    order: Vec<String>,
    /// Of the gradient that this rank has stepped with last, as bits: all must have the same.
    norm: AtomicU64,
}

impl Clone for Ranks {
    fn clone(&self) -> Self {
        Self {
            norm: AtomicU64::new(self.norm.load(Ordering::Relaxed)),
            order: self.order.clone(),
            ..Self::new(self.communicator.clone(), self.reduction)
        }
    }
}

/// Why a batch cannot be shared between ranks.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum ShareError {
    /// The batch is not a multiple of the number of ranks.
    #[error(
        "a `batch` of {batch} cannot be shared evenly by {ranks} ranks: take a multiple of {ranks}, or another number of ranks"
    )]
    Batch {
        /// Samples of a step, over all ranks.
        batch: usize,
        /// Processes that train together.
        ranks: usize,
    },
    /// The micro-batches of a step do not divide over the ranks.
    #[error(
        "a `batch` of {batch} in micro-batches of {micro_batch} makes {parts} parts, which {ranks} ranks cannot share evenly: take a smaller `micro_batch`, or another number of ranks"
    )]
    Parts {
        /// Samples of a step, over all ranks.
        batch: usize,
        /// Samples of a micro-batch.
        micro_batch: usize,
        /// Micro-batches of a step.
        parts: usize,
        /// Processes that train together.
        ranks: usize,
    },
}

impl Ranks {
    /// Ranks that add up gradients like this.
    #[must_use]
    pub fn new(communicator: Communicator, reduction: Reduction) -> Self {
        Self {
            communicator,
            reduction,
            order: Vec::new(),
            norm: AtomicU64::default(),
        }
    }

    /// Backward completes gradients about in this order: so they are sent.
    #[must_use]
    pub(in crate::training) fn in_order(self, order: Vec<String>) -> Self {
        Self { order, ..self }
    }

    /// What they tell each other through.
    #[must_use]
    pub fn communicator(&self) -> &Communicator {
        &self.communicator
    }

    /// Which of a step's micro-batches are this rank's.
    pub fn own(&self, micro_batches: usize) -> impl Iterator<Item = usize> + use<> {
        self.communicator.own(micro_batches)
    }

    /// Samples of each micro-batch of a step of `batch` samples over all ranks, `size` at a time; 0: as few micro-batches as there
    /// are ranks, which is one in the order of samples.
    ///
    /// # Errors
    /// When the ranks cannot share them evenly.
    pub fn micro_batches(&self, batch: usize, size: usize) -> Result<Vec<usize>, ShareError> {
        let ranks = self.communicator.size();
        if size == 0 && self.reduction == Reduction::Fast {
            return if batch.is_multiple_of(ranks) {
                Ok(micro_batches(batch, batch / ranks))
            } else {
                Err(ShareError::Batch { batch, ranks })
            };
        }
        let all = micro_batches(batch, size);
        if !all.len().is_multiple_of(ranks) {
            return Err(ShareError::Parts {
                batch,
                micro_batch: all.first().copied().unwrap_or(0),
                parts: all.len(),
                ranks,
            });
        }
        Ok(all)
    }

    /// Takes note of the norm of the gradient that this rank has stepped with.
    pub(in crate::training) fn note(&self, norm: f64) {
        self.norm.store(norm.to_bits(), Ordering::Relaxed);
    }

    /// Computes this rank's micro-batches of `step` and gives what all ranks found, in order, and the sum of their gradients, where
    /// any asks for one. The last micro-batch before ranks meet is told who wants to hear of its gradients.
    ///
    /// # Errors
    /// What `micro_step` says here or elsewhere, or when a rank is lost.
    pub(in crate::training) fn sum<M, T, E>(
        &self,
        step: u64,
        count: usize,
        model: &M,
        mut micro_step: impl FnMut(usize, Option<&mut Complete<'_>>) -> Result<MicroStep<T>, E>,
    ) -> Result<(Vec<MicroStep<T>>, Option<Gradients>), E>
    where
        M: Parameters,
        T: Told,
        E: From<TrainingError> + std::fmt::Display,
    {
        let ranks = &self.communicator;
        let lost = |error: RankError| E::from(TrainingError::from(error));
        let per_rank = count / ranks.size();
        // In the order of samples, ranks meet after each micro-batch.
        let rounds = match self.reduction {
            Reduction::Ordered => per_rank,
            Reduction::Fast => 1,
        };
        let Some(mut sum) = Sum::new(ranks, model, &self.order, rounds) else {
            let mut own = None;
            let micros: Result<Vec<_>, E> = (0..count)
                .map(|index| take(micro_step(index, None), &mut own))
                .collect();
            return Ok((micros?, own));
        };
        ranks.stepping(true);
        let mut own_indices = self.own(count);
        let mut all = Vec::new();
        let mut any = false;
        for _ in 0..rounds {
            let mut own_indices = own_indices.by_ref().take(per_rank / rounds).peekable();
            let mut round = || -> Result<Round<T>, E> {
                let (mut earlier, mut micros) = (None, Vec::new());
                while let Some(index) = own_indices.next() {
                    if own_indices.peek().is_some() {
                        micros.push(take(micro_step(index, None), &mut earlier)?);
                        continue;
                    }
                    // What is complete is on its way while backward goes on.
                    let mut complete = |name: &str, gradient: &Tensor<1>| {
                        let earlier = earlier.as_ref().and_then(|all: &Gradients| all.get(name));
                        sum.put(name, earlier, Some(gradient));
                    };
                    let micro = micro_step(index, Some(&mut complete));
                    let mut last = None;
                    micros.push(take(micro, &mut last)?);
                    return Ok((micros, earlier, last));
                }
                Ok((micros, earlier, None))
            };
            let found = round();
            let (earlier, last) = match &found {
                Ok((_, earlier, last)) => (earlier.as_ref(), last.as_ref()),
                // The others wait for buckets before they hear what went wrong here.
                Err(_) => (None, None),
            };
            let ended = sum.end_round(earlier, last);
            let told = found.as_ref().map_err(ToString::to_string);
            let told = told.map(|(micros, earlier, last)| {
                self.tell(step, micros, earlier.is_some() || last.is_some())
            });
            if let (Err(error), Ok(_)) = (ended, &found) {
                return Err(lost(error));
            }
            let gathered = ranks.gather(told);
            drop(found?);
            let mut round = Vec::new();
            for (rank, bytes) in gathered.map_err(lost)?.iter().enumerate() {
                let (micros, has) = self.hear(step, rank, bytes).map_err(lost)?;
                any |= has;
                round.push(micros.into_iter());
            }
            for _ in 0..per_rank / rounds {
                all.extend(round.iter_mut().filter_map(Iterator::next));
            }
        }
        // A loss that is not finite ends the step on every rank; nothing becomes of the sum.
        let finite = all.iter().all(|micro| micro.loss.is_finite());
        let gradients = if any && finite {
            Some(sum.finish(model).map_err(lost)?)
        } else {
            None
        };
        ranks.stepping(false);
        Ok((all, gradients))
    }

    fn tell<T: Told>(&self, step: u64, micros: &[MicroStep<T>], has: bool) -> Vec<u8> {
        let mut words = Words(Vec::new());
        words.put(step);
        words.put(self.norm.load(Ordering::Relaxed));
        words.put(u64::from(has));
        words.put(micros.len() as u64);
        for micro in micros {
            let used = micro.used;
            words.put(micro.loss.to_bits());
            for number in [used.samples, used.input_tokens, used.target_tokens] {
                words.put(number);
            }
            words.put(micro.parts.len() as u64);
            for (name, mean, weight) in &micro.parts {
                words.put_bytes(name.as_bytes());
                words.put(mean.to_bits());
                words.put(weight.to_bits());
            }
            words.put_bytes(&micro.trace.to_bytes());
        }
        words.0
    }

    fn hear<T: Told>(
        &self,
        step: u64,
        rank: usize,
        bytes: &[u8],
    ) -> Result<(Vec<MicroStep<T>>, bool), RankError> {
        let ranks = &self.communicator;
        let mut words = Reader(bytes);
        let mut read = || -> Option<_> {
            let (at, norm) = (words.take()?, words.take()?);
            let has = words.take()? != 0;
            let mut micros = Vec::new();
            for _ in 0..words.take()? {
                let loss = f64::from_bits(words.take()?);
                let used = Progress {
                    step: 0,
                    samples: words.take()?,
                    input_tokens: words.take()?,
                    target_tokens: words.take()?,
                };
                let mut parts = Vec::new();
                for _ in 0..words.take()? {
                    let name = String::from_utf8(words.take_bytes()?.to_vec()).ok()?;
                    parts.push((
                        name,
                        f64::from_bits(words.take()?),
                        f64::from_bits(words.take()?),
                    ));
                }
                micros.push(MicroStep {
                    loss,
                    parts,
                    gradients: None,
                    used,
                    trace: T::of_bytes(words.take_bytes()?)?,
                });
            }
            Some((at, norm, has, micros))
        };
        let (at, norm, has, micros) =
            read().ok_or_else(|| ranks.odd(rank, &"it told something else than a step"))?;
        if at != step {
            return Err(ranks.odd(
                rank,
                &format!("it takes step {}, this one {}", at + 1, step + 1),
            ));
        }
        let own = self.norm.load(Ordering::Relaxed);
        if norm != own {
            let (norm, own) = (f64::from_bits(norm), f64::from_bits(own));
            let reason = format!(
                "its gradient of step {step} had norm {norm}, rank {}'s {own}",
                ranks.rank()
            );
            return Err(ranks.odd(rank, &reason));
        }
        Ok((micros, has))
    }
}

/// Of a rank's micro-batches before all meet: what they found, the sum of the gradients of all but the last, and those of the last.
type Round<T> = (Vec<MicroStep<T>>, Option<Gradients>, Option<Gradients>);

/// Takes the gradients of a micro-batch out and adds them; a batch that asks for nothing has none.
fn take<T, E>(
    micro: Result<MicroStep<T>, E>,
    sum: &mut Option<Gradients>,
) -> Result<MicroStep<T>, E> {
    let mut micro = micro?;
    if let Some(gradients) = micro.gradients.take() {
        *sum = Some(match sum.take() {
            Some(sum) => sum.plus(gradients),
            None => gradients,
        });
    }
    Ok(micro)
}

/// What ranks tell each other as bytes.
pub trait Told: Sized {
    /// To another rank of the same machine type.
    fn to_bytes(&self) -> Vec<u8>;

    /// From another rank; `None` where it is no such thing.
    fn of_bytes(bytes: &[u8]) -> Option<Self>;
}

impl Told for () {
    fn to_bytes(&self) -> Vec<u8> {
        Vec::new()
    }

    fn of_bytes(bytes: &[u8]) -> Option<Self> {
        bytes.is_empty().then_some(())
    }
}

impl Told for Assignment {
    fn to_bytes(&self) -> Vec<u8> {
        let mut words = Words(Vec::new());
        words.put_bytes(
            &self
                .ids
                .iter()
                .flat_map(|id| id.to_le_bytes())
                .collect::<Vec<u8>>(),
        );
        words.put_bytes(
            &self
                .unit
                .iter()
                .flat_map(|x| x.to_le_bytes())
                .collect::<Vec<u8>>(),
        );
        words.0
    }

    fn of_bytes(bytes: &[u8]) -> Option<Self> {
        let mut words = Reader(bytes);
        let ids = words.take_bytes()?.as_chunks::<4>().0.iter();
        let ids = ids.map(|word| u32::from_le_bytes(*word)).collect();
        let unit = words.take_bytes()?.as_chunks::<4>().0.iter();
        let unit = unit.map(|word| f32::from_le_bytes(*word)).collect();
        Some(Self { ids, unit })
    }
}

/// Numbers and byte strings, one after the other.
struct Words(Vec<u8>);

impl Words {
    fn put(&mut self, number: u64) {
        self.0.extend(number.to_le_bytes());
    }

    fn put_bytes(&mut self, bytes: &[u8]) {
        self.put(bytes.len() as u64);
        self.0.extend(bytes);
    }
}

struct Reader<'a>(&'a [u8]);

impl<'a> Reader<'a> {
    fn take(&mut self) -> Option<u64> {
        let (word, rest) = self.0.split_first_chunk()?;
        self.0 = rest;
        Some(u64::from_le_bytes(*word))
    }

    fn take_bytes(&mut self) -> Option<&'a [u8]> {
        let length = usize::try_from(self.take()?).ok()?;
        let (bytes, rest) = self.0.split_at_checked(length)?;
        self.0 = rest;
        Some(bytes)
    }
}
