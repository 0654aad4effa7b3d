//! `reviv view`: the page of a reconstruction, opened as a double click would.

use super::run::{RunsDir, find, tell};
use super::terminal::{Failure, Terminal};
use crate::reconstruction::folder::{FOLDER, PAGE};
use crate::run::schedule::Schedule;
use crate::run::{Cache, RunDirectory};
use std::path::{Path, PathBuf};

/// Open the page of a reconstruction: one HTML file that needs no network and no server
///
/// Its path goes to stdout. Nothing is opened where there is no screen, or where there are several pages.
#[derive(Debug, clap::Args)]
pub struct View {
    /// A run with a `reconstruct` stage, a reconstruction folder, or a page
    #[arg(value_name = "RUN")]
    run: PathBuf,
    /// Print the path alone, and open nothing
    #[arg(long)]
    print: bool,
    /// Copy the page to this file, and open nothing
    #[arg(short, long, value_name = "FILE")]
    output: Option<PathBuf>,
    /// The report of a run instead: its results, curves and origin
    #[arg(long)]
    report: bool,
    #[command(flatten)]
    place: RunsDir,
}

impl super::Run for View {
    fn run(self, terminal: &Terminal) -> Result<(), Failure> {
        let pages = self.pages(terminal)?;
        if let Some(output) = &self.output {
            let [page] = pages.as_slice() else {
                return Err(Failure::input(
                    format!("there are {} pages", pages.len()),
                    "leave out `-o`, and copy the one you want",
                ));
            };
            std::fs::copy(page, output)
                .map_err(|error| Failure::machine(format_args!("{}: {error}", output.display())))?;
            terminal.data(format_args!("{}\n", output.display()));
            return Ok(());
        }
        for page in &pages {
            terminal.data(format_args!("{}\n", page.display()));
        }
        if self.print {
            return Ok(());
        }
        match pages.as_slice() {
            [page] => show(terminal, page),
            _ => terminal.note("several pages: `reviv view PAGE` opens one\n"),
        }
        Ok(())
    }
}

impl View {
    fn pages(&self, terminal: &Terminal) -> Result<Vec<PathBuf>, Failure> {
        let is_page = self.run.extension().is_some_and(|e| e == "html") && self.run.is_file();
        if is_page && !self.report {
            return Ok(vec![self.run.clone()]);
        }
        let own = self.run.join(PAGE);
        if own.is_file() && !self.report {
            return Ok(vec![own]);
        }
        let run = find(terminal, &self.place.runs, &self.run)?;
        if self.report {
            return Ok(vec![report_of(&run)?]);
        }
        let schedule = Schedule::read(&run).map_err(|error| tell(terminal, &error))?;
        let cache = Cache::of(run.runs());
        let pages: Vec<PathBuf> = schedule
            .works
            .iter()
            .map(|work| cache.path(&work.key).join(FOLDER).join(PAGE))
            .filter(|page| page.is_file())
            .collect();
        if pages.is_empty() {
            return Err(Failure::input(
                format!("run `{}` has no finished reconstruction", run.name()),
                "`--report` opens the run's other results; `reviv reconstruct VIDEO` makes a reconstruction",
            ));
        }
        Ok(pages)
    }
}

fn report_of(run: &RunDirectory) -> Result<PathBuf, Failure> {
    let report = run.report();
    if report.is_file() {
        return Ok(report);
    }
    Err(Failure::input(
        format!("run `{}` has no report yet", run.name()),
        "it is written when the run ends or is interrupted",
    ))
}

/// Hands the page to whatever opens pages here. That it cannot be opened is no failure: its path has been printed.
fn show(terminal: &Terminal, page: &Path) {
    if !has_screen() {
        terminal.note("no screen here: copy the page to where there is one; it is a single file\n");
        return;
    }
    // An absolute path is never taken for an option.
    let opened = std::path::absolute(page).and_then(open::that_detached);
    if let Err(error) = opened {
        terminal.note(format_args!("nothing here opens a page: {error}\n"));
    }
}

/// Without one, openers wait for each other in vain, or start a browser of the terminal.
fn has_screen() -> bool {
    let told = |name: &str| std::env::var_os(name).is_some_and(|value| !value.is_empty());
    let always = cfg!(any(windows, target_os = "macos"));
    always
        || ["DISPLAY", "WAYLAND_DISPLAY", "WSL_DISTRO_NAME"]
            .into_iter()
            .any(told)
}
