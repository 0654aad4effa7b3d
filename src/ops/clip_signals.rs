//! The signals of a clips artifact: which modalities it has, and reading one of them split by split.

use crate::clip::store::ClipSet;
use crate::experiment::{Code, Description, InputArtifact, Problem, StageError};
use crate::modality::{self, ClipFormat, Modality};
use serde_json::Value;
use std::path::Path;

/// The splits a clips artifact may have.
pub(super) const SPLITS: [&str; 3] = ["train", "validation", "test"];

/// The sizes of the clips that a description speaks of.
pub(super) fn described_format(clips: &Description) -> Option<ClipFormat> {
    serde_json::from_value(clips.extra.get("format")?.clone()).ok()
}

/// The sizes of the clips of a finished artifact.
pub(super) fn format(clips: &InputArtifact) -> Result<ClipFormat, StageError> {
    read_format(&clips.contents).ok_or_else(|| {
        damaged(&format!(
            "the clips of `{}` do not say their format",
            clips.stage
        ))
    })
}

fn read_format(contents: &Value) -> Option<ClipFormat> {
    serde_json::from_value(contents.get("format")?.clone()).ok()
}

/// A modality of `format` by name, built in or declared.
pub(super) fn modality(format: &ClipFormat, name: &str) -> Option<Box<dyn Modality>> {
    modality::all(format).into_iter().find(|m| m.name() == name)
}

/// What to say of a modality that the clips do not have.
pub(super) fn unknown_modality(key: String, name: &str, clips: &Description) -> Problem {
    let known: Vec<&str> = clips.signals.keys().map(String::as_str).collect();
    Problem::new(
        Code::E0203,
        key,
        format!("the clips have no modality `{name}`"),
    )
    .help(format!("they have: {}", known.join(", ")))
}

/// An artifact that cannot be used.
pub(super) fn damaged(reason: &str) -> StageError {
    StageError::Input {
        code: Code::E0601,
        message: reason.to_owned(),
        help: "run the stage that makes it again".to_owned(),
    }
}

/// The clips of one split; `None` where the artifact has none.
pub(super) fn open_split(clips: &Path, split: &str) -> Result<Option<ClipSet>, StageError> {
    let folder = clips.join(split);
    if !folder.is_dir() {
        return Ok(None);
    }
    ClipSet::open(&folder)
        .map(Some)
        .map_err(|error| damaged(&error.to_string()))
}
