//! Batches, prepared ahead by threads. A batch is a function of the seed and the step: threads only change who waits.

use super::sampler::Sampler;
use super::source::{DataError, TokenSample, TokenSource};
use crate::masking::{Mask, Masking};
use crate::mget::{Batch, MgetSpec};
use crate::random::stream;
use std::sync::Arc;
use std::sync::mpsc::{Receiver, sync_channel};
use std::thread::JoinHandle;

/// Micro-batches each thread may have ready beyond the one it works on.
const AHEAD: usize = 2;

/// Everything that decides what a training batch holds.
pub struct BatchSource {
    /// The model the batches are for.
    pub spec: MgetSpec,
    /// What is given and what is asked for.
    pub masking: Masking,
    /// The data sets.
    pub sources: Vec<Arc<dyn TokenSource>>,
    /// Which clip stands where.
    pub order: Sampler,
    /// The seed of the masks.
    pub seed: u64,
    /// Samples of each micro-batch of a step.
    pub micro_batches: Vec<usize>,
    /// How often a clip is used in a row.
    pub repeat: usize,
}

impl std::fmt::Debug for BatchSource {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("BatchSource")
            .field("order", &self.order)
            .finish_non_exhaustive()
    }
}

impl BatchSource {
    /// Micro-batch `micro` of `step`.
    ///
    /// # Errors
    /// When a clip cannot be read or does not fit the model.
    pub fn batch(&self, step: u64, micro: usize) -> Result<Batch, DataError> {
        let first: usize = self.micro_batches[..micro].iter().sum();
        let per_step: usize = self.micro_batches.iter().sum();
        let mut samples: Vec<TokenSample> = Vec::new();
        let mut masks: Vec<Mask> = Vec::new();
        for index in first..first + self.micro_batches[micro] {
            let n = step * per_step as u64 + index as u64;
            let place = self.order.place(n / self.repeat.max(1) as u64);
            let sample = self.sources[place.set].read(place.clip)?;
            sample.check(&self.spec)?;
            let mut rng = stream(self.seed, "training.mask", step, index as u64);
            masks.push(self.masking.draw(&sample.present(&self.spec), &mut rng));
            samples.push(sample);
        }
        pack(&self.spec, &samples, &masks)
    }
}

/// Packs samples under their masks.
pub(super) fn pack(
    spec: &MgetSpec,
    samples: &[TokenSample],
    masks: &[Mask],
) -> Result<Batch, DataError> {
    let contents: Vec<_> = samples.iter().map(|sample| sample.contents(spec)).collect();
    Ok(Batch::new(spec, &contents, masks)?)
}

/// How many micro-batches `threads` threads hold at most while one is trained on.
#[must_use]
pub fn held_batches(threads: usize) -> usize {
    // What waits, and what is being made.
    threads.max(1) * (AHEAD + 1)
}

/// Micro-batches in order, from a first step on.
#[derive(Debug)]
pub struct Loader {
    channels: Vec<Receiver<Result<Batch, DataError>>>,
    threads: Vec<JoinHandle<()>>,
    next: usize,
    waited: f64,
}

impl Loader {
    /// Starts `threads` threads that prepare the micro-batches of steps `steps` that are `own` in each step.
    #[must_use]
    pub fn start(
        feed: &Arc<BatchSource>,
        steps: std::ops::Range<u64>,
        own: &[usize],
        threads: usize,
    ) -> Self {
        let threads = threads.max(1);
        let mut loader = Self {
            channels: Vec::new(),
            threads: Vec::new(),
            next: 0,
            waited: 0.0,
        };
        let micro_batches = own.len().max(1) as u64;
        for thread in 0..threads {
            let (sender, receiver) = sync_channel(AHEAD);
            let (feed, own) = (Arc::clone(feed), own.to_vec());
            let items = steps.start * micro_batches..steps.end * micro_batches;
            // Thread k prepares every item k, k + threads, ...: order needs no agreement between threads.
            let work = move || {
                for item in items.skip(thread).step_by(threads) {
                    let micro = own
                        .get((item % micro_batches) as usize)
                        .copied()
                        .unwrap_or(0);
                    let batch = feed.batch(item / micro_batches, micro);
                    let failed = batch.is_err();
                    if sender.send(batch).is_err() || failed {
                        return;
                    }
                }
            };
            loader.channels.push(receiver);
            loader.threads.push(std::thread::spawn(work));
        }
        loader
    }

    /// The next micro-batch; `clock` gives seconds.
    ///
    /// # Errors
    /// When a clip cannot be read or does not fit the model.
    pub fn next(&mut self, clock: &dyn Fn() -> f64) -> Result<Batch, DataError> {
        let start = clock();
        let received = self.channels[self.next].recv();
        self.waited += clock() - start;
        self.next = (self.next + 1) % self.channels.len();
        received.map_err(|_| DataError::Stopped)?
    }

    /// Seconds that [`Loader::next`] has waited so far.
    #[must_use]
    pub fn waited(&self) -> f64 {
        self.waited
    }
}

impl Drop for Loader {
    fn drop(&mut self) {
        // Without receivers the threads' next send fails and they end.
        self.channels.clear();
        for thread in self.threads.drain(..) {
            // A thread that panicked has already said so.
            let _ = thread.join();
        }
    }
}
