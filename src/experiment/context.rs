//! What an op sees while it runs. `run::execute` implements it; tests may implement it in a few lines.

use std::path::{Path, PathBuf};

/// One finished artifact that a stage reads.
#[derive(Debug, Clone)]
pub struct InputArtifact {
    /// The stage that made it, as the experiment names it.
    pub stage: String,
    /// The op that made it, for instance `import` or `train_tokenizer`.
    pub op: String,
    /// Its directory. Read-only.
    pub path: PathBuf,
    /// What its op returned from [`super::stage::Op::run`]: the `contents` of its `manifest.json`.
    pub contents: serde_json::Value,
}

/// The surroundings of a running stage.
pub trait StageContext {
    /// The stage's name in the experiment.
    fn stage(&self) -> &str;

    /// Artifacts that arrive at a port, in the order of the YAML. Empty for an optional port that is not connected.
    fn inputs(&self, port: &str) -> &[InputArtifact];

    /// Where the artifact is written. The directory becomes visible under its key only when the stage has succeeded.
    fn output(&self) -> &Path;

    /// A directory that survives interruption, empty the first time. [`crate::run::checkpoint`] keeps whole checkpoints in
    /// it. What is left in it when the stage succeeds is kept for `reviv verify`.
    fn checkpoints(&self) -> &Path;

    /// The seed of the stage: the first argument of every [`crate::random::stream`].
    fn seed(&self) -> u64;

    /// Where a data set lies, from `data.yaml` or `REVIV_DATA_<NAME>`.
    fn data_root(&self, name: &str) -> Option<&Path>;

    /// Records scalars of a step: one line of `metrics.jsonl`, one TensorBoard event. Names are dotted or with slashes:
    /// `loss`, `loss/body`. A step recorded again after a resume replaces what was recorded for it and all after it.
    fn record(&mut self, step: u64, scalars: &[(&str, f64)]) -> Result<(), StageError>;

    /// Records text (markdown) of a step.
    fn record_text(&mut self, step: u64, name: &str, text: &str) -> Result<(), StageError>;

    /// Records the distribution of `values` at a step.
    fn record_histogram(&mut self, step: u64, name: &str, values: &[f32])
    -> Result<(), StageError>;

    /// Says how far the stage is; cheap, call it per step or per clip. `unit` is a plural noun: `steps`, `clips`.
    fn progress(&mut self, done: u64, total: u64, unit: &str);

    /// One line for the stage's `log.txt` (and the terminal, where it is asked for).
    fn log(&mut self, line: &str);

    /// Brings everything recorded to the disk. Call it before a checkpoint becomes visible, so that a resumed stage finds
    /// what was recorded before it; [`crate::run::checkpoint::save`] does.
    fn flush(&mut self) -> Result<(), StageError> {
        Ok(())
    }

    /// True after Ctrl-C or a termination signal. Poll it; when true, write a checkpoint and return
    /// [`StageError::Interrupted`].
    fn interrupted(&self) -> bool;
}

/// Why a stage did not finish.
#[derive(Debug, thiserror::Error)]
pub enum StageError {
    /// The op saw [`StageContext::interrupted`] and left a checkpoint.
    #[error("interrupted")]
    Interrupted,
    /// Something the user can mend: words, and the way out.
    #[error("{message}")]
    Input {
        /// A code of the families E05 or E06, usually.
        code: super::problem::Code,
        /// What is wrong, in a sentence.
        message: String,
        /// The way out; empty for none.
        help: String,
    },
    /// The machine: disk full, permission, a file that vanished.
    #[error("{path}: {error}")]
    Io {
        /// The file or folder, as shown to the user.
        path: String,
        /// What the file system said.
        #[source]
        error: std::io::Error,
    },
    /// Anything else that went wrong.
    #[error(transparent)]
    Other(#[from] Box<dyn std::error::Error + Send + Sync>),
}

impl StageError {
    /// An I/O error with the path it happened at: `.map_err(StageError::io(&path))`.
    pub fn io(path: &Path) -> impl FnOnce(std::io::Error) -> Self + '_ {
        move |error| Self::Io {
            path: path.display().to_string(),
            error,
        }
    }

    /// Wraps any error: `.map_err(StageError::other)`.
    pub fn other(error: impl std::error::Error + Send + Sync + 'static) -> Self {
        Self::Other(Box::new(error))
    }
}
