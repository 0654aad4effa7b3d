//! The reader of zip archives on any bytes: the directory, and the beginning of every entry.
#![no_main]

use libfuzzer_sys::fuzz_target;
use reviv_data::formats::zip::ZipArchive;
use std::io::Cursor;

/// Bytes of an entry that are asked for.
const LIMIT: u64 = 1 << 20;

fuzz_target!(|bytes: &[u8]| {
    let Ok(mut archive) = ZipArchive::new(Cursor::new(bytes)) else {
        return;
    };
    let names: Vec<String> = archive.entries().iter().map(|entry| entry.name.clone()).collect();
    for name in names {
        let _ = archive.read(&name, LIMIT);
    }
});
