//! Reads samples in the on-disk layouts of the data sets and compares the clips with golden answers:
//! `cargo run --release --example check_layouts -- DIR`.
//!
//! `DIR` holds a folder per data set (`nymeria/`, `holoassist/`, ...), or is one of those folders. Each has recordings in the
//! layout of the data set and one `golden*.npz` per recording. Prints one line per compared quantity, the worst of each set, then
//! how many passed; exits 1 if any is off.

#[path = "check_layouts/mod.rs"]
mod check_layouts;

use std::process::ExitCode;

fn main() -> ExitCode {
    let Some(folder) = std::env::args_os().nth(1) else {
        eprintln!("usage: check_layouts DIR");
        return ExitCode::from(2);
    };
    match check_layouts::check(folder.as_ref()) {
        Ok(report) => {
            print!("{report}");
            ExitCode::from(u8::from(!report.passed()))
        }
        Err(error) => {
            eprintln!("error: {error}");
            ExitCode::from(2)
        }
    }
}
