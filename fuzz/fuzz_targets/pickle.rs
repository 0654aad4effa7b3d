//! The interpreter of pickles on any bytes.
#![no_main]

use libfuzzer_sys::fuzz_target;
use reviv_data::formats::pickle::Pickle;

fuzz_target!(|bytes: &[u8]| {
    let _ = Pickle::parse(bytes);
});
