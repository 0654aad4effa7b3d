//! Clips in shards: where [`super::convert`] puts them, and a [`ClipSource`] that gives them back.
//!
//! A folder of converted clips is `<modality>/<data set>/shard-000000.tar` with [`FILE`] beside it, which says what was asked and
//! what became of it. An artifact of the op `clips` holds such folders by split, and is read as one.

use super::convert::{ShardSink, Tally};
use super::{ClipSource, Outcome, ReadError};
use crate::clip::Clip;
use crate::clip::shard::ShardError;
use crate::clip::store::{self, ClipSet};
use crate::formats::FormatError;
use crate::formats::read_error::Position;
use crate::formats::{place, tar};
use crate::modality::ClipFormat;
use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;
use std::ops::Range;
use std::path::{Path, PathBuf};

/// The name of the file that describes a folder of converted clips.
pub const FILE: &str = "clips.json";
/// The splits of an artifact.
const SPLITS: [&str; 3] = ["train", "validation", "test"];

/// What [`FILE`] says.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Header {
    /// The data set.
    pub source: String,
    /// Sizes of the clips.
    pub format: ClipFormat,
    /// What was asked, as the command sees it; a conversion goes on only where the same is asked again.
    pub request: serde_json::Value,
    /// What became of it; none while it is not finished.
    pub tally: Option<Tally>,
}

impl From<ShardError> for ReadError {
    fn from(error: ShardError) -> Self {
        match error {
            ShardError::Io { path, error } => ReadError::io(&path, error),
            ShardError::Member {
                path,
                member,
                reason,
            } => ReadError::malformed(
                &path,
                Position::File,
                format!("member `{member}`: {reason}"),
            ),
            ShardError::Tar {
                path,
                offset,
                reason,
            } => ReadError::malformed(&path, Position::Offset(offset), reason),
            ShardError::Empty(path) => ReadError::missing(&path, "there are no shards here"),
            ShardError::NoSample { index, count } => ReadError::OutOfRange {
                source_name: "shards".to_owned(),
                index,
                len: count,
            },
        }
    }
}

/// What the marker of a finished shard says.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Marker {
    /// What became of the shard's clips.
    pub tally: Tally,
    /// The shard's files below the root, by path.
    pub files: BTreeMap<String, Content>,
}

/// What a file held when it was written.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Content {
    /// Its size.
    pub bytes: u64,
    /// The BLAKE3 hash of its bytes, in hexadecimal.
    pub blake3: String,
}

impl Content {
    /// Reads a file to its end.
    ///
    /// # Errors
    /// When it cannot be read.
    pub fn of(path: &Path) -> Result<Self, ReadError> {
        let fail = |cause| ReadError::io(path, cause);
        let mut hasher = blake3::Hasher::new();
        let (mut file, _) = place::open(path, place::THROUGH).map_err(fail)?;
        let bytes = std::io::copy(&mut file, &mut hasher).map_err(fail)?;
        Ok(Content {
            bytes,
            blake3: hasher.finalize().to_hex().to_string(),
        })
    }

    /// Compares with what `file` below `root` holds now: its bytes, and what is wrong.
    #[must_use]
    pub fn compare(&self, root: &Path, file: &str) -> (u64, Option<String>) {
        match Content::of(&root.join(file)) {
            Ok(now) if now == *self => (now.bytes, None),
            Ok(now) if now.bytes != self.bytes => {
                let (now, then) = (now.bytes, self.bytes);
                let problem = format!("`{file}` has {now} bytes instead of {then}");
                (now, Some(problem))
            }
            Ok(now) => {
                let problem = format!("`{file}` has other bytes than were written");
                (now.bytes, Some(problem))
            }
            Err(ReadError::Io { cause, .. }) => (0, Some(format!("`{file}`: {cause}"))),
            Err(error) => (0, Some(error.to_string())),
        }
    }
}

/// The tars of every modality and data set below a folder, by path from there: `rgb/adt/shard-000003.tar`.
///
/// # Errors
/// When a folder cannot be read.
pub fn tars(root: &Path) -> Result<Vec<String>, ReadError> {
    let found = tar::below(root, 2).map_err(|error| match error {
        FormatError::File { path, source } => match *source {
            FormatError::Io(cause) => ReadError::io(&path, cause),
            source => source.in_file(&path).into(),
        },
        error => error.into(),
    })?;
    let inside = found
        .iter()
        .map(|path| path.strip_prefix(root).unwrap_or(path));
    let mut found: Vec<String> = inside
        .map(|path| path.to_string_lossy().into_owned())
        .collect();
    found.sort();
    Ok(found)
}

/// Writes shards below a folder; a marker beside them says that one is finished.
#[derive(Debug, Clone)]
pub struct TarSink {
    root: PathBuf,
    markers: PathBuf,
}

impl TarSink {
    /// Shards below `root`, markers in `markers`; both are made.
    ///
    /// # Errors
    /// When the disk refuses.
    pub fn new(root: &Path, markers: &Path) -> Result<Self, ReadError> {
        for folder in [root, markers] {
            place::make_folder(folder).map_err(|cause| ReadError::io(folder, cause))?;
        }
        Ok(TarSink {
            root: root.to_owned(),
            markers: markers.to_owned(),
        })
    }

    fn marker(&self, shard: usize) -> PathBuf {
        self.markers.join(format!("shard-{shard:06}.json"))
    }

    /// What is known of a finished shard; `None` when it has to be made.
    #[must_use]
    pub fn read_marker(&self, shard: usize) -> Option<Marker> {
        let bytes = place::read(&self.marker(shard)).ok()?;
        // Markers of version 1 were the tally alone.
        serde_json::from_slice(&bytes).ok().or_else(|| {
            Some(Marker {
                tally: serde_json::from_slice(&bytes).ok()?,
                files: BTreeMap::new(),
            })
        })
    }
}

impl ShardSink for TarSink {
    fn finished(&self, shard: usize) -> Option<Tally> {
        Some(self.read_marker(shard)?.tally)
    }

    fn write(
        &self,
        shard: usize,
        clips: &mut dyn Iterator<Item = Result<Clip, ReadError>>,
        tally: &dyn Fn() -> Tally,
    ) -> Result<(), ReadError> {
        store::write_clips(&self.root, shard as u32, clips)?;
        let name = format!("shard-{shard:06}.tar");
        let mut files = BTreeMap::new();
        for file in tars(&self.root)? {
            if Path::new(&file)
                .file_name()
                .is_some_and(|found| found == name.as_str())
            {
                let content = Content::of(&self.root.join(&file))?;
                files.insert(file, content);
            }
        }
        let tally = tally();
        place::write_json(&self.marker(shard), &Marker { tally, files })
    }
}

/// A folder that a conversion fills.
#[derive(Debug)]
pub struct Folder {
    root: PathBuf,
    header: Header,
}

impl Folder {
    /// Begins a conversion, or goes on with it.
    ///
    /// # Errors
    /// When the folder holds something else, or the disk refuses.
    pub fn begin(root: &Path, header: Header) -> Result<Self, ReadError> {
        let file = root.join(FILE);
        match place::read(&file) {
            Ok(bytes) => {
                let there: Header = serde_json::from_slice(&bytes).map_err(|error| {
                    ReadError::malformed(
                        &file,
                        Position::Line(error.line() as u64),
                        error.to_string(),
                    )
                })?;
                let same = |a: &Header, b: &Header| {
                    (&a.source, &a.format, &a.request) == (&b.source, &b.format, &b.request)
                };
                if !same(&there, &header) {
                    let reason = "holds clips of another conversion; name another folder";
                    return Err(ReadError::unsupported(root, reason));
                }
            }
            Err(error) if error.kind() == std::io::ErrorKind::NotFound => {
                let fail = |cause| ReadError::io(root, cause);
                let empty = place::is_empty(root).map_err(fail)?;
                // Another process with a share of the same conversion may have begun in between.
                if !empty && place::is_file(&file).map_err(fail)? {
                    return Self::begin(root, header);
                }
                if !empty {
                    let reason = "is not empty and holds no converted clips; name another folder";
                    return Err(ReadError::unsupported(root, reason));
                }
                place::make_folder(root).map_err(fail)?;
                place::write_json(&file, &header)?;
            }
            Err(error) => return Err(ReadError::io(&file, error)),
        }
        Ok(Folder {
            root: root.to_owned(),
            header,
        })
    }

    /// Where the shards go.
    ///
    /// # Errors
    /// When the disk refuses.
    pub fn sink(&self) -> Result<TarSink, ReadError> {
        TarSink::new(&self.root, &self.root.join(".finished"))
    }

    /// The header as it lies there.
    ///
    /// # Errors
    /// When there is none, or it is damaged.
    pub fn header(root: &Path) -> Result<Header, ReadError> {
        let file = root.join(FILE);
        let bytes = place::read(&file).map_err(|cause| ReadError::io(&file, cause))?;
        serde_json::from_slice(&bytes).map_err(|error| {
            let line = Position::Line(error.line() as u64);
            ReadError::malformed(&file, line, error.to_string())
        })
    }

    /// Writes what became of it.
    ///
    /// # Errors
    /// When the disk refuses.
    pub fn finish(mut self, tally: Tally) -> Result<(), ReadError> {
        self.header.tally = Some(tally);
        place::write_json(&self.root.join(FILE), &self.header)
    }
}

/// Clips read from shards.
#[derive(Debug)]
pub struct ShardClips {
    name: String,
    sets: Vec<(String, ClipSet)>,
    format: Option<ClipFormat>,
}

impl ShardClips {
    /// A folder of shards, or of splits of shards.
    ///
    /// # Errors
    /// When there are none, or a tar is damaged.
    pub fn open(root: &Path) -> Result<Self, ReadError> {
        let absent = || ReadError::absent(root, "there are no shards of clips here");
        let mut sets = Vec::new();
        for split in SPLITS {
            let folder = root.join(split);
            if holds_shards(&folder)? {
                sets.push((split.to_owned(), ClipSet::open(&folder)?));
            }
        }
        if sets.is_empty() && holds_shards(root)? {
            sets.push((String::new(), ClipSet::open(root)?));
        }
        let first = sets.first().ok_or_else(absent)?;
        let id = first.1.ids().first().ok_or_else(absent)?;
        Ok(ShardClips {
            name: id.split('/').next().unwrap_or("clips").to_owned(),
            format: described_format(root)?,
            sets,
        })
    }

    fn place(&self, mut index: usize) -> Option<(&ClipSet, usize)> {
        for (_, set) in &self.sets {
            if index < set.len() {
                return Some((set, index));
            }
            index -= set.len();
        }
        None
    }
}

/// Whether `<modality>/<data set>/shard-*.tar` is below a folder: not below one that cannot be listed, but a store has to answer.
fn holds_shards(root: &Path) -> Result<bool, ReadError> {
    fn below(folder: &Path, depth: usize) -> std::io::Result<bool> {
        let entries = match place::entries(folder) {
            Err(_) if !place::is_remote(folder) => return Ok(false),
            entries => entries?,
        };
        for (path, is_folder) in entries {
            let name = path.file_name().and_then(|name| name.to_str());
            let shard = name.is_some_and(|name| {
                name.starts_with("shard-")
                    && Path::new(name).extension().is_some_and(|e| e == "tar")
            });
            if (depth < 2 && shard) || (depth > 0 && is_folder && below(&path, depth - 1)?) {
                return Ok(true);
            }
        }
        Ok(false)
    }
    below(root, 2).map_err(|cause| ReadError::io(root, cause))
}

/// The sizes that the folder's own description, or that of the artifact it belongs to, speaks of.
///
/// # Errors
/// When a description is there and damaged.
fn described_format(root: &Path) -> Result<Option<ClipFormat>, ReadError> {
    let own = root.join(FILE);
    let above = root.parent().map(|parent| parent.join("manifest.json"));
    let manifests = [Some(root.join("manifest.json")), above];
    let described = [Some(own.clone())].into_iter().chain(manifests).flatten();
    let Some(path) = described
        .into_iter()
        .find(|path| place::is_file(path).unwrap_or(false))
    else {
        return Ok(None);
    };
    let value: serde_json::Value = place::read_json(&path)?;
    let format = if path == own {
        &value["format"]
    } else {
        &value["contents"]["format"]
    };
    if format.is_null() {
        return Ok(None);
    }
    serde_json::from_value(format.clone())
        .map(Some)
        .map_err(|error| ReadError::malformed(&path, Position::File, format!("`format`: {error}")))
}

impl ClipSource for ClipSet {
    fn name(&self) -> &'static str {
        "clips"
    }

    fn len(&self) -> usize {
        ClipSet::len(self)
    }

    fn modalities(&self) -> Vec<String> {
        self.shards().modalities().map(str::to_owned).collect()
    }

    fn clip(&self, index: usize) -> Result<Outcome, ReadError> {
        Ok(Outcome::Clip(Box::new(ClipSet::clip(self, index)?)))
    }

    fn clip_with(&self, index: usize, modalities: &[&str]) -> Result<Outcome, ReadError> {
        let clip = ClipSet::clip_with(self, index, modalities)?;
        Ok(Outcome::Clip(Box::new(clip)))
    }

    fn may_have(&self, index: usize, modality: &str) -> bool {
        self.shards().has(index, modality)
    }
}

impl ClipSource for ShardClips {
    fn name(&self) -> &str {
        &self.name
    }

    fn len(&self) -> usize {
        self.sets.iter().map(|(_, set)| set.len()).sum()
    }

    fn modalities(&self) -> Vec<String> {
        let there = |name: &&str| {
            let mut sets = self.sets.iter();
            sets.any(|(_, set)| set.shards().modalities().any(|known| known == *name))
        };
        let names = crate::modality::BUILT_IN.iter().copied();
        names.filter(there).map(str::to_owned).collect()
    }

    fn format(&self) -> Option<ClipFormat> {
        self.format.clone()
    }

    fn recordings(&self) -> Vec<(String, Range<usize>)> {
        let ids = self.sets.iter().flat_map(|(_, set)| set.ids());
        let mut found: Vec<(String, Range<usize>)> = Vec::new();
        for (index, id) in ids.enumerate() {
            // `data set/recording/number`; without a recording, every clip stands for itself.
            let recording = match id.rsplit_once('/') {
                Some((front, _)) if front.contains('/') => front,
                _ => id,
            };
            match found.last_mut() {
                Some((name, range)) if name == recording => range.end = index + 1,
                _ => found.push((recording.to_owned(), index..index + 1)),
            }
        }
        for (name, _) in &mut found {
            if let Some((_, recording)) = name.split_once('/') {
                *name = recording.to_owned();
            }
        }
        found
    }

    fn clip(&self, index: usize) -> Result<Outcome, ReadError> {
        let (set, inside) = self.place(index).ok_or_else(|| ReadError::OutOfRange {
            source_name: self.name.clone(),
            index,
            len: self.len(),
        })?;
        Ok(Outcome::Clip(Box::new(set.clip(inside)?)))
    }
}
