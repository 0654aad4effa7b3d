//! Advisory locks: one per run, one per shard of a run, one per cache key. They live in the file system alone, so machines
//! that share a disk need no server, and the kernel drops them with the process however it ends.

use super::environment;
use super::error::{AtPath, Holder, RunError};
use super::interrupt::Interrupt;
use std::fs::{File, TryLockError};
use std::io::{Read, Seek, Write};
use std::path::{Path, PathBuf};
use std::time::Duration;

/// A lock that is held until it is dropped.
#[derive(Debug)]
pub struct Lock {
    file: File,
    path: PathBuf,
}

/// Alone, or together with others that also share.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Mode {
    /// Alone; the lock's file says who has it.
    Exclusive,
    /// Together with others that share; the lock's file is left as it is.
    Shared,
}

/// How often a lock is tried before it counts as held.
const LOOKS: usize = 6;

impl Lock {
    /// Takes the lock, or says who has it.
    pub fn take(path: &Path, mode: Mode) -> Result<Self, RunError> {
        for _ in 0..LOOKS {
            if let Some(lock) = Self::attempt(path, mode)? {
                return Ok(lock);
            }
            // Somebody who only looks (`is_held`) has it for a moment.
            std::thread::sleep(Duration::from_millis(20));
        }
        Err(RunError::Held {
            path: path.to_path_buf(),
            holder: holder(path),
        })
    }

    /// Takes the lock, or gives `None` where somebody else has it.
    pub fn attempt(path: &Path, mode: Mode) -> Result<Option<Self>, RunError> {
        loop {
            let mut options = File::options();
            options.read(true).write(true).create(true).truncate(false);
            let file = options.open(path).at("locking", path)?;
            let result = match mode {
                Mode::Exclusive => file.try_lock(),
                Mode::Shared => file.try_lock_shared(),
            };
            match result {
                Ok(()) if is_still_at(&file, path) => {
                    let mut lock = Self {
                        file,
                        path: path.to_path_buf(),
                    };
                    if mode == Mode::Exclusive {
                        lock.sign();
                    }
                    return Ok(Some(lock));
                }
                // Pruning removed the file between opening and locking: lock the one that is there now.
                Ok(()) => {}
                Err(TryLockError::WouldBlock) => return Ok(None),
                Err(TryLockError::Error(error)) => return Err(error).at("locking", path),
            }
        }
    }

    /// Waits for the lock; gives up when interrupted. `waiting` is called once, with the holder, if it has to wait.
    pub fn wait(
        path: &Path,
        interrupt: &Interrupt,
        waiting: impl FnOnce(Option<Holder>),
    ) -> Result<Self, RunError> {
        Self::wait_as(path, Mode::Exclusive, interrupt, waiting)
    }

    /// [`Lock::wait`], alone or together with others.
    pub fn wait_as(
        path: &Path,
        mode: Mode,
        interrupt: &Interrupt,
        waiting: impl FnOnce(Option<Holder>),
    ) -> Result<Self, RunError> {
        let mut waiting = Some(waiting);
        loop {
            if let Some(lock) = Self::attempt(path, mode)? {
                return Ok(lock);
            }
            if let Some(tell) = waiting.take() {
                tell(holder(path));
            }
            interrupt.check()?;
            std::thread::sleep(Duration::from_millis(100));
        }
    }

    /// Removes the lock's file while still holding it. Others notice and lock a new one.
    pub fn remove(self) -> Result<(), RunError> {
        super::files::remove(&self.path)
    }

    /// Leaves a note of who holds it. A courtesy to the reader: that it fails (a full disk) takes nothing from the lock.
    fn sign(&mut self) {
        let holder = Holder {
            host: environment::host(),
            pid: environment::pid(),
            since: environment::now_text(),
        };
        if let Ok(text) = serde_json::to_string(&holder) {
            let _ = self.file.set_len(0);
            let _ = self.file.rewind();
            let _ = self.file.write_all(text.as_bytes());
        }
    }
}

impl Drop for Lock {
    /// Closing the file is not enough: a process that is just being started has a copy of it for a moment.
    fn drop(&mut self) {
        let _ = self.file.unlock();
    }
}

/// Whether a process holds the lock right now.
pub fn is_held(path: &Path) -> bool {
    let Ok(file) = File::open(path) else {
        return false;
    };
    let result = file.try_lock_shared();
    // Not left to closing, as in `Lock::drop`.
    let _ = file.unlock();
    matches!(result, Err(TryLockError::WouldBlock))
}

/// Who signed the lock last.
fn holder(path: &Path) -> Option<Holder> {
    let mut text = String::new();
    File::open(path)
        .ok()?
        .take(4096)
        .read_to_string(&mut text)
        .ok()?;
    serde_json::from_str(&text).ok()
}

#[cfg(unix)]
fn is_still_at(file: &File, path: &Path) -> bool {
    use std::os::unix::fs::MetadataExt;
    match (file.metadata(), std::fs::metadata(path)) {
        (Ok(ours), Ok(theirs)) => ours.ino() == theirs.ino() && ours.dev() == theirs.dev(),
        _ => false,
    }
}

#[cfg(not(unix))]
fn is_still_at(_: &File, _: &Path) -> bool {
    // An open file cannot be removed there.
    true
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_lock_excludes_others_until_dropped_and_names_its_holder() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("lock");
        let lock = Lock::take(&path, Mode::Exclusive).unwrap();
        assert!(is_held(&path));
        let Err(RunError::Held {
            holder: Some(holder),
            ..
        }) = Lock::take(&path, Mode::Shared)
        else {
            panic!("taken twice");
        };
        assert_eq!(holder.pid, std::process::id());
        drop(lock);
        assert!(!is_held(&path));
        let _first = Lock::take(&path, Mode::Shared).unwrap();
        let _second = Lock::take(&path, Mode::Shared).unwrap();
        assert!(Lock::attempt(&path, Mode::Exclusive).unwrap().is_none());
    }

    #[test]
    fn a_look_does_not_make_a_start_fail() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("lock");
        let look = Lock::take(&path, Mode::Shared).unwrap();
        let looker = std::thread::spawn(move || {
            std::thread::sleep(Duration::from_millis(30));
            drop(look);
        });
        Lock::take(&path, Mode::Exclusive).unwrap();
        looker.join().unwrap();
    }

    #[test]
    fn waiting_ends_with_an_interrupt() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("lock");
        let _lock = Lock::take(&path, Mode::Exclusive).unwrap();
        let interrupt = Interrupt::default();
        interrupt.request();
        let waited = Lock::wait(&path, &interrupt, |_| {});
        assert!(matches!(waited, Err(RunError::Interrupted)));
    }

    #[test]
    fn a_removed_lock_file_is_made_anew() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("lock");
        Lock::take(&path, Mode::Exclusive)
            .unwrap()
            .remove()
            .unwrap();
        assert!(!path.exists());
        let _again = Lock::take(&path, Mode::Exclusive).unwrap();
        assert!(is_held(&path));
    }
}
