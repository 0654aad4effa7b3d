//! Compares this implementation with numbers of the reference: `cargo run --example check_parity -- DIR`.
//!
//! `DIR` holds a set of vectors (`vq/`, `optim/`, ...), or is one of those folders. Settings, sizes and tolerances are read
//! from the files. Prints one line per tensor, the worst last, and exits 1 if any is off.

#[path = "check_parity/mod.rs"]
mod check_parity;

use std::process::ExitCode;

fn main() -> ExitCode {
    let Some(folder) = std::env::args_os().nth(1) else {
        eprintln!("usage: check_parity DIR");
        return ExitCode::from(2);
    };
    match check_parity::check(folder.as_ref()) {
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
