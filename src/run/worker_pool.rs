//! Several stages at once: which one may begin, beside which others, and with how many threads.
//!
//! Small stages cannot use many cores; a sweep of them is done sooner side by side. What a stage makes does not depend on how
//! many threads it has, so neither does it depend on its neighbours.

use super::cache::Key;
use super::environment;
use super::error::RunError;
use super::schedule::Task;
use super::stage::peers::Peers;
use std::collections::BTreeMap;
use std::sync::{Condvar, Mutex, MutexGuard, PoisonError};

/// What the stages of one process may take of the machine together.
#[derive(Debug, Clone, Copy)]
pub struct WorkerPool {
    /// Stages at once, at most.
    pub jobs: usize,
    /// Threads of all stages together.
    pub threads: usize,
    /// Bytes of all stages together, as planned; one stage alone may exceed it.
    pub memory: Option<u64>,
    /// Other processes that do some stages together with this one.
    pub peers: Option<&'static dyn Peers>,
}

/// What went wrong.
#[derive(Debug, Default)]
pub struct Ended {
    /// Of single stages, in their order.
    pub failures: Vec<RunError>,
    /// Of everything.
    pub end: Option<RunError>,
}

/// More stages at once than this gain little, and each needs memory.
const MOST: usize = 4;

/// Stacks of threads are as large as the main thread's.
const STACK: usize = 8 << 20;

impl WorkerPool {
    /// `jobs` stages at once on this machine, in half of its memory. By default as many as there are cores, up to four; one
    /// where a GPU may do the work.
    #[must_use]
    pub fn of_this_machine(jobs: Option<usize>) -> Self {
        let threads = rayon::current_num_threads();
        let usual = if cfg!(any(feature = "cuda", feature = "vulkan")) {
            1
        } else {
            threads.min(MOST)
        };
        Self {
            jobs: jobs.unwrap_or(usual).max(1),
            threads,
            memory: environment::memory().map(|bytes| bytes / 2),
            peers: None,
        }
    }

    /// One stage after the other, some of them together with other processes.
    #[must_use]
    pub fn together(peers: &'static dyn Peers) -> Self {
        Self {
            peers: Some(peers),
            ..Self::alone()
        }
    }

    /// One stage after the other.
    #[must_use]
    pub fn alone() -> Self {
        Self::of_this_machine(Some(1))
    }

    /// Does all of `works`, inputs before their readers, with `make(place, work)`. What depends on something that failed is left
    /// out. After an error that `ends` everything the stages that run come to their end, and no other begins.
    pub fn work(
        &self,
        works: &[&Task],
        make: impl Fn(usize, &Task) -> Result<(), RunError> + Sync,
        ends: impl Fn(&RunError) -> bool + Sync,
    ) -> Ended {
        let board = Scheduler::new(self, works);
        std::thread::scope(|scope| {
            for _ in 1..self.jobs.min(works.len()) {
                let thread = std::thread::Builder::new().stack_size(STACK);
                // With fewer threads than hoped for the work takes longer, that is all.
                let _ = thread.spawn_scoped(scope, || board.serve(&make, &ends));
            }
            board.serve(&make, &ends);
        });
        board.outcome()
    }
}

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Status {
    Waiting,
    Running,
    Done,
    /// It failed, or something it depends on did.
    Failed,
}

/// Who does what.
struct Scheduler<'a> {
    crew: &'a WorkerPool,
    works: &'a [&'a Task],
    /// Places of the works that each one reads.
    inputs: Vec<Vec<usize>>,
    state: Mutex<State>,
    changed: Condvar,
}

struct State {
    standing: Vec<Status>,
    failures: BTreeMap<usize, RunError>,
    end: Option<RunError>,
}

impl<'a> Scheduler<'a> {
    fn new(crew: &'a WorkerPool, works: &'a [&'a Task]) -> Self {
        let places: BTreeMap<Key, usize> =
            works.iter().enumerate().map(|(i, w)| (w.key, i)).collect();
        Self {
            crew,
            works,
            inputs: works
                .iter()
                .map(|work| {
                    work.input_keys()
                        .filter_map(|key| places.get(&key).copied())
                        .collect()
                })
                .collect(),
            state: Mutex::new(State {
                standing: vec![Status::Waiting; works.len()],
                failures: BTreeMap::new(),
                end: None,
            }),
            changed: Condvar::new(),
        }
    }

    fn lock(&self) -> MutexGuard<'_, State> {
        self.state.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Takes one work after the other until nothing is left to take.
    fn serve(
        &self,
        make: &(impl Fn(usize, &Task) -> Result<(), RunError> + Sync),
        ends: &(impl Fn(&RunError) -> bool + Sync),
    ) {
        while let Some((place, threads)) = self.next() {
            let work = || make(place, self.works[place]);
            // Inside a pool even with all threads: from outside, every small operation would wait to be handed over.
            let pool = rayon::ThreadPoolBuilder::new()
                .num_threads(threads)
                .stack_size(STACK)
                .build();
            let made = match pool {
                Ok(pool) => pool.install(work),
                Err(_) => work(),
            };
            let mut state = self.lock();
            state.standing[place] = match made {
                Ok(()) => Status::Done,
                Err(error) => {
                    if ends(&error) {
                        state.end.get_or_insert(error);
                    } else {
                        state.failures.insert(place, error);
                    }
                    Status::Failed
                }
            };
            self.changed.notify_all();
        }
    }

    /// The next work and its threads; waits while what could come next depends on what still runs.
    fn next(&self) -> Option<(usize, usize)> {
        let mut state = self.lock();
        loop {
            if state.end.is_some() {
                return None;
            }
            let ready = self.ready(&mut state.standing);
            let running = state
                .standing
                .iter()
                .filter(|one| **one == Status::Running)
                .count();
            if let Some(&place) = ready
                .iter()
                .find(|place| self.fits(&state.standing, **place))
            {
                state.standing[place] = Status::Running;
                let beside = (running + ready.len()).min(self.crew.jobs);
                return Some((place, (self.crew.threads / beside).max(1)));
            }
            if running == 0 {
                return None;
            }
            state = self
                .changed
                .wait(state)
                .unwrap_or_else(PoisonError::into_inner);
        }
    }

    /// What waits and has all its inputs; marks what never will.
    fn ready(&self, standing: &mut [Status]) -> Vec<usize> {
        let mut ready = Vec::new();
        for place in 0..standing.len() {
            if standing[place] != Status::Waiting {
                continue;
            }
            let inputs = &self.inputs[place];
            if inputs
                .iter()
                .any(|&input| standing[input] == Status::Failed)
            {
                standing[place] = Status::Failed;
            } else if inputs.iter().all(|&input| standing[input] == Status::Done) {
                ready.push(place);
            }
        }
        ready
    }

    /// Whether there is memory for it beside what runs.
    fn fits(&self, standing: &[Status], place: usize) -> bool {
        let planned = |work: &Task| work.plan["memory"].as_u64().unwrap_or(0);
        let others: Vec<u64> = (0..standing.len())
            .filter(|&other| standing[other] == Status::Running)
            .map(|other| planned(self.works[other]))
            .collect();
        let together = others
            .iter()
            .fold(planned(self.works[place]), |a, b| a.saturating_add(*b));
        others.is_empty() || self.crew.memory.is_none_or(|most| together <= most)
    }

    fn outcome(self) -> Ended {
        let state = self
            .state
            .into_inner()
            .unwrap_or_else(PoisonError::into_inner);
        Ended {
            failures: state.failures.into_values().collect(),
            end: state.end,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::run::schedule::PortPlan;
    use serde_json::json;
    use std::sync::atomic::{AtomicUsize, Ordering::SeqCst};

    fn key(name: &str) -> Key {
        blake3::hash(name.as_bytes()).into()
    }

    fn work(name: &str, inputs: &[&str], memory: u64) -> Task {
        Task {
            key: key(name),
            stage: name.to_owned(),
            directory: name.to_owned(),
            cells: Vec::new(),
            op: "test".to_owned(),
            version: 1,
            kind: "clips".to_owned(),
            seed: 0,
            seeded: false,
            settings: json!({}).into(),
            inputs: vec![PortPlan {
                port: "in".to_owned(),
                from: inputs
                    .iter()
                    .map(|name| ((*name).to_owned(), key(name)))
                    .collect(),
            }],
            files: Vec::new(),
            data: Vec::new(),
            plan: json!({"memory": memory}),
        }
    }

    fn crew(jobs: usize) -> WorkerPool {
        WorkerPool {
            jobs,
            threads: 4,
            memory: Some(100),
            peers: None,
        }
    }

    fn failed() -> RunError {
        RunError::Request {
            message: "no".to_owned(),
            help: String::new(),
        }
    }

    #[test]
    fn inputs_come_first_and_readers_of_what_failed_are_left_out() {
        let works = [
            work("clips", &[], 0),
            work("bad", &["clips"], 0),
            work("good", &["clips"], 0),
            work("reader", &["good", "bad"], 0),
            work("last", &["good"], 0),
        ];
        let works: Vec<&Task> = works.iter().collect();
        for jobs in [1, 3] {
            let order = Mutex::new(Vec::new());
            let make = |_: usize, work: &Task| {
                order.lock().unwrap().push(work.stage.clone());
                if work.stage == "bad" {
                    Err(failed())
                } else {
                    Ok(())
                }
            };
            let ended = crew(jobs).work(&works, make, |_| false);
            assert!(ended.failures.len() == 1 && ended.end.is_none());
            let order = order.into_inner().unwrap();
            let at = |name: &str| order.iter().position(|one| one == name);
            assert!(at("clips") < at("bad") && at("clips") < at("good") && at("good") < at("last"));
            assert_eq!(at("reader"), None);
            assert_eq!(order.len(), 4);
        }
    }

    #[test]
    fn threads_are_shared_and_memory_is_respected() {
        let works = [
            work("large", &[], 80),
            work("larger", &[], 90),
            work("small", &[], 10),
        ];
        let works: Vec<&Task> = works.iter().collect();
        let (now, most) = (AtomicUsize::new(0), AtomicUsize::new(0));
        let make = |_: usize, work: &Task| {
            let planned = work.plan["memory"].as_u64().unwrap() as usize;
            most.fetch_max(now.fetch_add(planned, SeqCst) + planned, SeqCst);
            std::thread::sleep(std::time::Duration::from_millis(20));
            now.fetch_sub(planned, SeqCst);
            assert!(rayon::current_num_threads() <= 4);
            Ok(())
        };
        assert!(crew(2).work(&works, make, |_| false).failures.is_empty());
        assert!(most.into_inner() <= 100);
    }

    #[test]
    fn an_error_that_ends_everything_begins_nothing_more() {
        let works = [
            work("first", &[], 0),
            work("second", &[], 0),
            work("third", &[], 0),
        ];
        let works: Vec<&Task> = works.iter().collect();
        let begun = AtomicUsize::new(0);
        let make = |_: usize, _: &Task| {
            begun.fetch_add(1, SeqCst);
            Err(failed())
        };
        assert!(crew(1).work(&works, make, |_| true).end.is_some());
        assert_eq!(begun.into_inner(), 1);
    }
}
