//! One NumPy array on any bytes, and its values as numbers.
#![no_main]

use libfuzzer_sys::fuzz_target;
use reviv_data::formats::npy;

fuzz_target!(|bytes: &[u8]| {
    if let Ok(array) = npy::parse(bytes) {
        let _ = array.to::<f64>();
        // What was read survives the way back.
        let again = npy::parse(&npy::to_bytes(&array)).expect("what is written is read");
        assert_eq!((again.shape, again.data.dtype()), (array.shape, array.data.dtype()));
    }
});
