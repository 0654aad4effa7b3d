//! A cheap look at bytes: the file system's word for when they last changed. Where it is not what it was when an artifact was made,
//! the bytes are read again; where it is, they are taken to be the same, unless somebody asks for all of them.

use super::error::{AtPath, RunError};
use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;
use std::path::Path;

/// Seconds and nanoseconds of the last change of a file's bytes, and of its entry, which nobody sets by hand.
type Stamp = [i64; 4];

/// By name of the file below the artifact.
#[derive(Debug, Clone, Default, PartialEq, Eq, Serialize, Deserialize)]
pub(super) struct Stamps(BTreeMap<String, Stamp>);

impl Stamps {
    /// Of these files as they are.
    pub fn of<'a>(
        root: &Path,
        names: impl IntoIterator<Item = &'a String>,
    ) -> Result<Self, RunError> {
        let one = |name: &String| Ok((name.clone(), stamp(&root.join(name))?));
        names
            .into_iter()
            .map(one)
            .collect::<Result<_, _>>()
            .map(Self)
    }

    /// The files whose stamp is another than in `known`.
    pub fn changed<'a>(&'a self, known: &'a Self) -> impl Iterator<Item = &'a String> {
        let changed = |(name, stamp): &(&String, &Stamp)| known.0.get(*name) != Some(*stamp);
        self.0.iter().filter(changed).map(|(name, _)| name)
    }
}

#[cfg(unix)]
fn stamp(path: &Path) -> Result<Stamp, RunError> {
    use std::os::unix::fs::MetadataExt;
    let meta = std::fs::metadata(path).at("reading", path)?;
    Ok([
        meta.mtime(),
        meta.mtime_nsec(),
        meta.ctime(),
        meta.ctime_nsec(),
    ])
}

#[cfg(not(unix))]
fn stamp(path: &Path) -> Result<Stamp, RunError> {
    let meta = std::fs::metadata(path).at("reading", path)?;
    let since = meta.modified().at("reading", path)?;
    let since = since
        .duration_since(std::time::UNIX_EPOCH)
        .unwrap_or_default();
    Ok([
        i64::try_from(since.as_secs()).unwrap_or(i64::MAX),
        i64::from(since.subsec_nanos()),
        0,
        0,
    ])
}
