//! How much faster two processes of one thread take the same training step than one of one thread (feature `mpi`), and whether
//! `reviv plan --devices` says so beforehand.
//!
//! `cargo bench --features mpi --bench scaling -- [--batch N] [--steps N] [--ranks N]`
//! `cargo bench --features mpi --bench scaling -- --plan`
//!
//! A step of MGET in the size `tiny` on tokens of camera, gaze, body and a small video codebook. Measured are: one process; as many
//! processes that know nothing of each other, each with its share of the batch, which is what the machine has to give; and ranks
//! under `mpirun`. Efficiency is the time of one process over ranks times the time of a rank; at least 0.85 is asked for. Nothing
//! else may run on the machine.
//!
//! With `--plan` the model of a step is calibrated by what one rank computes beside others that it does not talk to, and by a
//! reduction with nothing beside it: how long it takes, and how much of that the cores are busy. It is compared with 1, 2 and 4 ranks;
//! asked for: within 20 %. More ranks than cores share them while they compute and while they reduce, and both are measured so.

use clap::Parser;
use reviv::engine::communicator::launch;
use reviv::engine::communicator::reduce::Sum;
use reviv::engine::{Communicator, Compute, Gradients, Initialise, Parameters};
use reviv::experiment::scaling::{Cluster, INTERCONNECTS, Interconnect, Training};
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
    /// Compare what `reviv plan --devices` computes with 1, 2 and 4 processes.
    #[arg(long)]
    plan: bool,
    /// Be one of the processes: print the seconds of a step, or of a reduction with nothing beside it.
    #[arg(long, hide = true)]
    part: Option<Part>,
    #[arg(long, hide = true)]
    #[allow(dead_code)] // Cargo passes it to every bench.
    bench: bool,
}

#[derive(Debug, Clone, Copy, clap::ValueEnum)]
enum Part {
    Step,
    Reduction,
}

impl Part {
    fn name(self) -> &'static str {
        match self {
            Self::Step => "step",
            Self::Reduction => "reduction",
        }
    }
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

/// Seconds that processors have worked for this process so far, as Linux counts them in hundredths; 0 elsewhere.
fn worked() -> f64 {
    let text = std::fs::read_to_string("/proc/self/stat").unwrap_or_default();
    // The name of the program stands in brackets, and may hold anything.
    let fields = text.rsplit(')').next().unwrap_or_default();
    let ticks = fields.split_whitespace().skip(11).take(2);
    ticks
        .filter_map(|ticks| ticks.parse::<f64>().ok())
        .sum::<f64>()
        / 100.0
}

/// Seconds of the reduction of a gradient on this rank, with nothing beside it, and those that processors have worked for it.
fn reduction(ranks: &Communicator, times: usize) -> [f64; 2] {
    let mut model = Mget::new(&spec(), &Initialise::new(&Compute::cpu(), 0)).expect("the spec");
    model.start_training();
    let mut gradients = Gradients::default();
    gradients.complete(&model);
    let order = model.backward_order();
    let reduce = || {
        let mut sum = Sum::new(ranks, &model, &order, 1)?;
        sum.end_round(None, Some(&gradients)).expect("the others");
        Some(sum.finish(&model).expect("the others"))
    };
    reduce();
    let (start, before) = (Instant::now(), worked());
    for _ in 0..times {
        reduce();
    }
    [start.elapsed().as_secs_f64(), worked() - before].map(|seconds| seconds / times as f64)
}

fn part(part: Part, arguments: &Arguments) {
    let ranks = launch::launch(|error| panic!("{error}")).expect("the other processes");
    let [seconds, worked] = match part {
        Part::Step => [
            seconds(ranks.clone(), arguments.batch, arguments.steps),
            0.0,
        ],
        Part::Reduction => reduction(&ranks, arguments.steps),
    };
    let worked = ranks.gather(Ok(worked.to_le_bytes().to_vec()));
    let worked = worked.expect("the other processes").into_iter();
    let worked = worked.map(|bytes| f64::from_le_bytes(bytes.try_into().expect("a number")));
    let worked: f64 = worked.sum();
    if ranks.is_root() {
        println!("{seconds} {worked}");
    }
    ranks.finish().expect("all leave together");
}

/// The longest that a process of those takes.
fn measure(commands: Vec<Command>, part: Part, batch: usize, steps: usize) -> f64 {
    measure_both(commands, part, batch, steps)[0]
}

/// The same, and the most that processors have worked meanwhile for all of its ranks.
fn measure_both(mut commands: Vec<Command>, part: Part, batch: usize, steps: usize) -> [f64; 2] {
    let started: Vec<_> = commands
        .iter_mut()
        .map(|command| {
            command
                .args(["--part", part.name(), "--batch", &batch.to_string()])
                .args(["--steps", &steps.to_string()])
                .env("RAYON_NUM_THREADS", "1")
                .stdout(Stdio::piped())
                .spawn()
                .expect("a process")
        })
        .collect();
    let ended = started.into_iter().map(|process| {
        let output = process.wait_with_output().expect("its end");
        let text = String::from_utf8_lossy(&output.stdout).into_owned();
        let numbers = text.split_whitespace();
        let numbers = numbers.map(|number| number.parse::<f64>().expect("seconds"));
        let numbers: Vec<f64> = numbers.collect();
        <[f64; 2]>::try_from(numbers).expect("two numbers")
    });
    ended.fold([0.0; 2], |[a, b], [c, d]| [a.max(c), b.max(d)])
}

/// Processes that know nothing of each other.
fn apart(count: usize) -> Vec<Command> {
    let own = std::env::current_exe().expect("this program");
    (0..count).map(|_| Command::new(&own)).collect()
}

fn mpirun(ranks: usize) -> Vec<Command> {
    let mut command = Command::new("mpirun");
    // A core each, where there are as many, as `mpirun` does for two by itself: the threads that carry bytes stay with theirs.
    let options = if ranks <= cores() {
        "--allow-run-as-root --bind-to core -n"
    } else {
        "--allow-run-as-root --oversubscribe --bind-to none -n"
    };
    command
        .args(options.split(' '))
        .arg(ranks.to_string())
        .arg(std::env::current_exe().expect("this program"));
    vec![command]
}

fn cores() -> usize {
    std::thread::available_parallelism().map_or(1, usize::from)
}

/// A model of a step against steps.
fn compare(batch: usize, steps: usize) {
    let model = Mget::new(&spec(), &Initialise::meta(&Compute::cpu())).expect("the spec");
    let parameters = model.count() as f64;
    println!(
        "{:.1} M parameters, {batch} samples a step",
        parameters / 1e6
    );
    println!(
        "| processes | computing alone (s) | reduction alone (s) | cores busy with it | step planned (s) | step measured (s) | off |"
    );
    println!("|---|---|---|---|---|---|---|");
    let cores = cores();
    for n in [1, 2, 4] {
        let computing = measure(apart(n), Part::Step, batch / n, steps);
        let devices = n as f64;
        // Of one step, in a unit of its own: the rate is what was measured.
        let flop = 1.0;
        let training = Training {
            parameters,
            steps: 1.0,
            flop,
            tokens: 256.0 * batch as f64,
            sharded: false,
        };
        let mut link: Interconnect = INTERCONNECTS[5];
        link.busy = 0.0;
        let (mut reducing, mut measured) = (0.0, computing);
        if n > 1 {
            let worked;
            [reducing, worked] = measure_both(mpirun(n), Part::Reduction, batch, 4 * steps);
            // Cores without a rank do it for nothing.
            let busy = worked / reducing - cores.saturating_sub(n) as f64;
            link.busy = (busy / cores.min(n) as f64).clamp(0.0, 1.0);
            measured = measure(mpirun(n), Part::Step, batch, steps);
            link.bytes_per_second = 2.0 * 4.0 * parameters * (devices - 1.0) / devices / reducing;
            link.latency = 0.0;
        }
        let cost = training.on(&Cluster {
            devices,
            rate: flop / (devices * computing),
            interconnect: link,
            overlap: 2.0 / 3.0,
            exchanges: 1.0,
            disk: 1e9,
            checkpoint_every: 1.0,
            failures_per_day: 0.0,
            restart: 0.0,
        });
        let planned = cost.compute + cost.exposed;
        let off = 100.0 * (planned / measured - 1.0);
        println!(
            "| {n} | {computing:.3} | {reducing:.3} | {:.0} % | {planned:.3} | {measured:.3} | {off:+.0} % |",
            100.0 * link.busy
        );
    }
}

fn main() {
    let arguments = Arguments::parse();
    if let Some(wanted) = arguments.part {
        return part(wanted, &arguments);
    }
    let (batch, steps, ranks) = (arguments.batch, arguments.steps, arguments.ranks);
    if arguments.plan {
        if cfg!(feature = "mpi") {
            compare(batch, steps);
        } else {
            println!("ranks need `--features mpi`");
        }
        return;
    }
    let one = measure(apart(1), Part::Step, batch, steps);
    println!("one process of one thread: {one:.3} s for a step of {batch} samples");
    let share = batch / ranks;
    let alone = measure(apart(ranks), Part::Step, share, steps);
    let given = one / (ranks as f64 * alone);
    println!(
        "{ranks} that know nothing of each other, {share} samples each: {alone:.3} s, {given:.2} of what {ranks} machines would do"
    );
    if !cfg!(feature = "mpi") {
        println!("ranks need `--features mpi`");
        return;
    }
    let together = measure(mpirun(ranks), Part::Step, batch, steps);
    let efficiency = one / (ranks as f64 * together);
    let of_machine = alone / together;
    println!(
        "{ranks} ranks: {together:.3} s; efficiency {efficiency:.2} (at least 0.85 is asked for), {of_machine:.2} of what the machine has to give"
    );
}
