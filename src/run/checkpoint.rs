//! Checkpoints of a stage: whole or not there, in step order, the last two kept.
//!
//! They lie in [`StageContext::checkpoints`] as `step-000500/`. Two are kept so that `reviv verify` can redo the steps between
//! the older one and the end, and demand the same bytes.

use super::files;
use crate::experiment::{StageContext, StageError};
use std::path::{Path, PathBuf};
use std::thread::JoinHandle;

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
    publish(&home, step, |making| write(context, making))
}

fn publish(
    home: &Path,
    step: u64,
    write: impl FnOnce(&Path) -> Result<(), StageError>,
) -> Result<(), StageError> {
    let making = home.join(".making");
    files::remove(&making)?;
    files::create_directory(&making)?;
    write(&making)?;
    let place = home.join(format!("step-{step:06}"));
    files::remove(&place)?;
    files::publish_directory(&making, &place)?;
    prune(home)
}

/// Checkpoints that are written while the stage goes on, one after the other.
#[derive(Debug, Default)]
pub struct Background {
    writing: Option<JoinHandle<Result<(), StageError>>>,
}

impl Background {
    /// As [`save`], but returns when writing has begun: `write` has all that it needs. Waits for the checkpoint before it.
    ///
    /// # Errors
    /// When that one could not be written, or what was recorded does not reach the disk.
    pub fn save(
        &mut self,
        context: &mut dyn StageContext,
        step: u64,
        write: impl FnOnce(&Path) -> Result<(), StageError> + Send + 'static,
    ) -> Result<(), StageError> {
        self.finish()?;
        context.flush()?;
        let home = context.checkpoints().to_path_buf();
        let write = move || publish(&home, step, write);
        self.writing = Some(std::thread::spawn(write));
        Ok(())
    }

    /// Waits for the last checkpoint. The stage must not end before.
    ///
    /// # Errors
    /// When it could not be written.
    pub fn finish(&mut self) -> Result<(), StageError> {
        match self.writing.take().map(JoinHandle::join) {
            None => Ok(()),
            Some(Ok(written)) => written,
            Some(Err(panic)) => std::panic::resume_unwind(panic),
        }
    }
}

impl Background {
    /// The end of a stage, or of its attempt: waits for the last checkpoint. What went wrong first is said.
    ///
    /// # Errors
    /// Those of what was `done`, or of the checkpoint.
    pub fn end<T>(mut self, done: Result<T, StageError>) -> Result<T, StageError> {
        let written = self.finish();
        match done {
            // A stage that was asked to stop and could not keep its state has failed.
            Ok(_) | Err(StageError::Interrupted) => written.and(done),
            Err(error) => Err(error),
        }
    }
}

impl Drop for Background {
    /// Nobody writes into the folder of a stage that has ended.
    fn drop(&mut self) {
        if let Some(writing) = self.writing.take() {
            let _ = writing.join();
        }
    }
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
