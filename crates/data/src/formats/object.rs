//! Objects of a store that speaks the protocol of S3, through the crate `object_store`.
//!
//! Who may do what, and where the store is, says the environment, as for other programs: `AWS_ACCESS_KEY_ID`, `AWS_SECRET_ACCESS_KEY`,
//! `AWS_REGION`, `AWS_ENDPOINT`, `AWS_ALLOW_HTTP` and their kin. Requests are asynchronous; whoever asks here waits for the answer.

use bytes::Bytes;
use futures_util::TryStreamExt;
pub use object_store::ObjectStore;
use object_store::aws::AmazonS3Builder;
pub use object_store::memory::InMemory;
use object_store::path::Path as Key;
use object_store::{ObjectStoreExt, WriteMultipart};
use std::collections::BTreeMap;
use std::io::{Error, ErrorKind, Read, Result, Seek, SeekFrom};
use std::path::{Path, PathBuf};
use std::sync::{Arc, Mutex, OnceLock, PoisonError};
use tokio::runtime::Runtime;

/// Files beyond this are sent in parts of this size.
const PART: u64 = 16 << 20;
/// Parts on their way at a time.
const PARTS: usize = 4;

/// The stores that are open, by bucket.
static STORES: Mutex<BTreeMap<String, Arc<dyn ObjectStore>>> = Mutex::new(BTreeMap::new());

/// Lets a store stand for the bucket of this name, in this process: one in memory for tests, or one that is set up in another way than
/// by the environment.
pub fn mount(bucket: &str, store: Arc<dyn ObjectStore>) {
    let mut stores = STORES.lock().unwrap_or_else(PoisonError::into_inner);
    stores.insert(bucket.to_owned(), store);
}

fn bucket(name: &str) -> Result<Arc<dyn ObjectStore>> {
    let mut stores = STORES.lock().unwrap_or_else(PoisonError::into_inner);
    if let Some(store) = stores.get(name) {
        return Ok(Arc::clone(store));
    }
    let builder = AmazonS3Builder::from_env().with_bucket_name(name);
    let store: Arc<dyn ObjectStore> = Arc::new(builder.build()?);
    stores.insert(name.to_owned(), Arc::clone(&store));
    Ok(store)
}

/// Bucket and key of `s3://bucket/key`.
fn place(address: &Path) -> Result<(Arc<dyn ObjectStore>, Key)> {
    let wrong = |reason: String| Error::new(ErrorKind::InvalidInput, reason);
    let text = address.to_str().and_then(|text| text.strip_prefix("s3://"));
    let text =
        text.ok_or_else(|| wrong("no address of the form `s3://bucket/prefix`".to_owned()))?;
    let (name, key) = text.split_once('/').unwrap_or((text, ""));
    if name.is_empty() {
        return Err(wrong("an address without a bucket".to_owned()));
    }
    let key = Key::parse(key).map_err(|error| wrong(error.to_string()))?;
    Ok((bucket(name)?, key))
}

fn wait<T>(answer: impl Future<Output = object_store::Result<T>>) -> Result<T> {
    static RUNTIME: OnceLock<Runtime> = OnceLock::new();
    let runtime = if let Some(runtime) = RUNTIME.get() {
        runtime
    } else {
        let runtime = tokio::runtime::Builder::new_multi_thread()
            .worker_threads(2)
            .enable_all()
            .build()?;
        // Of two threads that come first, one is faster.
        RUNTIME.get_or_init(|| runtime)
    };
    Ok(runtime.block_on(answer)?)
}

/// Whether the address is one, and its store can be opened.
pub fn check(address: &Path) -> Result<()> {
    place(address).map(|_| ())
}

/// All bytes of an object.
pub fn read(address: &Path) -> Result<Vec<u8>> {
    let (store, key) = place(address)?;
    let bytes = wait(async { store.get(&key).await?.bytes().await })?;
    Ok(bytes.into())
}

/// Bytes of an object from `offset` on; fewer where it ends before.
pub fn read_range(address: &Path, offset: u64, length: u64) -> Result<Vec<u8>> {
    if length == 0 {
        return Ok(Vec::new());
    }
    let (store, key) = place(address)?;
    let end = offset.saturating_add(length);
    Ok(wait(store.get_range(&key, offset..end))?.into())
}

/// Writes an object.
pub fn write(address: &Path, bytes: &[u8]) -> Result<()> {
    let (store, key) = place(address)?;
    wait(store.put(&key, bytes.to_vec().into())).map(|_| ())
}

/// Sends a file.
pub fn send(file: &Path, address: &Path) -> Result<()> {
    let (store, key) = place(address)?;
    let mut from = std::fs::File::open(file)?;
    let mut part = Vec::new();
    if from.metadata()?.len() <= PART {
        from.read_to_end(&mut part)?;
        return wait(store.put(&key, part.into())).map(|_| ());
    }
    wait(async {
        let upload = store.put_multipart(&key).await?;
        let mut upload = WriteMultipart::new_with_chunk_size(upload, PART as usize);
        let mut next = || -> Result<Bytes> {
            part.clear();
            (&mut from).take(PART).read_to_end(&mut part)?;
            Ok(Bytes::copy_from_slice(&part))
        };
        loop {
            upload.wait_for_capacity(PARTS).await?;
            match next() {
                Ok(bytes) if bytes.is_empty() => break,
                Ok(bytes) => upload.put(bytes),
                Err(error) => {
                    upload.abort().await?;
                    return Err(object_store::Error::Generic {
                        store: "the file that is sent",
                        source: error.into(),
                    });
                }
            }
        }
        upload.finish().await
    })
    .map(|_| ())
}

/// Whether an object is there.
pub fn is_file(address: &Path) -> Result<bool> {
    let (store, key) = place(address)?;
    match wait(store.head(&key)) {
        Ok(_) => Ok(true),
        Err(error) if error.kind() == ErrorKind::NotFound => Ok(false),
        Err(error) => Err(error),
    }
}

/// What is one step below an address: objects, and what stands for folders.
pub fn entries(address: &Path) -> Result<Vec<(PathBuf, bool)>> {
    let (store, key) = place(address)?;
    let found = wait(store.list_with_delimiter(Some(&key)))?;
    let folders = found.common_prefixes.into_iter().map(|key| (key, true));
    let objects = found.objects.into_iter().map(|meta| (meta.location, false));
    let named = |(key, is_folder): (Key, bool)| {
        let name = key.filename().unwrap_or_default();
        (address.join(name), is_folder)
    };
    let mut entries: Vec<_> = folders.chain(objects).map(named).collect();
    entries.sort();
    Ok(entries)
}

/// The objects below an address, in the order of their names: name, size, and the store's own tag of their bytes (else when they were
/// written).
pub fn listing(address: &Path) -> Result<Vec<(String, u64, String)>> {
    let (store, key) = place(address)?;
    let found: Vec<object_store::ObjectMeta> = wait(store.list(Some(&key)).try_collect())?;
    let mut listing: Vec<_> = found
        .into_iter()
        .map(|meta| {
            let inside = meta.location.as_ref().strip_prefix(key.as_ref());
            let name = inside.unwrap_or(meta.location.as_ref());
            let tag = meta
                .e_tag
                .unwrap_or_else(|| meta.last_modified.to_rfc3339());
            (name.trim_start_matches('/').to_owned(), meta.size, tag)
        })
        .collect();
    listing.sort();
    Ok(listing)
}

/// An object that is read from any place on, some bytes ahead at a time.
pub struct Object {
    store: Arc<dyn ObjectStore>,
    key: Key,
    length: u64,
    ahead: u64,
    position: u64,
    /// What was fetched last, and where it begins.
    held: (u64, Bytes),
}

impl Object {
    /// Asks for its length.
    pub fn open(address: &Path, ahead: u64) -> Result<Self> {
        let (store, key) = place(address)?;
        let length = wait(store.head(&key))?.size;
        Ok(Self {
            store,
            key,
            length,
            ahead: ahead.max(1),
            position: 0,
            held: (0, Bytes::new()),
        })
    }

    /// Its bytes.
    pub fn length(&self) -> u64 {
        self.length
    }
}

impl Read for Object {
    fn read(&mut self, buffer: &mut [u8]) -> Result<usize> {
        if self.position >= self.length || buffer.is_empty() {
            return Ok(0);
        }
        let (start, held) = &self.held;
        if !(*start..start + held.len() as u64).contains(&self.position) {
            let end = self.position.saturating_add(self.ahead).min(self.length);
            let range = self.position..end;
            self.held = (self.position, wait(self.store.get_range(&self.key, range))?);
        }
        let (start, held) = &self.held;
        let from = &held[(self.position - start) as usize..];
        let count = from.len().min(buffer.len());
        buffer[..count].copy_from_slice(&from[..count]);
        self.position += count as u64;
        Ok(count)
    }
}

impl Seek for Object {
    fn seek(&mut self, to: SeekFrom) -> Result<u64> {
        let position = match to {
            SeekFrom::Start(position) => Some(position),
            SeekFrom::End(offset) => self.length.checked_add_signed(offset),
            SeekFrom::Current(offset) => self.position.checked_add_signed(offset),
        };
        let before = || Error::new(ErrorKind::InvalidInput, "a place before the first byte");
        self.position = position.ok_or_else(before)?;
        Ok(self.position)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_object_is_read_from_any_place_on() {
        mount("object-read", Arc::new(InMemory::new()));
        let address = Path::new("s3://object-read/a/b.bin");
        let bytes: Vec<u8> = (0..5000_u32).map(|i| (i * 7 % 251) as u8).collect();
        write(address, &bytes).unwrap();
        assert_eq!(read(address).unwrap(), bytes);
        assert_eq!(read_range(address, 4990, 100).unwrap(), bytes[4990..]);
        for ahead in [1, 100, 1 << 20] {
            let mut object = Object::open(address, ahead).unwrap();
            assert_eq!(object.length(), 5000);
            object.seek(SeekFrom::Start(17)).unwrap();
            let mut some = [0; 300];
            object.read_exact(&mut some).unwrap();
            assert_eq!(some[..], bytes[17..317]);
            assert_eq!(object.seek(SeekFrom::End(-1)).unwrap(), 4999);
            let mut rest = Vec::new();
            object.read_to_end(&mut rest).unwrap();
            assert_eq!(rest, bytes[4999..]);
            assert!(object.seek(SeekFrom::Current(-5001)).is_err());
        }
    }

    #[test]
    fn a_large_file_is_sent_in_parts() {
        mount("object-send", Arc::new(InMemory::new()));
        let folder = tempfile::tempdir().unwrap();
        let file = folder.path().join("large");
        let bytes = vec![0x5a; 3 * PART as usize + 12_345];
        std::fs::write(&file, &bytes).unwrap();
        let address = Path::new("s3://object-send/large");
        send(&file, address).unwrap();
        assert!(read(address).unwrap() == bytes);
    }

    #[test]
    fn folders_are_what_something_is_below() {
        mount("object-list", Arc::new(InMemory::new()));
        let root = Path::new("s3://object-list/set");
        for name in ["rgb/world/shard-000001.tar", "clips.json", "rgb/note"] {
            write(&root.join(name), name.as_bytes()).unwrap();
        }
        let names = |folder: &Path| entries(folder).unwrap();
        assert_eq!(
            names(root),
            [(root.join("clips.json"), false), (root.join("rgb"), true)]
        );
        assert_eq!(
            names(&root.join("rgb")),
            [
                (root.join("rgb/note"), false),
                (root.join("rgb/world"), true)
            ]
        );
        assert!(names(&root.join("nothing")).is_empty());
        assert!(is_file(&root.join("clips.json")).unwrap());
        assert!(!is_file(&root.join("rgb")).unwrap());
        let found = listing(root).unwrap();
        let listed: Vec<_> = found
            .iter()
            .map(|(name, size, _)| (name.as_str(), *size))
            .collect();
        assert_eq!(
            listed,
            [
                ("clips.json", 10),
                ("rgb/note", 8),
                ("rgb/world/shard-000001.tar", 26)
            ]
        );
        assert_eq!(
            read(&root.join("gone")).unwrap_err().kind(),
            ErrorKind::NotFound
        );
    }

    #[test]
    fn addresses_without_a_bucket_are_refused() {
        for wrong in ["s3://", "s3:///a"] {
            assert!(read(Path::new(wrong)).is_err(), "{wrong}");
        }
    }
}
