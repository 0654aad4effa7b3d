//! `reviv completions`: for the shell.

use super::terminal::{Failure, Terminal};

/// Print completions for a shell
#[derive(Debug, clap::Args)]
pub struct Completions {
    /// The shell
    shell: clap_complete::Shell,
}

impl super::Run for Completions {
    fn run(self, terminal: &Terminal) -> Result<(), Failure> {
        let mut text = Vec::new();
        clap_complete::generate(self.shell, &mut super::grammar(), "reviv", &mut text);
        terminal.data(String::from_utf8_lossy(&text));
        Ok(())
    }
}
