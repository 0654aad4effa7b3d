//! `reviv why`: the chain of layers that set a value.

use super::request::{Changes, open};
use super::terminal::{Failure, Terminal};
use crate::experiment::catalog::Catalog;
use crate::experiment::why;
use std::path::PathBuf;

/// Show the chain of layers that set a value
#[derive(Debug, clap::Args)]
pub struct Why {
    /// The experiment or sweep
    file: PathBuf,
    /// The value: `stages.mget.masking.alpha`; a stage, for all of its values
    key: String,
    /// The arm of a sweep; the first one otherwise
    #[arg(long)]
    arm: Option<String>,
    #[command(flatten)]
    changes: Changes,
    /// Write JSON to stdout
    #[arg(long)]
    json: bool,
}

impl super::Run for Why {
    fn run(self, terminal: &Terminal) -> Result<(), Failure> {
        let catalog = Catalog::linked();
        let (experiment, _) = open(&catalog, &self.changes.look(&self.file), terminal)?;
        let answers = why::explain(&catalog, &experiment, self.arm.as_deref(), &self.key)
            .map_err(|(message, help)| Failure::input(message, help))?;
        if self.json {
            terminal.json(&answers);
        } else {
            terminal.data(why::render(&answers));
        }
        Ok(())
    }
}
