//! Where output goes: data to stdout, everything else to stderr, colour only where a person looks.

use std::fmt::Display;
use std::io::IsTerminal as _;
use std::sync::OnceLock;

/// Why a command failed.
#[derive(Debug)]
pub enum Failure {
    /// The user's input; has been reported already.
    Reported,
    /// The user's input: what is wrong, and the way out (empty for none).
    Input {
        /// What is wrong, in a sentence or two, as it is printed.
        message: String,
        /// The way out, as it is printed; empty for none.
        help: String,
    },
    /// The machine, or a bug.
    Machine(String),
    /// Anything that has been reported already and ends the process with this code.
    Ended(u8),
}

impl Failure {
    /// The user's input: what is wrong, and the way out (empty for none).
    pub fn input(message: impl Into<String>, help: impl Into<String>) -> Self {
        Self::Input {
            message: message.into(),
            help: help.into(),
        }
    }

    /// The machine, or a bug.
    pub fn machine(error: impl Display) -> Self {
        Self::Machine(error.to_string())
    }
}

/// The two output streams.
#[derive(Debug)]
pub struct Terminal {
    /// Whether stderr shows colour.
    pub colour: bool,
    /// Whether stderr is looked at by a person.
    pub interactive: bool,
    /// Why data did not reach stdout, once.
    lost: OnceLock<String>,
}

impl Terminal {
    /// What this process writes to. `NO_COLOR` and `TERM=dumb` are respected.
    pub fn new() -> Self {
        let interactive = std::io::stderr().is_terminal();
        let refused = std::env::var_os("NO_COLOR").is_some_and(|value| !value.is_empty())
            || std::env::var_os("TERM").is_some_and(|term| term == "dumb");
        Self {
            colour: interactive && !refused,
            interactive,
            lost: OnceLock::new(),
        }
    }

    /// Writes data to stdout. A reader that has seen enough ends the process quietly; any other failure is remembered, and
    /// [`Terminal::end`] says it.
    pub fn data(&self, text: impl Display) {
        if let Err(error) = write_to(&mut std::io::stdout().lock(), &text) {
            if error.kind() == std::io::ErrorKind::BrokenPipe {
                std::process::exit(0);
            }
            self.lose(format!("stdout: {error}"));
        }
    }

    /// Remembers the first reason why data was lost.
    fn lose(&self, reason: String) {
        self.lost.get_or_init(|| reason);
    }

    /// Writes JSON to stdout.
    pub fn json(&self, value: &impl serde::Serialize) {
        match serde_json::to_string_pretty(value) {
            Ok(text) => self.data(format_args!("{text}\n")),
            Err(error) => self.lose(error.to_string()),
        }
    }

    /// Prints what the command line itself has to say: help and version to stdout, mistakes to stderr.
    pub fn usage(&self, error: &clap::Error) -> u8 {
        match error.print() {
            Err(failed)
                if !error.use_stderr() && failed.kind() != std::io::ErrorKind::BrokenPipe =>
            {
                self.lose(format!("stdout: {failed}"));
            }
            // A closed pipe is no reason to complain.
            _ => {}
        }
        self.end(if error.use_stderr() {
            Err(Failure::Reported)
        } else {
            Ok(())
        })
    }

    /// The end of the process: says why the command failed, and that what it printed did not arrive. Gives the exit code.
    pub fn end(&self, result: Result<(), Failure>) -> u8 {
        let lost = self.lost.get().cloned().map(Failure::Machine);
        match (result, lost) {
            (Ok(()), None) => 0,
            (Ok(()), Some(failure)) | (Err(failure), None) => self.fail(failure),
            (Err(failure), Some(lost)) => {
                self.fail(lost);
                self.fail(failure)
            }
        }
    }

    /// Writes anything else to stderr.
    pub fn note(&self, text: impl Display) {
        // Where nobody listens, there is nobody to tell; the exit code still says it.
        let _ = write_to(&mut std::io::stderr().lock(), &text);
    }

    /// Says why the command failed; gives the exit code.
    fn fail(&self, failure: Failure) -> u8 {
        match failure {
            Failure::Reported => 1,
            Failure::Ended(code) => code,
            Failure::Input { message, help } => {
                self.note(format_args!("error: {message}\n"));
                if !help.is_empty() {
                    self.note(format_args!("hint: {help}\n"));
                }
                1
            }
            Failure::Machine(message) => {
                self.note(format_args!("error: {message}\n"));
                2
            }
        }
    }
}

impl Default for Terminal {
    fn default() -> Self {
        Self::new()
    }
}

fn write_to(stream: &mut impl std::io::Write, text: &impl Display) -> std::io::Result<()> {
    write!(stream, "{text}").and_then(|()| stream.flush())
}
