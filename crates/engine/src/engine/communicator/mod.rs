//! Processes that train one model together, each with its own device: who they are, and what they tell each other.
//!
//! [`Communicator`] is what the rooms above see: alone, ranks that are threads of this process (what tests train with), or MPI
//! processes (feature `mpi`). Read in this order: this file; [`launch`], who started us and as what; [`reduce`], how gradients
//! are added up; [`shard`], who keeps which part of the optimizer's state; [`watch`], how a rank that is lost is found; `threads` and
//! `mpi`, the two ways to carry bytes; [`devices`] and `nccl`, how GPUs of NVIDIA add up gradients among themselves.
//!
//! Nothing is left to the library that carries the bytes: gradients are added here, in the order of ranks, so that what comes out
//! does not depend on an implementation of MPI or on the algorithm it picks (measured: six algorithms of OpenMPI give three
//! results for three ranks). NCCL is the exception: it adds up itself, and is not asked where an order is promised.

pub mod devices;
pub mod launch;
#[cfg(feature = "mpi")]
mod mpi;
#[cfg(feature = "cuda")]
mod nccl;
pub mod reduce;
pub mod shard;
mod threads;
pub mod watch;

use burn::tensor::Tensor;
use serde::{Serialize, de::DeserializeOwned};
use std::cell::RefCell;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::mpsc::Receiver;
use std::sync::{Arc, OnceLock};

/// Why ranks cannot go on together.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error("rank {rank} of {size}{}: {reason}", at(.host))]
pub struct RankError {
    /// Whose fault it is, counted from 0.
    pub rank: usize,
    /// How many ranks there are.
    pub size: usize,
    /// Where it runs; empty where that is not known.
    pub host: String,
    /// In its own words.
    pub reason: String,
}

fn at(host: &str) -> String {
    if host.is_empty() {
        String::new()
    } else {
        format!(" on `{host}`")
    }
}

/// What carries bytes between ranks. Every rank makes the same calls in the same order.
pub(crate) trait Link: Send + Sync {
    fn rank(&self) -> usize;
    fn size(&self) -> usize;
    /// The rank among those of this machine.
    fn local_rank(&self) -> usize;
    /// The bytes of every rank, by rank.
    fn gather(&self, bytes: Vec<u8>) -> Pending<Vec<Vec<u8>>>;
    /// `values` are as many equal parts as there are ranks, part `i` for rank `i`; what comes is what the ranks had for this one, by rank.
    fn exchange(&self, values: Vec<f32>) -> Pending<Vec<f32>>;
    /// The equally long values of every rank, one after the other, by rank.
    fn collect(&self, values: Vec<f32>) -> Pending<Vec<f32>>;
    /// This rank is where all ranks meet, by another way than this one.
    fn meet(&self) {}
    /// Whether this rank is in a step, where the others may not wait for it for long.
    fn stepping(&self, _: bool) {}
    /// Ends the connection, when all others do.
    fn finish(&self) -> Result<(), RankError> {
        Ok(())
    }
    /// Ends the whole job with this exit code, whatever the other ranks do.
    fn abort(&self, code: i32);
}

/// What adds up arrays of devices without the host. Every rank makes the same calls in the same order.
pub(crate) trait DeviceLink: Send + Sync {
    /// The sum over ranks of equally long arrays, each on the device of its rank.
    fn sum(&self, values: Tensor<1>) -> Result<Tensor<1>, RankError>;
}

/// What a link is about to have.
pub(crate) enum Pending<T> {
    Ready(Result<T, RankError>),
    #[cfg_attr(not(feature = "mpi"), allow(dead_code))]
    Later(Receiver<Result<T, RankError>>),
}

impl<T> Pending<T> {
    pub(crate) fn wait(self) -> Result<T, RankError> {
        match self {
            Self::Ready(result) => result,
            // The link ends the process before its thread goes; until then nothing is left to be told.
            Self::Later(receiver) => receiver.recv().unwrap_or_else(|_| {
                Err(RankError {
                    rank: 0,
                    size: 0,
                    host: String::new(),
                    reason: "the connection to the other ranks has ended".to_owned(),
                })
            }),
        }
    }
}

/// The ranks of a training. Clones are of the same rank.
#[derive(Clone, Default)]
pub struct Communicator {
    link: Option<Arc<dyn Link>>,
    /// What adds up arrays without the host, where there is such a thing.
    devices: Option<Arc<dyn DeviceLink>>,
    /// A failure that every rank has heard of, and that [`Communicator::settle`] has not cleared yet.
    failed: Arc<AtomicBool>,
}

impl std::fmt::Debug for Communicator {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(f, "rank {} of {}", self.rank(), self.size())
    }
}

/// The ranks that this process was started among.
static WORLD: OnceLock<Communicator> = OnceLock::new();

thread_local! {
    /// The rank that this thread is, where ranks are threads.
    static THREAD: RefCell<Option<Communicator>> = const { RefCell::new(None) };
}

/// What stands first in every gathered message.
const FINE: u8 = 0;
const FAILED: u8 = 1;

impl Communicator {
    /// One rank.
    #[must_use]
    pub fn alone() -> Self {
        Self::default()
    }

    /// The ranks that this process was started among, once [`launch::launch`] has found them; alone before.
    #[must_use]
    pub fn world() -> Self {
        let thread = THREAD.with_borrow(Clone::clone);
        thread.or_else(|| WORLD.get().cloned()).unwrap_or_default()
    }

    /// Does `work` as this rank: on this thread, [`Communicator::world`] is this one until it is done. For ranks that are threads.
    pub fn enter<T>(&self, work: impl FnOnce() -> T) -> T {
        /// Puts back what was there, also after a panic.
        struct Before(Option<Communicator>);
        impl Drop for Before {
            fn drop(&mut self) {
                THREAD.set(self.0.take());
            }
        }
        let _before = Before(THREAD.replace(Some(self.clone())));
        work()
    }

    /// Ranks that are threads of this process: one communicator for each.
    #[must_use]
    pub fn threads(size: usize) -> Vec<Self> {
        let links = threads::links(size).into_iter();
        links.map(|link| Self::of(Arc::new(link))).collect()
    }

    fn of(link: Arc<dyn Link>) -> Self {
        Self {
            link: Some(link),
            devices: None,
            failed: Arc::default(),
        }
    }

    /// This rank, from 0.
    #[must_use]
    pub fn rank(&self) -> usize {
        self.link.as_ref().map_or(0, |link| link.rank())
    }

    /// How many ranks there are.
    #[must_use]
    pub fn size(&self) -> usize {
        self.link.as_ref().map_or(1, |link| link.size())
    }

    /// The rank among those of this machine: the index of its device.
    #[must_use]
    pub fn local_rank(&self) -> usize {
        self.link.as_ref().map_or(0, |link| link.local_rank())
    }

    /// Whether this is rank 0, which owns the run directory, the progress and the record.
    #[must_use]
    pub fn is_root(&self) -> bool {
        self.rank() == 0
    }

    /// Which of `count` equal pieces of work are this rank's.
    pub fn own(&self, count: usize) -> impl Iterator<Item = usize> + use<> {
        (self.rank()..count).step_by(self.size())
    }

    /// The bytes of every rank, by rank.
    ///
    /// # Errors
    /// On every rank, where one of them failed (`mine` is an error there) or is lost.
    pub fn gather(&self, mine: Result<Vec<u8>, String>) -> Result<Vec<Vec<u8>>, RankError> {
        let (first, mut bytes) = match mine {
            Ok(bytes) => (FINE, bytes),
            Err(reason) => (FAILED, reason.into_bytes()),
        };
        bytes.insert(0, first);
        let mut all = match &self.link {
            None => vec![bytes],
            Some(link) => link.gather(bytes).wait()?,
        };
        for (rank, bytes) in all.iter_mut().enumerate() {
            let first = bytes.first().copied();
            bytes.drain(..bytes.len().min(1));
            if first != Some(FINE) {
                self.failed.store(true, Ordering::Relaxed);
                return Err(RankError {
                    rank,
                    size: self.size(),
                    host: String::new(),
                    reason: String::from_utf8_lossy(bytes).into_owned(),
                });
            }
        }
        Ok(all)
    }

    /// `of(index)` for every index below `count`, each computed by one rank and told to all.
    ///
    /// # Errors
    /// What `of` says on this rank, or on another.
    pub fn map<T, E>(
        &self,
        count: usize,
        mut of: impl FnMut(usize) -> Result<T, E>,
    ) -> Result<Vec<T>, E>
    where
        T: Serialize + DeserializeOwned,
        E: From<RankError> + std::fmt::Display,
    {
        let mine: Result<Vec<T>, E> = self.own(count).map(&mut of).collect();
        if self.link.is_none() {
            return mine;
        }
        let told = mine.as_ref().map_err(ToString::to_string);
        let told = told.and_then(|mine| serde_json::to_vec(mine).map_err(|e| e.to_string()));
        let all = self.gather(told);
        mine?;
        let mut parts = Vec::new();
        for (rank, bytes) in all?.iter().enumerate() {
            let part: Vec<T> =
                serde_json::from_slice(bytes).map_err(|error| self.odd(rank, &error))?;
            parts.push(part.into_iter());
        }
        let size = parts.len();
        (0..count)
            .map(|index| {
                let rank = index % size;
                let next = parts[rank].next();
                next.ok_or_else(|| self.odd(rank, &"too few results").into())
            })
            .collect()
    }

    /// Whether any rank says so.
    ///
    /// # Errors
    /// On every rank, where one of them failed or is lost.
    pub fn any(&self, mine: Result<bool, String>) -> Result<bool, RankError> {
        let all = self.gather(mine.map(|yes| vec![u8::from(yes)]))?;
        Ok(all.iter().any(|told| told.first() == Some(&1)))
    }

    /// What another rank sent makes no sense: it is not at the same place.
    pub fn odd(&self, rank: usize, reason: &dyn std::fmt::Display) -> RankError {
        RankError {
            rank,
            size: self.size(),
            host: String::new(),
            reason: format!("it is not where the others are ({reason})"),
        }
    }

    /// Marks a stretch of equal work on all ranks: where one of them does not come to its end, the job ends.
    pub fn stepping(&self, yes: bool) {
        if let Some(link) = &self.link {
            link.stepping(yes);
        }
    }

    /// The end of work that all ranks do together: says how it went on this rank, unless all know of a failure already.
    ///
    /// # Errors
    /// When another rank has failed.
    pub fn settle(&self, mine: Result<(), String>) -> Result<(), RankError> {
        self.stepping(false);
        if self.failed.swap(false, Ordering::Relaxed) {
            return Ok(());
        }
        let ended = self.gather(mine.map(|()| Vec::new())).map(drop);
        self.failed.store(false, Ordering::Relaxed);
        ended
    }

    /// Leaves, when all ranks do.
    ///
    /// # Errors
    /// When one is lost.
    pub fn finish(&self) -> Result<(), RankError> {
        self.link.as_ref().map_or(Ok(()), |link| link.finish())
    }

    /// Ends the job of all ranks with this exit code, whatever they do. Returns where this rank is alone.
    pub fn abort(&self, code: i32) {
        if let Some(link) = &self.link {
            link.abort(code);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// What `work` gives on each of `size` ranks.
    pub(super) fn on_ranks<T: Send>(
        size: usize,
        work: impl Fn(Communicator) -> T + Sync,
    ) -> Vec<T> {
        std::thread::scope(|scope| {
            let work = &work;
            let threads: Vec<_> = Communicator::threads(size)
                .into_iter()
                .map(|ranks| scope.spawn(move || work(ranks)))
                .collect();
            threads
                .into_iter()
                .map(|thread| thread.join().unwrap())
                .collect()
        })
    }

    #[test]
    fn work_that_is_shared_comes_back_in_order_on_every_rank() {
        let square = |ranks: Communicator| ranks.map(7, |i| Ok::<_, RankError>(i * i)).unwrap();
        let expected: Vec<usize> = (0..7).map(|i| i * i).collect();
        assert_eq!(square(Communicator::alone()), expected);
        for size in 1..5 {
            for found in on_ranks(size, square) {
                assert_eq!(found, expected);
            }
        }
    }

    #[test]
    fn a_rank_that_fails_is_named_on_all_and_they_go_on_together_after() {
        let found = on_ranks(3, |ranks| {
            let mine = if ranks.rank() == 1 {
                Err("no shard 7".to_owned())
            } else {
                Ok(Vec::new())
            };
            let error = ranks.gather(mine).unwrap_err();
            assert_eq!(ranks.settle(Err("seen already".into())), Ok(()));
            assert_eq!(ranks.settle(Ok(())), Ok(()));
            error.to_string()
        });
        for message in found {
            assert_eq!(message, "rank 1 of 3: no shard 7");
        }
    }

    #[test]
    fn a_thread_is_the_rank_that_it_has_entered_until_it_leaves() {
        let found = on_ranks(2, |ranks| {
            let inside =
                ranks.enter(|| (Communicator::world().rank(), Communicator::world().size()));
            (inside, Communicator::world().size())
        });
        assert_eq!(found, [((0, 2), 1), ((1, 2), 1)]);
    }

    #[test]
    fn a_rank_that_leaves_does_not_keep_the_others_waiting() {
        let found = on_ranks(2, |ranks| {
            (ranks.rank() == 0).then(|| ranks.gather(Ok(Vec::new())).unwrap_err().to_string())
        });
        assert_eq!(found[0].as_deref(), Some("rank 1 of 2: it has left"));
    }
}
