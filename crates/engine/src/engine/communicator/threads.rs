//! Ranks that are threads of one process.

use super::{Link, Pending, RankError};
use std::sync::{Arc, Condvar, Mutex, MutexGuard, PoisonError};

/// One rank.
pub(super) struct Threads {
    rank: usize,
    meeting: Arc<Meeting>,
}

/// Where they meet: each brings something, and all leave with everything.
struct Meeting {
    state: Mutex<State>,
    changed: Condvar,
}

#[derive(Clone)]
enum Brought {
    Bytes(Arc<Vec<u8>>),
    Values(Arc<Vec<f32>>),
}

struct State {
    brought: Vec<Option<Brought>>,
    gone: Vec<bool>,
    /// How many have taken everything with them; 0 until all are here.
    left: usize,
    complete: bool,
}

pub(super) fn links(size: usize) -> Vec<Threads> {
    let size = size.max(1);
    let meeting = Arc::new(Meeting {
        state: Mutex::new(State {
            brought: vec![None; size],
            gone: vec![false; size],
            left: 0,
            complete: false,
        }),
        changed: Condvar::new(),
    });
    let link = |rank| Threads {
        rank,
        meeting: Arc::clone(&meeting),
    };
    (0..size).map(link).collect()
}

impl Threads {
    fn state(&self) -> MutexGuard<'_, State> {
        // A rank that panicked is gone, and found so.
        let state = self.meeting.state.lock();
        state.unwrap_or_else(PoisonError::into_inner)
    }

    fn wait<'a>(&self, state: MutexGuard<'a, State>) -> MutexGuard<'a, State> {
        let state = self.meeting.changed.wait(state);
        state.unwrap_or_else(PoisonError::into_inner)
    }

    fn meet(&self, mine: Brought) -> Result<Vec<Brought>, RankError> {
        let mut state = self.state();
        // The last meeting is not over yet.
        while state.complete {
            state = self.wait(state);
        }
        let size = state.brought.len();
        state.brought[self.rank] = Some(mine);
        if state.brought.iter().all(Option::is_some) {
            state.complete = true;
            self.meeting.changed.notify_all();
        }
        while !state.complete {
            let missing = |rank: &usize| state.gone[*rank] && state.brought[*rank].is_none();
            if let Some(rank) = (0..size).find(missing) {
                return Err(RankError {
                    rank,
                    size,
                    host: String::new(),
                    reason: "it has left".to_owned(),
                });
            }
            state = self.wait(state);
        }
        let all = state.brought.iter().flatten().cloned().collect();
        state.left += 1;
        if state.left == size {
            state.left = 0;
            state.complete = false;
            state.brought.fill(None);
            self.meeting.changed.notify_all();
        }
        Ok(all)
    }

    fn values(&self, mine: Vec<f32>) -> Result<Vec<Arc<Vec<f32>>>, RankError> {
        let all = self.meet(Brought::Values(Arc::new(mine)))?;
        let values = all.into_iter().enumerate();
        let values = values.map(|(rank, brought)| match brought {
            Brought::Values(values) => Ok(values),
            Brought::Bytes(_) => Err(self.lost(rank)),
        });
        values.collect()
    }

    fn lost(&self, rank: usize) -> RankError {
        RankError {
            rank,
            size: self.size(),
            host: String::new(),
            reason: "it is not where the others are".to_owned(),
        }
    }
}

impl Link for Threads {
    fn rank(&self) -> usize {
        self.rank
    }

    fn size(&self) -> usize {
        self.state().brought.len()
    }

    fn local_rank(&self) -> usize {
        self.rank
    }

    fn gather(&self, bytes: Vec<u8>) -> Pending<Vec<Vec<u8>>> {
        let gathered = self.meet(Brought::Bytes(Arc::new(bytes))).and_then(|all| {
            let all = all.into_iter().enumerate();
            let bytes = all.map(|(rank, brought)| match brought {
                Brought::Bytes(bytes) => Ok(bytes.to_vec()),
                Brought::Values(_) => Err(self.lost(rank)),
            });
            bytes.collect()
        });
        Pending::Ready(gathered)
    }

    fn exchange(&self, values: Vec<f32>) -> Pending<Vec<f32>> {
        let part = values.len() / self.size();
        let mine = self.rank * part..(self.rank + 1) * part;
        let all = self.values(values);
        Pending::Ready(all.map(|all| {
            let parts = all.iter().map(|values| &values[mine.clone()]);
            parts.collect::<Vec<_>>().concat()
        }))
    }

    fn collect(&self, values: Vec<f32>) -> Pending<Vec<f32>> {
        let all = self.values(values);
        Pending::Ready(all.map(|all| {
            let all = all.iter().map(|values| values.as_slice());
            all.collect::<Vec<_>>().concat()
        }))
    }

    fn abort(&self, code: i32) {
        std::process::exit(code);
    }
}

impl Drop for Threads {
    fn drop(&mut self) {
        let rank = self.rank;
        self.state().gone[rank] = true;
        self.meeting.changed.notify_all();
    }
}
