//! What an op sees of the run while it works, and how its failures are told.

use super::environment;
use super::error::{AtPath, RunError};
use super::interrupt::Interrupt;
use super::metrics::Metrics;
use super::progress::Task;
use super::tensorboard::SessionStatus;
use crate::experiment::{AnyOp, InputArtifact, StageContext, StageError};
use serde_json::Value;
use std::collections::BTreeMap;
use std::fs::File;
use std::io::Write;
use std::path::{Path, PathBuf};

/// What an op sees.
pub struct Context<'a> {
    pub stage: &'a str,
    pub inputs: Vec<(String, Vec<InputArtifact>)>,
    pub output: PathBuf,
    pub checkpoints: PathBuf,
    pub seed: u64,
    pub data: &'a BTreeMap<String, PathBuf>,
    pub metrics: Option<Metrics>,
    pub log: PathBuf,
    pub log_file: Option<File>,
    /// A log line that could not be written: reported at the next chance.
    pub failed: Option<RunError>,
    pub task: Task<'a>,
    pub interrupt: &'a Interrupt,
}

impl Context<'_> {
    /// Ends the records; what they could not write fails a stage that succeeded otherwise.
    pub fn close(&mut self, result: Result<Value, RunError>) -> Result<Value, RunError> {
        let status = match &result {
            Ok(_) => SessionStatus::Success,
            Err(RunError::Interrupted) => SessionStatus::Running,
            Err(_) => SessionStatus::Failure,
        };
        let ended = self
            .metrics
            .take()
            .map_or(Ok(()), |metrics| metrics.finish(status));
        let contents = result?;
        ended?;
        self.failed.take().map_or(Ok(contents), Err)
    }

    fn metrics(&mut self) -> Result<&mut Metrics, StageError> {
        if let Some(error) = self.failed.take() {
            return Err(error.into());
        }
        self.metrics.as_mut().ok_or(StageError::Interrupted)
    }
}

impl StageContext for Context<'_> {
    fn stage(&self) -> &str {
        self.stage
    }

    fn inputs(&self, port: &str) -> &[InputArtifact] {
        let found = self.inputs.iter().find(|(name, _)| name == port);
        found.map_or(&[], |(_, artifacts)| artifacts)
    }

    fn output(&self) -> &Path {
        &self.output
    }

    fn checkpoints(&self) -> &Path {
        &self.checkpoints
    }

    fn seed(&self) -> u64 {
        self.seed
    }

    fn data_root(&self, name: &str) -> Option<&Path> {
        self.data.get(name).map(PathBuf::as_path)
    }

    fn record(&mut self, step: u64, scalars: &[(&str, f64)]) -> Result<(), StageError> {
        Ok(self.metrics()?.scalars(step, scalars)?)
    }

    fn record_text(&mut self, step: u64, name: &str, text: &str) -> Result<(), StageError> {
        Ok(self.metrics()?.text(step, name, text)?)
    }

    fn record_histogram(
        &mut self,
        step: u64,
        name: &str,
        values: &[f32],
    ) -> Result<(), StageError> {
        Ok(self.metrics()?.histogram(step, name, values)?)
    }

    fn progress(&mut self, done: u64, total: u64, unit: &str) {
        self.task.update(done, total, unit);
    }

    fn log(&mut self, line: &str) {
        let line = format!("{} {line}\n", environment::now_text());
        let open = self.log_file.take();
        let write = || -> std::io::Result<File> {
            let mut file = match open {
                Some(file) => file,
                None => File::options().create(true).append(true).open(&self.log)?,
            };
            file.write_all(line.as_bytes())?;
            Ok(file)
        };
        match write().at("writing", &self.log) {
            Ok(file) => self.log_file = Some(file),
            Err(error) => self.failed = Some(error),
        }
    }

    fn flush(&mut self) -> Result<(), StageError> {
        Ok(self.metrics()?.flush()?)
    }

    fn interrupted(&self) -> bool {
        self.interrupt.requested()
    }
}

/// Turns what an op reports into what the run reports.
pub fn explain(stage: &str, error: StageError) -> RunError {
    if let Some(full) = full_disk(&error) {
        return full;
    }
    match error {
        StageError::Interrupted => RunError::Interrupted,
        StageError::Input {
            code,
            message,
            help,
        } => RunError::Stage {
            stage: stage.into(),
            code: code.to_string(),
            message,
            help,
            exit: 1,
        },
        StageError::Io { path, error } => RunError::io("working on", Path::new(&path), error),
        StageError::Other(error) => match error.downcast::<RunError>() {
            Ok(error) => *error,
            Err(error) => RunError::Stage {
                stage: stage.into(),
                code: "E0806".into(),
                message: chain(error.as_ref()),
                help: String::new(),
                exit: 2,
            },
        },
    }
}

/// A full disk is a full disk, however deep the science wrapped it.
fn full_disk(error: &StageError) -> Option<RunError> {
    let mut path = PathBuf::from("the stage's files");
    if let StageError::Io { path: at, .. } = error {
        path = at.into();
    }
    let mut next: Option<&(dyn std::error::Error + 'static)> = match error {
        // Transparent: its own source would skip the error that it wraps.
        StageError::Other(inner) => Some(inner.as_ref()),
        other => Some(other),
    };
    while let Some(error) = next {
        if let Some(io) = error.downcast_ref::<std::io::Error>() {
            use std::io::ErrorKind::{QuotaExceeded, StorageFull};
            if matches!(io.kind(), StorageFull | QuotaExceeded) {
                return Some(RunError::NoSpace {
                    action: "writing",
                    path,
                });
            }
        }
        next = error.source();
    }
    None
}

fn chain(error: &(dyn std::error::Error + 'static)) -> String {
    let mut text = error.to_string();
    let mut next = error.source();
    while let Some(error) = next {
        let cause = error.to_string();
        // Many errors repeat their cause in their own words.
        if !text.contains(&cause) {
            text = format!("{text}: {cause}");
        }
        next = error.source();
    }
    text
}

/// What becomes of a panic: where the op cannot explain it, it is a bug of the op.
pub fn explain_panic(
    stage: &str,
    op: &dyn AnyOp,
    panic: &(dyn std::any::Any + Send),
    help: &str,
) -> RunError {
    let text = panic_text(panic);
    match op.explain_panic(&text) {
        Some(error) => explain(stage, error),
        None => RunError::Stage {
            stage: stage.into(),
            code: "E0806".into(),
            message: format!("a bug in op `{}`: {text}", op.name()),
            help: help.into(),
            exit: 2,
        },
    }
}

fn panic_text(panic: &(dyn std::any::Any + Send)) -> String {
    let text = panic.downcast_ref::<&str>().map(|text| (*text).to_owned());
    let text = text.or_else(|| panic.downcast_ref::<String>().cloned());
    text.unwrap_or_else(|| "it panicked without a message".into())
}
