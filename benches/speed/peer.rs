//! Asks a side, ours or PyTorch's, in a process of its own, and reads what it says.
//!
//! Both sides answer alike: a line of JSON on the standard output about the engine, then one per measurement. Whatever else
//! they print there is passed over.

use reviv::engine::DeviceChoice;
use serde::{Deserialize, Serialize};
use std::path::{Path, PathBuf};
use std::process::{Command, Output};

/// What a side says in one line.
#[derive(Debug, Clone, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Line {
    Engine(Engine),
    Measured(Measured),
}

/// What computes.
#[derive(Debug, Clone, Serialize, Deserialize)]
pub struct Engine {
    pub version: String,
    pub threads: usize,
}

/// One measurement of a case.
#[derive(Debug, Clone, Serialize, Deserialize)]
pub struct Measured {
    pub name: String,
    /// One per repetition.
    pub seconds: Vec<f64>,
    /// Operations of products in one of them; `None` where nobody has counted.
    #[serde(default)]
    pub flop: Option<f64>,
    /// Peak of resident memory while it ran; `None` where the system does not tell.
    pub memory_mib: Option<f64>,
    /// The most minor page faults of a call after the second; `None` where the side or the system does not tell.
    #[serde(default)]
    pub faults: Option<u64>,
}

/// Who is asked.
#[derive(Debug, Clone)]
pub enum Side {
    /// This program, started once more.
    Reviv,
    /// `peer/`.
    PyTorch { python: PathBuf },
}

/// What is asked.
#[derive(Debug, Clone)]
pub struct Question {
    pub case: String,
    pub repeats: usize,
    pub threads: usize,
    pub device: DeviceChoice,
    /// Products of bfloat16.
    pub bf16: bool,
    /// PyTorch's MGET is compiled.
    pub compile: bool,
}

impl Side {
    fn answer(&self, question: &Question) -> std::io::Result<Output> {
        let Question {
            case,
            repeats,
            threads,
            device,
            bf16,
            compile,
        } = question;
        let (repeats, threads) = (repeats.to_string(), threads.to_string());
        let device = device.to_string();
        match self {
            Self::Reviv => Command::new(std::env::current_exe()?)
                .args([case, "--repeats", &repeats, "--threads", &threads])
                .args(["--device", &device])
                .args(bf16.then_some("--bf16"))
                .output(),
            Self::PyTorch { python } => {
                let package = Path::new(env!("CARGO_MANIFEST_DIR")).join("benches/speed/peer");
                Command::new(python)
                    // Leave no compiled files among the sources.
                    .arg("-B")
                    .arg(package)
                    .args([case, &repeats, &threads, &device])
                    .args(bf16.then_some("bf16"))
                    .args(compile.then_some("compile"))
                    .output()
            }
        }
    }
}

/// What a side said of one case in all rounds so far.
#[derive(Debug, Clone, Default)]
pub struct Answers {
    pub engine: Option<Engine>,
    /// How often the side was asked.
    pub rounds: usize,
    /// In the order they were first said.
    pub measured: Vec<Measured>,
    /// Why the side did not say everything.
    pub failure: Option<String>,
}

impl Answers {
    /// Asks once more; not a side that failed, it would fail again.
    pub fn ask(&mut self, side: &Side, question: &Question) {
        if self.failure.is_some() {
            return;
        }
        self.rounds += 1;
        match side.answer(question) {
            Ok(output) => self.read(&output),
            Err(error) => self.failure = Some(error.to_string()),
        }
    }

    fn read(&mut self, output: &Output) {
        let text = String::from_utf8_lossy(&output.stdout);
        let lines: Vec<Line> = text
            .lines()
            .filter_map(|line| serde_json::from_str(line).ok())
            .collect();
        let silent = !lines.iter().any(|line| matches!(line, Line::Measured(_)));
        for line in lines {
            match line {
                Line::Engine(engine) => self.engine = Some(engine),
                Line::Measured(measured) => self.add(measured),
            }
        }
        if silent || !output.status.success() {
            let errors = String::from_utf8_lossy(&output.stderr);
            // Who was killed did not say why: what stands on the standard error is about something else.
            let said = output.status.code().and_then(|_| last_line(&errors));
            self.failure = Some(said.unwrap_or_else(|| output.status.to_string()));
        }
    }

    fn add(&mut self, more: Measured) {
        match self
            .measured
            .iter_mut()
            .find(|known| known.name == more.name)
        {
            None => self.measured.push(more),
            Some(known) => {
                known.seconds.extend(more.seconds);
                let both = [known.memory_mib, more.memory_mib];
                known.memory_mib = both.into_iter().flatten().reduce(f64::max);
                known.faults = known.faults.max(more.faults);
            }
        }
    }
}

/// Characters of a reason, at most: it stands in a table.
const LONGEST: usize = 200;

/// The last line that says something; a panic ends in advice.
fn last_line(errors: &str) -> Option<String> {
    errors
        .lines()
        .map(str::trim)
        .rfind(|line| !line.is_empty() && !line.starts_with("note: "))
        .map(|line| line.chars().take(LONGEST).collect())
}
