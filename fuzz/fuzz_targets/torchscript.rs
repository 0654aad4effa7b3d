//! A checkpoint in a sound archive whose tree of objects is any bytes: tensors, storages and modules of TorchScript.
#![no_main]

use libfuzzer_sys::fuzz_target;
use reviv::formats::zip::ZipWriter;
use reviv::import::Checkpoint;

fuzz_target!(|pickle: &[u8]| {
    let mut zip = ZipWriter::new(Vec::new());
    let parts: [(&str, &[u8]); 4] = [
        ("a/data.pkl", pickle),
        ("a/constants.pkl", b"\x80\x02)."),
        ("a/data/0", &[0; 24]),
        ("a/data/1", &[0; 24]),
    ];
    for (name, bytes) in parts {
        zip.add(name, bytes).expect("a vector takes all bytes");
    }
    let archive = zip.finish().expect("a vector takes all bytes");
    let file = tempfile::NamedTempFile::new().expect("the temporary folder can be written");
    std::fs::write(file.path(), archive).expect("the temporary folder can be written");
    if let Ok(mut checkpoint) = Checkpoint::open(file.path()) {
        for index in 0..checkpoint.entries().len() {
            let _ = checkpoint.values(index);
        }
    }
});
