//! `mpirun -n 4 reviv run`: one run by several processes. Rank 0 has the run; the others do their part of its trainings.

use super::request::open;
use super::terminal::{Failure, Terminal};
use crate::engine::Communicator;
use crate::engine::communicator::launch::{self, LaunchError};
use crate::experiment::Experiment;
use crate::experiment::catalog::Catalog;
use crate::experiment::load::{Request, load};
use crate::run::Cache;
use crate::run::inputs::Fingerprints;
use crate::run::schedule::Schedule;
use crate::run::stage::peers::{Part, Peers};
use crate::run::{Interrupt, Progress, environment};
use serde::{Deserialize, Serialize};
use std::path::Path;

/// Joins the processes that were started with this one. With `apart` each works on its own, whoever started it.
///
/// # Errors
/// When there are others that cannot be reached; one of them says so.
pub fn join(terminal: &Terminal, apart: bool) -> Result<Communicator, Failure> {
    if apart {
        return Ok(Communicator::alone());
    }
    let tell = |error: &crate::engine::RankError| {
        Terminal::new().note(format_args!("error[E0808]: {error}; the job ends\n"));
    };
    launch::launch(tell).map_err(|error| refused(terminal, &error))
}

/// One of the processes says why none of them goes on.
fn refused(terminal: &Terminal, error: &LaunchError) -> Failure {
    if launch::here().is_some_and(|here| here.rank > 0) {
        return Failure::Ended(1);
    }
    terminal.note(format_args!("error[E0808]: {error}\n"));
    terminal.note(format_args!("  = help: {}\n", error.help()));
    Failure::Ended(1)
}

/// Refuses commands that several processes would only do several times.
///
/// # Errors
/// When this is one of several.
pub fn only_one(terminal: &Terminal, command: &str) -> Result<(), Failure> {
    let Some(here) = launch::here() else {
        return Ok(());
    };
    if here.rank == 0 {
        let (by, size) = (here.by, here.size);
        terminal.note(format_args!(
            "error[E0808]: `{by}` started {size} processes, and `reviv {command}` is done by one\n  = help: start it without `{by}`\n"
        ));
    }
    Err(Failure::Ended(1))
}

/// What all ranks must agree on.
#[derive(Debug, PartialEq, Eq, Serialize, Deserialize)]
struct Identity {
    host: String,
    binary: String,
    experiment: String,
    data: String,
}

impl Identity {
    fn of(experiment: &Experiment, prints: Fingerprints<'_>) -> Result<Self, String> {
        let schedule = Schedule::of(experiment, prints).map_err(|error| error.to_string())?;
        let (mut settings, mut data) = (blake3::Hasher::new(), blake3::Hasher::new());
        for work in &schedule.works {
            let own = work.settings.json();
            settings.update(format!("{} {} {own}\n", work.op, work.seed).as_bytes());
            for file in &work.files {
                data.update(format!("{} {}\n", file.key, file.blake3).as_bytes());
            }
        }
        let binary = std::env::current_exe().and_then(std::fs::read);
        let binary = binary.map_err(|error| format!("its own binary cannot be read: {error}"))?;
        Ok(Self {
            host: environment::host(),
            binary: blake3::hash(&binary).to_string(),
            experiment: settings.finalize().to_string(),
            data: data.finalize().to_string(),
        })
    }

    /// What of another rank is not as here.
    fn other(&self, other: &Self) -> Option<&'static str> {
        let checks = [
            (
                self.binary == other.binary,
                "it is another build of `reviv`",
            ),
            (
                self.experiment == other.experiment,
                "it reads another experiment",
            ),
            (self.data == other.data, "it sees other data"),
        ];
        checks
            .into_iter()
            .find(|(same, _)| !same)
            .map(|(_, what)| what)
    }
}

/// Opens the experiment on rank 0, which shows what is wrong with it.
///
/// # Errors
/// When it has errors, or the ranks do not agree on it.
pub fn open_together(
    world: &Communicator,
    catalog: &Catalog,
    request: &Request,
    runs: &Path,
    progress: &Progress,
    terminal: &Terminal,
) -> Result<Experiment, Failure> {
    let cache = Cache::of(runs);
    let opened = open(catalog, request, terminal).map(|(experiment, _)| experiment);
    if world.size() == 1 {
        return opened;
    }
    // The others read what rank 0 has read before them, and find its fingerprints.
    let identity = opened.and_then(|experiment| {
        let interrupt = Interrupt::default();
        let prints = Fingerprints::remembered(&cache).watched(progress, &interrupt);
        let identity = Identity::of(&experiment, prints).map_err(Failure::machine)?;
        Ok((experiment, identity))
    });
    let told = identity.as_ref().map(|_| Vec::new());
    let first = world.gather(told.map_err(|_| "rank 0 could not begin".to_owned()));
    let (experiment, identity) = identity?;
    let first = first.map_err(|error| error.to_string());
    let agreed = first.and_then(|_| compare(world, Ok(identity)));
    agreed.map_err(|error| {
        Failure::input(
            error,
            "start the same binary on the same files and data everywhere",
        )
    })?;
    let ranks = world.size();
    terminal.note(format_args!("ranks       {ranks}\n"));
    Ok(experiment)
}

/// Every rank tells what it has, and rank 0's must be it.
fn compare(world: &Communicator, mine: Result<Identity, String>) -> Result<(), String> {
    let told = mine.and_then(|mine| serde_json::to_vec(&mine).map_err(|error| error.to_string()));
    let all = world.gather(told).map_err(|error| error.to_string())?;
    let mut read = Vec::new();
    for bytes in &all {
        let identity: Identity = serde_json::from_slice(bytes).map_err(|e| e.to_string())?;
        read.push(identity);
    }
    let (size, first) = (read.len(), &read[0]);
    let other = read.iter().enumerate().find_map(|(rank, identity)| {
        let what = first.other(identity)?;
        let host = &identity.host;
        Some(format!(
            "rank {rank} of {size} on `{host}`: {what} than rank 0"
        ))
    });
    other.map_or(Ok(()), Err)
}

/// Does what rank 0 hands out, until it has no more.
///
/// # Errors
/// When rank 0 or the agreement fails; rank 0 says so.
pub fn serve(world: &Communicator, request: &Request, runs: &Path) -> Result<(), Failure> {
    let ended = |_| Failure::Ended(1);
    let cache = Cache::of(runs);
    // A signal reaches all; rank 0 decides what becomes of it.
    let interrupt = Interrupt::default();
    // Without a handler a signal ends the process, and with it the job.
    let _ = interrupt.on_signals(|| ());
    world.gather(Ok(Vec::new())).map_err(ended)?;
    let (experiment, report) = load(&Catalog::linked(), request);
    let experiment = experiment.ok_or_else(|| report.render(false));
    let prints = Fingerprints::borrowed(&cache);
    let identity = experiment.and_then(|experiment| Identity::of(&experiment, prints));
    compare(world, identity).map_err(|_| Failure::Ended(1))?;
    loop {
        let all = world.gather(Ok(Vec::new())).map_err(ended)?;
        let Some(part) = all.first().filter(|bytes| !bytes.is_empty()) else {
            return Ok(());
        };
        let part: Result<Part, _> = serde_json::from_slice(part);
        let done = part.map_err(|error| error.to_string());
        let done = done.and_then(|part| part.work(&cache).map_err(|error| error.to_string()));
        // Rank 0 has it in its record.
        let _ = world.settle(done);
    }
}

/// Rank 0's way to the others.
#[derive(Debug)]
pub struct Root(Communicator);

impl Root {
    /// For the rest of the process; `None` where rank 0 is alone.
    pub fn of(world: &Communicator) -> Option<&'static Self> {
        (world.size() > 1).then(|| &*Box::leak(Box::new(Self(world.clone()))))
    }

    /// Lets the others go.
    fn dismiss(&self) -> Result<(), String> {
        let all = self.0.gather(Ok(Vec::new()));
        all.map(drop).map_err(|error| error.to_string())
    }
}

impl Peers for Root {
    fn begin(&self, part: &Part) -> Result<(), String> {
        let bytes = serde_json::to_vec(part).map_err(|error| error.to_string())?;
        let all = self.0.gather(Ok(bytes));
        all.map(drop).map_err(|error| error.to_string())
    }

    fn end(&self, mine: Result<(), String>) -> Result<(), String> {
        self.0.settle(mine).map_err(|error| error.to_string())
    }
}

/// The end of the command on every rank.
pub fn leave(world: &Communicator, root: Option<&Root>, failed: bool, terminal: &Terminal) {
    let dismissed = root.map_or(Ok(()), Root::dismiss);
    let left = dismissed.and_then(|()| world.finish().map_err(|error| error.to_string()));
    if let Err(error) = left {
        if !failed {
            terminal.note(format_args!("error[E0808]: {error}\n"));
        }
        world.abort(2);
    }
}
