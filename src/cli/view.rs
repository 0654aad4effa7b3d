//! `reviv view`: the page of a reconstruction.

use super::run::{RunsDir, find, tell};
use super::terminal::{Failure, Terminal};
use crate::reconstruction::folder::{FOLDER, PAGE};
use crate::run::Cache;
use crate::run::files;
use crate::run::schedule::Schedule;
use std::path::PathBuf;

/// Give the page of a reconstruction: one HTML file that needs no network and no server
#[derive(Debug, clap::Args)]
pub struct View {
    /// A run with a `reconstruct` stage, or a reconstruction folder
    #[arg(value_name = "RUN")]
    run: PathBuf,
    /// Copy the page to this file
    #[arg(short, long, value_name = "FILE")]
    output: Option<PathBuf>,
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
        for page in pages {
            terminal.data(format_args!("{}\n", page.display()));
        }
        Ok(())
    }
}

impl View {
    fn pages(&self, terminal: &Terminal) -> Result<Vec<PathBuf>, Failure> {
        let own = self.run.join(PAGE);
        if own.is_file() {
            return Ok(vec![own]);
        }
        let run = find(terminal, &self.place.runs, &self.run)?;
        let schedule: Schedule = files::read_json(&run.path().join("plan.json"))
            .map_err(|error| tell(terminal, &error))?;
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
                "`reviv reconstruct VIDEO` makes one; `reviv run` shows any other result in its report",
            ));
        }
        Ok(pages)
    }
}
