//! `reviv schema`: what an editor with a YAML language server completes from.

use super::terminal::{Failure, Terminal};
use crate::experiment::catalog::Catalog;
use crate::experiment::schema;
use std::path::PathBuf;

/// Write the JSON schema of experiments and registry entries, for editors
#[derive(Debug, clap::Args)]
pub struct Schema {
    /// Where to write it; `-` for stdout
    #[arg(
        short,
        long,
        default_value = "registry/schema.json",
        value_name = "FILE"
    )]
    output: PathBuf,
}

impl super::Run for Schema {
    fn run(self, terminal: &Terminal) -> Result<(), Failure> {
        let text = schema::text(&Catalog::linked());
        if self.output.as_os_str() == "-" {
            terminal.data(text);
            return Ok(());
        }
        let failed = |error: std::io::Error| {
            Failure::machine(format!("writing `{}`: {error}", self.output.display()))
        };
        if let Some(folder) = self.output.parent() {
            std::fs::create_dir_all(folder).map_err(failed)?;
        }
        std::fs::write(&self.output, text).map_err(failed)?;
        terminal.note(format_args!("wrote {}\n", self.output.display()));
        terminal.note(
            "hint: start a YAML file with `# yaml-language-server: $schema=PATH` to complete from it\n",
        );
        Ok(())
    }
}
