//! What our side does when it is asked: takes times and the peak of memory, and says them as [`Line`]s.

use crate::peer::{Engine, Line, Measured};
use std::time::Instant;

/// Takes every measurement of one case.
#[derive(Debug)]
pub struct Meter {
    repeats: usize,
}

impl Meter {
    pub fn new(repeats: usize) -> Self {
        Self { repeats }
    }

    /// Measures `work`, after one call that is not counted.
    pub fn measure(&self, name: &str, work: impl FnMut()) {
        self.measure_flop(name, None, work);
    }

    /// The same of work whose operations were counted.
    pub fn measure_flop(&self, name: &str, flop: Option<f64>, mut work: impl FnMut()) {
        reset_peak();
        work();
        let mut faulted = Vec::new();
        let seconds = (0..self.repeats)
            .map(|_| {
                let (start, before) = (Instant::now(), faults());
                work();
                let seconds = start.elapsed().as_secs_f64();
                faulted.push(faults().zip(before).map(|(after, before)| after - before));
                seconds
            })
            .collect();
        say(&Line::Measured(Measured {
            name: name.to_owned(),
            seconds,
            flop,
            memory_mib: device_memory().or_else(peak),
            // The call to warm up is the first.
            faults: faulted.into_iter().skip(1).flatten().max(),
        }));
    }
}

/// Says what computes.
pub fn introduce() {
    say(&Line::Engine(Engine {
        version: env!("CARGO_PKG_VERSION").to_owned(),
        threads: rayon::current_num_threads(),
    }));
}

fn say(line: &Line) {
    let text = serde_json::to_string(line).expect("names and numbers are JSON");
    println!("{text}");
}

/// Lets the peak begin at what is in use now, where the system can; elsewhere it is that of all work so far.
fn reset_peak() {
    let _ = std::fs::write("/proc/self/clear_refs", "5");
}

/// What a GPU holds for this process in MiB, which never shrinks meanwhile; `None` for the processor.
fn device_memory() -> Option<f64> {
    let bytes = crate::compute().memory()?;
    Some(bytes as f64 / f64::from(1 << 20))
}

/// Peak of resident memory in MiB; `None` where the system does not tell.
fn peak() -> Option<f64> {
    let text = std::fs::read_to_string("/proc/self/status").ok()?;
    let line = text.lines().find_map(|line| line.strip_prefix("VmHWM:"))?;
    let kib: f64 = line.split_whitespace().next()?.parse().ok()?;
    Some(kib / 1024.0)
}

/// Minor page faults of this process so far; `None` where the system does not tell.
fn faults() -> Option<u64> {
    let text = std::fs::read_to_string("/proc/self/stat").ok()?;
    // The name before the last bracket may hold anything; the eighth field after it counts.
    let (_, fields) = text.rsplit_once(')')?;
    fields.split_whitespace().nth(7)?.parse().ok()
}
