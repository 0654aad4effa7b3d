//! Text on any bytes, by its first byte: calibrations and hands in lines of JSON, tables, trajectories, layouts of records.
#![no_main]

use libfuzzer_sys::fuzz_target;
use reviv_data::datasets::aria::vrs::layout::Layout;
use reviv_data::datasets::aria::{calibration, gaze, hand_tracking, trajectory};
use reviv_data::datasets::csv::Lines;
use reviv_data::datasets::umetrack::HandProfile;

fuzz_target!(|bytes: &[u8]| {
    let Some((kind, text)) = bytes.split_first() else {
        return;
    };
    let file = tempfile::NamedTempFile::new().expect("the temporary folder can be written");
    std::fs::write(file.path(), text).expect("the temporary folder can be written");
    let path = file.path();
    match kind % 7 {
        0 => drop(calibration::online(path, 1408)),
        1 => drop(HandProfile::read(path)),
        2 => drop(trajectory::read(path)),
        3 => drop(gaze::read(path)),
        4 => drop(hand_tracking::read(path)),
        5 => drop(std::str::from_utf8(text).map(Layout::parse)),
        _ => {
            if let Ok(lines) = Lines::open(path) {
                let _ = lines.map_while(Result::ok).count();
            }
        }
    }
});
