//! How fast reviv is, beside PyTorch on the same machine in the same run.
//!
//! `cargo bench --bench speed -- --python PATH [--device cuda] [--bf16] [--compile] [--threads N] [--rounds N] [--write FILE] [CASE...]`
//!
//! PATH is a Python that has PyTorch; without it reviv is measured alone. The two sides take turns, round by round, each in a
//! process of its own with as many threads and one call to warm up, so both see the same machine and neither the other's
//! memory. In this order: [`peer`] (asks a side), [`measure`] (what our side does when asked), the cases [`tokenizer`],
//! [`video`], [`depth`], [`mget`], [`decoding`] and [`product`], and [`table`] with [`machine`] (the answer). `peer/` is PyTorch's side.

mod decoding;
mod depth;
mod machine;
mod measure;
mod mget;
mod peer;
mod product;
mod table;
mod tokenizer;
mod video;

use clap::{Parser, ValueEnum};
use measure::Meter;
use peer::{Answers, Question, Side};
use reviv::engine::{Compute, DeviceChoice, Precision};
use reviv::mget::Size;
use std::num::NonZeroUsize;
use std::path::PathBuf;
use std::process::ExitCode;
use std::sync::OnceLock;
use table::Results;

/// As in the program.
#[global_allocator]
static MEMORY: reviv::engine::memory::Pool = reviv::engine::memory::Pool;

/// What our side computes on.
static DEVICE: OnceLock<Compute> = OnceLock::new();

fn compute() -> Compute {
    DEVICE.get().cloned().unwrap_or_else(Compute::cpu)
}

/// Measures reviv, and PyTorch beside it.
#[derive(Debug, Parser)]
#[command(name = "speed")]
struct Arguments {
    /// What to measure; everything if nothing is named.
    #[arg(value_name = "CASE")]
    cases: Vec<Case>,
    /// A Python that has PyTorch; without it, reviv is measured alone.
    #[arg(long, value_name = "PATH")]
    python: Option<PathBuf>,
    /// Threads of each side; as many as there are cores if not given.
    #[arg(long, value_name = "N")]
    threads: Option<NonZeroUsize>,
    /// Where reviv computes: auto, cpu, cuda, vulkan, metal or wgpu, a GPU also with its number: `cuda:1`.
    #[arg(long, value_name = "DEVICE", default_value = "cpu")]
    device: DeviceChoice,
    /// Round the operands of MGET's products to bfloat16; PyTorch does so with everything that its autocast takes.
    #[arg(long)]
    bf16: bool,
    /// Let PyTorch compile its MGET.
    #[arg(long)]
    compile: bool,
    /// How often each side has its turn.
    #[arg(long, value_name = "N", default_value = "3")]
    rounds: NonZeroUsize,
    /// Also writes what is printed to this file.
    #[arg(long, value_name = "FILE")]
    write: Option<PathBuf>,
    /// Be our side: measure one case in this process, this many times.
    #[arg(long, hide = true)]
    repeats: Option<usize>,
    #[arg(long, hide = true)]
    #[allow(dead_code)] // Cargo passes it to every bench.
    bench: bool,
}

/// What can be measured. `peer/__main__.py` knows the same names.
#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
enum Case {
    /// The VQ-VAE of bodies: encode, forward, train step.
    Tokenizer,
    /// The video tokenizer: encode, decode.
    Video,
    /// The depth network, a window of 32 frames: encoder, head.
    Depth,
    /// The same with a window of 8 frames.
    DepthShort,
    /// MGET `laptop_small`: forward, train step; for a look at whether everything runs.
    MgetShort,
    /// MGET `tiny`: forward, train step.
    MgetTiny,
    /// MGET `base`: forward, train step.
    MgetBase,
    /// What packed samples save; our side alone.
    Packing,
    /// What keeping less for backward saves; our side alone.
    ActivationCheckpointing,
    /// Generation with the preset `fast`.
    DecodingFast,
    /// Generation with the preset `release`.
    DecodingRelease,
    /// One large product of matrices: what the device has at its best. Before MGET, whose share of it is said.
    Product,
}

impl Case {
    /// As on the command line.
    fn name(self) -> String {
        let value = self.to_possible_value().expect("no case is skipped");
        value.get_name().to_owned()
    }

    /// As in the table.
    fn title(self) -> &'static str {
        match self {
            Self::Tokenizer => "body tokenizer (VQ-VAE, ViT-B, 8 clips)",
            Self::Video => "video tokenizer (Cosmos DV4x8x8, 17 x 256 x 256)",
            Self::Depth => "depth network (Video Depth Anything Small, 32 x 518 x 518)",
            Self::DepthShort => "depth network (Video Depth Anything Small, 8 x 518 x 518)",
            Self::MgetShort => "MGET `laptop_small` (2 samples, 128 + 128 tokens)",
            Self::MgetTiny => "MGET `tiny` (8 samples, 256 + 256 tokens)",
            Self::MgetBase => "MGET `base` (1 sample, 1024 + 1024 tokens)",
            Self::Packing => "MGET `tiny` (8 samples, at most 512 + 512 tokens)",
            Self::ActivationCheckpointing => "MGET `tiny` (8 samples, 1024 + 1024 tokens)",
            Self::DecodingFast => "decoding `fast` (1 clip: camera, gaze, body from video tokens)",
            Self::DecodingRelease => {
                "decoding `release` (1 clip: camera, gaze, body from video tokens)"
            }
            Self::Product => "product (4096 x 4096 x 4096)",
        }
    }

    /// Measurements per round: more of what is quick.
    fn repeats(self) -> usize {
        match self {
            Self::MgetShort | Self::MgetTiny => 5,
            Self::Tokenizer | Self::Packing | Self::DecodingFast | Self::Product => 3,
            Self::Video | Self::MgetBase | Self::ActivationCheckpointing => 2,
            Self::DepthShort | Self::Depth | Self::DecodingRelease => 1,
        }
    }

    /// Whether PyTorch's side has it.
    fn has_peer(self) -> bool {
        !matches!(self, Self::Packing | Self::ActivationCheckpointing)
    }

    /// Our side.
    fn run(self, meter: &Meter) {
        match self {
            Self::Tokenizer => tokenizer::run(meter),
            Self::Video => video::run(meter),
            Self::Depth => depth::run(meter, 32),
            Self::DepthShort => depth::run(meter, 8),
            Self::MgetShort => mget::run(meter, Size::LAPTOP_SMALL, 2, 128),
            Self::MgetTiny => mget::run(meter, mget::TINY, 8, 256),
            Self::MgetBase => mget::run(meter, mget::BASE, 1, 1024),
            Self::Packing => mget::packing(meter),
            Self::ActivationCheckpointing => mget::activation_checkpointing(meter),
            Self::DecodingFast => decoding::run(meter, decoding::FAST),
            Self::DecodingRelease => decoding::run(meter, decoding::RELEASE),
            Self::Product => product::run(meter),
        }
    }
}

fn main() -> ExitCode {
    let arguments = Arguments::parse();
    let threads = arguments.threads.map_or_else(
        || std::thread::available_parallelism().map_or(1, usize::from),
        usize::from,
    );
    let precision = if arguments.bf16 {
        Precision::Bf16
    } else {
        Precision::F32
    };
    match Compute::new(arguments.device, precision) {
        Ok(compute) => {
            let _ = DEVICE.set(compute);
        }
        Err(error) => {
            eprintln!("error: {error}");
            return ExitCode::FAILURE;
        }
    }
    if let (Some(repeats), [case]) = (arguments.repeats, arguments.cases.as_slice()) {
        alone(*case, repeats, threads);
        return ExitCode::SUCCESS;
    }
    let text = compare(&arguments, threads);
    print!("{text}");
    if let Some(path) = arguments.write
        && let Err(error) = std::fs::write(&path, text)
    {
        eprintln!("{} was not written: {error}", path.display());
        return ExitCode::FAILURE;
    }
    ExitCode::SUCCESS
}

/// Our side of one case, inside the pool as stages of a run are.
fn alone(case: Case, repeats: usize, threads: usize) {
    rayon::ThreadPoolBuilder::new()
        .num_threads(threads)
        .build_global()
        .expect("nothing has used the pool before");
    let meter = Meter::new(repeats);
    measure::introduce();
    rayon::join(|| case.run(&meter), || ());
}

/// All cases on all sides, as the text to print. Progress goes to the standard error.
fn compare(arguments: &Arguments, threads: usize) -> String {
    let cases = if arguments.cases.is_empty() {
        Case::value_variants()
    } else {
        &arguments.cases
    };
    let rounds = arguments.rounds.get();
    let theirs = arguments.python.as_ref().map(|python| Side::PyTorch {
        python: python.clone(),
    });
    let mut all = Vec::new();
    for &case in cases {
        let mut results = Results {
            case,
            ours: Answers::default(),
            theirs: (theirs.is_some() && case.has_peer()).then(Answers::default),
        };
        let question = Question {
            case: case.name(),
            repeats: case.repeats(),
            threads,
            device: arguments.device,
            bf16: arguments.bf16,
            compile: arguments.compile,
        };
        for round in 1..=rounds {
            eprintln!("{}, round {round} of {rounds}", question.case);
            results.ours.ask(&Side::Reviv, &question);
            if let (Some(side), Some(answers)) = (&theirs, &mut results.theirs) {
                answers.ask(side, &question);
            }
        }
        all.push(results);
    }
    let header = machine::header(arguments, threads, &all);
    format!("{header}\n{}", table::table(&all, theirs.is_some()))
}
