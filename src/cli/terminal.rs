//! Where output goes: data to stdout, everything else to stderr, colour only where a person looks.

use std::fmt::Display;
use std::io::IsTerminal as _;
use std::process::ExitCode;

/// Why a command failed.
#[derive(Debug)]
pub enum Failure {
    /// The user's input; has been reported already.
    Reported,
    /// The user's input: what is wrong, and the way out (empty for none).
    Input { message: String, help: String },
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
        }
    }

    /// Writes data to stdout. A reader that has seen enough ends the process quietly.
    pub fn data(&self, text: impl Display) {
        let written = write_to(&mut std::io::stdout().lock(), &text);
        if let Err(error) = written
            && error.kind() == std::io::ErrorKind::BrokenPipe
        {
            std::process::exit(0);
        }
    }

    /// Writes JSON to stdout.
    pub fn json(&self, value: &impl serde::Serialize) {
        match serde_json::to_string_pretty(value) {
            Ok(text) => self.data(format_args!("{text}\n")),
            Err(error) => self.note(format_args!("error: {error}\n")),
        }
    }

    /// Writes anything else to stderr.
    pub fn note(&self, text: impl Display) {
        // Where nobody listens, there is nobody to tell; the exit code still says it.
        let _ = write_to(&mut std::io::stderr().lock(), &text);
    }

    /// Says why the command failed; gives the exit code.
    pub fn fail(&self, failure: Failure) -> ExitCode {
        match failure {
            Failure::Reported => ExitCode::from(1),
            Failure::Ended(code) => ExitCode::from(code),
            Failure::Input { message, help } => {
                self.note(format_args!("error: {message}\n"));
                if !help.is_empty() {
                    self.note(format_args!("hint: {help}\n"));
                }
                ExitCode::from(1)
            }
            Failure::Machine(message) => {
                self.note(format_args!("error: {message}\n"));
                ExitCode::from(2)
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
