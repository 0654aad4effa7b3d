//! `--export rerun`: a recording for Rerun. The Python package writes it, by the SDK of its own Python: the SDK for Rust would be the
//! larger half of the build.

use super::terminal::Failure;
use std::ffi::OsStr;
use std::path::{Path, PathBuf};
use std::process::{Command, Output, Stdio};
use std::sync::OnceLock;

/// The recording in a reconstruction folder; `reviv/rerun.py` calls it so, too.
pub(super) const FILE: &str = "scene.rrd";
/// Names a Python that has the package and the SDK, for a program that was not installed with one.
const VARIABLE: &str = "REVIV_PYTHON";
const HELP: &str = "`pip install . rerun-sdk` in a clone of reviv; the command `reviv` of that Python finds it, any other where \
                    REVIV_PYTHON names that Python";

static PYTHON: OnceLock<PathBuf> = OnceLock::new();

/// Says which Python this program was installed with; the first word stands.
pub fn python_is(path: PathBuf) {
    PYTHON.get_or_init(|| path);
}

fn python() -> PathBuf {
    let named = std::env::var_os(VARIABLE).filter(|value| !value.is_empty());
    let usual = if cfg!(windows) { "python" } else { "python3" };
    PYTHON
        .get()
        .cloned()
        .or_else(|| named.map(PathBuf::from))
        .unwrap_or_else(|| usual.into())
}

/// Refuses where a recording could not be written, before anything is computed for it.
pub(super) fn check() -> Result<(), Failure> {
    run([OsStr::new("--check")]).map(|_| ())
}

/// Writes the recording into a reconstruction folder.
pub(super) fn write(folder: &Path) -> Result<(), Failure> {
    let file = folder.join(FILE);
    run([folder.as_os_str(), OsStr::new("-o"), file.as_os_str()]).map(|_| ())
}

fn run<const N: usize>(arguments: [&OsStr; N]) -> Result<Output, Failure> {
    let python = python();
    let refuse = |reason: &str| {
        let message = format!("`--export rerun` by `{}`: {reason}", python.display());
        Failure::input(message, HELP)
    };
    let output = Command::new(&python)
        .args(["-m", "reviv.rerun"])
        .args(arguments)
        .stdin(Stdio::null())
        .output()
        .map_err(|error| refuse(&error.to_string()))?;
    if output.status.success() {
        return Ok(output);
    }
    let said = String::from_utf8_lossy(&output.stderr);
    Err(refuse(reason(&said)))
}

/// What went wrong, of all that Python says: the sentence of the package, or else the last line.
fn reason(said: &str) -> &str {
    let lines = || said.lines().map(str::trim).filter(|line| !line.is_empty());
    let own = lines().find_map(|line| line.strip_prefix("error: "));
    own.or_else(|| lines().next_back()).unwrap_or("it failed")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_sentence_of_the_package_counts_and_else_the_last_line() {
        let said = "error: the Rerun SDK is not installed\nhint: pip install rerun-sdk\n";
        assert_eq!(reason(said), "the Rerun SDK is not installed");
        assert_eq!(
            reason("Traceback\n  line 1\nImportError: no\n\n"),
            "ImportError: no"
        );
        assert_eq!(reason("\n"), "it failed");
    }
}
