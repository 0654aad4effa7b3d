//! The headers of H.264 on any bytes: the configuration of a container with its parameter sets, and what a sample is.
#![no_main]

use libfuzzer_sys::fuzz_target;
use reviv::video::h264::Configuration;

fuzz_target!(|parts: (Vec<u8>, Vec<u8>)| {
    let (configuration, sample) = parts;
    if let Ok(configuration) = Configuration::parse(&configuration) {
        let _ = configuration.beyond_embedded();
        let _ = configuration.is_disposable(&sample);
        let _ = configuration.is_intra(&sample);
    }
});
