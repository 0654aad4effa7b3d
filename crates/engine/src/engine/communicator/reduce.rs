//! Gradients added up over ranks, while backward goes on.
//!
//! Parameters travel in buckets, in the order in which backward completes their gradients. Each bucket is cut into as many parts as
//! there are ranks; every rank gets its part from all, adds them in the order of ranks, and the sums are collected again: as many
//! bytes on the wire as a ring, and one order of additions. A thread of its own does that with a bucket as soon as it is full, so
//! that it is on its way while backward fills the next.
//!
//! Which values a bucket has and when it is sent changes no bit of a sum: a number is added in the order of ranks wherever it lies.
//!
//! Where devices add up arrays among themselves ([`super::devices`]), a bucket stays on them; their library chooses the order.

use super::{Communicator, DeviceLink, Link, RankError};
use crate::engine::{Gradients, Parameters, parameters::to_host};
use burn::tensor::{Device, Tensor, TensorData};
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;
use std::sync::Arc;
use std::sync::mpsc::{Receiver, Sender, channel};
use std::thread::JoinHandle;

/// Values on the wire at a time, at most: 25 MiB, as PyTorch's buckets are.
pub(super) const BUCKET: usize = 25 * (1 << 20) / 4;

/// Values that a rank sends to another at a time, at least: 1 MiB, which takes much longer than its message is late. Of few ranks
/// buckets are smaller for it: they are added while they are in the cache, and less is left to do when backward ends.
const PART: usize = (1 << 20) / 4;

/// Values of a bucket of so many ranks.
fn bucket(ranks: usize) -> usize {
    BUCKET.min(ranks * PART)
}

/// In which order gradients of micro-batches are added over ranks. One rank always adds them in the order of samples.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "snake_case")]
pub enum Reduction {
    /// Each rank adds its own first, then ranks are added in their order: the same bytes from run to run on the same number of
    /// ranks.
    #[default]
    Fast,
    /// In the order of samples: the same bytes on any number of ranks. One more exchange of a gradient for each micro-batch of a
    /// rank but its first.
    Ordered,
}

/// A sum over ranks, in rounds: each adds one gradient of every rank, in the order of ranks.
#[derive(Debug)]
pub struct Sum {
    places: BTreeMap<String, Place>,
    buckets: Vec<Bucket>,
    /// The first bucket of this round that was not sent yet.
    next: usize,
    full: Sender<Vec<Piece>>,
    ended: Receiver<()>,
    /// `None` once it was heard.
    worker: Option<JoinHandle<Result<Vec<Tensor<1>>, RankError>>>,
}

/// Where the gradient of a parameter travels.
#[derive(Debug)]
struct Place {
    bucket: usize,
    start: usize,
    length: usize,
    /// It is in the bucket of this round.
    there: bool,
}

/// Values that travel together.
#[derive(Debug, Default)]
struct Bucket {
    /// How many there are; on the wire they are padded to equal parts.
    length: usize,
    parameters: usize,
    /// Of this round, as far as they are there.
    pieces: Vec<Piece>,
}

/// This rank's gradient of one parameter.
#[derive(Debug)]
struct Piece {
    /// Where it stands in its bucket, and how long it is.
    start: usize,
    length: usize,
    /// Of all micro-batches but the last, and of the last; neither adds nothing.
    earlier: Option<Tensor<1>>,
    last: Option<Tensor<1>>,
}

impl Piece {
    fn sum(&self) -> Option<Tensor<1>> {
        match (&self.earlier, &self.last) {
            (Some(sum), Some(more)) => Some(sum.clone() + more.clone()),
            (sum, more) => sum.as_ref().or(more.as_ref()).cloned(),
        }
    }
}

/// The values of a bucket, on their device.
fn joined(mut pieces: Vec<Piece>, device: &Device) -> Tensor<1> {
    pieces.sort_unstable_by_key(|piece| piece.start);
    let sums = pieces.iter().map(|piece| {
        let sum = piece.sum();
        sum.unwrap_or_else(|| Tensor::full([piece.length], -0.0, device))
    });
    Tensor::cat(sums.collect(), 0)
}

/// The values of a bucket, on the host.
fn packed(mut pieces: Vec<Piece>) -> Vec<f32> {
    pieces.sort_unstable_by_key(|piece| piece.start);
    let sums: Vec<Option<Tensor<1>>> = pieces.iter().map(Piece::sum).collect();
    // One wait for a device, and not one for each parameter.
    let all: Option<Vec<Tensor<1>>> = sums.iter().cloned().collect();
    if let Some(all) = all.filter(|all| !all.is_empty()) {
        return to_host(Tensor::cat(all, 0));
    }
    let mut values = Vec::new();
    for (piece, sum) in pieces.iter().zip(sums) {
        match sum {
            Some(sum) => values.extend(to_host(sum)),
            // x + -0.0 is x, also where x is -0.0: what adds nothing leaves no trace.
            None => values.resize(values.len() + piece.length, -0.0),
        }
    }
    values
}

impl Sum {
    /// An empty sum of gradients of `model` in so many rounds; `None` where there is one rank, which needs none. Backward completes
    /// gradients about in the `order` of these names.
    #[must_use]
    pub fn new<M: Parameters + ?Sized>(
        ranks: &Communicator,
        model: &M,
        order: &[String],
        rounds: usize,
    ) -> Option<Self> {
        let most = match ranks.devices {
            Some(_) => BUCKET,
            None => bucket(ranks.size()),
        };
        Self::in_buckets(ranks, model, order, rounds, most)
    }

    fn in_buckets<M: Parameters + ?Sized>(
        ranks: &Communicator,
        model: &M,
        order: &[String],
        rounds: usize,
        most: usize,
    ) -> Option<Self> {
        let link = Arc::clone(ranks.link.as_ref()?);
        let mut lengths = BTreeMap::new();
        let mut device = None;
        model.visit("", &mut |name, parameter| {
            if parameter.is_tracked() {
                lengths.insert(name.to_owned(), parameter.len());
                device.get_or_insert_with(|| parameter.untracked().device());
            }
        });
        let mut buckets: Vec<Bucket> = Vec::new();
        let mut places = BTreeMap::new();
        let known = order.iter().filter_map(|name| lengths.remove_entry(name));
        // What the order does not name comes last.
        let known: Vec<(String, usize)> = known.collect();
        for (name, length) in known.into_iter().chain(lengths) {
            let full = |bucket: &Bucket| bucket.length + length > most;
            if buckets.last().is_none_or(full) {
                buckets.push(Bucket::default());
            }
            let index = buckets.len() - 1;
            let bucket = &mut buckets[index];
            let place = Place {
                bucket: index,
                start: bucket.length,
                length,
                there: false,
            };
            bucket.length += length;
            bucket.parameters += 1;
            places.insert(name, place);
        }
        let lengths = buckets.iter().map(|bucket| bucket.length).collect();
        let (sender, received) = channel();
        let (end, ended) = channel();
        // Several rounds are there for an order, which is ours to keep.
        let devices = ranks.devices.clone().filter(|_| rounds == 1);
        let device = device.unwrap_or_default();
        let work = move || {
            let worker = Worker::new(link, lengths, device, end);
            match devices {
                Some(devices) => worker.run_on(devices.as_ref(), &received),
                None => worker.run(rounds, &received),
            }
        };
        Some(Self {
            places,
            buckets,
            next: 0,
            full: sender,
            ended,
            worker: Some(std::thread::spawn(work)),
        })
    }

    /// This rank's gradient of one parameter is complete: the sum of what there is of it. Nothing at all adds nothing.
    pub fn put(&mut self, name: &str, earlier: Option<&Tensor<1>>, last: Option<&Tensor<1>>) {
        let Some(place) = self.places.get_mut(name).filter(|place| !place.there) else {
            return;
        };
        place.there = true;
        self.buckets[place.bucket].pieces.push(Piece {
            start: place.start,
            length: place.length,
            earlier: earlier.cloned(),
            last: last.cloned(),
        });
        // In one order on all ranks.
        while let Some(bucket) = self.buckets.get_mut(self.next)
            && bucket.pieces.len() == bucket.parameters
        {
            // Where the worker has ended, the end of the round says why.
            let _ = self.full.send(std::mem::take(&mut bucket.pieces));
            self.next += 1;
        }
    }

    /// Ends a round: whatever was not put is taken from these gradients, and once this returns all ranks may talk of something else.
    ///
    /// # Errors
    /// When a rank is lost.
    pub fn end_round(
        &mut self,
        earlier: Option<&Gradients>,
        last: Option<&Gradients>,
    ) -> Result<(), RankError> {
        let names: Vec<String> = self.places.keys().cloned().collect();
        for name in &names {
            let of =
                |gradients: Option<&Gradients>| gradients.and_then(|all| all.get(name)).cloned();
            self.put(name, of(earlier).as_ref(), of(last).as_ref());
        }
        self.next = 0;
        for place in self.places.values_mut() {
            place.there = false;
        }
        match self.ended.recv() {
            Ok(()) => Ok(()),
            // It ends before a round does only where a rank is lost.
            Err(_) => Err(self.join().err().unwrap_or_else(gone)),
        }
    }

    /// The sum, on every rank.
    ///
    /// # Errors
    /// When a rank is lost.
    pub fn finish<M: Parameters + ?Sized>(mut self, model: &M) -> Result<Gradients, RankError> {
        let all = self.join()?;
        let mut gradients = BTreeMap::new();
        model.visit("", &mut |name, _| {
            if let Some(place) = self.places.get(name) {
                let sum = all[place.bucket].clone();
                let sum = sum.narrow(0, place.start, place.length);
                gradients.insert(name.to_owned(), sum);
            }
        });
        Ok(Gradients::from_map(gradients))
    }

    /// What the worker leaves.
    fn join(&mut self) -> Result<Vec<Tensor<1>>, RankError> {
        match self.worker.take().map(JoinHandle::join) {
            Some(Ok(sums)) => sums,
            // What the tensor library panics with is said on this thread, as without a worker.
            Some(Err(panic)) => std::panic::resume_unwind(panic),
            None => Err(gone()),
        }
    }
}

fn gone() -> RankError {
    RankError {
        rank: 0,
        size: 0,
        host: String::new(),
        reason: "the thread that adds gradients has ended".to_owned(),
    }
}

/// What adds up buckets beside backward.
struct Worker {
    link: Arc<dyn Link>,
    /// Values of each bucket.
    lengths: Vec<usize>,
    /// Where gradients are.
    device: Device,
    /// This rank's parts of the sums so far.
    parts: Vec<Vec<f32>>,
    ended: Sender<()>,
}

impl Worker {
    fn new(link: Arc<dyn Link>, lengths: Vec<usize>, device: Device, ended: Sender<()>) -> Self {
        Self {
            link,
            parts: vec![Vec::new(); lengths.len()],
            lengths,
            device,
            ended,
        }
    }

    /// The sums of all buckets; nothing where this rank gives up before the last round.
    fn run(
        mut self,
        rounds: usize,
        buckets: &Receiver<Vec<Piece>>,
    ) -> Result<Vec<Tensor<1>>, RankError> {
        let size = self.link.size();
        let mut collecting = Vec::new();
        for round in 1..=rounds {
            // One bucket travels while the one before it is added; in an order that is the same on all ranks, whoever is first.
            let mut travelling = None;
            for index in 0..=self.lengths.len() {
                let next = match self.lengths.get(index) {
                    None => None,
                    Some(length) => {
                        let Ok(pieces) = buckets.recv() else {
                            return Ok(Vec::new());
                        };
                        let mut values = packed(pieces);
                        values.resize(length.div_ceil(size) * size, -0.0);
                        Some((index, self.link.exchange(values)))
                    }
                };
                let before = std::mem::replace(&mut travelling, next);
                let Some((index, pending)) = before else {
                    continue;
                };
                self.add(index, &pending.wait()?);
                if round == rounds {
                    let part = std::mem::take(&mut self.parts[index]);
                    collecting.push(self.link.collect(part));
                }
            }
            if self.ended.send(()).is_err() {
                return Ok(Vec::new());
            }
        }
        let sums = collecting.into_iter();
        let sums = sums.map(|sum| {
            let values = sum.wait()?;
            let length = values.len();
            let data = TensorData::new(values, [length]);
            Ok(Tensor::from_data(data, &self.device))
        });
        sums.collect()
    }

    /// The sums of all buckets of one round, which never leave their devices.
    fn run_on(
        self,
        devices: &dyn DeviceLink,
        buckets: &Receiver<Vec<Piece>>,
    ) -> Result<Vec<Tensor<1>>, RankError> {
        let mut sums = Vec::new();
        for _ in &self.lengths {
            let Ok(pieces) = buckets.recv() else {
                return Ok(Vec::new());
            };
            let values = joined(pieces, &self.device);
            // The library of the devices waits for a rank that hangs for ever; so it is seen that this one does not.
            self.link.meet();
            sums.push(devices.sum(values)?);
        }
        // Where the round is over for this rank, nobody listens.
        let _ = self.ended.send(());
        Ok(sums)
    }

    /// Adds what the ranks have for this one, in their order.
    fn add(&mut self, index: usize, received: &[f32]) {
        let part = self.lengths[index].div_ceil(self.link.size());
        let mut received = received.chunks_exact(part.max(1));
        let sum = &mut self.parts[index];
        if sum.is_empty() {
            sum.extend(received.next().unwrap_or_default());
        }
        for more in received {
            let sum = sum.iter_mut().zip(more);
            sum.for_each(|(sum, more)| *sum += more);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::super::tests::on_ranks;
    use super::*;
    use crate::engine::{Compute, Initialise};
    use crate::nn::Linear;

    fn model() -> Linear {
        let mut model = Linear::new(&Initialise::new(&Compute::cpu(), 1), 5, 3, true);
        model.start_training();
        model
    }

    /// The gradient of micro-batch `n`: values whose sum depends on the order; every fourth asks for nothing.
    fn gradient(model: &Linear, n: usize) -> Option<Gradients> {
        let mut map = BTreeMap::new();
        model.visit("", &mut |name, parameter| {
            let flat = parameter.flat();
            let values: Vec<f32> = (0..flat.dims()[0])
                .map(|i| ((n * 31 + i * 7) as f32).sin() * 10_f32.powi((n % 5) as i32))
                .collect();
            let length = values.len();
            let data = TensorData::new(values, [length]);
            map.insert(name.to_owned(), Tensor::from_data(data, &flat.device()));
        });
        (n % 4 != 1).then(|| Gradients::from_map(map))
    }

    fn bits(gradients: &Gradients) -> Vec<u32> {
        let tensors = gradients.iter();
        let values = tensors.flat_map(|(_, tensor)| to_host(tensor.clone()));
        values.map(f32::to_bits).collect()
    }

    #[test]
    fn sums_in_the_order_of_samples_are_those_of_one_rank_to_the_bit() {
        let one = model();
        let expected = (0..12).filter_map(|n| gradient(&one, n));
        let expected = bits(&expected.reduce(Gradients::plus).unwrap());
        for size in 1..5 {
            for most in [4, 1000] {
                let found = on_ranks(size, |ranks| {
                    let model = model();
                    let rounds = 12 / size;
                    let mut sum = Sum::in_buckets(&ranks, &model, &[], rounds, most).unwrap();
                    for n in ranks.own(12) {
                        sum.end_round(None, gradient(&model, n).as_ref()).unwrap();
                    }
                    bits(&sum.finish(&model).unwrap())
                });
                for found in found {
                    assert_eq!(found, expected, "{size} ranks, buckets of {most}");
                }
            }
        }
    }

    #[test]
    fn neither_the_order_nor_the_time_of_what_is_put_changes_a_bit() {
        let orders: [&[&str]; 3] = [&[], &["weight", "bias"], &["bias"]];
        let sum = |order: &[&str], early: &[&str]| {
            let order: Vec<String> = order.iter().map(ToString::to_string).collect();
            let found = on_ranks(3, |ranks| {
                let model = model();
                let rank = ranks.rank();
                let mut sum = Sum::in_buckets(&ranks, &model, &order, 1, 7).unwrap();
                let (first, last) = (gradient(&model, 2 * rank), gradient(&model, 2 * rank + 4));
                let of = |all: &Option<Gradients>, name| {
                    all.as_ref().and_then(|all| all.get(name).cloned())
                };
                for name in early {
                    sum.put(name, of(&first, name).as_ref(), of(&last, name).as_ref());
                }
                sum.end_round(first.as_ref(), last.as_ref()).unwrap();
                bits(&sum.finish(&model).unwrap())
            });
            assert!(found.iter().all(|other| *other == found[0]));
            found.into_iter().next().unwrap()
        };
        let expected = sum(&[], &[]);
        for order in orders {
            for early in orders {
                assert_eq!(sum(order, early), expected, "{order:?} {early:?}");
            }
        }
    }

    #[test]
    fn buckets_are_added_while_others_are_not_there_yet() {
        let found = on_ranks(2, |ranks| {
            let model = model();
            let order = ["bias", "weight"].map(str::to_owned);
            let mut sum = Sum::in_buckets(&ranks, &model, &order, 1, 4).unwrap();
            let gradient = gradient(&model, 0).unwrap();
            sum.put("bias", None, gradient.get("bias"));
            // Nothing but the first bucket was sent: it alone was exchanged.
            let sent = sum.next;
            sum.end_round(None, Some(&gradient)).unwrap();
            (sent, sum.finish(&model).unwrap().iter().count())
        });
        assert_eq!(found, [(1, 2), (1, 2)]);
    }

    #[test]
    fn a_rank_that_gives_up_in_a_round_is_named_by_the_others() {
        let found = on_ranks(2, |ranks| {
            let model = model();
            let mut sum = Sum::in_buckets(&ranks, &model, &[], 1, 4).unwrap();
            let gradient = gradient(&model, 0);
            if ranks.rank() == 1 {
                sum.put(
                    "bias",
                    None,
                    gradient.as_ref().and_then(|all| all.get("bias")),
                );
                return String::new();
            }
            sum.end_round(None, gradient.as_ref())
                .unwrap_err()
                .to_string()
        });
        assert_eq!(found[0], "rank 1 of 2: it has left");
    }

    /// Adds up as a library of devices would, over the link of the ranks.
    struct OverLink(Arc<dyn Link>);

    impl DeviceLink for OverLink {
        fn sum(&self, values: Tensor<1>) -> Result<Tensor<1>, RankError> {
            let (device, length) = (values.device(), values.dims()[0]);
            let all = self.0.collect(to_host(values)).wait()?;
            let parts = all
                .chunks_exact(length)
                .map(|part| Tensor::from_data(TensorData::new(part.to_vec(), [length]), &device));
            Ok(parts.reduce(|sum: Tensor<1>, more| sum + more).unwrap())
        }
    }

    #[test]
    fn buckets_that_stay_on_devices_have_the_sums_of_those_that_travel_and_an_order_is_kept_on_the_host()
     {
        for rounds in [1, 2] {
            let found = on_ranks(3, |ranks| {
                let model = model();
                let order = ["bias", "weight"].map(str::to_owned);
                let sum = |ranks: &Communicator| {
                    let mut sum = Sum::in_buckets(ranks, &model, &order, rounds, 4).unwrap();
                    for round in 0..rounds {
                        // Rank 1 has nothing in the first round, and nothing for the bias before.
                        let last = gradient(&model, ranks.rank() + 4 * round);
                        sum.put("bias", None, last.as_ref().and_then(|all| all.get("bias")));
                        let earlier = gradient(&model, ranks.rank() + 8);
                        sum.end_round(earlier.as_ref(), last.as_ref()).unwrap();
                    }
                    bits(&sum.finish(&model).unwrap())
                };
                let host = sum(&ranks);
                let link = ranks.link.clone().unwrap();
                let ranks = Communicator {
                    devices: Some(Arc::new(OverLink(link))),
                    ..ranks
                };
                (host, sum(&ranks))
            });
            for (host, devices) in found {
                assert_eq!(host, devices, "{rounds} rounds");
            }
        }
    }
}
