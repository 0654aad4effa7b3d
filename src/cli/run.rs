//! `reviv run`: an experiment or a sweep, from where it stands to its end.

use super::ranks::{self, Root};
use super::request::Changes;
use super::sweep_table;
use super::terminal::{Failure, Terminal};
use crate::engine::Communicator;
use crate::experiment::Experiment;
use crate::experiment::catalog::Catalog;
use crate::run::execute::{Job, Outcome, execute};
use crate::run::{Interrupt, Progress, RunError, Shard, State, WorkerPool};
use std::path::{Path, PathBuf};

/// Run an experiment or a sweep; continue it where it was interrupted
#[derive(Debug, clap::Args)]
pub struct Run {
    /// The experiment or sweep
    #[arg(value_name = "FILE")]
    file: PathBuf,
    #[command(flatten)]
    changes: Changes,
    /// Only this stage, and what it needs
    #[arg(long, value_name = "STAGE")]
    only: Option<String>,
    /// Do one of N parts of a sweep; run the others beside it, on any machine that shares the disk
    #[arg(long, value_name = "I/N", default_value_t = Shard::WHOLE)]
    shard: Shard,
    /// Read every byte of what is in the cache before it is used, and make again what is damaged; without it, only files that were
    /// written to since they were made are read
    #[arg(long)]
    check: bool,
    /// Stages made at the same time [default: as many as there are cores, up to 4, as far as their planned memory fits into half
    /// of the machine's]
    #[arg(long, short, value_name = "N", value_parser = clap::value_parser!(u16).range(1..))]
    jobs: Option<u16>,
    #[command(flatten)]
    place: RunsDir,
}

/// Where runs are kept.
#[derive(Debug, Clone, clap::Args)]
pub struct RunsDir {
    /// The directory of runs and of the cache
    #[arg(long, value_name = "DIR", default_value = "runs")]
    pub runs: PathBuf,
}

impl super::Run for Run {
    fn run(self, terminal: &Terminal) -> Result<(), Failure> {
        let world = ranks::join(terminal, self.shard != Shard::WHOLE)?;
        if !world.is_root() {
            let request = self.changes.request(&self.file);
            let served = ranks::serve(&world, &request, &self.place.runs);
            ranks::leave(&world, None, served.is_err(), terminal);
            // Rank 0 ends with the code of the run.
            return Ok(());
        }
        let (root, result) = self.alone(&world, terminal);
        ranks::leave(&world, root, result.is_err(), terminal);
        result
    }
}

impl Run {
    /// What one process does, or rank 0 of several.
    fn alone(
        self,
        world: &Communicator,
        terminal: &Terminal,
    ) -> (Option<&'static Root>, Result<(), Failure>) {
        let catalog = Catalog::linked();
        let request = self.changes.request(&self.file);
        let opened = ranks::open_together(
            world,
            &catalog,
            &request,
            &self.place.runs,
            &progress(terminal),
            terminal,
        );
        match opened {
            Ok(experiment) => {
                let root = Root::of(world);
                (root, self.execute(&catalog, &experiment, root, terminal))
            }
            Err(failure) => (None, Err(failure)),
        }
    }

    fn execute(
        self,
        catalog: &Catalog,
        experiment: &Experiment,
        root: Option<&'static Root>,
        terminal: &Terminal,
    ) -> Result<(), Failure> {
        let interrupt = interruptible(terminal)?;
        let progress = progress(terminal);
        let crew = match root {
            Some(root) => WorkerPool::together(root),
            None => WorkerPool::of_this_machine(self.jobs.map(usize::from)),
        };
        let job = Job {
            experiment,
            runs: &self.place.runs,
            only: self.only.as_deref(),
            shard: self.shard,
            check: self.check,
            crew,
            progress: &progress,
            interrupt: &interrupt,
        };
        let outcome = execute(&job).map_err(|error| tell(terminal, &error))?;
        if let (State::Done, Some(compare)) = (outcome.state, &experiment.compare) {
            let table = sweep_table::write(catalog, experiment, compare, &outcome)?;
            terminal.note(format_args!("\n{table}\n"));
        }
        finish(terminal, &outcome, &interrupt)
    }
}

/// Says what became of the run. The path of its page is the data.
fn finish(terminal: &Terminal, outcome: &Outcome, interrupt: &Interrupt) -> Result<(), Failure> {
    let path = outcome.run.path().display();
    for error in &outcome.failures {
        tell(terminal, error);
    }
    let word = match outcome.state {
        State::Done if outcome.made == 0 => "done before".to_owned(),
        State::Done => format!(
            "done: {} made, {} found in the cache",
            outcome.made, outcome.found
        ),
        State::Queued => "this part is done; others of the run are not".to_owned(),
        state => state.to_string(),
    };
    terminal.note(format_args!("{path}: {word}\n"));
    match outcome.state {
        State::Interrupted => {
            terminal.note("hint: ask for the same experiment again and it continues\n");
            Err(Failure::Ended(if interrupt.requested() { 130 } else { 2 }))
        }
        State::Failed => {
            let worst = outcome.failures.iter().map(RunError::exit_code).max();
            Err(Failure::Ended(worst.unwrap_or(2)))
        }
        _ => {
            terminal.data(format_args!("{}\n", outcome.run.report().display()));
            Ok(())
        }
    }
}

/// Shows an error of the record and gives the failure that ends the command with its code.
pub fn tell(terminal: &Terminal, error: &RunError) -> Failure {
    terminal.note(format_args!("error[{}]: {error}\n", error.code()));
    let help = error.help();
    if !help.is_empty() {
        terminal.note(format_args!("  = help: {help}\n"));
    }
    Failure::Ended(error.exit_code())
}

/// A flag that Ctrl-C sets.
pub fn interruptible(terminal: &Terminal) -> Result<Interrupt, Failure> {
    let interrupt = Interrupt::default();
    let told = || {
        Terminal::new()
            .note("\nstopping at the next point to continue from; Ctrl-C again stops at once\n");
    };
    let set = interrupt.on_signals(told);
    set.map_err(|error| tell(terminal, &error))?;
    Ok(interrupt)
}

/// Bars for a person, lines for a file.
pub fn progress(terminal: &Terminal) -> Progress {
    if terminal.interactive {
        Progress::terminal()
    } else {
        Progress::lines(Box::new(std::io::stderr()))
    }
}

/// A run by its path or name.
pub fn find(
    terminal: &Terminal,
    runs: &Path,
    name: impl AsRef<Path>,
) -> Result<crate::run::RunDirectory, Failure> {
    crate::run::RunDirectory::named(runs, name).map_err(|error| tell(terminal, &error))
}
