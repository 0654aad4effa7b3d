//! The content-addressed cache of artifacts.
//!
//! An artifact's [`Key`] ([`crate::experiment::Graph::keys`]) is the blake3 hash of the op, the op's version, the resolved
//! settings, the seed, the bytes of the files it reads and the keys of the input artifacts: everything that decides its bytes. The directory
//! `cache/ab/abcdef.../` is the artifact; it appears in one step, complete, with a [`Manifest`] that lists its files. What
//! has no manifest, lost a file, or has a file that was written to since and now has other bytes, is not there.

use super::environment;
use super::error::{AtPath, RunError};
use super::files;
use super::interrupt::Interrupt;
use super::lock::Lock;
use super::stamps::Stamps;
use crate::experiment::ArtifactKey;

use serde::{Deserialize, Serialize};
use serde_json::Value;
use std::collections::{BTreeMap, BTreeSet};
use std::fmt;
use std::path::{Path, PathBuf};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

/// The name of the manifest inside an artifact.
pub const MANIFEST: &str = "manifest.json";

/// What decided an artifact's bytes, for the reader of its manifest.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Recipe {
    /// The op that made it.
    pub op: String,
    /// The op's version when it made it; another version is another artifact.
    pub version: u32,
    /// `None` for ops without randomness, so that seeds share what they make.
    pub seed: Option<u64>,
    /// Resolved: no reference, no default left open.
    pub settings: Value,
    /// Settings key of each outside file to the blake3 of its bytes.
    pub files: BTreeMap<String, String>,
    /// Port name to the artifacts behind it, in their order.
    pub inputs: BTreeMap<String, Vec<Key>>,
}

/// The address of an artifact.
#[derive(Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct Key([u8; 32]);

impl Key {
    /// The first four digits, as run directories carry them.
    pub fn short(&self) -> String {
        self.to_string()[..4].to_owned()
    }
}

impl From<blake3::Hash> for Key {
    fn from(hash: blake3::Hash) -> Self {
        Self(*hash.as_bytes())
    }
}

impl From<ArtifactKey> for Key {
    fn from(key: ArtifactKey) -> Self {
        key.0.into()
    }
}

impl fmt::Display for Key {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(&blake3::Hash::from_bytes(self.0).to_hex())
    }
}

impl fmt::Debug for Key {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "Key({self})")
    }
}

impl std::str::FromStr for Key {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        let hash = blake3::Hash::from_hex(text).map_err(|error| error.to_string())?;
        Ok(Self(*hash.as_bytes()))
    }
}

impl Serialize for Key {
    fn serialize<S: serde::Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        serializer.collect_str(self)
    }
}

impl<'de> Deserialize<'de> for Key {
    fn deserialize<D: serde::Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
        let text = String::deserialize(deserializer)?;
        text.parse().map_err(serde::de::Error::custom)
    }
}

/// What an artifact is and what it is made of. Nothing here depends on when, where or by whom it was made.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Manifest {
    /// The artifact's type: `clips`, `tokenizer`, ...
    pub kind: String,
    /// The artifact's own address, by which a manifest in the wrong place is noticed.
    pub key: Key,
    /// What decided its bytes.
    pub recipe: Recipe,
    /// What the op says of it.
    pub contents: Value,
    /// Every other file, with `/` between folders.
    pub files: BTreeMap<String, FileHash>,
}

/// One file of an artifact.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct FileHash {
    /// The file's size.
    pub bytes: u64,
    /// The hash of its content, in hexadecimal.
    pub blake3: String,
}

/// How an artifact came to be; kept beside it, not in it.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Made {
    /// The op that made it.
    pub op: String,
    /// Of work, over all attempts.
    pub seconds: f64,
    /// Name of the machine that made it.
    pub host: String,
    /// UTC.
    pub at: String,
    /// The stage directory with its metrics, relative to the directory of runs.
    pub stage: String,
}

/// What a look at a key finds.
#[derive(Debug)]
pub enum Entry {
    /// There is nothing.
    Absent,
    /// The artifact, with its manifest and every file at its size.
    Whole(Box<Manifest>),
    /// Something is there, and why it does not count.
    Damaged(String),
}

/// A directory of artifacts.
#[derive(Debug, Clone)]
pub struct Cache {
    root: PathBuf,
    /// Every byte is read before an artifact counts as whole; those that were read lately do.
    strict: Option<Arc<Mutex<BTreeSet<Key>>>>,
}

/// What lies beside an artifact and says when its files were seen to be whole.
const SEEN: &str = "seen.json";

impl Cache {
    /// The cache of a directory of runs.
    pub fn of(runs: &Path) -> Self {
        Self::new(runs.join("cache"))
    }

    /// The cache in a directory, which is made when something is put there.
    pub fn new(root: impl Into<PathBuf>) -> Self {
        Self {
            root: root.into(),
            strict: None,
        }
    }

    /// The same cache, which reads every byte of an artifact once before it counts as whole.
    #[must_use]
    pub fn strict(self) -> Self {
        Self {
            strict: Some(Arc::default()),
            ..self
        }
    }

    /// The directory that holds all of it.
    pub fn root(&self) -> &Path {
        &self.root
    }

    /// Where the artifact of `key` is, or would be.
    pub fn path(&self, key: &Key) -> PathBuf {
        let name = key.to_string();
        self.root.join(&name[..2]).join(name)
    }

    fn beside(&self, key: &Key, extension: &str) -> PathBuf {
        let name = key.to_string();
        self.root
            .join(&name[..2])
            .join(format!("{name}.{extension}"))
    }

    /// The lock file of `key`, beside its artifact: who makes the artifact holds it.
    pub fn lock_path(&self, key: &Key) -> PathBuf {
        self.beside(key, "lock")
    }

    /// Whether a whole artifact is there.
    pub fn contains(&self, key: &Key) -> bool {
        matches!(self.look(key), Entry::Whole(_))
    }

    /// Looks at what is there: the manifest, every file's presence and size, and the bytes of files that were written to since they
    /// were seen to be whole. A strict cache reads all bytes.
    pub fn look(&self, key: &Key) -> Entry {
        let path = self.path(key);
        if std::fs::symlink_metadata(&path).is_err() {
            return Entry::Absent;
        }
        let manifest: Manifest = match files::read_json(&path.join(MANIFEST)) {
            Ok(manifest) => manifest,
            Err(error) => return Entry::Damaged(error.to_string()),
        };
        if manifest.key != *key {
            return Entry::Damaged("its manifest belongs to another artifact".into());
        }
        for (name, file) in &manifest.files {
            if !is_inside(name) {
                return Entry::Damaged(format!("`{name}` leads out of it"));
            }
            match std::fs::metadata(path.join(name)) {
                Ok(meta) if meta.is_file() && meta.len() == file.bytes => {}
                Ok(meta) => {
                    let found = meta.len();
                    return Entry::Damaged(format!("`{name}` has {found} bytes of {}", file.bytes));
                }
                Err(error) => return Entry::Damaged(format!("`{name}`: {error}")),
            }
        }
        match self.bytes_hold(key, &manifest) {
            Ok(()) => Entry::Whole(Box::new(manifest)),
            Err(why) => Entry::Damaged(why),
        }
    }

    fn bytes_hold(&self, key: &Key, manifest: &Manifest) -> Result<(), String> {
        let path = self.path(key);
        let read = || self.strict.as_ref().map(|read| lock(read).contains(key));
        let known: Option<Stamps> = match read() {
            Some(true) => return Ok(()),
            // As if nothing had ever been seen.
            Some(false) => Some(Stamps::default()),
            None => files::read_json(&self.beside(key, SEEN)).ok(),
        };
        // An artifact of which nobody knows when it was seen is believed, as its size is right.
        let Some(known) = known else {
            return Ok(());
        };
        let now = Stamps::of(&path, manifest.files.keys()).map_err(|error| error.to_string())?;
        let mut any = false;
        for name in now.changed(&known) {
            any = true;
            let Some(file) = manifest.files.get(name) else {
                continue;
            };
            let (hash, _) = files::hash(&path.join(name)).map_err(|error| error.to_string())?;
            if hash.to_hex().as_str() != file.blake3 {
                return Err(format!("`{name}` has other bytes than when it was made"));
            }
        }
        if any {
            // On a disk that cannot be written to, the next look reads them again.
            let _ = files::write_json(&self.beside(key, SEEN), &now);
        }
        if let Some(read) = &self.strict {
            lock(read).insert(*key);
        }
        Ok(())
    }

    /// Reads every byte of an artifact again and compares with its manifest.
    pub fn rehash(&self, key: &Key) -> Result<(), RunError> {
        let what = format!("artifact `{}`", self.path(key).display());
        let changed = |detail: String| RunError::Changed {
            what: what.clone(),
            detail,
        };
        let manifest = match self.look(key) {
            Entry::Whole(manifest) => manifest,
            Entry::Absent => return Err(changed("it is gone".into())),
            Entry::Damaged(why) => return Err(changed(why)),
        };
        for (name, file) in &manifest.files {
            let (hash, _) = files::hash(&self.path(key).join(name))?;
            if hash.to_hex().as_str() != file.blake3 {
                return Err(changed(format!(
                    "`{name}` has other bytes than when it was made"
                )));
            }
        }
        Ok(())
    }

    /// Waits for the right to make `key`.
    pub fn lock(
        &self,
        key: &Key,
        interrupt: &Interrupt,
        waiting: impl FnOnce(Option<super::error::Holder>),
    ) -> Result<Lock, RunError> {
        let path = self.lock_path(key);
        files::create_directory(path.parent().unwrap_or(&self.root))?;
        Lock::wait(&path, interrupt, waiting)
    }

    /// An empty directory to make the artifact in. What a killed process left there is removed. Needs the key's lock.
    pub fn begin(&self, key: &Key) -> Result<PathBuf, RunError> {
        let path = self.beside(key, "making");
        files::remove(&path)?;
        files::create_directory(&path)?;
        Ok(path)
    }

    /// Lists what was made under [`Cache::begin`] and puts it in its place. Needs the key's lock.
    pub fn publish(
        &self,
        key: &Key,
        kind: &str,
        recipe: Recipe,
        contents: Value,
        made: &Made,
    ) -> Result<Manifest, RunError> {
        let making = self.beside(key, "making");
        let mut listed = BTreeMap::new();
        for file in files::files_below(&making)? {
            if file == Path::new(MANIFEST) {
                return Err(RunError::Malformed {
                    path: making.join(file),
                    reason: "the name is reserved; what an op wants to say goes into `contents`"
                        .into(),
                });
            }
            let (hash, bytes) = files::hash(&making.join(&file))?;
            let name = portable(&file)?;
            let blake3 = hash.to_hex().to_string();
            listed.insert(name, FileHash { bytes, blake3 });
        }
        let manifest = Manifest {
            kind: kind.into(),
            key: *key,
            recipe,
            contents,
            files: listed,
        };
        files::write_json(&making.join(MANIFEST), &manifest)?;
        let place = self.path(key);
        self.set_aside(key)?;
        files::publish_directory(&making, &place)?;
        let seen = Stamps::of(&place, manifest.files.keys())?;
        files::write_json(&self.beside(key, SEEN), &seen)?;
        files::write_json(&self.beside(key, "made.json"), made)?;
        if let Some(read) = &self.strict {
            lock(read).insert(*key);
        }
        Ok(manifest)
    }

    /// Drops what was begun. Needs the key's lock.
    pub fn abandon(&self, key: &Key) -> Result<(), RunError> {
        files::remove(&self.beside(key, "making"))
    }

    /// How the artifact came to be, if that was kept.
    pub fn made(&self, key: &Key) -> Option<Made> {
        files::read_json(&self.beside(key, "made.json")).ok()
    }

    /// Moves a damaged entry out of the way; it stays readable until `reviv gc`.
    pub fn set_aside(&self, key: &Key) -> Result<(), RunError> {
        let path = self.path(key);
        if std::fs::symlink_metadata(&path).is_err() {
            return Ok(());
        }
        if let Some(read) = &self.strict {
            lock(read).remove(key);
        }
        files::remove(&self.beside(key, SEEN))?;
        let aside = self.beside(key, "damaged");
        files::remove(&aside)?;
        std::fs::rename(&path, &aside).at("moving", &path)
    }

    /// Everything in the cache, sorted by name.
    pub fn entries(&self) -> Result<Vec<Leaf>, RunError> {
        let mut leaves = Vec::new();
        if !self.root.exists() {
            return Ok(leaves);
        }
        for shelf in read_sorted(&self.root)? {
            if !shelf.is_dir() {
                continue;
            }
            for path in read_sorted(&shelf)? {
                let name = path
                    .file_name()
                    .map_or_else(String::new, |n| n.to_string_lossy().into_owned());
                let (stem, extension) = name.split_once('.').unwrap_or((name.as_str(), ""));
                if let Ok(key) = stem.parse() {
                    let extension = extension.to_owned();
                    leaves.push(Leaf {
                        key,
                        extension,
                        path,
                    });
                }
            }
        }
        Ok(leaves)
    }

    /// A `Made` for work that ends now.
    pub fn made_now(op: &str, seconds: f64, stage: String) -> Made {
        Made {
            op: op.into(),
            seconds,
            host: environment::host(),
            at: environment::now_text(),
            stage,
        }
    }
}

/// One name in the cache: an artifact (no extension), or what lies beside it (`lock`, `making`, `made.json`, `seen.json`,
/// `damaged`).
#[derive(Debug)]
pub struct Leaf {
    /// The artifact that it is, or lies beside.
    pub key: Key,
    /// What follows the first dot of its name: empty, `lock`, `making`, `made.json`, `damaged`.
    pub extension: String,
    /// Where it lies.
    pub path: PathBuf,
}

fn lock(read: &Mutex<BTreeSet<Key>>) -> MutexGuard<'_, BTreeSet<Key>> {
    read.lock().unwrap_or_else(PoisonError::into_inner)
}

fn read_sorted(directory: &Path) -> Result<Vec<PathBuf>, RunError> {
    let mut paths = Vec::new();
    for entry in std::fs::read_dir(directory).at("reading", directory)? {
        paths.push(entry.at("reading", directory)?.path());
    }
    paths.sort();
    Ok(paths)
}

/// Whether a listed name stays below the artifact.
fn is_inside(name: &str) -> bool {
    use std::path::Component;
    let mut parts = Path::new(name).components();
    !name.is_empty() && parts.all(|part| matches!(part, Component::Normal(_)))
}

fn portable(path: &Path) -> Result<String, RunError> {
    let parts: Option<Vec<&str>> = path.iter().map(|part| part.to_str()).collect();
    parts
        .map(|parts| parts.join("/"))
        .ok_or_else(|| RunError::Malformed {
            path: path.into(),
            reason: "a file name of an artifact is not UTF-8".into(),
        })
}

#[cfg(test)]
mod tests {
    use super::*;
    use serde_json::json;

    fn key(name: &str) -> Key {
        blake3::hash(name.as_bytes()).into()
    }

    fn make(cache: &Cache, key: &Key) -> Manifest {
        let recipe = Recipe {
            op: "clips".into(),
            version: 1,
            seed: Some(0),
            settings: json!({}),
            files: BTreeMap::new(),
            inputs: BTreeMap::new(),
        };
        let _lock = cache.lock(key, &Interrupt::default(), |_| {}).unwrap();
        let dir = cache.begin(key).unwrap();
        std::fs::create_dir(dir.join("part")).unwrap();
        std::fs::write(dir.join("part/a.bin"), b"abc").unwrap();
        let made = Cache::made_now("clips", 1.0, String::new());
        let contents = json!({"clips": 3});
        cache
            .publish(key, "clips", recipe, contents, &made)
            .unwrap()
    }

    #[test]
    fn what_was_published_is_found_and_what_lost_a_byte_is_not() {
        let dir = tempfile::tempdir().unwrap();
        let cache = Cache::new(dir.path());
        let key = key("a");
        assert!(matches!(cache.look(&key), Entry::Absent));
        make(&cache, &key);
        assert!(cache.contains(&key));
        cache.rehash(&key).unwrap();

        let file = cache.path(&key).join("part/a.bin");
        std::fs::write(&file, b"abd").unwrap();
        assert_eq!(cache.rehash(&key).unwrap_err().code(), "E0602");
        let Entry::Damaged(why) = cache.look(&key) else {
            panic!("as many bytes, but others");
        };
        assert!(why.contains("part/a.bin"), "{why}");
        std::fs::write(&file, b"abc").unwrap();
        assert!(cache.contains(&key), "the bytes are back");
        std::fs::write(&file, b"ab").unwrap();
        assert!(matches!(cache.look(&key), Entry::Damaged(_)));
        std::fs::remove_file(cache.path(&key).join(MANIFEST)).unwrap();
        assert!(matches!(cache.look(&key), Entry::Damaged(_)));

        make(&cache, &key);
        assert!(cache.contains(&key));
    }

    /// Bytes that went bad without the file system's knowledge are found by who reads them all.
    #[test]
    fn a_strict_cache_reads_what_the_stamps_do_not_tell() {
        let dir = tempfile::tempdir().unwrap();
        let cache = Cache::new(dir.path());
        let key = key("a");
        make(&cache, &key);
        let file = cache.path(&key).join("part/a.bin");
        std::fs::write(&file, b"abd").unwrap();
        // As if the stamps were of the bytes that are there now.
        let now = Stamps::of(&cache.path(&key), [&"part/a.bin".to_owned()]).unwrap();
        files::write_json(&cache.beside(&key, SEEN), &now).unwrap();
        assert!(cache.contains(&key));
        assert!(!cache.clone().strict().contains(&key));
        std::fs::write(&file, b"abc").unwrap();
        let strict = cache.strict();
        assert!(strict.contains(&key));
        std::fs::write(&file, b"abd").unwrap();
        assert!(strict.contains(&key), "once in a process is enough");
    }

    #[test]
    fn a_manifest_of_another_artifact_does_not_count() {
        let dir = tempfile::tempdir().unwrap();
        let cache = Cache::new(dir.path());
        let (one, two) = (key("one"), key("two"));
        make(&cache, &one);
        std::fs::create_dir_all(cache.path(&two).parent().unwrap()).unwrap();
        std::fs::rename(cache.path(&one), cache.path(&two)).unwrap();
        assert!(matches!(cache.look(&two), Entry::Damaged(_)));
    }

    #[test]
    fn two_makings_of_one_artifact_have_the_same_bytes() {
        let dirs = [tempfile::tempdir().unwrap(), tempfile::tempdir().unwrap()];
        let bytes = dirs.each_ref().map(|dir| {
            let cache = Cache::new(dir.path());
            make(&cache, &key("a"));
            std::fs::read(cache.path(&key("a")).join(MANIFEST)).unwrap()
        });
        assert_eq!(bytes[0], bytes[1]);
    }

    #[test]
    fn a_path_in_a_manifest_cannot_lead_out_of_its_artifact() {
        let dir = tempfile::tempdir().unwrap();
        let cache = Cache::new(dir.path());
        let mut manifest = make(&cache, &key("a"));
        let file = manifest.files.remove("part/a.bin").unwrap();
        manifest.files.insert("/dev/zero".into(), file);
        files::write_json(&cache.path(&key("a")).join(MANIFEST), &manifest).unwrap();
        assert!(matches!(cache.look(&key("a")), Entry::Damaged(_)));
        assert!(cache.rehash(&key("a")).is_err());
    }
}
