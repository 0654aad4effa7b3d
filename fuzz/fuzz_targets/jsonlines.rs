//! Calibrations of Project Aria and MPS, one JSON object a line, on any bytes behind the first, which is the width of the picture.
#![no_main]

use libfuzzer_sys::fuzz_target;
use reviv_data::datasets::aria::calibration;
use reviv_data::formats::text;

fuzz_target!(|bytes: &[u8]| {
    let Some((side, text)) = bytes.split_first() else {
        return;
    };
    let file = tempfile::NamedTempFile::new().expect("the temporary folder can be written");
    std::fs::write(file.path(), text).expect("the temporary folder can be written");
    let _ = calibration::online(file.path(), u32::from(*side) * 11);
    let _ = text::read_json::<serde_json::Value>(file.path());
    if let Ok(text) = std::str::from_utf8(text) {
        let _ = calibration::colour_camera(text, u32::from(*side) * 11);
    }
});
