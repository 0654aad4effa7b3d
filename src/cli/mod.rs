//! The command line: one file per command. Parse, call, print; nothing else prints.

use std::process::ExitCode;

/// Runs the `reviv` command line on the process arguments. Plug-in binaries call this from their own `main`.
pub fn main() -> ExitCode {
    ExitCode::SUCCESS
}
