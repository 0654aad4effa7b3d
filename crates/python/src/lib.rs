//! The native half of the Python package `reviv`: what needs the library. `python/reviv/` is the half that users read.
//!
//! Arrays go to NumPy by moving them, or as read-only views of what an object here holds and keeps alive ([`arrays`]). Compute runs
//! without Python's lock; a callback takes it back for as long as it runs ([`progress`]).
#![allow(non_snake_case)]

mod arrays;
mod clips;
mod error;
mod model;
mod progress;
mod reconstruction;
mod table;

use pyo3::prelude::*;
use std::ffi::OsString;
use std::path::PathBuf;

/// Steps allocate the same arrays again and again.
#[global_allocator]
static MEMORY: reviv::engine::memory::Pool = reviv::engine::memory::Pool;

#[pymodule]
mod _reviv {
    #[pymodule_export]
    use super::clips::{Clip, Clips, Tokens, open_clips, open_tokens, world};
    #[pymodule_export]
    use super::error::{Error, Stopped};
    #[pymodule_export]
    use super::model::{Model, evaluate, open_model};
    #[pymodule_export]
    use super::reconstruction::{Reconstruction, reconstruct, skeleton};
    #[pymodule_export]
    use super::table::{Table, compare};
    #[pymodule_export]
    use super::{main, version};
}

/// The command line with these arguments, the first of which is the program's name; `module` is the file of this module, which
/// the record of a run names as its program, `python` what runs it (empty for unknown). Returns the exit code.
#[pyfunction]
fn main(py: Python<'_>, arguments: Vec<OsString>, module: PathBuf, python: PathBuf) -> u8 {
    reviv::run::environment::program_is(module);
    if !python.as_os_str().is_empty() {
        reviv::cli::python_is(python);
    }
    py.detach(|| reviv::cli::main_with(arguments))
}

/// Of the library.
#[pyfunction]
fn version() -> &'static str {
    env!("CARGO_PKG_VERSION")
}
