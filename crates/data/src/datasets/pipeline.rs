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

/// Makes one result for every position `0..count` on `threads` threads while `take` takes them in order on this one. At most
/// `2 * threads` results wait. When `take` returns, what has not been begun is left.
pub(super) fn in_order<T: Send, R>(
    count: usize,
    threads: usize,
    make: impl Fn(usize) -> T + Sync,
    take: impl FnOnce(&mut Results<'_, T>) -> R,
) -> R {
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
            let position = {
                let mut state = shared.state();
                while !state.over && state.begun < count && state.begun >= state.taken + 2 * threads
                {
                    state = shared.wait(state);
                }
                if state.over || state.begun >= count {
                    return;
                }
                state.begun += 1;
                state.begun - 1
            };
            // Left by a panic of `make`, it wakes everybody; left in order, it is forgotten.
            let guard = Guard(&shared);
            let result = make(position);
            std::mem::forget(guard);
            shared.state().ready.insert(position, result);
            shared.change.notify_all();
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
        assert!(most.load(Ordering::SeqCst) <= 9, "{most:?}");
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
