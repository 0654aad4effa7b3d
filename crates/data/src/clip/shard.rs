//! WebDataset tar shards: one folder per modality, identical stems, as the ancestors of this project lay them out.
//!
//! ```text
//! root/<modality>/<data set>/shard-000000.tar        clips: <id>.npz
//! root/<modality>/<data set>/token/shard-000000.tar  tokens: <id>.npz with `arr_0`
//! ```
//!
//! A sample that lacks a modality has no member in that modality's tar. Opening shards reads headers only; samples are read
//! one at a time when asked for, in any order, so memory does not grow with the data. Tars are untrusted: a size is compared
//! with the file before anything is allocated.

use crate::formats::tar::{self, Member};
use crate::formats::{FormatError, place};
use std::collections::BTreeMap;
use std::fs::File;
use std::io::BufWriter;
use std::path::{Path, PathBuf};

/// Samples per shard of tokens, as in the released data.
pub const TOKENS_PER_SHARD: usize = 1000;

/// Why shards cannot be read or written.
#[derive(Debug, thiserror::Error)]
pub enum ShardError {
    /// The operating system refuses to make, open, list, read or write a file or a folder.
    #[error("{}: {error}", path.display())]
    Io {
        /// The file or folder it refuses.
        path: PathBuf,
        /// What it says.
        #[source]
        error: std::io::Error,
    },
    /// A member has a name that is no relative path, is there twice, or cannot be read as what it should hold.
    #[error("{}: member `{member}`: {reason}", path.display())]
    Member {
        /// The tar; the folder where a name is refused before there is one.
        path: PathBuf,
        /// The stem of the member: the id of the sample.
        member: String,
        /// What is wrong with it.
        reason: String,
    },
    /// The file is no tar, is cut off, or has a member that is neither `.npz` nor `.npy`.
    #[error("{}: byte {offset}: {reason}", path.display())]
    Tar {
        /// The tar.
        path: PathBuf,
        /// Bytes from the start of the tar: where the contents of the member begin, or those of the last one before the damage.
        offset: u64,
        /// What is wrong there.
        reason: String,
    },
    /// A folder is opened below which no tar lies where shards do.
    #[error("{}: no shards below it", .0.display())]
    Empty(PathBuf),
    /// A sample is asked for beyond the last one.
    #[error("no sample number {index}; there are {count}")]
    NoSample {
        /// The number that was asked for, from 0.
        index: usize,
        /// How many samples the shards have.
        count: usize,
    },
}

fn io(path: &Path) -> impl FnOnce(std::io::Error) -> ShardError + '_ {
    move |error| ShardError::Io {
        path: path.to_owned(),
        error,
    }
}

/// Writes one shard of every modality; nothing is visible under its final name before [`ShardWriter::finish`].
pub struct ShardWriter {
    root: PathBuf,
    number: u32,
    open: BTreeMap<String, Open>,
    /// Where tars grow that are sent away when they are complete.
    drafts: Option<tempfile::TempDir>,
}

/// A tar that grows.
struct Open {
    path: PathBuf,
    /// Where it lies until it is complete.
    temporary: PathBuf,
    builder: ::tar::Builder<BufWriter<File>>,
}

impl ShardWriter {
    /// Shard `number` below `root`.
    pub fn new(root: &Path, number: u32) -> Self {
        Self {
            root: root.to_owned(),
            number,
            open: BTreeMap::new(),
            drafts: None,
        }
    }

    /// Begins the tar in `folder`.
    fn begin(&mut self, folder: &str) -> Result<Open, ShardError> {
        let place = self.root.join(folder);
        place::make_folder(&place).map_err(io(&place))?;
        let path = place.join(format!("shard-{:06}.tar", self.number));
        let temporary = if place::is_remote(&path) {
            if self.drafts.is_none() {
                let made = tempfile::tempdir().map_err(io(&std::env::temp_dir()))?;
                self.drafts = Some(made);
            }
            let drafts = self
                .drafts
                .as_ref()
                .map_or(Path::new("."), tempfile::TempDir::path);
            drafts.join(format!("{:06}.tar", self.open.len()))
        } else {
            path.with_extension("tar.part")
        };
        let file = File::create(&temporary).map_err(io(&temporary))?;
        let builder = ::tar::Builder::new(BufWriter::with_capacity(1 << 18, file));
        Ok(Open {
            path,
            temporary,
            builder,
        })
    }

    /// Adds a member to the tar in `folder` (`camera/world`, `camera/world/token`).
    ///
    /// # Errors
    /// When `stem` is empty, absolute or leaves the folder, or the disk refuses.
    pub fn add(&mut self, folder: &str, stem: &str, bytes: &[u8]) -> Result<(), ShardError> {
        let clean =
            |part: &str| !part.is_empty() && part != "." && part != ".." && !part.contains('\\');
        if !stem.split('/').all(clean) || !folder.split('/').all(clean) {
            return Err(ShardError::Member {
                path: self.root.join(folder),
                member: stem.to_owned(),
                reason: "not a relative path".to_owned(),
            });
        }
        if !self.open.contains_key(folder) {
            let open = self.begin(folder)?;
            self.open.insert(folder.to_owned(), open);
        }
        let Open { path, builder, .. } = self
            .open
            .get_mut(folder)
            .expect("the folder's tar was opened above");
        // Nothing in the header but name and size: the same clips give the same bytes.
        let mut header = ::tar::Header::new_ustar();
        header.set_size(bytes.len() as u64);
        header.set_mode(0o644);
        header.set_mtime(0);
        builder
            .append_data(&mut header, format!("{stem}.npz"), bytes)
            .map_err(io(path))
    }

    /// Completes the tars and gives them their names.
    ///
    /// # Errors
    /// When the disk refuses.
    pub fn finish(self) -> Result<(), ShardError> {
        for open in self.open.into_values() {
            let Open {
                path,
                temporary,
                builder,
            } = open;
            let writer = builder.into_inner().map_err(io(&temporary))?;
            let file = writer
                .into_inner()
                .map_err(|e| io(&temporary)(e.into_error()))?;
            file.sync_all().map_err(io(&temporary))?;
            place::publish(&temporary, &path).map_err(io(&path))?;
        }
        Ok(())
    }
}

/// Where a member lies.
#[derive(Debug, Clone, Copy)]
struct Place {
    tar: u32,
    member: Member,
}

/// Shards of any number of modalities, indexed by sample.
#[derive(Debug, Clone)]
pub struct ShardIndex {
    tars: Vec<PathBuf>,
    /// Stems in the order of their first appearance: shard by shard, data set by data set, the fullest tar first.
    samples: Vec<String>,
    modalities: BTreeMap<String, BTreeMap<String, Place>>,
}

impl ShardIndex {
    /// Indexes all shards below `root/<modality>/`.
    ///
    /// # Errors
    /// When there are none, or a tar is damaged; the error names file, byte and reason.
    pub fn open(root: &Path) -> Result<Self, ShardError> {
        let mut found = Vec::new();
        for (modality, is_folder) in place::entries(root).map_err(io(root))? {
            if is_folder {
                let name = file_name(&modality);
                for path in tar::below(&modality, 3).map_err(|e| damaged(&modality, e))? {
                    let folder = path.parent().unwrap_or(&path);
                    let dataset = folder.strip_prefix(&modality).unwrap_or(folder).to_owned();
                    found.push((file_name(&path), dataset, name.clone(), path));
                }
            }
        }
        if found.is_empty() {
            return Err(ShardError::Empty(root.to_owned()));
        }
        // By shard, then data set, so that samples keep the order they were written in.
        found.sort();
        let mut shards = Self {
            tars: Vec::new(),
            samples: Vec::new(),
            modalities: BTreeMap::new(),
        };
        let mut known = std::collections::BTreeSet::new();
        for tars in found.chunk_by(|a, b| (&a.0, &a.1) == (&b.0, &b.1)) {
            let mut lists = Vec::with_capacity(tars.len());
            for (_, _, modality, path) in tars {
                let members = index(path, shards.tars.len() as u32)?;
                shards.tars.push(path.clone());
                lists.push((modality, path, members));
            }
            // The fullest tells the order of most samples: a modality that some lack would put those last.
            lists.sort_by_key(|(_, _, members)| std::cmp::Reverse(members.len()));
            for (modality, path, members) in lists {
                let places = shards.modalities.entry(modality.clone()).or_default();
                for (stem, place) in members {
                    if known.insert(stem.clone()) {
                        shards.samples.push(stem.clone());
                    }
                    if places.contains_key(&stem) {
                        return Err(ShardError::Member {
                            path: path.clone(),
                            member: stem,
                            reason: "is there twice".to_owned(),
                        });
                    }
                    places.insert(stem, place);
                }
            }
        }
        Ok(shards)
    }

    /// The stems of all samples, in order.
    pub fn samples(&self) -> &[String] {
        &self.samples
    }

    /// The modalities that have shards, sorted by name.
    pub fn modalities(&self) -> impl Iterator<Item = &str> {
        self.modalities.keys().map(String::as_str)
    }

    /// How many samples have the modality.
    pub fn count(&self, modality: &str) -> usize {
        self.modalities.get(modality).map_or(0, BTreeMap::len)
    }

    /// Whether the sample has the modality.
    pub fn has(&self, sample: usize, modality: &str) -> bool {
        let places = self.modalities.get(modality);
        let stem = self.samples.get(sample);
        stem.is_some_and(|stem| places.is_some_and(|places| places.contains_key(stem)))
    }

    /// The bytes of one member; `None` where the sample lacks the modality.
    ///
    /// # Errors
    /// When `sample` is out of range or the file cannot be read.
    pub fn read(&self, sample: usize, modality: &str) -> Result<Option<Vec<u8>>, ShardError> {
        let stem = self.samples.get(sample).ok_or(ShardError::NoSample {
            index: sample,
            count: self.samples.len(),
        })?;
        let Some(place) = self.modalities.get(modality).and_then(|m| m.get(stem)) else {
            return Ok(None);
        };
        let path = &self.tars[place.tar as usize];
        let bytes =
            place::read_range(path, place.member.offset, place.member.size).map_err(io(path))?;
        if bytes.len() as u64 != place.member.size {
            return Err(ShardError::Member {
                path: path.clone(),
                member: stem.clone(),
                reason: "the file has become shorter".to_owned(),
            });
        }
        Ok(Some(bytes))
    }

    /// An error about one member, for whoever reads its bytes.
    pub fn member_error(
        &self,
        sample: usize,
        modality: &str,
        reason: impl std::fmt::Display,
    ) -> ShardError {
        let stem = self.samples.get(sample).cloned().unwrap_or_default();
        let place = self.modalities.get(modality).and_then(|m| m.get(&stem));
        ShardError::Member {
            path: place.map_or_else(PathBuf::new, |p| self.tars[p.tar as usize].clone()),
            member: stem,
            reason: reason.to_string(),
        }
    }
}

fn file_name(path: &Path) -> String {
    path.file_name()
        .unwrap_or_default()
        .to_string_lossy()
        .into_owned()
}

/// What is wrong with a tar, or with a folder of them.
fn damaged(path: &Path, error: FormatError) -> ShardError {
    match error {
        FormatError::File { path, source } => damaged(&path, *source),
        FormatError::Io(error) => io(path)(error),
        FormatError::Malformed { offset, reason, .. } => ShardError::Tar {
            path: path.to_owned(),
            offset,
            reason,
        },
        error => ShardError::Tar {
            path: path.to_owned(),
            offset: 0,
            reason: error.to_string(),
        },
    }
}

/// The members of a tar by stem.
fn index(path: &Path, tar: u32) -> Result<Vec<(String, Place)>, ShardError> {
    let headers = tar::headers(path).map_err(|error| damaged(path, error))?;
    let mut members = Vec::new();
    for header in headers.into_iter().filter(|header| header.is_file) {
        let wrong = |reason: String| ShardError::Tar {
            path: path.to_owned(),
            offset: header.member.offset,
            reason,
        };
        let name = std::str::from_utf8(&header.name)
            .map_err(|_| wrong("a name that is not UTF-8".to_owned()))?;
        let stem = name
            .strip_suffix(".npz")
            .or_else(|| name.strip_suffix(".npy"))
            .ok_or_else(|| wrong(format!("`{name}` is neither .npz nor .npy")))?;
        let member = header.member;
        members.push((stem.to_owned(), Place { tar, member }));
    }
    Ok(members)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn members_come_back_in_the_order_they_were_written() {
        let folder = tempfile::tempdir().unwrap();
        for number in 0..2 {
            let mut writer = ShardWriter::new(folder.path(), number);
            for i in 0..3 {
                let stem = format!("world/{:06}", 5 - (number * 3 + i));
                writer.add("camera/world", &stem, &[i as u8; 700]).unwrap();
                if i != 1 {
                    writer.add("gaze/world", &stem, stem.as_bytes()).unwrap();
                }
            }
            writer.finish().unwrap();
        }
        let shards = ShardIndex::open(folder.path()).unwrap();
        let expected: Vec<String> = (0..6).rev().map(|i| format!("world/{i:06}")).collect();
        assert_eq!(shards.samples(), expected);
        assert_eq!(shards.modalities().collect::<Vec<_>>(), ["camera", "gaze"]);
        assert_eq!((shards.count("camera"), shards.count("gaze")), (6, 4));
        assert_eq!(shards.read(5, "camera").unwrap().unwrap(), [2; 700]);
        assert_eq!(shards.read(0, "gaze").unwrap().unwrap(), b"world/000005");
        assert_eq!(shards.read(1, "gaze").unwrap(), None);
        assert!(shards.read(6, "gaze").is_err());
    }

    #[test]
    fn a_sample_without_the_first_modality_keeps_its_place() {
        let folder = tempfile::tempdir().unwrap();
        let mut writer = ShardWriter::new(folder.path(), 0);
        for dataset in ["adt", "world"] {
            for i in 0..3 {
                let stem = format!("{dataset}/{i}");
                if i != 0 {
                    writer.add(&format!("body/{dataset}"), &stem, b"1").unwrap();
                }
                writer
                    .add(&format!("camera/{dataset}"), &stem, b"1")
                    .unwrap();
            }
        }
        writer.finish().unwrap();
        let shards = ShardIndex::open(folder.path()).unwrap();
        assert_eq!(
            shards.samples(),
            ["adt/0", "adt/1", "adt/2", "world/0", "world/1", "world/2"]
        );
        assert!(!shards.has(0, "body") && shards.has(5, "body"));
    }

    #[test]
    fn names_cannot_leave_the_folder() {
        let folder = tempfile::tempdir().unwrap();
        let mut writer = ShardWriter::new(folder.path(), 0);
        for stem in ["../x", "/x", "", "a//b", "a/./b"] {
            assert!(writer.add("camera/world", stem, b"1").is_err(), "{stem}");
        }
    }

    #[test]
    fn an_unfinished_shard_is_not_seen() {
        let folder = tempfile::tempdir().unwrap();
        let mut writer = ShardWriter::new(folder.path(), 0);
        writer.add("camera/world", "a", b"1").unwrap();
        drop(writer);
        assert!(matches!(
            ShardIndex::open(folder.path()),
            Err(ShardError::Empty(_))
        ));
    }

    #[test]
    fn damaged_tars_are_errors_and_never_panics() {
        let folder = tempfile::tempdir().unwrap();
        let mut writer = ShardWriter::new(folder.path(), 0);
        for i in 0..4 {
            writer
                .add("camera/world", &format!("c{i}"), &[7; 900])
                .unwrap();
        }
        writer.finish().unwrap();
        let path = folder.path().join("camera/world/shard-000000.tar");
        let good = std::fs::read(&path).unwrap();
        // Between two members, too: a member is 1536 bytes with its header, and two empty blocks are the end.
        for cut in [0, 1, 300, 512, 800, 1300, 1536, 2500, 4 * 1536] {
            std::fs::write(&path, &good[..cut]).unwrap();
            let message = ShardIndex::open(folder.path()).unwrap_err().to_string();
            assert!(
                message.contains("shard-000000.tar") && message.contains("byte"),
                "{cut}: {message}"
            );
        }
        // GNU tar, too, is content with one of them.
        std::fs::write(&path, &good[..4 * 1536 + 512]).unwrap();
        assert_eq!(ShardIndex::open(folder.path()).unwrap().count("camera"), 4);
        let mut errors = 0;
        for at in 0..600 {
            let mut bad = good.clone();
            bad[at] ^= 0x41;
            std::fs::write(&path, &bad).unwrap();
            match ShardIndex::open(folder.path()) {
                Ok(shards) => (0..shards.samples().len()).for_each(|i| {
                    let _ = shards.read(i, "camera");
                }),
                Err(_) => errors += 1,
            }
        }
        // A size of eight gigabytes in a small file.
        let mut huge = good.clone();
        huge[124..136].copy_from_slice(b"77777777777\0");
        huge[148..156].copy_from_slice(b"        ");
        let sum: u32 = huge[..512].iter().map(|b| u32::from(*b)).sum();
        huge[148..156].copy_from_slice(format!("{sum:06o}\0 ").as_bytes());
        std::fs::write(&path, &huge).unwrap();
        let message = ShardIndex::open(folder.path()).unwrap_err().to_string();
        assert!(message.contains("shard-000000.tar"), "{message}");
        assert!(errors > 200, "{errors}");
    }
}
