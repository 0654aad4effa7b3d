//! The identity of what lies outside: a file by its bytes; a folder (a data set) by the names and the bytes of its files.
//!
//! Data sets are too large to read each time. [`Fingerprints`] therefore remembers the hash of every file it has read, beside
//! the cache, and takes it again only when the file's size, times or inode are others. Where a data set lies, and when it was
//! copied there, is no part of its identity: two machines agree on it.

use super::cache::Cache;
use super::environment;
use super::error::{AtPath, RunError};
use super::files;
use super::interrupt::Interrupt;
use super::progress::Progress;
use crate::formats::place;
use rayon::prelude::*;
use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;
use std::fs::Metadata;
use std::path::{Path, PathBuf};

/// A fingerprint, and how many bytes stand behind it.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Fingerprint {
    /// blake3 of a file's bytes; of a folder, of the names and hashes of its files.
    pub hash: blake3::Hash,
    /// Size of the file, or of all files of the folder together.
    pub bytes: u64,
}

/// Looks at a file or a folder now: every byte is read.
pub fn fingerprint(path: &Path) -> Result<Fingerprint, RunError> {
    Fingerprints::default().of(path)
}

/// Fingerprints, each taken once, with a memory beside the cache.
#[derive(Debug, Default)]
pub struct Fingerprints<'a> {
    taken: BTreeMap<PathBuf, Fingerprint>,
    /// The folder of the memory.
    memory: Option<PathBuf>,
    /// Whether the memory is another process's to write.
    borrowed: bool,
    /// Whom to tell how far it is, and who may stop it.
    watched: Option<(&'a Progress, &'a Interrupt)>,
}

impl<'a> Fingerprints<'a> {
    /// With the memory of a cache.
    pub fn remembered(cache: &Cache) -> Self {
        Self {
            memory: Some(cache.root().join("fingerprints")),
            ..Self::default()
        }
    }

    /// With the memory of a cache that another process keeps: writes nothing.
    pub fn borrowed(cache: &Cache) -> Self {
        Self {
            borrowed: true,
            ..Self::remembered(cache)
        }
    }

    /// With somebody who waits for it.
    #[must_use]
    pub fn watched(mut self, progress: &'a Progress, interrupt: &'a Interrupt) -> Self {
        self.watched = Some((progress, interrupt));
        self
    }

    /// The fingerprint of a file or a folder.
    pub fn of(&mut self, path: &Path) -> Result<Fingerprint, RunError> {
        if let Some(known) = self.taken.get(path) {
            return Ok(*known);
        }
        if place::is_remote(path) {
            let print = listed(path)?;
            self.taken.insert(path.to_path_buf(), print);
            return Ok(print);
        }
        let mut scan = Scan::at(path, self.memory.as_deref())?;
        if self.borrowed {
            scan.memory = None;
        }
        let print = scan.take(self.watched, environment::now())?;
        self.taken.insert(path.to_path_buf(), print);
        Ok(print)
    }

    /// The fingerprint, if at most `most` bytes have to be read for it; otherwise how many have to. Writes nothing.
    pub fn within_limit(
        &mut self,
        path: &Path,
        most: u64,
    ) -> Result<Result<Fingerprint, u64>, RunError> {
        if let Some(known) = self.taken.get(path) {
            return Ok(Ok(*known));
        }
        if place::is_remote(path) {
            return self.of(path).map(Ok);
        }
        let mut look = Scan::at(path, self.memory.as_deref())?;
        let unread = look.unread();
        if unread > most {
            return Ok(Err(unread));
        }
        look.memory = None;
        let print = look.take(None, environment::now())?;
        self.taken.insert(path.to_path_buf(), print);
        Ok(Ok(print))
    }

    /// One that was taken before.
    pub fn known(&self, path: &Path) -> Option<Fingerprint> {
        self.taken.get(path).copied()
    }
}

/// What lies in an object store, by the names, the sizes and the store's tags of its objects: nothing is read.
fn listed(path: &Path) -> Result<Fingerprint, RunError> {
    let mut hasher = blake3::Hasher::new();
    hasher.update(b"reviv objects 1");
    let mut part = |bytes: &[u8]| {
        hasher.update(&(bytes.len() as u64).to_le_bytes());
        hasher.update(bytes);
    };
    let mut sum = 0;
    for (name, bytes, tag) in place::listing(path).at("reading", path)? {
        part(name.as_bytes());
        part(&bytes.to_le_bytes());
        part(tag.as_bytes());
        sum += bytes;
    }
    Ok(Fingerprint {
        hash: hasher.finalize(),
        bytes: sum,
    })
}

/// What tells that a file is still the one that was read.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
struct FileMetadata {
    bytes: u64,
    /// Nanoseconds since 1970: of the last change of the bytes, and of the file (which nobody can set back).
    modified: i64,
    changed: i64,
    inode: u64,
}

impl FileMetadata {
    fn of(meta: &Metadata) -> Self {
        #[cfg(unix)]
        {
            use std::os::unix::fs::MetadataExt;
            let nanoseconds = |s: i64, n: i64| s.saturating_mul(1_000_000_000).saturating_add(n);
            Self {
                bytes: meta.len(),
                modified: nanoseconds(meta.mtime(), meta.mtime_nsec()),
                changed: nanoseconds(meta.ctime(), meta.ctime_nsec()),
                inode: meta.ino(),
            }
        }
        #[cfg(not(unix))]
        {
            let since = meta
                .modified()
                .ok()
                .and_then(|time| time.duration_since(std::time::UNIX_EPOCH).ok());
            Self {
                bytes: meta.len(),
                modified: since.map_or(0, |since| since.as_nanos() as i64),
                changed: 0,
                inode: 0,
            }
        }
    }

    /// A file that was changed just now may be changed again without its times showing it.
    fn settled(self, now: f64) -> bool {
        let last = self.modified.max(self.changed) as f64 / 1e9;
        now - last > 2.0
    }
}

/// What the memory keeps of one file or folder.
#[derive(Debug, Default, Serialize, Deserialize)]
struct Remembered {
    root: PathBuf,
    /// Name below the root to its stamp and the hash of its bytes.
    files: BTreeMap<String, (FileMetadata, String)>,
}

/// One name below a folder.
#[derive(Debug)]
enum Found {
    File(PathBuf, FileMetadata, Option<blake3::Hash>),
    /// A link to a folder that was met before, a broken link, a pipe: never read.
    Other(String),
}

/// A file or a folder with what is known of it.
#[derive(Debug)]
struct Scan {
    root: PathBuf,
    folder: bool,
    found: BTreeMap<String, Found>,
    memory: Option<PathBuf>,
}

impl Scan {
    fn at(root: &Path, memory: Option<&Path>) -> Result<Self, RunError> {
        let meta = std::fs::metadata(root).at("reading", root)?;
        let mut look = Self {
            root: root.to_owned(),
            folder: meta.is_dir(),
            found: BTreeMap::new(),
            memory: memory.map(|folder| folder.join(memory_name(root))),
        };
        if look.folder {
            look.walk()?;
        } else {
            look.found.insert(
                String::new(),
                Found::File(root.to_owned(), FileMetadata::of(&meta), None),
            );
        }
        look.recall();
        Ok(look)
    }

    /// Lists everything below the root. Links to folders are followed once.
    fn walk(&mut self) -> Result<(), RunError> {
        let real = |path: &Path| std::fs::canonicalize(path).at("reading", path);
        let mut met = BTreeMap::from([(real(&self.root)?, String::new())]);
        let mut open = vec![(self.root.clone(), String::new())];
        while let Some((folder, prefix)) = open.pop() {
            let mut names = Vec::new();
            for entry in std::fs::read_dir(&folder).at("reading", &folder)? {
                names.push(entry.at("reading", &folder)?.file_name());
            }
            // The last one is opened first; any order does, as long as it is always the same.
            names.sort();
            for name in names {
                let path = folder.join(&name);
                let below = match name.to_str() {
                    Some(name) => format!("{prefix}{name}"),
                    // No text: its bytes under another name.
                    None => format!("{prefix}{}", blake3::hash(name.as_encoded_bytes())),
                };
                let found = match std::fs::metadata(&path) {
                    Err(_) if path.is_symlink() => Found::Other("leads nowhere".into()),
                    Err(error) => return Err(error).at("reading", &path),
                    Ok(meta) if meta.is_file() => Found::File(path, FileMetadata::of(&meta), None),
                    Ok(meta) if meta.is_dir() => {
                        let linked = real(&path)?;
                        if let Some(first) = met.get(&linked) {
                            Found::Other(format!("is `{first}`"))
                        } else {
                            met.insert(linked, below.clone());
                            open.push((path, format!("{below}/")));
                            continue;
                        }
                    }
                    Ok(_) => Found::Other("is no file".into()),
                };
                self.found.insert(below, found);
            }
        }
        Ok(())
    }

    /// Fills in the hashes of files that are as they were when they were read.
    fn recall(&mut self) {
        let Some(path) = self.memory.as_deref().filter(|path| path.exists()) else {
            return;
        };
        // A damaged memory is no memory.
        let Ok(remembered) = files::read_json::<Remembered>(path) else {
            return;
        };
        for (name, (stamp, hash)) in &remembered.files {
            if let Some(Found::File(_, now, known)) = self.found.get_mut(name)
                && now == stamp
            {
                *known = blake3::Hash::from_hex(hash).ok();
            }
        }
    }

    fn unread(&self) -> u64 {
        let sizes = self.found.values().map(|found| match found {
            Found::File(_, stamp, None) => stamp.bytes,
            _ => 0,
        });
        sizes.sum()
    }

    /// Reads what is not known, remembers it, and sums up.
    fn take(
        mut self,
        watched: Option<(&Progress, &Interrupt)>,
        now: f64,
    ) -> Result<Fingerprint, RunError> {
        self.read(watched, now)?;
        let bytes = self.found.values().map(|found| match found {
            Found::File(_, stamp, _) => stamp.bytes,
            Found::Other(_) => 0,
        });
        let bytes = bytes.sum();
        let mut hasher = blake3::Hasher::new();
        hasher.update(b"reviv folder 2");
        let mut part = |bytes: &[u8]| {
            hasher.update(&(bytes.len() as u64).to_le_bytes());
            hasher.update(bytes);
        };
        for (name, found) in &self.found {
            match found {
                Found::File(_, _, Some(hash)) if !self.folder => {
                    return Ok(Fingerprint { hash: *hash, bytes });
                }
                Found::File(_, _, hash) => {
                    part(name.as_bytes());
                    part(hash.as_ref().map_or(&[], |hash| hash.as_bytes()));
                }
                Found::Other(what) => {
                    part(name.as_bytes());
                    part(what.as_bytes());
                }
            }
        }
        Ok(Fingerprint {
            hash: hasher.finalize(),
            bytes,
        })
    }

    fn read(&mut self, watched: Option<(&Progress, &Interrupt)>, now: f64) -> Result<(), RunError> {
        let total = self.unread();
        let mut open: Vec<(&PathBuf, FileMetadata, &mut Option<blake3::Hash>)> = self
            .found
            .values_mut()
            .filter_map(|found| match found {
                Found::File(path, stamp, hash @ None) => Some((&*path, *stamp, hash)),
                _ => None,
            })
            .collect();
        if open.is_empty() {
            return Ok(());
        }
        let mut task = watched.map(|(progress, _)| progress.task(&self.root.display().to_string()));
        let mut done = 0;
        for some in open.chunks_mut(64) {
            if let Some((_, interrupt)) = watched {
                interrupt.check()?;
            }
            some.par_iter_mut().try_for_each(|(path, stamp, hash)| {
                let (read, bytes) = files::hash(path)?;
                // What was listed and what was read must be one file.
                let after = FileMetadata::of(&std::fs::metadata(*path).at("reading", path)?);
                if after != *stamp || bytes != stamp.bytes {
                    return Err(RunError::Changed {
                        what: format!("`{}`", path.display()),
                        detail: "it is being written to".into(),
                    });
                }
                **hash = Some(read);
                Ok(())
            })?;
            done += some.iter().map(|(_, stamp, _)| stamp.bytes).sum::<u64>();
            if let Some(task) = &mut task {
                task.update(done >> 20, total >> 20, "MiB hashed");
            }
        }
        self.remember(now)
    }

    fn remember(&self, now: f64) -> Result<(), RunError> {
        let Some(path) = &self.memory else {
            return Ok(());
        };
        let files = self.found.iter().filter_map(|(name, found)| match found {
            Found::File(_, stamp, Some(hash)) if stamp.settled(now) => {
                Some((name.clone(), (*stamp, hash.to_hex().to_string())))
            }
            _ => None,
        });
        let remembered = Remembered {
            root: self.root.clone(),
            files: files.collect(),
        };
        if let Some(parent) = path.parent() {
            files::create_directory(parent)?;
        }
        files::write_json(path, &remembered)
    }
}

/// One name per place.
fn memory_name(root: &Path) -> String {
    let place = std::fs::canonicalize(root).unwrap_or_else(|_| root.to_owned());
    let hash = blake3::hash(place.to_string_lossy().as_bytes());
    format!("{}.json", &hash.to_hex()[..16])
}

#[cfg(test)]
mod tests {
    use super::*;

    fn folder(files: &[(&str, &str)]) -> tempfile::TempDir {
        let dir = tempfile::tempdir().unwrap();
        for (name, text) in files {
            let path = dir.path().join(name);
            std::fs::create_dir_all(path.parent().unwrap()).unwrap();
            std::fs::write(path, text).unwrap();
        }
        dir
    }

    /// Takes a fingerprint a minute from now, when every file has settled.
    fn later(path: &Path, memory: &Path) -> Fingerprint {
        let look = Scan::at(path, Some(memory)).unwrap();
        look.take(None, environment::now() + 60.0).unwrap()
    }

    fn unread(path: &Path, memory: &Path) -> u64 {
        Scan::at(path, Some(memory)).unwrap().unread()
    }

    #[test]
    fn a_folder_is_the_names_and_bytes_of_its_files_wherever_it_lies() {
        let of = |files: &[(&str, &str)]| fingerprint(folder(files).path()).unwrap();
        let first = of(&[("a", "1"), ("more/b", "22")]);
        assert_eq!(first.bytes, 3);
        assert_eq!(first, of(&[("more/b", "22"), ("a", "1")]));
        for other in [
            &[("a", "1"), ("more/b", "23")][..],
            &[("a", "1"), ("more/c", "22")],
            &[("a", "1")],
            &[("a", "1"), ("more/b", "22"), ("c", "")],
            &[("a", "1"), ("b", "22")],
        ] {
            assert_ne!(first.hash, of(other).hash, "{other:?}");
        }
    }

    #[test]
    fn a_file_is_its_bytes_wherever_it_lies() {
        let dir = folder(&[("a", "1"), ("b", "1")]);
        let of = |name| fingerprint(&dir.path().join(name)).unwrap();
        assert_eq!(of("a"), of("b"));
        assert_eq!(of("a").hash, blake3::hash(b"1"));
        assert!(fingerprint(&dir.path().join("c")).is_err());
    }

    #[test]
    fn bytes_are_read_once_until_a_file_changes() {
        let (dir, memory) = (folder(&[("a", "1"), ("b", "22")]), folder(&[]));
        let first = later(dir.path(), memory.path());
        assert_eq!(unread(dir.path(), memory.path()), 0);
        assert_eq!(later(dir.path(), memory.path()), first);
        // Same size, and the time of the change set back: the file still shows that it was touched.
        let path = dir.path().join("b");
        let before = std::fs::metadata(&path).unwrap().modified().unwrap();
        std::fs::write(&path, "33").unwrap();
        let file = std::fs::File::options().write(true).open(&path).unwrap();
        file.set_modified(before).unwrap();
        drop(file);
        assert_eq!(
            unread(dir.path(), memory.path()),
            if cfg!(unix) { 2 } else { 0 }
        );
        if cfg!(unix) {
            assert_ne!(later(dir.path(), memory.path()).hash, first.hash);
        }
    }

    #[test]
    fn a_file_that_was_just_written_is_not_trusted_to_stay() {
        let (dir, memory) = (folder(&[("a", "1")]), folder(&[]));
        let look = Scan::at(dir.path(), Some(memory.path())).unwrap();
        look.take(None, environment::now()).unwrap();
        assert_eq!(unread(dir.path(), memory.path()), 1);
    }

    #[test]
    fn a_damaged_memory_is_no_memory() {
        let (dir, memory) = (folder(&[("a", "1")]), folder(&[]));
        let first = later(dir.path(), memory.path());
        let file = memory.path().join(memory_name(dir.path()));
        for bytes in [&b""[..], b"{", b"\xff", b"[]"] {
            std::fs::write(&file, bytes).unwrap();
            assert_eq!(unread(dir.path(), memory.path()), 1);
            assert_eq!(later(dir.path(), memory.path()), first);
        }
    }

    #[test]
    fn what_is_too_large_to_read_now_says_how_large_it_is_and_nothing_is_written() {
        let dir = folder(&[("data/a", "12345"), ("cache/x", "")]);
        let cache = Cache::new(dir.path().join("cache"));
        let data = dir.path().join("data");
        let mut prints = Fingerprints::remembered(&cache);
        assert_eq!(prints.within_limit(&data, 4).unwrap(), Err(5));
        let print = prints.within_limit(&data, 5).unwrap().unwrap();
        assert_eq!(print, fingerprint(&data).unwrap());
        assert!(!dir.path().join("cache/fingerprints").exists());
    }

    #[cfg(unix)]
    #[test]
    fn links_are_followed_once_and_pipes_never() {
        use std::os::unix::fs::symlink;
        let (dir, outside) = (folder(&[("a", "1")]), folder(&[("x", "1")]));
        let before = fingerprint(dir.path()).unwrap();
        symlink(outside.path(), dir.path().join("linked")).unwrap();
        symlink(dir.path(), dir.path().join("circle")).unwrap();
        symlink("nowhere", dir.path().join("broken")).unwrap();
        let linked = fingerprint(dir.path()).unwrap();
        assert_eq!((before.bytes, linked.bytes), (1, 2));
        std::fs::write(outside.path().join("x"), "2").unwrap();
        assert_ne!(linked.hash, fingerprint(dir.path()).unwrap().hash);
        let made = std::process::Command::new("mkfifo")
            .arg(dir.path().join("pipe"))
            .status();
        if made.is_ok_and(|status| status.success()) {
            assert_eq!(fingerprint(dir.path()).unwrap().bytes, 2);
        }
    }
}
