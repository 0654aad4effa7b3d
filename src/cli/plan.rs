//! `reviv plan`: the resolved graph, without running it.

use super::machine::{History, Machine};
use super::plan_devices::Devices;
use super::request::{Changes, count, open};
use super::terminal::{Failure, Terminal};
use crate::experiment::catalog::Catalog;
use crate::experiment::plan::{Plan as Planned, PlannedStage, plan};
use crate::run::inputs::Fingerprints;
use crate::run::{Cache, Key};
use std::collections::BTreeMap;
use std::fmt::Write as _;
use std::path::{Path, PathBuf};

/// Show the resolved graph: what is cached, shapes, parameters, tokens, memory, FLOP
#[derive(Debug, clap::Args)]
pub struct Plan {
    /// The experiment or sweep
    file: PathBuf,
    #[command(flatten)]
    changes: Changes,
    /// Where runs and their cache are
    #[arg(long, default_value = "runs", value_name = "DIR")]
    runs: PathBuf,
    /// Write JSON to stdout
    #[arg(long)]
    json: bool,
    #[command(flatten)]
    devices: Devices,
}

impl super::Run for Plan {
    fn run(self, terminal: &Terminal) -> Result<(), Failure> {
        let catalog = Catalog::linked();
        let (experiment, _) = open(&catalog, &self.changes.look(&self.file), terminal)?;
        let cache = Cache::new(self.runs.join("cache"));
        let cached = |key: &crate::experiment::ArtifactKey| cache.contains(&Key::from(*key));
        let mut outside = Outside {
            prints: Fingerprints::remembered(&cache),
            unread: BTreeMap::new(),
        };
        let mut planned =
            plan(&experiment, &cached, &mut |path| outside.hash(path)).map_err(Failure::machine)?;
        let machine = Machine::here(&cache);
        let history = History::of(&self.runs, &machine);
        for stage in &mut planned.stages {
            let (flop, units) = (stage.plan.flop, stage.plan.work.as_ref().map(|work| work.0));
            let took = history.seconds(&machine, stage.op, stage.settings.json(), flop, units);
            stage.plan.seconds = stage.plan.seconds.or(took);
        }
        for (path, number) in &outside.unread {
            terminal.note(format_args!(
                "note: `{}` has {} that were never hashed: `reviv run` does that; what is cached of it is not known here\n",
                path.display(),
                bytes(*number)
            ));
        }
        if self.json {
            terminal.json(&planned);
        } else {
            terminal.data(render(&planned));
            terminal.data(self.devices.render(&experiment, &planned.stages)?);
        }
        Ok(())
    }
}

/// A plan is to come at once: it reads no more than this of outside files and data sets.
const QUICK_BYTES: u64 = 64 << 20;

/// Files and data sets that stages read.
struct Outside<'a> {
    prints: Fingerprints<'a>,
    unread: BTreeMap<PathBuf, u64>,
}

impl Outside<'_> {
    /// Of what is too large to read now, a stand-in that no artifact was ever made from.
    fn hash(&mut self, path: &Path) -> std::io::Result<blake3::Hash> {
        let print = self.prints.within_limit(path, QUICK_BYTES);
        match print.map_err(std::io::Error::other)? {
            Ok(print) => Ok(print.hash),
            Err(unread) => {
                self.unread.insert(path.to_owned(), unread);
                let mut hasher = blake3::Hasher::new();
                hasher.update(b"reviv unread ");
                hasher.update(path.to_string_lossy().as_bytes());
                Ok(hasher.finalize())
            }
        }
    }
}

fn render(plan: &Planned) -> String {
    let mut text = String::new();
    let to_do = plan.to_do().count();
    let _ = write!(text, "{}: {}", plan.name, count(plan.stages.len(), "stage"));
    if plan.cells.len() > 1 {
        let _ = write!(
            text,
            " for {} runs that have {} together, {} of them shared",
            plan.cells.len(),
            plan.total,
            plan.total - plan.stages.len()
        );
    }
    let _ = writeln!(
        text,
        "; {} cached, {to_do} to do\n",
        plan.stages.len() - to_do
    );
    let name = plan.stages.iter().map(|s| s.name.len()).max().unwrap_or(0);
    let op = plan.stages.iter().map(|s| s.op.len()).max().unwrap_or(0);
    for stage in &plan.stages {
        let state = if stage.cached { "cached" } else { "to do" };
        let _ = writeln!(
            text,
            "{:name$}  {:op$}  {state:6}  {}  {}",
            stage.name,
            stage.op,
            &stage.key[..8],
            users(plan, stage)
        );
        details(&mut text, stage);
    }
    let mut totals = Vec::new();
    if plan.flop() > 0.0 {
        totals.push(format!("{} FLOP", scaled(plan.flop())));
    }
    if let Some(data) = plan.data() {
        let mut parts = Vec::new();
        if data.clips > 0 {
            parts.push(format!("{} clips", grouped(data.clips)));
        }
        if data.tokens > 0 {
            parts.push(format!("at most {} tokens", scaled(data.tokens as f64)));
        }
        parts.push(format!("{} on disk", bytes(data.bytes)));
        if data.core_hours > 0.0 {
            parts.push(format!("about {} core hours", rough(data.core_hours)));
        }
        let _ = writeln!(text, "\ndata to do: {}", parts.join(", "));
    }
    if let Some(memory) = plan.memory() {
        totals.push(format!("peak memory {}", bytes(memory)));
    }
    let (seconds, unknown) = plan.seconds();
    if to_do > unknown {
        let of_these = match unknown {
            0 => String::new(),
            n => format!(
                " and what {} take that no run has shown yet",
                count(n, "stage")
            ),
        };
        totals.push(format!("about {}{of_these}", duration(seconds)));
    }
    if !totals.is_empty() {
        let _ = writeln!(text, "\nto do: {}", totals.join(", "));
    }
    text
}

/// Which runs need a stage.
fn users(plan: &Planned, stage: &PlannedStage) -> String {
    match stage.cells.len() {
        _ if plan.cells.len() == 1 => String::new(),
        n if n == plan.cells.len() => "all runs".to_owned(),
        n if n > 4 => format!("{n} runs"),
        _ => {
            let names: Vec<&str> = stage
                .cells
                .iter()
                .map(|&i| plan.cells[i].as_str())
                .collect();
            names.join(" ")
        }
    }
}

fn details(text: &mut String, stage: &PlannedStage) {
    let plan = &stage.plan;
    if let Some((amount, unit)) = &plan.work {
        let _ = writeln!(text, "    {} {unit}", grouped(*amount));
    }
    for (name, shape) in &plan.shapes {
        let shape: Vec<String> = shape.iter().map(ToString::to_string).collect();
        let _ = writeln!(text, "    {name} [{}]", shape.join(", "));
    }
    if let Some(parameters) = plan.parameters {
        let parts: Vec<String> = plan
            .parameter_parts
            .iter()
            .map(|(name, count)| format!("{name} {}", grouped(*count)))
            .collect();
        let parts = if parts.is_empty() {
            String::new()
        } else {
            format!(": {}", parts.join(", "))
        };
        let _ = writeln!(text, "    {} parameters{parts}", grouped(parameters));
    }
    let width = plan
        .tokens
        .iter()
        .map(|t| t.modality.len())
        .max()
        .unwrap_or(0);
    for tokens in &plan.tokens {
        let _ = write!(
            text,
            "    {:width$}  {:>6} tokens of {:>6}",
            tokens.modality,
            grouped(tokens.tokens),
            grouped(tokens.vocabulary)
        );
        if let (Some(input), Some(target)) = (tokens.mean_input, tokens.mean_target) {
            let _ = write!(text, ", masking shows {input:.1} and asks for {target:.1}");
        }
        text.push('\n');
    }
    let mut costs = Vec::new();
    if let Some(memory) = plan.memory {
        costs.push(format!("peak memory {}", bytes(memory)));
    }
    if let Some(disk) = plan.disk {
        costs.push(format!("{} on disk", bytes(disk)));
    }
    if let Some(flop) = plan.flop {
        costs.push(format!("{} FLOP", scaled(flop)));
    }
    if let Some(seconds) = plan.seconds {
        costs.push(format!("about {}", duration(seconds)));
    }
    if !costs.is_empty() {
        let _ = writeln!(text, "    {}", costs.join(", "));
    }
    for line in &plan.lines {
        let _ = writeln!(text, "    {line}");
    }
}

/// `127 272 960`.
fn grouped(number: u64) -> String {
    let digits = number.to_string();
    let mut text = String::new();
    for (index, digit) in digits.chars().enumerate() {
        if index > 0 && (digits.len() - index).is_multiple_of(3) {
            text.push(' ');
        }
        text.push(digit);
    }
    text
}

/// `1.2 T`.
fn scaled(number: f64) -> String {
    let units = [
        (1e18, "E"),
        (1e15, "P"),
        (1e12, "T"),
        (1e9, "G"),
        (1e6, "M"),
    ];
    units.iter().find(|(size, _)| number >= *size).map_or_else(
        || format!("{number:.0}"),
        |(size, unit)| format!("{:.1} {unit}", number / size),
    )
}

/// Two digits of a number that is not known better.
fn rough(number: f64) -> String {
    if number < 10.0 {
        return format!("{number:.1}");
    }
    let scale = 10f64.powf(number.log10().floor() - 1.0);
    grouped(((number / scale).round() * scale) as u64)
}

/// `1.2 GiB`.
fn bytes(number: u64) -> String {
    let units = [
        (1u64 << 40, "TiB"),
        (1 << 30, "GiB"),
        (1 << 20, "MiB"),
        (1 << 10, "KiB"),
    ];
    units.iter().find(|(size, _)| number >= *size).map_or_else(
        || format!("{number} B"),
        |(size, unit)| format!("{:.1} {unit}", number as f64 / *size as f64),
    )
}

/// `2 h 5 min`.
fn duration(seconds: f64) -> String {
    let whole = seconds.round() as u64;
    match whole {
        0..60 => format!("{whole} s"),
        60..3600 => format!("{} min {} s", whole / 60, whole % 60),
        _ => format!("{} h {} min", whole / 3600, whole % 3600 / 60),
    }
}
