//! Where the material that is not part of the repository lies: reference vectors and recordings.

use std::path::{Path, PathBuf};

/// `$REVIV_SHARED`, or `../shared` beside the repository; `None` where neither exists: the test skips, and the last
/// lines of the run say so.
pub fn folder() -> Option<PathBuf> {
    let folder = std::env::var_os("REVIV_SHARED").map_or_else(
        || Path::new(env!("CARGO_MANIFEST_DIR")).join("../shared"),
        PathBuf::from,
    );
    if folder.is_dir() {
        return Some(folder);
    }
    crate::skipped::skipped(&format!(
        "{} does not exist (set REVIV_SHARED)",
        folder.display()
    ));
    None
}
