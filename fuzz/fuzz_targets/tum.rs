//! A trajectory of TUM on any bytes.
#![no_main]

use libfuzzer_sys::fuzz_target;
use reviv::evaluation::tum;

fuzz_target!(|bytes: &[u8]| {
    let file = tempfile::NamedTempFile::new().expect("the temporary folder can be written");
    std::fs::write(file.path(), bytes).expect("the temporary folder can be written");
    drop(tum::read_tum(file.path()));
});
