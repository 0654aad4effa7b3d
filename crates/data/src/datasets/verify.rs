//! Whether a folder of converted clips is whole: every shard there, every file as it was written, every clip counted.

use super::ReadError;
use super::convert::Tally;
use super::shards::{FILE, Folder, Marker, TarSink, tars};
use crate::clip::store::ClipSet;
use crate::formats::read_error::Position;
use rayon::prelude::*;
use serde::Serialize;
use std::collections::BTreeSet;
use std::path::Path;

/// What was found.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Verified {
    /// Shards that the conversion has, and those that are finished.
    pub shards: usize,
    /// Those of them that are finished.
    pub finished: usize,
    /// Files of the finished shards, missing ones included.
    pub files: usize,
    /// What those files have now; a missing one has none.
    pub bytes: u64,
    /// What became of the clips of the finished shards.
    pub tally: Tally,
    /// One sentence for each thing that is not as it should be.
    pub problems: Vec<String>,
}

/// Compares a folder with what its conversion wrote down.
///
/// # Errors
/// When it is no folder of converted clips, or the disk refuses.
pub fn verify(root: &Path) -> Result<Verified, ReadError> {
    let header = Folder::header(root)?;
    let number = |value: &serde_json::Value| value.as_u64().map(|number| number as usize);
    let clips = number(&header.request["clips"]);
    let per_shard = number(&header.request["shards"]["clips_per_shard"]).filter(|n| *n > 0);
    let (Some(clips), Some(per_shard)) = (clips, per_shard) else {
        return Err(ReadError::malformed(
            &root.join(FILE),
            Position::File,
            "it does not say how many clips were asked for",
        ));
    };
    let shards = clips.div_ceil(per_shard);
    let sink = TarSink::new(root, &root.join(".finished"))?;
    let markers: Vec<Option<Marker>> = (0..shards).map(|shard| sink.read_marker(shard)).collect();
    let mut found = Verified {
        shards,
        finished: markers.iter().flatten().count(),
        files: 0,
        bytes: 0,
        tally: Tally::default(),
        problems: Vec::new(),
    };
    let mut known = BTreeSet::new();
    for (shard, marker) in markers.iter().enumerate() {
        let (first, last) = (shard * per_shard, ((shard + 1) * per_shard).min(clips) - 1);
        let Some(marker) = marker else {
            found.problems.push(format!(
                "shard {shard} is not there: clips {first} to {last}"
            ));
            continue;
        };
        let tally = &marker.tally;
        let counted = tally.clips + tally.dropped.values().sum::<usize>() + tally.damaged.len();
        if counted != last - first + 1 {
            found.problems.push(format!(
                "shard {shard} accounts for {counted} of its {} clips",
                last - first + 1
            ));
        }
        found.tally.add(tally);
        known.extend(marker.files.keys().cloned());
    }
    let listed = markers.iter().flatten().flat_map(|marker| &marker.files);
    let checked: Vec<(u64, Option<String>)> = listed
        .collect::<Vec<_>>()
        .into_par_iter()
        .map(|(file, written)| written.compare(root, file))
        .collect();
    for (bytes, problem) in checked {
        found.files += 1;
        found.bytes += bytes;
        found.problems.extend(problem);
    }
    let hashed = markers
        .iter()
        .flatten()
        .all(|marker| marker.tally.clips == 0 || !marker.files.is_empty());
    if !hashed {
        found.problems.push(
            "some shards were written before hashes were kept: their bytes are not compared"
                .to_owned(),
        );
    }
    for file in tars(root)? {
        if hashed && !known.contains(&file) {
            found
                .problems
                .push(format!("`{file}` belongs to no finished shard"));
        }
    }
    // What is inside has to be as many clips as were counted.
    if found.tally.clips > 0 {
        match ClipSet::open(root) {
            Ok(set) if set.len() == found.tally.clips => {}
            Ok(set) => found.problems.push(format!(
                "the shards hold {} clips, and {} were counted",
                set.len(),
                found.tally.clips
            )),
            Err(error) => found.problems.push(ReadError::from(error).to_string()),
        }
    }
    if let Some(tally) = &header.tally
        && (tally.clips, &tally.dropped, &tally.damaged)
            != (
                found.tally.clips,
                &found.tally.dropped,
                &found.tally.damaged,
            )
    {
        found
            .problems
            .push(format!("`{FILE}` counts other clips than the shards do"));
    }
    if header.tally.is_none() && found.finished == shards {
        found.problems.push(format!(
            "every shard is there, but `{FILE}` does not say that it is finished: convert once more"
        ));
    }
    Ok(found)
}
