//! One file per data set; [`golden`] (the answers), [`compare`] and [`report`] are what they share.

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

use report::Report;

/// An error of the check itself: a golden file that cannot be read.
pub type Outcome<T = ()> = Result<T, Box<dyn std::error::Error>>;

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
    let folder = &folder
        .canonicalize()
        .map_err(|error| format!("{}: {error}", folder.display()))?;
    let mut report = Report::default();
    let own = folder.file_name().and_then(|name| name.to_str());
    let mut present: Vec<_> = SETS
        .iter()
        .filter(|(name, _)| folder.join(name).is_dir())
        .map(|(name, check)| (*name, *check, folder.join(name)))
        .collect();
    if present.is_empty()
        && let Some((name, check)) = SETS.iter().find(|(name, _)| Some(*name) == own)
    {
        present.push((*name, *check, folder.clone()));
    }
    if present.is_empty() {
        let known: Vec<&str> = SETS.iter().map(|(name, _)| *name).collect();
        return Err(format!(
            "{} is none of, and holds none of: {}",
            folder.display(),
            known.join(" ")
        )
        .into());
    }
    for (name, check, folder) in present {
        report.begin(name);
        // A set that cannot be read fails; the others are still checked.
        if let Err(error) = check(&folder, &mut report) {
            report.problem("read", &error.to_string());
        }
    }
    Ok(report)
}
