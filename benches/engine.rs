//! The VQ-VAE of bodies at the paper's size (ViT-B): train step, forward pass and tokenising, beside PyTorch eager in f32.
//!
//! `cargo bench --bench engine -- --python PATH/TO/python` runs `benches/peer.py` in turns with our own measurements, with as
//! many threads, and prints the ratios (above 1: we are faster). Without `--python` it prints our numbers alone. Besides wall
//! time it prints processor time, which other programs on the machine disturb less.

use std::process::Command;
use std::time::Instant;

use reviv::engine::{Compute, Initialise};
use reviv::modality::Shape;
use reviv::tokenizer::trained::{Prepared, batch};
use reviv::tokenizer::vq::{Loss, VqSettings, VqVae};
use reviv::training::tokenizer::{TokenizerTraining, Trainer};

/// Clips per step.
const BATCH: usize = 8;
/// Measured repetitions per round, after one that is not counted.
const REPEATS: usize = 3;
/// Rounds in turns with the peer.
const ROUNDS: usize = 2;

/// The best of some repetitions: wall and processor seconds.
#[derive(Debug, Clone, Copy)]
struct Time {
    wall: f64,
    processor: f64,
}

impl Time {
    fn best(self, other: Self) -> Self {
        Self {
            wall: self.wall.min(other.wall),
            processor: self.processor.min(other.processor),
        }
    }
}

/// Seconds of processor time of this process so far; 0 where the system does not tell.
fn processor_seconds() -> f64 {
    let text = std::fs::read_to_string("/proc/self/stat").unwrap_or_default();
    let fields: Vec<&str> = text
        .rsplit(')')
        .next()
        .unwrap_or_default()
        .split_whitespace()
        .collect();
    let ticks = |i: usize| {
        fields
            .get(i)
            .and_then(|field| field.parse::<f64>().ok())
            .unwrap_or(0.0)
    };
    (ticks(11) + ticks(12)) / 100.0
}

/// Peak memory of this process in MB; 0 where the system does not tell.
fn peak_megabytes() -> f64 {
    let text = std::fs::read_to_string("/proc/self/status").unwrap_or_default();
    let line = text
        .lines()
        .find_map(|line| line.strip_prefix("VmHWM:"))
        .unwrap_or_default();
    line.split_whitespace()
        .next()
        .and_then(|kb| kb.parse::<f64>().ok())
        .unwrap_or(0.0)
        / 1024.0
}

fn time(mut run: impl FnMut()) -> Time {
    run();
    let mut best = Time {
        wall: f64::INFINITY,
        processor: f64::INFINITY,
    };
    for _ in 0..REPEATS {
        let (wall, processor) = (Instant::now(), processor_seconds());
        run();
        let once = Time {
            wall: wall.elapsed().as_secs_f64(),
            processor: processor_seconds() - processor,
        };
        best = best.best(once);
    }
    best
}

fn model(compute: &Compute) -> VqVae {
    let settings = VqSettings {
        codebook: 2048,
        compression: vec![2, 3],
        loss: Loss::Mse,
        ..VqSettings::default()
    };
    let shape = Shape::Kinematic {
        samples: 60,
        joints: 21,
    };
    VqVae::new(&Initialise::new(compute, 0), &settings, &shape).expect("the paper's size fits")
}

fn data() -> Vec<Prepared> {
    let value = |clip: usize, i: usize| ((clip * 3780 + i) as f32 * 0.017).sin();
    (0..BATCH)
        .map(|clip| Prepared {
            values: (0..60 * 21 * 3).map(|i| value(clip, i)).collect(),
            valid: None,
        })
        .collect()
}

/// Train step, forward, and encode alone.
fn ours() -> [Time; 3] {
    let compute = Compute::cpu();
    let (model, data) = (model(&compute), data());
    let clips = batch(&model, &data);
    let encode = time(|| {
        std::hint::black_box(model.encode(&clips));
    });
    let forward = time(|| {
        let ids = model.encode(&clips);
        std::hint::black_box(model.decode(&ids, BATCH).into_data());
    });
    let settings = TokenizerTraining {
        steps: 1000,
        batch: BATCH,
        ..TokenizerTraining::default()
    };
    let mut trainer = Trainer::new(model, &settings, 0).expect("a schedule of 1000 steps");
    let step = time(|| {
        trainer.step(&data).expect("finite data");
    });
    [step, forward, encode]
}

/// What the peer prints: a line `wall processor` per measurement, then its peak memory in MB.
fn theirs(python: &str) -> Option<([Time; 3], f64)> {
    let script = concat!(env!("CARGO_MANIFEST_DIR"), "/benches/peer.py");
    let threads = rayon::current_num_threads().to_string();
    let arguments = [script, &BATCH.to_string(), &REPEATS.to_string(), &threads];
    let output = Command::new(python).args(arguments).output().ok()?;
    let text = String::from_utf8_lossy(&output.stdout).into_owned();
    let numbers: Vec<f64> = text
        .split_whitespace()
        .filter_map(|word| word.parse().ok())
        .collect();
    let [a, b, c, d, e, f, memory] = numbers[..] else {
        eprintln!(
            "the peer failed: {}",
            String::from_utf8_lossy(&output.stderr)
        );
        return None;
    };
    let time = |wall, processor| Time { wall, processor };
    Some(([time(a, b), time(c, d), time(e, f)], memory))
}

/// Inside the pool, as stages of a run are.
fn main() {
    rayon::join(bench, || ());
}

fn bench() {
    let mut arguments = std::env::args().skip(1);
    let mut python = None;
    while let Some(argument) = arguments.next() {
        if argument == "--python" {
            python = arguments.next();
        }
    }
    let names = ["train step", "forward", "tokenise"];
    let mut own = ours();
    let mut peer = python.as_deref().and_then(theirs);
    for _ in 1..ROUNDS {
        let again = ours();
        own = std::array::from_fn(|i| own[i].best(again[i]));
        if let Some((times, memory)) = &mut peer
            && let Some((again, more)) = python.as_deref().and_then(theirs)
        {
            *times = std::array::from_fn(|i| times[i].best(again[i]));
            *memory = memory.max(more);
        }
    }
    println!(
        "VQ-VAE of bodies, ViT-B, {BATCH} clips, {} threads",
        rayon::current_num_threads()
    );
    for (i, name) in names.iter().enumerate() {
        print!(
            "{name:<12} {:.3} s wall, {:.2} s processor",
            own[i].wall, own[i].processor
        );
        if let Some((times, _)) = &peer {
            let (wall, processor) = (
                times[i].wall / own[i].wall,
                times[i].processor / own[i].processor,
            );
            print!(
                "; PyTorch {:.3} s, {:.2} s: {wall:.2}x wall, {processor:.2}x processor",
                times[i].wall, times[i].processor
            );
        }
        println!();
    }
    print!("peak memory  {:.0} MB", peak_megabytes());
    if let Some((_, memory)) = &peer {
        print!("; PyTorch {memory:.0} MB");
    }
    println!();
}
