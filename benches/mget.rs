//! One training step and one forward pass of MGET, beside the same computation in plain PyTorch, and what packing saves.
//!
//! `cargo bench --bench mget -- [tiny] [base] [packing] [--threads N]`; with `REVIV_TORCH_PYTHON` naming a Python that has
//! PyTorch, `benches/peer_mget.py` runs in between ours, so both see the same machine.

use std::process::Command;
use std::time::Instant;

use reviv::engine::{Compute, Gradients, Initialise, Parameters};
use reviv::masking::{Mask, Masking, MaskingSettings, Overflow, TokenBudget};
use reviv::mget::{Batch, Content, Loss, Mget, MgetSpec, ModalitySpec, Positions, Size};
use reviv::random::stream;
use reviv::training::{AdamW, AdamWSettings};

/// Name, width, heads, depth, batch, tokens on each side, repetitions.
const CASES: [(&str, usize, usize, usize, usize, usize, usize); 2] = [
    ("tiny", 384, 6, 6, 8, 256, 5),
    ("base", 768, 12, 12, 1, 1024, 3),
];

fn spec(width: usize, heads: usize, depth: usize) -> MgetSpec {
    MgetSpec {
        size: Size {
            width,
            heads,
            encoder_depth: depth,
            decoder_depth: depth,
            hidden: 0,
        },
        positions: Positions::Released,
        modalities: vec![
            ModalitySpec::tokens("body", &[30, 7], 2048),
            ModalitySpec::tokens("camera", &[30], 256),
            ModalitySpec::tokens("depth", &[5, 32, 32], 64_000),
            ModalitySpec::tokens("gaze", &[30], 512),
            ModalitySpec::tokens("rgb", &[5, 32, 32], 64_000),
        ],
    }
}

/// Ids that depend on sample, modality and position alone; the peer computes the same.
fn ids(spec: &MgetSpec, sample: usize) -> Vec<Vec<u32>> {
    spec.modalities
        .iter()
        .enumerate()
        .map(|(index, modality)| {
            let vocabulary = modality.vocabulary().unwrap_or(1) as u64;
            (0..modality.count() as u64)
                .map(|p| {
                    ((p * 7919 + sample as u64 * 104_729 + index as u64 * 1_299_709) % vocabulary)
                        as u32
                })
                .collect()
        })
        .collect()
}

/// Fixed masks: 30 camera tokens and the rest half rgb, half depth are given; 30 gaze and 34 body tokens and the rest half rgb,
/// half depth are asked for.
fn mask(tokens: usize) -> Mask {
    let range =
        |from: usize, count: usize| (from as u32..(from + count) as u32).collect::<Vec<u32>>();
    let given = (tokens - 30) / 2;
    let asked = (tokens - 64) / 2;
    Mask {
        input: vec![
            vec![],
            range(0, 30),
            range(0, given),
            vec![],
            range(0, tokens - 30 - given),
        ],
        target: vec![
            range(0, 34),
            vec![],
            range(2560, asked),
            range(0, 30),
            range(2560, tokens - 64 - asked),
        ],
    }
}

fn batch(spec: &MgetSpec, masks: &[Mask]) -> Batch {
    let ids: Vec<_> = (0..masks.len()).map(|sample| ids(spec, sample)).collect();
    let contents: Vec<Vec<Content<'_>>> = ids
        .iter()
        .map(|ids| ids.iter().map(|ids| Content::Ids(ids)).collect())
        .collect();
    Batch::new(spec, &contents, masks).expect("the batch is made for the spec")
}

fn seconds(mut work: impl FnMut()) -> f64 {
    let start = Instant::now();
    work();
    start.elapsed().as_secs_f64()
}

fn median(mut times: Vec<f64>) -> f64 {
    times.sort_by(f64::total_cmp);
    times[times.len() / 2]
}

/// Median seconds of a training step (forward, backward, clipping, AdamW).
fn step_time(model: &mut Mget, batch: &Batch, repetitions: usize) -> f64 {
    model.start_training();
    let mut optimizer = AdamW::new(AdamWSettings::default(), model);
    let times = (0..=repetitions)
        .map(|_| {
            seconds(|| {
                let losses = model.losses(batch, Loss::Mod);
                let gradients =
                    Gradients::of(&losses.total.expect("something is asked for"), model);
                optimizer
                    .step(model, gradients, 1e-4)
                    .expect("finite gradients");
            })
        })
        .skip(1)
        .collect();
    median(times)
}

fn forward_time(model: &Mget, batch: &Batch, repetitions: usize) -> f64 {
    let model = model.frozen();
    let times = (0..=repetitions)
        .map(|_| seconds(|| assert!(model.losses(batch, Loss::Mod).values().total.is_finite())))
        .skip(1)
        .collect();
    median(times)
}

/// `[train step, forward]` of PyTorch in seconds, where there is one.
fn peer(case: &str, threads: usize) -> Option<[f64; 2]> {
    let python = std::env::var_os("REVIV_TORCH_PYTHON")?;
    let script = concat!(env!("CARGO_MANIFEST_DIR"), "/benches/peer_mget.py");
    let output = Command::new(python)
        .args([script, case, &threads.to_string()])
        .output()
        .ok()?;
    let text = String::from_utf8_lossy(&output.stdout).into_owned();
    let numbers: Vec<f64> = text
        .split_whitespace()
        .filter_map(|word| word.parse().ok())
        .collect();
    if numbers.len() != 2 {
        eprintln!(
            "the peer said: {text}{}",
            String::from_utf8_lossy(&output.stderr)
        );
        return None;
    }
    Some([numbers[0], numbers[1]])
}

fn compare(case: (&str, usize, usize, usize, usize, usize, usize), threads: usize) {
    let (name, width, heads, depth, samples, tokens, repetitions) = case;
    let spec = spec(width, heads, depth);
    let compute = Compute::cpu();
    let mut model = Mget::new(&spec, &Initialise::new(&compute, 0)).expect("the spec can be built");
    let batch = batch(&spec, &vec![mask(tokens); samples]);
    println!(
        "{name}: {samples} samples, {tokens} + {tokens} tokens, {} parameters",
        spec.parameter_count()
    );
    let forward = forward_time(&model, &batch, repetitions);
    let step = step_time(&mut model, &batch, repetitions);
    drop(model);
    println!("  reviv    step {step:.3} s  forward {forward:.3} s");
    if let Some([peer_step, peer_forward]) = peer(name, threads) {
        println!("  PyTorch  step {peer_step:.3} s  forward {peer_forward:.3} s");
        println!(
            "  faster by {:.2} (step), {:.2} (forward)",
            peer_step / step,
            peer_forward / forward
        );
    }
}

/// A step on samples as the mixture draws them, and on as many samples padded to the full budget.
fn packing() {
    let spec = spec(384, 6, 6);
    let compute = Compute::cpu();
    let drawn = |overflow| {
        let settings = MaskingSettings {
            input_tokens: TokenBudget::Fixed(512),
            target_tokens: TokenBudget::Fixed(512),
            overflow,
            ..MaskingSettings::default()
        };
        let masking = Masking::new(&settings, &spec.slots()).expect("settings of the paper");
        let masks: Vec<Mask> = (0..8)
            .map(|sample| masking.draw(&[true; 5], &mut stream(0, "bench.mask", 0, sample)))
            .collect();
        batch(&spec, &masks)
    };
    let time = |batch: &Batch| {
        let mut model =
            Mget::new(&spec, &Initialise::new(&compute, 0)).expect("the spec can be built");
        step_time(&mut model, batch, 3)
    };
    let (packed, padded) = (drawn(Overflow::Drop), drawn(Overflow::Respill));
    let rows = |batch: &Batch| batch.visible.sequence.len() + batch.targets.sequence.len();
    let (fast, slow) = (time(&packed), time(&padded));
    println!(
        "packing: {} rows instead of {}",
        rows(&packed),
        rows(&padded)
    );
    println!(
        "  packed {fast:.3} s, padded {slow:.3} s: {:.2} times faster",
        slow / fast
    );
}

fn main() {
    let arguments: Vec<String> = std::env::args()
        .skip(1)
        .filter(|a| a != "--bench")
        .collect();
    let threads = arguments
        .iter()
        .position(|argument| argument == "--threads")
        .and_then(|index| arguments.get(index + 1)?.parse().ok())
        .unwrap_or_else(|| std::thread::available_parallelism().map_or(1, usize::from));
    let wanted = |name: &str| {
        let named = |a: &&String| ["tiny", "base", "packing"].contains(&a.as_str());
        arguments.iter().all(|a| !named(&a)) || arguments.iter().any(|a| a == name)
    };
    // Inside the pool, as stages of a run are.
    let bench = || {
        for case in CASES {
            if wanted(case.0) {
                compare(case, threads);
            }
        }
        if wanted("packing") {
            packing();
        }
    };
    rayon::join(bench, || ());
}
