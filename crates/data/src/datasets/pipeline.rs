//! Work on all cores whose results are taken one after the other: in order, with few of them waiting, so that memory does not grow
//! with the length of the list.

use std::collections::BTreeMap;
use std::sync::{Condvar, Mutex, MutexGuard, PoisonError};

struct State<T> {
    /// The next position to be worked on, and the next to be taken.
    begun: usize,
    taken: usize,
    ready: BTreeMap<usize, T>,
    /// Nobody takes any more, or a worker is gone.
    over: bool,
}

struct Shared<T> {
    state: Mutex<State<T>>,
    change: Condvar,
}

impl<T> Shared<T> {
    fn state(&self) -> MutexGuard<'_, State<T>> {
        self.state.lock().unwrap_or_else(PoisonError::into_inner)
    }

    fn wait<'a>(&'a self, guard: MutexGuard<'a, State<T>>) -> MutexGuard<'a, State<T>> {
        self.change
            .wait(guard)
            .unwrap_or_else(PoisonError::into_inner)
    }
}

/// Ends the work when it is dropped, also by a panic.
struct Guard<'a, T>(&'a Shared<T>);

impl<T> Drop for Guard<'_, T> {
    fn drop(&mut self) {
        self.0.state().over = true;
        self.0.change.notify_all();
    }
}

/// Results in the order of the list.
pub(super) struct Results<'a, T> {
    shared: &'a Shared<T>,
    count: usize,
}

impl<T> Iterator for Results<'_, T> {
    type Item = T;

    fn next(&mut self) -> Option<T> {
        let mut state = self.shared.state();
        if state.taken >= self.count {
            return None;
        }
        let wanted = state.taken;
        loop {
            if let Some(result) = state.ready.remove(&wanted) {
                state.taken += 1;
                self.shared.change.notify_all();
                return Some(result);
            }
            if state.over {
                return None;
            }
            state = self.shared.wait(state);
        }
    }
}

/// Positions that a thread works on one after the other: clips that follow each other are cut from one video, which is then decoded
/// in order instead of from a key frame for each of them.
const RUN: usize = 4;

/// Makes one result for every position `0..count` on `threads` threads while `take` takes them in order on this one. At most
/// `RUN * (threads + 1)` results wait. When `take` returns, what has not been begun is left.
pub(super) fn in_order<T: Send, R>(
    count: usize,
    threads: usize,
    make: impl Fn(usize) -> T + Sync,
    take: impl FnOnce(&mut Results<'_, T>) -> R,
) -> R {
    // Few positions are spread over all threads.
    let run = RUN.min(count.div_ceil(threads.max(1))).max(1);
    let threads = threads.clamp(1, count.max(1));
    let shared = Shared {
        state: Mutex::new(State {
            begun: 0,
            taken: 0,
            ready: BTreeMap::new(),
            over: false,
        }),
        change: Condvar::new(),
    };
    let work = || {
        loop {
            let positions = {
                let mut state = shared.state();
                let full = |state: &State<T>| state.begun > state.taken + run * threads;
                while !state.over && state.begun < count && full(&state) {
                    state = shared.wait(state);
                }
                if state.over || state.begun >= count {
                    return;
                }
                let first = state.begun;
                state.begun = (first + run).min(count);
                first..state.begun
            };
            for position in positions {
                // Left by a panic of `make`, it wakes everybody; left in order, it is forgotten.
                let guard = Guard(&shared);
                let result = make(position);
                std::mem::forget(guard);
                let mut state = shared.state();
                state.ready.insert(position, result);
                let over = state.over;
                drop(state);
                shared.change.notify_all();
                if over {
                    return;
                }
            }
        }
    };
    std::thread::scope(|scope| {
        for _ in 0..threads {
            scope.spawn(work);
        }
        let _guard = Guard(&shared);
        take(&mut Results {
            shared: &shared,
            count,
        })
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::sync::atomic::{AtomicUsize, Ordering};
    use std::time::Duration;

    #[test]
    fn results_come_in_order_and_few_of_them_wait() {
        let (alive, most) = (AtomicUsize::new(0), AtomicUsize::new(0));
        let make = |position: usize| {
            most.fetch_max(alive.fetch_add(1, Ordering::SeqCst) + 1, Ordering::SeqCst);
            std::thread::sleep(Duration::from_micros(((position * 7) % 5) as u64 * 100));
            position
        };
        let taken: Vec<usize> = in_order(200, 4, make, |results| {
            results
                .inspect(|_| {
                    alive.fetch_sub(1, Ordering::SeqCst);
                })
                .collect()
        });
        assert_eq!(taken, (0..200).collect::<Vec<_>>());
        assert!(most.load(Ordering::SeqCst) <= RUN * 5 + 1, "{most:?}");
    }

    #[test]
    fn who_stops_taking_stops_the_work() {
        let made = AtomicUsize::new(0);
        let first = in_order(
            100_000,
            3,
            |_| made.fetch_add(1, Ordering::SeqCst),
            |results| results.take(5).count(),
        );
        assert_eq!(first, 5);
        assert!(made.load(Ordering::SeqCst) < 50);
        assert_eq!(in_order(0, 3, |p| p, |results| results.count()), 0);
    }

    #[test]
    #[should_panic(expected = "a scoped thread panicked")]
    fn a_panic_of_a_worker_is_not_a_wait_for_ever() {
        in_order(10, 2, |p| assert!(p != 3), |results| results.count());
    }
}
