//! A neutral folder whose `recording.yaml` is any bytes, beside arrays that are there.
#![no_main]

use libfuzzer_sys::fuzz_target;
use reviv_data::datasets::neutral;
use reviv_data::formats::npz::Npz;

fuzz_target!(|bytes: &[u8]| {
    let folder = tempfile::tempdir().expect("the temporary folder can be written");
    let arrays = Npz::default()
        .with("poses", ndarray::Array3::<f64>::from_shape_fn((9, 4, 4), |(_, i, j)| f64::from(u8::from(i == j))))
        .with("gaze", ndarray::Array2::<f32>::zeros((9, 2)))
        .with("joints", ndarray::Array3::<f32>::zeros((9, 22, 3)))
        .with("t", ndarray::Array1::<f64>::linspace(0.0, 0.3, 9));
    arrays
        .write(&folder.path().join("a.npz"))
        .expect("the temporary folder can be written");
    std::fs::write(folder.path().join("recording.yaml"), bytes).expect("the temporary folder can be written");
    drop(neutral::open(folder.path()));
});
