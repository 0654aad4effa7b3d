//! How long work takes here: what this machine multiplies and moves per second, measured once and kept beside the cache, and how long
//! earlier runs took for what they had planned.

use crate::engine::ops::gemm::{Matrix, Threads, product};
use crate::run::environment::{self, Stopwatch};
use crate::run::schedule::Schedule;
use crate::run::stage::StageRecord;
use crate::run::{Cache, RunDirectory, State, files};
use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;
use std::path::Path;

/// What a machine does per second, with all its threads.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Machine {
    pub host: String,
    pub threads: usize,
    /// Floating point operations in products of matrices.
    pub products: f64,
    /// Bytes copied.
    pub memory: f64,
}

const FILE: &str = "machine.json";
/// Side of the matrices that are multiplied: small enough for a cache, as those of a training step are.
const SIDE: usize = 256;
/// Seconds that each measurement takes.
const LONG: f64 = 0.1;
/// How many times longer a training takes than its products alone, where no run has shown it: an estimate.
const USUAL: f64 = 3.0;

impl Machine {
    /// What was measured here before, or what is measured now.
    #[must_use]
    pub fn here(cache: &Cache) -> Self {
        let path = cache.root().join(FILE);
        let (host, threads) = (environment::host(), rayon::current_num_threads());
        if let Ok(known) = files::read_json::<Self>(&path)
            && known.host == host
            && known.threads == threads
        {
            return known;
        }
        let measured = Self {
            host,
            threads,
            products: rate(|| {
                let values = vec![0.5_f32; SIDE * SIDE];
                let of = || Matrix::rows(&values, SIDE, SIDE);
                std::hint::black_box(product(of(), of(), None, Threads::All));
                2.0 * (SIDE * SIDE * SIDE) as f64
            }),
            memory: rate(|| {
                let from = vec![1_u8; 1 << 22];
                std::hint::black_box(from.clone());
                2.0 * from.len() as f64
            }),
        };
        // Where nothing can be written, it is measured again.
        let _ = files::create_directory(cache.root())
            .and_then(|()| files::write_json(&path, &measured));
        measured
    }
}

/// How much of something `work` does per second.
fn rate(work: impl Fn() -> f64) -> f64 {
    work();
    let watch = Stopwatch::start();
    let mut done = 0.0;
    while watch.seconds() < LONG {
        done += work();
    }
    done / watch.seconds()
}

/// What earlier runs took, by kind of work.
#[derive(Debug, Clone, Default)]
pub struct History {
    /// Seconds of every run, and how many more per second of its products alone, by op, and by op and what it works on.
    by_products: BTreeMap<String, [f64; 2]>,
    /// Seconds per unit of work, by op and what it works on.
    by_work: BTreeMap<String, Vec<f64>>,
}

impl History {
    /// Of all finished stages of the runs in a folder.
    #[must_use]
    pub fn of(runs: &Path, machine: &Machine) -> Self {
        let mut history = Self::default();
        // Seconds that the products alone would have taken, and that it took.
        let mut products: BTreeMap<String, Vec<[f64; 2]>> = BTreeMap::new();
        for run in RunDirectory::all(runs).unwrap_or_default() {
            let Ok(schedule) = Schedule::read(&run) else {
                continue;
            };
            for work in &schedule.works {
                let directory = run.path().join("stages").join(&work.directory);
                let record = StageRecord::read(&directory);
                // Of one that was interrupted, not all seconds are known.
                let own = |r: &StageRecord| {
                    r.state == State::Done && r.found.is_none() && r.attempts <= 1
                };
                let Some(record) = record.filter(own).filter(|r| r.seconds > 0.0) else {
                    continue;
                };
                if let Some(flop) = work.plan["flop"].as_f64().filter(|flop| *flop > 0.0) {
                    let ideal = flop / machine.products;
                    for key in [
                        work.op.clone(),
                        one_modality(&work.op, work.settings.json()),
                    ] {
                        let seen = products.entry(key).or_default();
                        seen.push([ideal, record.seconds]);
                    }
                }
                if let Some(units) = work.plan["work"][0].as_f64().filter(|n| *n > 0.0) {
                    let key = kind(&work.op, work.settings.json());
                    let of_kind = history.by_work.entry(key).or_default();
                    of_kind.push(record.seconds / units);
                }
            }
        }
        let lines = products.into_iter();
        history.by_products = lines
            .filter_map(|(key, seen)| Some((key, line(&seen)?)))
            .collect();
        history
    }

    /// Seconds that a stage will take; `None` where nothing is known of its kind.
    #[must_use]
    pub fn seconds(
        &self,
        machine: &Machine,
        op: &str,
        settings: &serde_json::Value,
        flop: Option<f64>,
        units: Option<u64>,
    ) -> Option<f64> {
        if let Some(flop) = flop {
            let ideal = flop / machine.products;
            let known = self.by_products.get(&one_modality(op, settings));
            let known = known.or_else(|| self.by_products.get(op));
            let [start, factor] = known.copied().unwrap_or([0.0, USUAL]);
            return Some(start + factor * ideal);
        }
        let each = median(self.by_work.get(&kind(op, settings))?)?;
        Some(each * units? as f64)
    }
}

/// Trainings of one op on one modality take alike beside their products.
fn one_modality(op: &str, settings: &serde_json::Value) -> String {
    format!("{op} {}", part(settings, "modality"))
}

/// Work of one op on one modality with one batch has one price per unit.
fn kind(op: &str, settings: &serde_json::Value) -> String {
    let parts = ["modality", "batch", "decoding"].map(|key| part(settings, key));
    format!("{op} {}", parts.join(" "))
}

fn part(settings: &serde_json::Value, key: &str) -> String {
    settings
        .get(key)
        .map_or_else(|| "-".to_owned(), ToString::to_string)
}

/// How much ideals have to differ before they say what every run takes beside its products.
const APART: f64 = 1.5;

/// Seconds that every run of an op takes, and how many more per second of its products alone: the median slope between runs that
/// differ enough and the median of what is left, or, where that makes no sense, the median ratio.
fn line(seen: &[[f64; 2]]) -> Option<[f64; 2]> {
    let mut slopes = Vec::new();
    for (index, [x, y]) in seen.iter().enumerate() {
        for [other, took] in &seen[index + 1..] {
            if x.max(*other) > APART * x.min(*other) {
                slopes.push((took - y) / (other - x));
            }
        }
    }
    if let Some(slope) = median(&slopes).filter(|slope| *slope > 0.0) {
        let left: Vec<f64> = seen.iter().map(|[x, y]| y - slope * x).collect();
        if let Some(start) = median(&left).filter(|start| *start > 0.0) {
            return Some([start, slope]);
        }
    }
    let ratios: Vec<f64> = seen.iter().map(|[x, y]| y / x).collect();
    median(&ratios).map(|ratio| [0.0, ratio])
}

fn median(values: &[f64]) -> Option<f64> {
    let mut sorted = values.to_vec();
    sorted.sort_by(f64::total_cmp);
    sorted.get(sorted.len() / 2).copied()
}

#[cfg(test)]
mod tests {
    use super::*;
    use serde_json::json;

    #[test]
    fn earlier_runs_refine_what_the_machine_alone_would_say() {
        let machine = Machine {
            host: "here".into(),
            threads: 2,
            products: 1e9,
            memory: 1e9,
        };
        let mut history = History::default();
        let of = |history: &History, flop, units| {
            let settings = json!({"modality": "body", "batch": 8});
            history.seconds(&machine, "train_mget", &settings, flop, units)
        };
        assert_eq!(of(&history, Some(1e9), None), Some(USUAL));
        assert_eq!(of(&history, None, Some(10)), None);
        let of_products = |seen: Vec<[f64; 2]>| {
            let mut history = History::default();
            let line = line(&seen).unwrap();
            history.by_products.insert("train_mget".into(), line);
            of(&history, Some(2e9), None).unwrap()
        };
        assert!((of_products(vec![[4.0, 20.0]]) - 10.0).abs() < 1e-9);
        // Two seconds for itself, and three per second of products.
        let seen = vec![[1.0, 5.0], [4.0, 14.0], [10.0, 32.0]];
        assert!((of_products(seen) - 8.0).abs() < 1e-9);
        // One that is off changes little, and what is alike says nothing of its start.
        let seen = vec![
            [1.0, 5.0],
            [3.0, 0.5],
            [4.0, 14.0],
            [10.0, 32.0],
            [12.0, 38.0],
        ];
        assert!((of_products(seen) - 8.0).abs() < 1.0);
        assert!((of_products(vec![[4.0, 20.0], [4.1, 30.0], [4.2, 20.9]]) - 10.0).abs() < 0.1);
        let key = kind("train_mget", &json!({"modality": "body", "batch": 8}));
        history.by_work.insert(key, vec![0.5]);
        assert_eq!(of(&history, None, Some(10)), Some(5.0));
    }

    #[test]
    fn a_machine_is_measured_once() {
        let folder = tempfile::tempdir().unwrap();
        let cache = Cache::new(folder.path());
        let measured = Machine::here(&cache);
        assert!(
            measured.products > 1e6 && measured.memory > 1e6,
            "{measured:?}"
        );
        assert_eq!(Machine::here(&cache), measured);
    }
}
