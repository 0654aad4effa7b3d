//! The command line: one file per command. Parse, call, print; nothing else prints.
//!
//! A new command is a new file with a `clap::Args` struct that implements [`Run`], a `mod` line and a line in
//! `commands!`. Its doc comment is its help.

mod check;
mod compare;
mod completions;
mod data;
mod gc;
mod import;
mod list;
mod machine;
mod new;
mod plan;
mod plan_devices;
mod ranks;
mod reconstruct;
mod request;
mod rerun;
mod run;
mod schema;
mod show;
mod sweep_table;
mod terminal;
mod verify;
mod view;
mod why;

use clap::{CommandFactory as _, Parser as _};
use std::ffi::OsString;
use std::process::ExitCode;

pub use compare::entrants_of;
pub use reconstruct::{artifact_of, find_model};
pub use rerun::python_is;
pub use terminal::{Failure, Terminal};

/// A command, parsed.
pub trait Run {
    /// Does it. What it prints goes through the terminal.
    ///
    /// # Errors
    /// When the command has failed: the user's input (exit code 1), or the machine (exit code 2).
    fn run(self, terminal: &Terminal) -> Result<(), Failure>;
}

macro_rules! commands {
    ($($module:ident :: $name:ident),* $(,)?) => {
        #[derive(clap::Subcommand)]
        enum Command {
            $($name(Box<$module::$name>),)*
        }

        impl Run for Command {
            fn run(self, terminal: &Terminal) -> Result<(), Failure> {
                match self {
                    $(Self::$name(command) => command.run(terminal),)*
                }
            }
        }
    };
}

// In the order of `reviv --help`.
commands! {
    reconstruct::Reconstruct,
    view::View,
    run::Run,
    check::Check,
    plan::Plan,
    why::Why,
    list::List,
    show::Show,
    compare::Compare,
    verify::Verify,
    gc::Gc,
    import::Import,
    data::Data,
    new::New,
    schema::Schema,
    completions::Completions,
}

/// Reconstruct the viewer and the view in 4D from one head-mounted video.
#[derive(clap::Parser)]
#[command(name = "reviv", version, about, max_term_width = 100)]
#[command(
    after_help = "Exit codes: 0 done, 1 the input is at fault, 2 the machine or a bug, 130 stopped by Ctrl-C"
)]
struct Arguments {
    #[command(subcommand)]
    command: Command,
}

/// The whole command line, for completions.
fn grammar() -> clap::Command {
    Arguments::command()
}

/// Runs the `reviv` command line on the process arguments. Plug-in binaries call this from their own `main`.
///
/// Exit codes: 0 done, 1 the user's input, 2 the machine or a bug, 130 stopped by Ctrl-C (the run continues when asked again).
pub fn main() -> ExitCode {
    ExitCode::from(main_with(std::env::args_os()))
}

/// As [`main`], on these arguments, the first of which is the program's name; gives the exit code.
pub fn main_with(arguments: impl IntoIterator<Item = OsString>) -> u8 {
    let terminal = Terminal::new();
    match Arguments::try_parse_from(arguments) {
        Ok(arguments) => terminal.end(arguments.command.run(&terminal)),
        Err(error) => terminal.usage(&error),
    }
}
