//! Exceptions with the words of the command line.

use pyo3::create_exception;
use pyo3::exceptions::PyException;
use pyo3::prelude::*;
use reviv::cli::Failure;
use reviv::run::RunError;
use std::fmt::Display;

create_exception!(
    reviv,
    Error,
    PyException,
    "What went wrong, in the words of the command line; `help` is the way out, where there is one."
);
create_exception!(reviv, Stopped, Error, "A progress callback returned False.");

/// An [`Error`] that says this, with a way out (empty for none).
pub fn refused(py: Python<'_>, message: impl Display, help: &str) -> PyErr {
    let text = if help.is_empty() {
        message.to_string()
    } else {
        format!("{message}\nhint: {help}")
    };
    let error = Error::new_err(text);
    match error.value(py).setattr("help", help) {
        Ok(()) => error,
        Err(failed) => failed,
    }
}

/// An error of the record of runs.
pub fn of_run(py: Python<'_>, error: &RunError) -> PyErr {
    refused(py, error, &error.help())
}

/// A command's failure.
pub fn of_command(py: Python<'_>, failure: Failure) -> PyErr {
    match failure {
        Failure::Input { message, help } => refused(py, message, &help),
        Failure::Machine(message) => refused(py, message, ""),
        Failure::Reported => refused(py, "refused; the reason was printed", ""),
        Failure::Ended(code) => refused(py, format!("ended with exit code {code}"), ""),
    }
}
