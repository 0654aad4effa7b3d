//! One file per data set; [`golden`] (the answers), [`compare`] and [`report`] are what they share, [`checks`] what they share with other
//! checks.

#[path = "../checks/mod.rs"]
mod checks;
pub mod compare;
pub mod golden;
pub mod report;

mod arctic;
mod ego_exo4d;
mod egogen;
mod fake_mano;
mod h2o;
mod holoassist;
mod hot3d_clips;
mod nymeria;
mod taco;

use std::path::Path;

pub use checks::Outcome;
use report::Report;

/// Compares the recordings in the folder of one data set with the golden files beside them.
type Check = fn(&Path, &mut Report) -> Outcome;

/// The folders that are known, and what checks each.
const SETS: &[(&str, Check)] = &[
    ("nymeria", nymeria::check),
    ("ego_exo4d", ego_exo4d::check),
    ("holoassist", holoassist::check),
    ("egogen", egogen::check),
    ("fake_mano", fake_mano::check),
    ("arctic", arctic::check),
    ("taco", taco::check),
    ("h2o", h2o::check),
    ("hot3d_clips", hot3d_clips::check),
];

/// Checks everything below `folder`: one known folder, or a set of them.
pub fn check(folder: &Path) -> Outcome<Report> {
    let mut report = Report::default();
    for (name, check, folder) in checks::subjects(folder, SETS)? {
        report.begin(name);
        // A set that cannot be read fails; the others are still checked.
        if let Err(error) = check(&folder, &mut report) {
            report.problem("read", &error.to_string());
        }
    }
    Ok(report)
}
