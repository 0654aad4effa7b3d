//! The headers of H.264 on any bytes: the configuration of a container with its parameter sets, and what a sample is.
#![no_main]

use libfuzzer_sys::fuzz_target;
use reviv_data::video::h264::Configuration;

fuzz_target!(|bytes: &[u8]| {
    if let Ok(configuration) = Configuration::parse(bytes) {
        let _ = configuration.beyond_embedded();
        // Behind the parameter sets anything may follow; all of it is taken for a sample.
        for start in [0, 8, 32, 64] {
            let sample = bytes.get(start..).unwrap_or_default();
            let _ = configuration.is_disposable(sample);
            let _ = configuration.is_start(sample);
        }
    }
});
