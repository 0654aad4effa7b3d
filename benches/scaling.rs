//! How much faster two processes of one thread take the same training step than one of one thread (feature `mpi`).
//!
//! `cargo bench --features mpi --bench scaling -- [--batch N] [--steps N] [--ranks N]`
//!
//! A step of MGET in the size `tiny` on tokens of camera, gaze, body and a small video codebook. Measured are: one process; as many
//! processes that know nothing of each other, each with its share of the batch, which is what the machine has to give; and ranks
//! under `mpirun`. Efficiency is the time of one process over ranks times the time of a rank.

use clap::Parser;
use reviv::engine::communicator::launch;
use reviv::engine::{Communicator, Compute, Initialise};
use reviv::masking::{Masking, MaskingSettings, TokenBudget};
use reviv::mget::{Mget, MgetSpec, ModalitySpec, Positions, Size};
use reviv::tokenizer::TokenGrid;
use reviv::training::{
    BatchSource, DatasetSize, InMemory, Ranks, Sampler, TokenSample, Trainer, TrainingSettings,
};
use std::process::{Command, Stdio};
use std::sync::Arc;
use std::time::Instant;

/// As in the program.
#[global_allocator]
static MEMORY: reviv::engine::memory::Pool = reviv::engine::memory::Pool;

#[derive(Debug, Parser)]
struct Arguments {
    /// Samples of a step.
    #[arg(long, default_value = "16")]
    batch: usize,
    /// Steps that are timed, after one that is not.
    #[arg(long, default_value = "5")]
    steps: usize,
    /// Processes.
    #[arg(long, default_value = "2")]
    ranks: usize,
    /// Be one of the processes: print the seconds of a step.
    #[arg(long, hide = true)]
    part: bool,
    #[arg(long, hide = true)]
    #[allow(dead_code)] // Cargo passes it to every bench.
    bench: bool,
}

fn spec() -> MgetSpec {
    MgetSpec {
        // `registry/size/tiny.yaml`.
        size: Size {
            width: 384,
            heads: 6,
            encoder_depth: 6,
            decoder_depth: 6,
            hidden: 0,
        },
        positions: Positions::Released,
        modalities: vec![
            ModalitySpec::tokens("body", &[30, 7], 2048),
            ModalitySpec::tokens("camera", &[30], 256),
            ModalitySpec::tokens("gaze", &[30], 512),
            ModalitySpec::tokens("rgb", &[5, 8, 8], 240),
        ],
    }
}

fn samples() -> InMemory {
    let grid = |name: &str, shape: &[usize], vocabulary: usize, clip: usize| {
        let count: usize = shape.iter().product();
        let ids = (0..count).map(|i| ((i * 7919 + clip * 104_729) % vocabulary) as u32);
        let grid = TokenGrid {
            ids: ids.collect(),
            grid: shape.to_vec(),
        };
        (name.to_owned(), grid)
    };
    let sample = |clip: usize| TokenSample {
        key: clip.to_string(),
        tokens: [
            grid("body", &[30, 7], 2048, clip),
            grid("camera", &[30], 256, clip),
            grid("gaze", &[30], 512, clip),
            grid("rgb", &[5, 8, 8], 240, clip),
        ]
        .into(),
        ..TokenSample::default()
    };
    InMemory {
        name: "counting".to_owned(),
        samples: (0..64).map(sample).collect(),
    }
}

/// Seconds of a step on this rank.
fn seconds(ranks: Communicator, batch: usize, steps: usize) -> f64 {
    let settings = TrainingSettings {
        steps: Some(steps as u64 + 1),
        batch,
        ..TrainingSettings::default()
    };
    let masking = MaskingSettings {
        input_tokens: TokenBudget::Fixed(128),
        target_tokens: TokenBudget::Fixed(128),
        ..MaskingSettings::default()
    };
    let spec = spec();
    let masking = Masking::new(&masking, &spec.slots()).expect("the budgets fit");
    let size = DatasetSize {
        clips: 64,
        tokens_per_sample: 256,
    };
    let schedule = settings
        .learning_rates(size)
        .expect("the settings are good");
    let compute = Compute::cpu();
    let model = Mget::new(&spec, &Initialise::new(&compute, 0)).expect("the spec can be built");
    let together = Ranks::new(ranks.clone(), settings.reduction);
    let mut trainer = Trainer::new(model, &settings, schedule)
        .shared(together, 0)
        .expect("the ranks divide the batch");
    let source = BatchSource {
        spec,
        masking,
        sources: vec![Arc::new(samples())],
        order: Sampler::new(0, &["counting"], &[64], None).expect("there are clips"),
        seed: 0,
        micro_batches: trainer.micro_batches().to_vec(),
        repeat: 1,
    };
    let step = |trainer: &mut Trainer<_>| {
        let step = trainer.progress().step;
        let batch = |micro| Ok::<_, reviv::training::TrainingError>(source.batch(step, micro)?);
        trainer.step(batch).expect("a step");
    };
    step(&mut trainer);
    let start = Instant::now();
    for _ in 0..steps {
        step(&mut trainer);
    }
    start.elapsed().as_secs_f64() / steps as f64
}

fn part(arguments: &Arguments) {
    let ranks = launch::launch(|error| panic!("{error}")).expect("the other processes");
    let seconds = seconds(ranks.clone(), arguments.batch, arguments.steps);
    if ranks.is_root() {
        println!("{seconds}");
    }
    ranks.finish().expect("all leave together");
}

/// The longest that a process of those takes for a step.
fn measure(mut commands: Vec<Command>, batch: usize, steps: usize) -> f64 {
    let started: Vec<_> = commands
        .iter_mut()
        .map(|command| {
            command
                .args([
                    "--part",
                    "--batch",
                    &batch.to_string(),
                    "--steps",
                    &steps.to_string(),
                ])
                .env("RAYON_NUM_THREADS", "1")
                .stdout(Stdio::piped())
                .spawn()
                .expect("a process")
        })
        .collect();
    let ended = started.into_iter().map(|process| {
        let output = process.wait_with_output().expect("its end");
        let text = String::from_utf8_lossy(&output.stdout).into_owned();
        text.trim().parse::<f64>().expect("the seconds of a step")
    });
    ended.fold(0.0, f64::max)
}

fn main() {
    let arguments = Arguments::parse();
    if arguments.part {
        return part(&arguments);
    }
    let (batch, steps, ranks) = (arguments.batch, arguments.steps, arguments.ranks);
    let own = std::env::current_exe().expect("this program");
    let alone = || Command::new(&own);
    let one = measure(vec![alone()], batch, steps);
    println!("one process of one thread: {one:.3} s for a step of {batch} samples");
    let apart = (0..ranks).map(|_| alone()).collect();
    let apart = measure(apart, batch / ranks, steps);
    let share = one / (ranks as f64 * apart);
    println!(
        "{ranks} that know nothing of each other, {} samples each: {apart:.3} s, {share:.2} of what {ranks} machines would do",
        batch / ranks
    );
    if !cfg!(feature = "mpi") {
        println!("ranks need `--features mpi`");
        return;
    }
    let mut command = Command::new("mpirun");
    command
        .args([
            "--allow-run-as-root",
            "--oversubscribe",
            "--bind-to",
            "none",
            "-n",
        ])
        .arg(ranks.to_string())
        .arg(&own);
    let together = measure(vec![command], batch, steps);
    let efficiency = one / (ranks as f64 * together);
    println!(
        "{ranks} ranks: {together:.3} s; efficiency {efficiency:.2}, {:.2} of what the machine has to give",
        apart / together
    );
}
