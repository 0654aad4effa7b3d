//! One file per folder of vectors; [`report`] and [`vectors`] are what they share.

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

use reviv::engine::Compute;

use report::Report;

/// An error of the check itself: a file that cannot be read, a model that cannot be built.
pub type Outcome<T = ()> = Result<T, Box<dyn std::error::Error>>;

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

thread_local! {
    /// What computes.
    static DEVICE: RefCell<Compute> = RefCell::new(Compute::cpu());
}

/// What computes.
fn compute() -> Compute {
    DEVICE.with_borrow(Clone::clone)
}

/// Lets `compute` compute everything below `folder`: one known folder, or a set of them; compares.
pub fn check(folder: &Path, compute: &Compute) -> Outcome<Report> {
    DEVICE.set(compute.clone());
    let folder = &folder
        .canonicalize()
        .map_err(|error| format!("{}: {error}", folder.display()))?;
    let mut report = Report::default();
    let own = folder.file_name().and_then(|name| name.to_str());
    if let Some((_, check)) = FOLDERS.iter().find(|(name, _)| Some(*name) == own) {
        check(folder, &mut report)?;
        return Ok(report);
    }
    let present: Vec<_> = FOLDERS
        .iter()
        .filter(|(name, _)| folder.join(name).is_dir())
        .collect();
    if present.is_empty() {
        let known: Vec<&str> = FOLDERS.iter().map(|(name, _)| *name).collect();
        return Err(format!(
            "{} is none of, and holds none of: {}",
            folder.display(),
            known.join(" ")
        )
        .into());
    }
    for (name, check) in present {
        check(&folder.join(name), &mut report)?;
    }
    Ok(report)
}
