//! Tests that cannot run here say so where it is read: in the last lines of the whole run, with the reason.

use std::collections::BTreeMap;
use std::io::Write as _;
use std::sync::{Mutex, Once, PoisonError};

/// By reason, the tests.
static SKIPPED: Mutex<BTreeMap<String, Vec<String>>> = Mutex::new(BTreeMap::new());
static AT_EXIT: Once = Once::new();

/// Notes that this test, or a part of it, is not run, and why.
pub fn skipped(reason: &str) {
    let test = std::thread::current().name().unwrap_or("?").to_owned();
    let mut all = SKIPPED.lock().unwrap_or_else(PoisonError::into_inner);
    let tests = all.entry(reason.to_owned()).or_default();
    if !tests.contains(&test) {
        tests.push(test);
    }
    AT_EXIT.call_once(|| {
        // SAFETY: `report` takes no argument, does not unwind, and touches statics alone, which live as long as the process.
        #[allow(unsafe_code)]
        let refused = unsafe { libc::atexit(report) };
        assert_eq!(
            refused, 0,
            "the tests that are skipped could not be reported"
        );
    });
}

/// The test harness shows what a test printed only where it failed; what is written behind its back is shown always.
extern "C" fn report() {
    let all = SKIPPED.lock().unwrap_or_else(PoisonError::into_inner);
    let mut text = String::new();
    for (reason, tests) in all.iter() {
        text.extend(["skipped: ", reason.as_str(), "\n"]);
        for test in tests {
            text.extend(["  ", test.as_str(), "\n"]);
        }
    }
    // Nobody is left to tell where this fails.
    let _ = write!(std::io::stderr(), "{text}");
}
