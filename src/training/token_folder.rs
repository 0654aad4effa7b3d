//! Clips into shards of tokens by any number of processes, written down so that the folder can be verified and gone on with.
//!
//! ```text
//! tokens.json                               what was asked: clips, tokenizers by their bytes, raw video
//! <split>/<modality>/shard-000000.tar       as `shards` reads them; `pixels` is raw colour video
//! tokenizers/<modality>/                    so that what is trained on the tokens can be used on its own
//! .finished/<split>-000000.json             what a finished shard holds: clips, files, their hashes
//! ```

mod verify;

pub use verify::verify;

use super::signals::extract;
use super::trainer::TrainingError;
use crate::clip::shard::ShardWriter;
use crate::clip::source::{ClipSource, Outcome};
use crate::clip::store::tokens_to_bytes;
use crate::datasets::convert::{Share, Tally};
use crate::datasets::shards::{Content, Marker};
use crate::flow::Flow;
use crate::formats::ReadError;
use crate::formats::npz::Npz;
use crate::formats::place;
use crate::formats::read_error::Position;
use crate::masking::PIXELS;
use crate::modality::{ClipFormat, Modality};
use crate::model::{ModelManifest, TOKENIZERS};
use crate::tokenizer::Tokenizer;
use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;
use std::ops::Range;
use std::path::{Path, PathBuf};

/// The file that describes a folder of tokens.
pub const FILE: &str = "tokens.json";
const FINISHED: &str = ".finished";

/// Clips tokenized at a time.
const CHUNK: usize = 16;

/// One modality's way into the shards.
pub struct ModalityTokens {
    /// How it comes out of a clip.
    pub modality: Box<dyn Modality>,
    /// What makes tokens of it.
    pub tokenizer: Box<dyn Tokenizer>,
}

impl std::fmt::Debug for ModalityTokens {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_tuple("ModalityTokens")
            .field(&self.modality.name())
            .finish()
    }
}

impl ModalityTokens {
    fn add(
        &self,
        clips: &dyn ClipSource,
        range: Range<usize>,
        shard: &mut ShardWriter,
    ) -> Result<(), TrainingError> {
        let found = extract(clips, self.modality.as_ref(), &[], range)?;
        let (ids, signals): (Vec<_>, Vec<_>) = found
            .into_iter()
            .map(|found| (found.clip.id, found.signal))
            .unzip();
        let grids = self.tokenizer.encode(&signals)?;
        for (id, grid) in ids.iter().zip(grids) {
            let bytes = tokens_to_bytes(&grid.ids, &grid.grid).map_err(ReadError::from)?;
            let name = self.modality.name();
            shard.add(name, id, &bytes).map_err(ReadError::from)?;
        }
        Ok(())
    }
}

/// Writes the shard of the clips `range`: tokens of every modality that a clip has, and raw colour video where `pixels` says so.
/// `watch` hears how many of its clips are done, and may stop it: then nothing is written, and `false` returned.
///
/// # Errors
/// When a clip cannot be read, a tokenizer does not take it, `watch` fails, or the disk refuses.
pub fn write_shard<E: From<TrainingError>>(
    modalities: &[ModalityTokens],
    pixels: bool,
    clips: &dyn ClipSource,
    range: Range<usize>,
    mut shard: ShardWriter,
    watch: &mut dyn FnMut(usize) -> Result<Flow, E>,
) -> Result<bool, E> {
    let wrap = |error: crate::clip::shard::ShardError| TrainingError::from(ReadError::from(error));
    for from in range.clone().step_by(CHUNK) {
        if watch(from - range.start)? == Flow::Stop {
            return Ok(false);
        }
        let part = from..(from + CHUNK).min(range.end);
        for modality in modalities {
            modality.add(clips, part.clone(), &mut shard)?;
        }
        for index in part.filter(|_| pixels) {
            let made = clips
                .clip_with(index, &["rgb"])
                .map_err(TrainingError::from)?;
            let Outcome::Clip(clip) = made else { continue };
            if let Some(rgb) = clip.rgb() {
                let npz = Npz::default().with("arr_0", &rgb.frames);
                let bytes = npz.to_bytes().map_err(ReadError::from);
                let bytes = bytes.map_err(TrainingError::from)?;
                shard.add(PIXELS, &clip.id, &bytes).map_err(wrap)?;
            }
        }
    }
    shard.finish().map_err(wrap)?;
    Ok(true)
}

/// What [`FILE`] says.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct TokenHeader {
    /// The sizes of the clips.
    pub format: ClipFormat,
    /// By modality.
    pub tokens: BTreeMap<String, TokenKind>,
    /// Whether raw colour video lies beside the tokens.
    pub pixels: bool,
    /// By split.
    pub splits: BTreeMap<String, SplitClips>,
    /// Clips per shard.
    pub clips_per_shard: usize,
}

/// The tokens of one modality.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct TokenKind {
    /// The shape of a clip's tokens.
    pub grid: Vec<usize>,
    /// How many different ones there are.
    pub vocabulary: usize,
    /// blake3 of the tokenizer's files.
    pub tokenizer: String,
}

/// The clips of one split.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct SplitClips {
    /// How many.
    pub clips: usize,
    /// blake3 of their names, in order.
    pub names: String,
}

impl SplitClips {
    /// The clips of a split by their names.
    #[must_use]
    pub fn of(names: &[String]) -> Self {
        let mut hasher = blake3::Hasher::new();
        for name in names {
            hasher.update(&(name.len() as u64).to_le_bytes());
            hasher.update(name.as_bytes());
        }
        SplitClips {
            clips: names.len(),
            names: hasher.finalize().to_hex()[..32].to_owned(),
        }
    }
}

impl TokenHeader {
    /// Reads [`FILE`] of a folder.
    ///
    /// # Errors
    /// When it is not there or not of this form.
    pub fn read(root: &Path) -> Result<Self, ReadError> {
        let path = root.join(FILE);
        let header: Self = place::read_json(&path)?;
        if header.clips_per_shard == 0 {
            let reason = "`clips_per_shard` is 0".to_owned();
            return Err(ReadError::malformed(&path, Position::File, reason));
        }
        Ok(header)
    }

    /// What [`FILE`] says of tokens that `modalities` make of the clips with these names, by split.
    ///
    /// # Errors
    /// When a tokenizer cannot be written, to be hashed.
    pub fn of(
        format: &ClipFormat,
        modalities: &[ModalityTokens],
        pixels: bool,
        names: &BTreeMap<String, &[String]>,
        clips_per_shard: usize,
    ) -> Result<Self, TrainingError> {
        let kind = |tokens: &ModalityTokens| {
            let kind = TokenKind {
                grid: tokens.tokenizer.grid().to_vec(),
                vocabulary: tokens.tokenizer.vocabulary(),
                tokenizer: digest(tokens.tokenizer.as_ref())?,
            };
            Ok::<_, TrainingError>((tokens.modality.name().to_owned(), kind))
        };
        let splits = names.iter();
        Ok(Self {
            format: format.clone(),
            tokens: modalities.iter().map(kind).collect::<Result<_, _>>()?,
            pixels,
            splits: splits
                .map(|(split, names)| (split.clone(), SplitClips::of(names)))
                .collect(),
            clips_per_shard,
        })
    }

    /// Begins a folder, or goes on with one of which the same was asked.
    ///
    /// # Errors
    /// When the folder holds something else, or the disk refuses.
    pub fn begin(&self, root: &Path) -> Result<(), ReadError> {
        let fail = |cause| ReadError::io(root, cause);
        if place::is_file(&root.join(FILE)).map_err(fail)? {
            let there = Self::read(root)?;
            if there == *self {
                return Ok(());
            }
            let difference = there.difference(self);
            let difference = difference.unwrap_or_else(|| "other modalities or shards".to_owned());
            let reason = format!("holds other tokens ({difference}); name another folder");
            return Err(ReadError::unsupported(root, reason));
        }
        let empty = place::is_empty(root).map_err(fail)?;
        // Another process with a share of the same work may have begun in between.
        if !empty && place::is_file(&root.join(FILE)).map_err(fail)? {
            return self.begin(root);
        }
        if !empty {
            let reason = "is not empty and holds no tokens; name another folder";
            return Err(ReadError::unsupported(root, reason));
        }
        place::make_folder(root).map_err(fail)?;
        place::write_json(&root.join(FILE), self)
    }

    /// In which way it speaks of other tokens than `other`, if it does; how many clips a shard has does not matter.
    #[must_use]
    pub fn difference(&self, other: &Self) -> Option<String> {
        for (split, clips) in &other.splits {
            match self.splits.get(split) {
                None => return Some(format!("no tokens of the split `{split}`")),
                Some(found) if found != clips => {
                    return Some(format!(
                        "its {} clips of `{split}` are not the {} clips of this experiment",
                        found.clips, clips.clips
                    ));
                }
                Some(_) => {}
            }
        }
        for (name, kind) in &other.tokens {
            match self.tokens.get(name) {
                None => return Some(format!("no tokens of `{name}`")),
                Some(found) if found != kind => {
                    return Some(format!("tokens of another tokenizer of `{name}`"));
                }
                Some(_) => {}
            }
        }
        if other.pixels && !self.pixels {
            return Some("no raw video beside the tokens".to_owned());
        }
        (self.format != other.format).then(|| "clips of other sizes".to_owned())
    }

    /// How many shards are not finished below `root`.
    #[must_use]
    pub fn missing(&self, root: &Path) -> usize {
        let there = |(split, number, _): &(&str, u32, Range<usize>)| {
            finished(root, split, *number).is_some()
        };
        self.shards().filter(|shard| !there(shard)).count()
    }

    /// Every shard: its split, its number in it, and its clips.
    pub fn shards(&self) -> impl Iterator<Item = (&str, u32, Range<usize>)> + '_ {
        let per_shard = self.clips_per_shard;
        self.splits
            .iter()
            .flat_map(move |(split, SplitClips { clips, .. })| {
                (0..clips.div_ceil(per_shard)).map(move |number| {
                    let first = number * per_shard;
                    (
                        split.as_str(),
                        number as u32,
                        first..(first + per_shard).min(*clips),
                    )
                })
            })
    }
}

/// blake3 of the files of a tokenizer, as they lie in a folder of tokens.
fn digest(tokenizer: &dyn Tokenizer) -> Result<String, TrainingError> {
    let folder =
        tempfile::tempdir().map_err(|cause| ReadError::io(&std::env::temp_dir(), cause))?;
    let place = folder.path().join(TOKENIZERS).join(tokenizer.modality());
    std::fs::create_dir_all(&place).map_err(|cause| ReadError::io(&place, cause))?;
    tokenizer.write(&place)?;
    let mut digests = ModelManifest::digests(folder.path())?;
    Ok(digests.remove(tokenizer.modality()).unwrap_or_default())
}

/// Writes the tokenizers beside the tokens, each there whole or not at all.
fn keep(modalities: &[ModalityTokens], root: &Path) -> Result<(), TrainingError> {
    let folder = root.join(TOKENIZERS);
    let fail = |cause| ReadError::io(&folder, cause);
    place::make_folder(&folder).map_err(fail)?;
    for tokens in modalities {
        let place = folder.join(tokens.modality.name());
        if place::is_remote(root) {
            // Objects have no rename: equal tokenizers have equal bytes, and whoever comes second writes the same.
            let draft = tempfile::tempdir().map_err(fail)?;
            tokens.tokenizer.write(draft.path())?;
            place::store(draft.path(), &place).map_err(fail)?;
            continue;
        }
        if place.is_dir() {
            continue;
        }
        let draft = tempfile::tempdir_in(root).map_err(|cause| ReadError::io(root, cause))?;
        tokens.tokenizer.write(draft.path())?;
        // Another process may have been faster.
        if let Err(cause) = std::fs::rename(draft.path(), &place)
            && !place.is_dir()
        {
            return Err(ReadError::io(&place, cause).into());
        }
    }
    Ok(())
}

/// Where it is written what a finished shard holds.
fn marker(root: &Path, split: &str, number: u32) -> PathBuf {
    root.join(FINISHED)
        .join(format!("{split}-{number:06}.json"))
}

fn finished(root: &Path, split: &str, number: u32) -> Option<Marker> {
    let bytes = place::read(&marker(root, split, number)).ok()?;
    serde_json::from_slice(&bytes).ok()
}

/// Clips to be tokenized into a folder.
pub struct Tokenization<'a> {
    /// What is asked.
    pub header: &'a TokenHeader,
    /// The clips of every split of the header.
    pub splits: &'a BTreeMap<String, &'a dyn ClipSource>,
    /// Every modality of the header.
    pub modalities: &'a [ModalityTokens],
    /// The part of the shards that is made.
    pub share: Share,
}

/// What became of it.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize)]
pub struct Tokenized {
    /// Shards of this share, and how many of them were there before.
    pub shards: usize,
    /// Shards that were there before.
    pub reused: usize,
    /// Clips of this share.
    pub clips: usize,
    /// Whether every shard is there, whoever made it.
    pub whole: bool,
    /// Whether it was asked to stop before its end; calling again goes on.
    pub interrupted: bool,
}

impl std::fmt::Debug for Tokenization<'_> {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("Tokenization")
            .field("header", &self.header)
            .field("share", &self.share)
            .finish_non_exhaustive()
    }
}

impl Tokenization<'_> {
    /// Makes the shards of the share that are not there. `watch` hears how many of how many clips are done, and may stop it.
    ///
    /// # Errors
    /// When the folder holds something else, a clip cannot be read, or the disk refuses.
    pub fn run(
        &self,
        root: &Path,
        watch: &mut dyn FnMut(usize, usize) -> Flow,
    ) -> Result<Tokenized, TrainingError> {
        self.header.begin(root)?;
        keep(self.modalities, root)?;
        let markers = root.join(FINISHED);
        place::make_folder(&markers).map_err(|cause| ReadError::io(&markers, cause))?;
        let own = |(index, shard)| self.share.has(index).then_some(shard);
        let shards: Vec<_> = self.header.shards().enumerate().filter_map(own).collect();
        let total = shards.iter().map(|(_, _, range)| range.len()).sum();
        let mut done = Tokenized {
            shards: shards.len(),
            ..Tokenized::default()
        };
        for (split, number, range) in shards {
            if finished(root, split, number).is_some() {
                done.reused += 1;
            } else if !self.shard(root, split, number, range.clone(), &mut |clips| {
                watch(done.clips + clips, total)
            })? {
                done.interrupted = true;
                return Ok(done);
            }
            done.clips += range.len();
            watch(done.clips, total);
        }
        done.whole = self.header.missing(root) == 0;
        Ok(done)
    }

    fn shard(
        &self,
        root: &Path,
        split: &str,
        number: u32,
        range: Range<usize>,
        watch: &mut dyn FnMut(usize) -> Flow,
    ) -> Result<bool, TrainingError> {
        let clips = self.splits.get(split).ok_or(TrainingError::NoData)?;
        let place = root.join(split);
        let writer = ShardWriter::new(&place, number);
        let count = range.len();
        let written = write_shard::<TrainingError>(
            self.modalities,
            self.header.pixels,
            *clips,
            range,
            writer,
            &mut |clips| Ok(watch(clips)),
        )?;
        if !written {
            return Ok(false);
        }
        let mut files = BTreeMap::new();
        let names = self.header.tokens.keys().map(String::as_str);
        for name in names.chain(self.header.pixels.then_some(PIXELS)) {
            let file = format!("{split}/{name}/shard-{number:06}.tar");
            let path = root.join(&file);
            if place::is_file(&path).map_err(|cause| ReadError::io(&path, cause))? {
                files.insert(file.clone(), Content::of(&path)?);
            }
        }
        let tally = Tally {
            clips: count,
            ..Tally::default()
        };
        place::write_json(&marker(root, split, number), &Marker { tally, files })?;
        Ok(true)
    }
}
