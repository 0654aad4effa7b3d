//! Pictures on any bytes: jpeg and png as colour, png as 16-bit grey, and the orientation that EXIF names.
#![no_main]

use libfuzzer_sys::fuzz_target;
use reviv_data::formats::png;
use reviv_data::video::exif;
use reviv_data::video::image::{Image, grey16_from_png};

fuzz_target!(|bytes: &[u8]| {
    let orientation = exif::orientation(bytes);
    if let Ok(picture) = Image::from_bytes(bytes) {
        // Large ones are only read: the fuzzer shall look at many files.
        if u64::from(picture.width) * u64::from(picture.height) < 1 << 16 {
            let _ = picture.upright(orientation).square(16);
        }
    }
    let _ = grey16_from_png(bytes);
    if let Ok(picture) = png::parse(bytes) {
        let again = png::to_bytes(&picture).expect("what is read can be written");
        assert!(png::parse(&again).is_ok_and(|found| found == picture));
    }
});
