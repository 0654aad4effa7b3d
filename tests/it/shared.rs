//! Where the material that is not part of the repository lies: reference vectors and recordings.

use std::path::{Path, PathBuf};

/// `$REVIV_SHARED`, or `../shared` beside the repository; `None` (said on stderr) where neither exists, and the test skips.
pub fn folder() -> Option<PathBuf> {
    let folder = std::env::var_os("REVIV_SHARED").map_or_else(
        || Path::new(env!("CARGO_MANIFEST_DIR")).join("../shared"),
        PathBuf::from,
    );
    if folder.is_dir() {
        return Some(folder);
    }
    eprintln!(
        "skipped: {} does not exist (set REVIV_SHARED)",
        folder.display()
    );
    None
}
