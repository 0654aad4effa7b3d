//! Checkpoints of a stage: whole or not there, in step order, the last two kept.
//!
//! They lie in [`StageContext::checkpoints`] as `step-000500/`. Two are kept so that `reviv verify` can redo the steps between
//! the older one and the end, and demand the same bytes.

use super::files;
use crate::experiment::{StageContext, StageError};
use std::path::{Path, PathBuf};

/// How many stay.
const KEPT: usize = 2;

/// Writes the checkpoint of `step`: `write` fills an empty directory, which then takes its place in one step. Metrics
/// recorded so far reach the disk first, so that a resumed stage finds all of them.
pub fn save(
    context: &mut dyn StageContext,
    step: u64,
    write: impl FnOnce(&mut dyn StageContext, &Path) -> Result<(), StageError>,
) -> Result<(), StageError> {
    context.flush()?;
    let home = context.checkpoints().to_path_buf();
    let making = home.join(".making");
    files::remove(&making)?;
    files::create_directory(&making)?;
    write(context, &making)?;
    let place = home.join(format!("step-{step:06}"));
    files::remove(&place)?;
    files::publish_directory(&making, &place)?;
    prune(&home)
}

/// The last checkpoint, with its step.
pub fn latest(checkpoints: &Path) -> Option<(u64, PathBuf)> {
    all(checkpoints).pop()
}

/// Every whole checkpoint in step order.
pub fn all(checkpoints: &Path) -> Vec<(u64, PathBuf)> {
    let Ok(entries) = std::fs::read_dir(checkpoints) else {
        return Vec::new();
    };
    let mut found = Vec::new();
    for entry in entries.flatten() {
        let name = entry.file_name();
        let step = name
            .to_str()
            .and_then(|name| name.strip_prefix("step-")?.parse().ok());
        if let Some(step) = step {
            found.push((step, entry.path()));
        }
    }
    found.sort();
    found
}

fn prune(home: &Path) -> Result<(), StageError> {
    let found = all(home);
    for (_, path) in &found[..found.len().saturating_sub(KEPT)] {
        files::remove(path)?;
    }
    Ok(())
}
