//! The boxes of an mp4 file on any bytes: tracks, samples, edit lists, fragments.
#![no_main]

use libfuzzer_sys::fuzz_target;
use reviv_data::video::mp4;

fuzz_target!(|bytes: &[u8]| {
    let file = tempfile::NamedTempFile::new().expect("the temporary folder can be written");
    std::fs::write(file.path(), bytes).expect("the temporary folder can be written");
    let _ = mp4::sniff(bytes);
    let _ = mp4::read(file.path());
});
