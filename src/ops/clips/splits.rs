//! Which clips go into which split, and the move to where the artifact is.

use super::settings::{ClipsSettings, MARKERS};
use crate::datasets::coded::Coded;
use crate::datasets::open::{OpenWith, open};
use crate::datasets::split::{Chosen, divide};
use crate::datasets::{ClipSource, ReadError};
use crate::experiment::context::{StageContext, StageError};
use crate::experiment::problem::Code;
use crate::modality::ClipFormat;
use crate::world::World;
use crate::world::clips::WorldClips;
use std::path::Path;
use std::sync::Arc;

/// A split and its clips.
pub(super) type Part = (&'static str, Arc<dyn ClipSource>);

/// The clips of each split, in the order they are stored.
pub(super) fn parts(
    settings: &ClipsSettings,
    format: &ClipFormat,
    context: &mut dyn StageContext,
) -> Result<Vec<Part>, StageError> {
    let from = &settings.source.settings;
    let Some(data) = &from.data else {
        let world = World::new(from.world.clone(), context.seed());
        let part = |(split, first, count): (&'static str, u64, u64)| {
            let clips = WorldClips::new(world.clone(), first..first + count);
            let source: Arc<dyn ClipSource> = Arc::new(clips.with_declared(&format.declared));
            (split, Coded::wrap(source, format))
        };
        return Ok(settings.splits().map(part).collect());
    };
    let root = context.data_root(data).ok_or_else(|| StageError::Input {
        code: Code::E0601,
        message: format!("data set `{data}` is not configured"),
        help: "add it to `data.yaml`".to_owned(),
    })?;
    let with = OpenWith {
        declared: &format.declared,
        mano: from.mano().and_then(|name| context.data_root(name)),
        hands: from.hands,
    };
    let source = open(root, from.dataset, &from.cut, with).map_err(refused)?;
    if let Some(there) = source.format() {
        let size = |format: &ClipFormat| (format.frames, format.size, format.video_rate.to_bits());
        if size(&there) != size(format) {
            return Err(StageError::Input {
                code: Code::E0401,
                message: format!(
                    "`{data}` holds clips of {} frames of {} pixels at {} Hz",
                    there.frames, there.size, there.video_rate
                ),
                help: "make `cut: {fps, side}` say the same, or convert the recordings again"
                    .to_owned(),
            });
        }
    }
    for (note, count) in source.notes() {
        context.log(&format!("{count} recordings: {note}"));
    }
    for excluded in source.excluded() {
        context.log(&format!(
            "excluded: `{}`: {}",
            excluded.recording, excluded.reason
        ));
    }
    let asked: Vec<(&'static str, u64)> = settings
        .splits()
        .map(|(split, _, count)| (split, count))
        .collect();
    let divided = divide(source.as_ref(), &from.split, &asked).map_err(refused)?;
    let mut parts: Vec<Part> = Vec::new();
    for (split, clips) in divided {
        if clips.is_empty() {
            // A recording that cannot be read may be why.
            let excluded = source.excluded();
            let left_out = excluded.first().map_or_else(String::new, |first| {
                format!(", {} left out: {}", excluded.len(), first.reason)
            });
            return Err(StageError::Input {
                code: Code::E0601,
                message: format!(
                    "no recording for `{split}`: {} recordings, {} clips in all{left_out}",
                    source.recordings().len(),
                    source.len()
                ),
                help: format!(
                    "name some in `split: {{{split}_recordings: [...]}}`, or ask for fewer splits"
                ),
            });
        }
        let chosen = Arc::new(Chosen::new(Arc::clone(&source), clips));
        parts.push((split, Coded::wrap(chosen, format)));
    }
    Ok(parts)
}

/// What is wrong with recordings is for the user to mend, what is wrong with the disk is not.
pub(super) fn refused(error: ReadError) -> StageError {
    match error {
        ReadError::Io { path, cause } => StageError::Io {
            path: path.display().to_string(),
            error: cause,
        },
        error => StageError::Input {
            code: Code::E0601,
            message: error.to_string(),
            help: "`reviv data inspect` shows what can be read".to_owned(),
        },
    }
}

/// Moves finished shards to where the artifact is written.
///
/// The markers go first: a marker that outlived its shard would make the next try publish an artifact without it.
pub(super) fn deliver(from: &Path, to: &Path) -> Result<(), StageError> {
    let markers = from.join(MARKERS);
    std::fs::remove_dir_all(&markers).map_err(StageError::io(&markers))?;
    for entry in std::fs::read_dir(from).map_err(StageError::io(from))? {
        let path = entry.map_err(StageError::io(from))?.path();
        std::fs::create_dir_all(to).map_err(StageError::io(to))?;
        let target = to.join(path.file_name().unwrap_or_default());
        if std::fs::rename(&path, &target).is_err() {
            copy(&path, &target)?;
        }
    }
    std::fs::remove_dir_all(from).map_err(StageError::io(from))
}

pub(super) fn copy(from: &Path, to: &Path) -> Result<(), StageError> {
    if from.is_dir() {
        std::fs::create_dir_all(to).map_err(StageError::io(to))?;
        for entry in std::fs::read_dir(from).map_err(StageError::io(from))? {
            let path = entry.map_err(StageError::io(from))?.path();
            copy(&path, &to.join(path.file_name().unwrap_or_default()))?;
        }
        return Ok(());
    }
    std::fs::copy(from, to)
        .map(|_| ())
        .map_err(StageError::io(from))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn no_shard_counts_as_finished_once_shards_are_on_their_way() {
        let folder = tempfile::tempdir().unwrap();
        let (from, to) = (folder.path().join("train"), folder.path().join("output"));
        std::fs::create_dir_all(from.join(MARKERS)).unwrap();
        std::fs::write(from.join(MARKERS).join("shard-000000.json"), b"{}").unwrap();
        std::fs::create_dir_all(from.join("body/world")).unwrap();
        std::fs::write(from.join("body/world/shard-000000.tar"), b"clips").unwrap();
        std::fs::write(&to, b"a file in the way of the folder").unwrap();
        assert!(deliver(&from, &to).is_err());
        assert!(!from.join(MARKERS).exists());
        std::fs::remove_file(&to).unwrap();
        std::fs::create_dir(from.join(MARKERS)).unwrap();
        deliver(&from, &to).unwrap();
        assert!(to.join("body/world/shard-000000.tar").is_file() && !to.join(MARKERS).exists());
    }
}
