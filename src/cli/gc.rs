//! `reviv gc`: prunes the cache.

use super::run::{RunsDir, tell};
use super::terminal::{Failure, Terminal};
use crate::run::gc::{Options, prune};

/// Remove artifacts that no run refers to, and what killed processes left behind
#[derive(Debug, clap::Args)]
pub struct Gc {
    /// Only say what would be removed
    #[arg(long)]
    dry_run: bool,
    /// Also remove the checkpoints of finished stages
    #[arg(long)]
    checkpoints: bool,
    /// Write the result as JSON to stdout
    #[arg(long)]
    json: bool,
    #[command(flatten)]
    place: RunsDir,
}

impl super::Run for Gc {
    fn run(self, terminal: &Terminal) -> Result<(), Failure> {
        let options = Options {
            dry_run: self.dry_run,
            checkpoints: self.checkpoints,
        };
        let pruned = prune(&self.place.runs, options).map_err(|error| tell(terminal, &error))?;
        if self.json {
            terminal.json(&pruned);
            return Ok(());
        }
        let verb = if self.dry_run {
            "would remove"
        } else {
            "removed"
        };
        for path in &pruned.paths {
            terminal.data(format_args!("{verb} {}\n", path.display()));
        }
        let megabytes = pruned.bytes as f64 / 1e6;
        terminal.note(format_args!(
            "{verb} {} paths, {megabytes:.1} MB; {} artifacts are in use by runs\n",
            pruned.paths.len(),
            pruned.kept
        ));
        Ok(())
    }
}
