//! A VRS file on any bytes: its index, its records, their layouts, and pictures in them.
#![no_main]

use libfuzzer_sys::fuzz_target;
use reviv_data::datasets::aria::vrs::image::Pictures;
use reviv_data::datasets::aria::vrs::{Kind, StreamId, Vrs};
use std::sync::Arc;

/// Records of a file that are looked at: the fuzzer shall look at many files.
const RECORDS: usize = 32;

fuzz_target!(|bytes: &[u8]| {
    let file = tempfile::NamedTempFile::new().expect("the temporary folder can be written");
    std::fs::write(file.path(), bytes).expect("the temporary folder can be written");
    let Ok(vrs) = Vrs::open(file.path()) else {
        return;
    };
    let vrs = Arc::new(vrs);
    for kind in [Kind::Configuration, Kind::State, Kind::Data] {
        let mut streams: Vec<StreamId> = vrs.of_kind(kind).take(RECORDS).collect();
        streams.dedup();
        for stream in streams {
            for entry in vrs.of(stream, kind).take(RECORDS) {
                let Ok(record) = vrs.read(entry) else {
                    continue;
                };
                if let Ok(layout) = vrs.layout(stream, kind, record.format_version)
                    && let Ok(fields) = vrs.fields(&layout, &record)
                {
                    let _ = fields.text("description");
                    let _ = fields.string_map("tags");
                    let _ = fields.rest();
                }
            }
            let _ = vrs.time_map(stream);
            if let Ok(pictures) = Pictures::new(Arc::clone(&vrs), stream) {
                for index in 0..pictures.len().min(RECORDS) {
                    let _ = pictures.read(index);
                }
            }
        }
    }
});
