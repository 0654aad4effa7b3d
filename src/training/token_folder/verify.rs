//! Whether a folder of tokens is whole: every shard there, every file as it was written, the tokenizers those that it names.

use super::{FILE, TokenHeader, finished};
use crate::datasets::convert::Tally;
use crate::datasets::shards::{Content, tars};
use crate::datasets::verify::Verified;
use crate::formats::ReadError;
use crate::formats::place;
use crate::model::{ModelManifest, TOKENIZERS};
use rayon::prelude::*;
use std::collections::{BTreeMap, BTreeSet};
use std::path::Path;

/// The digests of the tokenizers, which are fetched from an object store.
fn digests(root: &Path) -> Result<BTreeMap<String, String>, String> {
    if !place::is_remote(root) {
        return ModelManifest::digests(root).map_err(|error| error.to_string());
    }
    let fetch = || -> std::io::Result<tempfile::TempDir> {
        let folder = tempfile::tempdir()?;
        let to = folder.path().join(TOKENIZERS);
        place::fetch(&root.join(TOKENIZERS), &to)?;
        Ok(folder)
    };
    let fetched = fetch().map_err(|cause| ReadError::io(root, cause).to_string())?;
    ModelManifest::digests(fetched.path()).map_err(|error| error.to_string())
}

/// Compares a folder of tokens with what was written down when its shards were made.
///
/// # Errors
/// When it is no folder of tokens.
pub fn verify(root: &Path) -> Result<Verified, ReadError> {
    let header = TokenHeader::read(root)?;
    let mut found = Verified {
        shards: 0,
        finished: 0,
        files: 0,
        bytes: 0,
        tally: Tally::default(),
        problems: Vec::new(),
    };
    let mut listed: BTreeMap<String, Content> = BTreeMap::new();
    for (split, number, range) in header.shards() {
        found.shards += 1;
        let Some(marker) = finished(root, split, number) else {
            let (first, last) = (range.start, range.end - 1);
            found.problems.push(format!(
                "shard {number} of `{split}` is not there: clips {first} to {last}"
            ));
            continue;
        };
        found.finished += 1;
        let (counted, clips) = (marker.tally.clips, range.len());
        if counted != clips {
            found.problems.push(format!(
                "shard {number} of `{split}` accounts for {counted} of its {clips} clips"
            ));
        }
        found.tally.add(&marker.tally);
        listed.extend(marker.files);
    }
    let files: Vec<_> = listed.iter().collect();
    let checked: Vec<(u64, Option<String>)> = files
        .into_par_iter()
        .map(|(file, written)| written.compare(root, file))
        .collect();
    for (bytes, problem) in checked {
        found.files += 1;
        found.bytes += bytes;
        found.problems.extend(problem);
    }
    let known: BTreeSet<&String> = listed.keys().collect();
    for split in header.splits.keys() {
        let split = Path::new(split);
        for file in tars(&root.join(split)).unwrap_or_default() {
            let file = split.join(file).to_string_lossy().into_owned();
            if !known.contains(&file) {
                let problem = format!("`{file}` belongs to no finished shard");
                found.problems.push(problem);
            }
        }
    }
    match digests(root) {
        Ok(digests) => {
            for (name, kind) in &header.tokens {
                if digests.get(name) != Some(&kind.tokenizer) {
                    found.problems.push(format!(
                        "`{TOKENIZERS}/{name}` is not the tokenizer that `{FILE}` names"
                    ));
                }
            }
        }
        Err(error) => found.problems.push(error),
    }
    Ok(found)
}
