//! Gradients added up over ranks.
//!
//! Each bucket of a gradient is cut into as many parts as there are ranks; every rank gets its part from all, adds them in the
//! order of ranks, and the sums are collected again: as many bytes on the wire as a ring, and one order of additions. Buckets
//! are on their way while the next is packed.

use super::{Communicator, Link, Pending, RankError};
use crate::engine::{Gradients, Parameters, parameters::to_host};
use burn::tensor::{Tensor, TensorData};
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;
use std::sync::Arc;

/// Values on the wire at a time: 25 MiB, as PyTorch's buckets are.
const BUCKET: usize = 25 * (1 << 20) / 4;

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

/// A running sum over ranks, of which this one holds its parts.
pub struct Sum {
    link: Arc<dyn Link>,
    buckets: Vec<Bucket>,
    /// Parts of the buckets that were added so far.
    parts: Option<Vec<Vec<f32>>>,
}

/// Parameters that travel together, and how many values they have.
struct Bucket {
    parameters: Vec<(String, usize)>,
    /// Values of one rank's part: all values, rounded up.
    part: usize,
}

impl Sum {
    /// An empty sum of gradients of `model`; `None` where there is one rank, which needs none.
    #[must_use]
    pub fn new<M: Parameters + ?Sized>(ranks: &Communicator, model: &M) -> Option<Self> {
        Self::in_buckets(ranks, model, BUCKET)
    }

    fn in_buckets<M: Parameters + ?Sized>(
        ranks: &Communicator,
        model: &M,
        most: usize,
    ) -> Option<Self> {
        let link = Arc::clone(ranks.link.as_ref()?);
        let mut buckets: Vec<(Vec<(String, usize)>, usize)> = Vec::new();
        let mut lengths = BTreeMap::new();
        model.visit("", &mut |name, parameter| {
            if parameter.is_tracked() {
                lengths.insert(name.to_owned(), parameter.flat().dims()[0]);
            }
        });
        for (name, length) in lengths {
            match buckets.last_mut() {
                Some((names, values)) if *values + length <= most => {
                    names.push((name, length));
                    *values += length;
                }
                _ => buckets.push((vec![(name, length)], length)),
            }
        }
        let size = link.size();
        let buckets = buckets.into_iter().map(|(parameters, values)| Bucket {
            parameters,
            part: values.div_ceil(size),
        });
        Some(Self {
            buckets: buckets.collect(),
            link,
            parts: None,
        })
    }

    /// Adds one gradient of every rank, in the order of ranks; `None` adds nothing.
    ///
    /// # Errors
    /// When a rank is lost.
    pub fn add(&mut self, gradients: Option<Gradients>) -> Result<(), RankError> {
        let pending: Vec<Pending<Vec<f32>>> = self
            .buckets
            .iter()
            .map(|bucket| {
                let values = bucket.pack(gradients.as_ref(), self.link.size());
                self.link.exchange(values)
            })
            .collect();
        drop(gradients);
        let mut sums = self.parts.take().unwrap_or_default().into_iter();
        let mut parts = Vec::new();
        for (bucket, pending) in self.buckets.iter().zip(pending) {
            let received = pending.wait()?;
            let mut received = received.chunks_exact(bucket.part.max(1));
            let first = || received.next().map(<[f32]>::to_vec).unwrap_or_default();
            let mut sum = sums.next().unwrap_or_else(first);
            for more in received {
                sum.iter_mut()
                    .zip(more)
                    .for_each(|(sum, more)| *sum += more);
            }
            parts.push(sum);
        }
        self.parts = Some(parts);
        Ok(())
    }

    /// The sum, on every rank.
    ///
    /// # Errors
    /// When a rank is lost.
    pub fn finish<M: Parameters + ?Sized>(self, model: &M) -> Result<Gradients, RankError> {
        let parts = self.parts.unwrap_or_default().into_iter();
        let pending: Vec<_> = parts.map(|part| self.link.collect(part)).collect();
        let mut values = BTreeMap::new();
        for (bucket, pending) in self.buckets.into_iter().zip(pending) {
            let all = pending.wait()?;
            let mut at = 0;
            for (name, length) in bucket.parameters {
                values.insert(name, all[at..at + length].to_vec());
                at += length;
            }
        }
        let mut gradients = BTreeMap::new();
        model.visit("", &mut |name, parameter| {
            if let Some(values) = values.remove(name) {
                let length = values.len();
                let device = parameter.untracked().device();
                let tensor = Tensor::from_data(TensorData::new(values, [length]), &device);
                gradients.insert(name.to_owned(), tensor);
            }
        });
        Ok(Gradients::from_map(gradients))
    }
}

impl Bucket {
    /// The values of the bucket, padded to a part for each of `size` ranks.
    fn pack(&self, gradients: Option<&Gradients>, size: usize) -> Vec<f32> {
        // x + -0.0 is x, also where x is -0.0: what adds nothing leaves no trace.
        let mut values = Vec::with_capacity(self.part * size);
        for (name, length) in &self.parameters {
            match gradients.and_then(|gradients| gradients.get(name)) {
                Some(tensor) => values.extend(to_host(tensor.clone())),
                None => values.resize(values.len() + length, -0.0),
            }
        }
        values.resize(self.part * size, -0.0);
        values
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
                    let mut sum = Sum::in_buckets(&ranks, &model, most).unwrap();
                    for n in ranks.own(12) {
                        sum.add(gradient(&model, n)).unwrap();
                    }
                    bits(&sum.finish(&model).unwrap())
                });
                for found in found {
                    assert_eq!(found, expected, "{size} ranks, buckets of {most}");
                }
            }
        }
    }
}
