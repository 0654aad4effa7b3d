//! One file per folder of vectors; [`report`] and [`vectors`] are what they share, [`checks`] what they share with other
//! checks.

#[path = "../checks/mod.rs"]
mod checks;
pub mod report;
pub mod vectors;

mod cosmos;
mod generation;
mod mask;
mod mget;
mod optim;
mod structure;
mod tmr;
mod vda;
mod vda_video;
mod vq;

use std::cell::RefCell;
use std::path::Path;

use reviv::engine::{Compute, Precision};

pub use checks::Outcome;
use report::Report;

/// Compares one folder.
type Check = fn(&Path, &mut Report) -> Outcome;

/// The folders that are known, and what compares each.
const FOLDERS: &[(&str, Check)] = &[
    ("cosmos", cosmos::check),
    ("gen", generation::check),
    ("mask", mask::check),
    ("mget", mget::check),
    ("optim", optim::check),
    ("structure", structure::check),
    ("tmr", tmr::check),
    ("vda", vda::check),
    ("vq", vq::check),
];

/// What products of bfloat16 may be off.
const BF16: f64 = 2e-2;

thread_local! {
    /// What computes.
    static DEVICE: RefCell<Compute> = RefCell::new(Compute::cpu());
}

/// What computes.
fn compute() -> Compute {
    DEVICE.with_borrow(Clone::clone)
}

/// How far off a number may be that a file allows `tolerance`.
fn allowed(tolerance: f64) -> f64 {
    match compute().precision() {
        Precision::F32 => tolerance,
        Precision::Bf16 => tolerance.max(BF16),
    }
}

/// Lets `compute` compute everything below `folder`: one known folder, or a set of them; compares.
pub fn check(folder: &Path, compute: &Compute) -> Outcome<Report> {
    DEVICE.set(compute.clone());
    let mut report = Report::default();
    for (_, check, folder) in checks::subjects(folder, FOLDERS)? {
        check(&folder, &mut report)?;
    }
    Ok(report)
}
