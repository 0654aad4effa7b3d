//! Recordings of our own making through the same readers as real ones, and what becomes of them when they are cut off, flipped
//! or hostile: an error that names the file and the place, never a panic.

use crate::vrs_writer::{CONFIGURATION, DATA, VrsWriter};
use proptest::prelude::*;
use reviv::clip::CAMERA;
use reviv::datasets::aria::vrs::image::{Pictures, Pixels};
use reviv::datasets::aria::vrs::{Kind, StreamId, Vrs};
use reviv::datasets::aria::{gaze, hand_tracking, trajectory};
use reviv::datasets::open::OpenWith;
use reviv::datasets::recording::CutSettings;
use reviv::datasets::umetrack::HandProfile;
use reviv::datasets::{ClipSource, Outcome, ReadError, adt, egom2p, neutral};
use reviv::formats::npy::NpyArray;
use reviv::formats::npz::Npz;
use reviv::video::Video;
use std::path::Path;
use std::sync::Arc;

pub const LAYOUT: &str = r#"{"data_layout":[{"name":"frame_number","type":"DataPieceValue<uint64_t>","offset":0},
    {"name":"capture_timestamp_ns","type":"DataPieceValue<int64_t>","offset":8}]}"#;
pub const CONFIGURATION_LAYOUT: &str = r#"{"data_layout":[{"name":"image_width","type":"DataPieceValue<uint32_t>","offset":0},
    {"name":"image_height","type":"DataPieceValue<uint32_t>","offset":4},{"name":"image_stride","type":"DataPieceValue<uint32_t>","offset":8},
    {"name":"image_pixel_format","type":"DataPieceValue<uint32_t>","offset":12},{"name":"description","type":"DataPieceString","index":0}]}"#;

/// Jpeg colour (24 x 16) and raw 16-bit depth, uncompressed, LZ4 and zstd records.
fn small_vrs() -> VrsWriter {
    let mut writer = VrsWriter::default();
    writer.file_tag("device_serial", "S1");
    for (stream, content) in [((214, 1), "image/jpg"), ((345, 2), "image/raw")] {
        writer.stream(
            stream,
            &[
                ("RF:Data:2", &format!("data_layout/size=16+{content}")),
                ("DL:Data:2:0", LAYOUT),
                ("RF:Configuration:2", "data_layout"),
                ("DL:Configuration:2:0", CONFIGURATION_LAYOUT),
            ],
        );
        let mut configuration = Vec::new();
        for value in [24_u32, 16, 48, 11, 0, 5] {
            configuration.extend(value.to_le_bytes());
        }
        configuration.extend(b"214-1");
        writer.record(stream, CONFIGURATION, 5e-324, &configuration, 2);
    }
    let jpeg =
        std::fs::read(Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/data/tiny.jpg")).unwrap();
    for k in 0..6_u64 {
        let mut head = k.to_le_bytes().to_vec();
        head.extend((1_000_000_000 + k as i64 * 33_333_333).to_le_bytes());
        let colour = [head.clone(), jpeg.clone()].concat();
        writer.record(
            (214, 1),
            DATA,
            1.0 + k as f64 / 30.0,
            &colour,
            (k % 3) as u8,
        );
        let depth: Vec<u8> = (0..24 * 16_u16)
            .flat_map(|i| (1000 + i + k as u16).to_le_bytes())
            .collect();
        writer.record(
            (345, 2),
            DATA,
            1.0 + k as f64 / 30.0,
            &[head, depth].concat(),
            2 - (k % 3) as u8,
        );
    }
    writer
}

/// Reads a table and says how many rows it has.
type Reader = fn(&Path) -> Result<usize, ReadError>;

fn read_all(path: &Path) -> Result<usize, ReadError> {
    let vrs = Arc::new(Vrs::open(path)?);
    let mut count = 0;
    for stream in [StreamId::RGB, StreamId::new(345, 2)] {
        let pictures = Pictures::new(Arc::clone(&vrs), stream)?;
        for index in 0..pictures.len() {
            pictures.read(index)?;
            count += 1;
        }
    }
    Ok(count)
}

#[test]
fn own_vrs_files_are_read_with_and_without_an_index_and_in_chunks() {
    let folder = tempfile::tempdir().unwrap();
    for (index, compressed) in [(true, true), (true, false), (false, false)] {
        let path = folder.path().join(format!("{index}{compressed}.vrs"));
        let bytes = small_vrs().finish(index, compressed);
        std::fs::write(&path, &bytes).unwrap();
        let vrs = Arc::new(Vrs::open(&path).unwrap());
        assert_eq!(vrs.tags["device_serial"], "S1");
        assert_eq!(vrs.of(StreamId::RGB, Kind::Data).count(), 6);
        let depth = Pictures::new(Arc::clone(&vrs), StreamId::new(345, 2)).unwrap();
        assert_eq!(depth.times[1] - depth.times[0], 33_333_333);
        let Pixels::Grey16(values) = depth.read(5).unwrap() else {
            panic!("depth")
        };
        assert_eq!(values[[1, 2]], 1000 + 26 + 5);
        assert_eq!(read_all(&path).unwrap(), 12);
    }
    // The same file cut at a record border.
    let bytes = small_vrs().finish(true, true);
    let whole = folder.path().join("truefalse.vrs");
    let cut = Vrs::open(&whole).unwrap().entries[7].offset as usize;
    let bytes_plain = std::fs::read(&whole).unwrap();
    std::fs::write(folder.path().join("chunked.vrs"), &bytes_plain[..cut]).unwrap();
    std::fs::write(folder.path().join("chunked.vrs_1"), &bytes_plain[cut..]).unwrap();
    assert_eq!(read_all(&folder.path().join("chunked.vrs")).unwrap(), 12);
    assert_ne!(bytes, bytes_plain);
}

#[test]
fn every_truncation_of_a_vrs_file_is_an_error_that_names_file_and_place() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("cut.vrs");
    let bytes = small_vrs().finish(true, true);
    for keep in (0..bytes.len()).step_by(211) {
        std::fs::write(&path, &bytes[..keep]).unwrap();
        let text = read_all(&path).unwrap_err().to_string();
        assert!(
            text.contains("cut.vrs") && text.contains("byte"),
            "{keep}: {text}"
        );
    }
}

fn mutated(mut bytes: Vec<u8>, flips: &[(usize, u8)], keep: usize) -> Vec<u8> {
    for (at, value) in flips {
        let at = at % bytes.len();
        bytes[at] ^= value;
    }
    bytes.truncate(keep.max(1));
    bytes
}

#[test]
fn a_sample_description_that_is_not_there_is_an_error_of_the_frame() {
    let data = Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/data/synthetic_30fps.mp4");
    let mut bytes = std::fs::read(data).unwrap();
    let stsc = bytes.windows(4).position(|name| name == b"stsc").unwrap();
    // Name, version and flags, how many runs; first chunk, samples per chunk, description.
    bytes[stsc + 20..stsc + 24].copy_from_slice(&7_u32.to_be_bytes());
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("no_description.mp4");
    std::fs::write(&path, bytes).unwrap();
    let settings = reviv::video::VideoSettings {
        decoder: reviv::video::DecoderChoice::Embedded,
        ..Default::default()
    };
    let error = match Video::open_with(&path, &settings) {
        Err(error) => error,
        Ok(video) => {
            let mut frames = video.frames(0..20).unwrap();
            frames.find_map(Result::err).unwrap()
        }
    };
    assert!(error_names(&path, &error), "{error}");
}

fn error_names(path: &Path, error: &ReadError) -> bool {
    error
        .to_string()
        .contains(&path.file_name().unwrap().to_string_lossy().into_owned())
}

proptest! {
    #![proptest_config(ProptestConfig { cases: 96, failure_persistence: None, ..ProptestConfig::default() })]

    #[test]
    fn damaged_vrs_files_never_panic(flips in proptest::collection::vec((0usize..100_000, 1u8..), 1..6), keep in 1usize..20_000) {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("bad.vrs");
        std::fs::write(&path, mutated(small_vrs().finish(true, flips.len() % 2 == 0), &flips, keep)).unwrap();
        if let Err(error) = read_all(&path) {
            prop_assert!(error_names(&path, &error), "{error}");
        }
    }

    #[test]
    fn damaged_mp4_files_never_panic(
        which in 0usize..3,
        flips in proptest::collection::vec((0usize..100_000, 1u8..), 1..6),
        head in any::<bool>(),
        keep in 1usize..20_000,
    ) {
        let name = ["synthetic_30fps.mp4", "synthetic_fragmented.mp4", "synthetic_variable.mp4"][which];
        let bytes = std::fs::read(Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/data").join(name)).unwrap();
        // Half of the cases damage the index, where every field matters.
        let flips: Vec<_> = flips.into_iter().map(|(at, value)| (if head { at % 1500 } else { at }, value)).collect();
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("bad.mp4");
        std::fs::write(&path, mutated(bytes, &flips, keep + 300)).unwrap();
        let settings = reviv::video::VideoSettings {
            decoder: reviv::video::DecoderChoice::Embedded,
            ..Default::default()
        };
        match Video::open_with(&path, &settings) {
            Ok(video) => {
                for frame in video.frames(0..20).unwrap() {
                    if let Err(error) = frame {
                        prop_assert!(error_names(&path, &error), "{error}");
                    }
                }
                let _ = video.load_clip(video.info().frames / 2, 8.0, 4, 32);
            }
            Err(error) => prop_assert!(error_names(&path, &error), "{error}"),
        }
    }

    #[test]
    fn damaged_tables_never_panic(flips in proptest::collection::vec((0usize..100_000, 1u8..), 1..5), keep in 1usize..4000) {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("bad.csv");
        let tables: [(&str, Reader); 3] = [
            (TRAJECTORY, |path| trajectory::read(path).map(|t| t.poses.times().len())),
            (GAZE, |path| gaze::read(path).map(|t| t.times().len())),
            (TRAJECTORY, |path| hand_tracking::read(path).map(|t| t[0].times().len())),
        ];
        for (text, read) in tables {
            std::fs::write(&path, mutated(text.as_bytes().to_vec(), &flips, keep)).unwrap();
            if let Err(error) = read(&path) {
                prop_assert!(error_names(&path, &error), "{error}");
            }
        }
        let path = folder.path().join("bad.json");
        std::fs::write(&path, mutated(SKELETON.as_bytes().to_vec(), &flips, keep)).unwrap();
        if let Err(error) = adt::read_skeleton(&path) {
            prop_assert!(error_names(&path, &error), "{error}");
        }
        prop_assert!(HandProfile::read(&path).is_err());
    }
}

const TRAJECTORY: &str = "\
tracking_timestamp_us,utc_timestamp_ns,tx_world_device,ty_world_device,tz_world_device,qx_world_device,qy_world_device,qz_world_device,qw_world_device,gravity_x_world,gravity_y_world,gravity_z_world
1000000,-1,0,1.5,0,0,0,0,1,0,-9.81,0
1033333,-1,0.01,1.5,0,0,0,0,1,0,-9.81,0
1066667,-1,nan,1.5,0,0,0,0,1,0,-9.81,0
1100000,-1,0.03,1.5,0,0,0,0,1,0,-9.81,0
";
const GAZE: &str = "\
tracking_timestamp_us,left_yaw_rads_cpf,right_yaw_rads_cpf,pitch_rads_cpf,depth_m
1000000,0.10,0.12,-0.2,
1100000,0.11,0.13,-0.2,0.8
1200000,nan,0.13,-0.2,0.8
";
const SKELETON: &str = r#"{"dt_optitrack_minus_device_ns": {"a": 1}, "frames": [{"markers": [[1,2,3]], "joints": [[0,0,0]], "timestamp_ns": 5}]}"#;

#[test]
fn wrong_cells_are_named_by_line_and_nan_rows_are_gaps() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("t.csv");
    std::fs::write(&path, TRAJECTORY).unwrap();
    let track = trajectory::read(&path).unwrap();
    assert_eq!(track.poses.times().len(), 3);
    assert!((track.up_world.unwrap().y - 1.0).abs() < 1e-9);
    std::fs::write(&path, TRAJECTORY.replace("0.01,", "0.o1,")).unwrap();
    let text = trajectory::read(&path).unwrap_err().to_string();
    assert!(text.contains("line 3") && text.contains("0.o1"), "{text}");
    std::fs::write(&path, GAZE).unwrap();
    assert_eq!(gaze::read(&path).unwrap().times().len(), 2);
    let json = folder.path().join("s.json");
    std::fs::write(&json, SKELETON).unwrap();
    let text = adt::read_skeleton(&json).unwrap_err().to_string();
    assert!(
        text.contains("51 joints") && text.contains("line 1"),
        "{text}"
    );
}

/// A recording in the neutral format: three seconds of video, poses with a hole, gaze, hands, body and depth.
pub fn neutral_folder(folder: &Path, depth_rate: f64, depth_start: f64) {
    let synthetic = Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/data/synthetic_30fps.mp4");
    std::fs::copy(synthetic, folder.join("rgb.mp4")).unwrap();
    let poses = ndarray::Array3::from_shape_fn((75, 4, 4), |(t, r, c)| match (r, c) {
        (0, 3) => t as f64 * 0.01,
        (2, 3) => 1.6,
        // Looking along world +y: camera x = world x, y = -z, z = y.
        (0, 0) | (1, 2) | (3, 3) => 1.0,
        (2, 1) => -1.0,
        _ => 0.0,
    });
    let mut poses = poses;
    for t in 20..30 {
        poses.index_axis_mut(ndarray::Axis(0), t).fill(f64::NAN);
    }
    let gaze =
        ndarray::Array2::from_shape_fn(
            (75, 2),
            |(t, k)| if t == 3 { f64::NAN } else { [48.0, 32.0][k] },
        );
    let hand =
        ndarray::Array3::from_shape_fn((75, 21, 3), |(_, j, k)| [0.1, 0.2, 300.0 + j as f64][k]);
    let body =
        ndarray::Array3::from_shape_fn((75, 22, 3), |(_, j, k)| [0.0, 1.0, j as f64 * 0.1][k]);
    let depth =
        ndarray::Array3::from_shape_fn(((2.5 * depth_rate) as usize, 64, 96), |(_, y, _)| {
            if y < 4 { 0.0 } else { 2000.0_f32 }
        });
    Npz::default()
        .with("T", NpyArray::from(&poses))
        .with("gaze", NpyArray::from(&gaze))
        .with("hand", NpyArray::from(&hand))
        .with("body", NpyArray::from(&body))
        .with("depth", NpyArray::from(&depth))
        .write(&folder.join("signals.npz"))
        .unwrap();
    let manifest = format!(
        "format: reviv-recording/1\nsource: mine\nname: one\ncolour: {{file: rgb.mp4}}\n\
         depth: {{file: signals.npz, key: depth, unit: mm, rate: {depth_rate}, start: {depth_start}}}\n\
         camera: {{file: signals.npz, key: T, rate: 30, direction: camera_to_world, axes: opencv, up: [0, 0, 1]}}\n\
         gaze: {{file: signals.npz, key: gaze, rate: 30, unit: pixel, size: [96, 64]}}\n\
         left_hand: {{file: signals.npz, key: hand, rate: 30, unit: mm, frame: camera, order: common}}\n\
         body: {{file: signals.npz, key: body, rate: 30, unit: m, frame: world, order: smpl22}}\n"
    );
    std::fs::write(folder.join("recording.yaml"), manifest).unwrap();
}

fn small() -> CutSettings {
    CutSettings {
        side: 32,
        ..CutSettings::default()
    }
}

#[test]
fn a_neutral_folder_gives_clips_with_units_frames_and_holes_in_place() {
    let folder = tempfile::tempdir().unwrap();
    neutral_folder(folder.path(), 30.0, 0.004);
    let source = neutral::source(folder.path(), small()).unwrap();
    assert_eq!((source.name(), source.len()), ("mine", 1));
    let clip = source.clip(0).unwrap().into_clip().unwrap();
    assert_eq!(clip.id, "mine/one/000000");
    assert_eq!(clip.rgb().unwrap().frames.dim(), (16, 32, 32, 3));
    let depth = clip.depth().unwrap();
    assert_eq!(depth.metres[[3, 20, 20]], 2.0);
    assert!(depth.metres[[3, 0, 20]].is_nan());
    let camera = clip.camera().unwrap();
    assert!(camera.valid[15] && !camera.valid[25] && camera.valid[35]);
    let gaze = clip.gaze().unwrap();
    assert!((gaze.points[[10, 0]] - 0.5).abs() < 1e-6 && (gaze.points[[10, 1]] - 0.5).abs() < 1e-6);
    assert!(!gaze.valid[3] || gaze.points[[3, 0]] == 0.5);
    let hand = clip.left_hand().unwrap();
    // Common order: joint 5 is the index finger's knuckle, ours number 1.
    assert!((hand.joints[[0, 1, 2]] - 0.305).abs() < 1e-6);
    let body = clip.body().unwrap();
    // World (0, 1, 0.1 j) seen from (0, 0, 1.6), x right, y forward, z up; SMPL joint 4 is ours number 3.
    assert!(
        (body.joints[[0, 3, 1]] - 1.0).abs() < 1e-6
            && (body.joints[[0, 3, 2]] - (0.4 - 1.6)).abs() < 1e-6
    );
    assert!(clip.right_hand().is_none());
}

#[test]
fn clips_whose_depth_is_more_than_ten_milliseconds_away_are_dropped_and_say_so() {
    let folder = tempfile::tempdir().unwrap();
    neutral_folder(folder.path(), 30.0, 0.0166);
    let source = neutral::source(folder.path(), small()).unwrap();
    let Outcome::Dropped { id, reason } = source.clip(0).unwrap() else {
        panic!("must be dropped")
    };
    assert_eq!(
        (id.as_str(), reason.text()),
        ("mine/one/000000", "depth more than 10 ms from colour")
    );
}

#[test]
fn a_wrong_manifest_names_its_line_and_the_key() {
    let folder = tempfile::tempdir().unwrap();
    neutral_folder(folder.path(), 30.0, 0.0);
    let path = folder.path().join("recording.yaml");
    let text = std::fs::read_to_string(&path).unwrap();
    std::fs::write(&path, text.replace("unit: pixel", "units: pixel")).unwrap();
    let error = neutral::source(folder.path(), small())
        .unwrap_err()
        .to_string();
    assert!(
        error.contains("recording.yaml") && error.contains("units"),
        "{error}"
    );
    std::fs::write(&path, text.replace("order: smpl22", "order: common")).unwrap();
    let error = neutral::source(folder.path(), small())
        .unwrap_err()
        .to_string();
    assert!(error.contains("[75, 22, 3]"), "{error}");
}

/// The neutral recording with a part of its manifest replaced, and what opening it says.
fn refused(part: &str, replacement: &str, settings: CutSettings) -> String {
    let folder = tempfile::tempdir().unwrap();
    neutral_folder(folder.path(), 30.0, 0.0);
    let path = folder.path().join("recording.yaml");
    let text = std::fs::read_to_string(&path).unwrap();
    assert!(text.contains(part));
    std::fs::write(&path, text.replace(part, replacement)).unwrap();
    let empty = NpyArray::from(&ndarray::Array3::<f32>::zeros((60, 0, 0)));
    reviv::formats::npy::write(&folder.path().join("empty.npy"), &empty).unwrap();
    neutral::source(folder.path(), settings)
        .unwrap_err()
        .to_string()
}

#[test]
fn a_lens_that_is_unknown_or_of_another_size_a_slanted_turn_and_empty_depth_are_refused() {
    let undistort = CutSettings {
        undistort: Some(90.0),
        ..small()
    };
    let said = refused("name: one", "name: lensless", undistort);
    assert_eq!(
        said,
        "`undistort` needs a lens, and `mine/lensless` has none"
    );
    let lens = "lens: {model: pinhole, parameters: [50, 50, 48, 32], size: [192, 128]}";
    let said = refused("file: rgb.mp4", &format!("file: rgb.mp4, {lens}"), small());
    assert!(
        said.contains("192 x 128") && said.contains("96 x 64"),
        "{said}"
    );
    let said = refused("file: rgb.mp4", "file: rgb.mp4, turn: 45", small());
    assert!(said.contains("45 degrees"), "{said}");
    let said = refused(
        "depth: {file: signals.npz, key: depth,",
        "depth: {file: empty.npy,",
        small(),
    );
    assert!(
        said.contains("empty.npy") && said.contains("[60, 0, 0]"),
        "{said}"
    );
}

#[test]
fn a_recording_that_lacks_a_part_is_an_error_and_not_another_kind() {
    let look = |folder: &Path| match reviv::datasets::open::open(
        folder,
        None,
        &small(),
        OpenWith::default(),
    ) {
        Ok(source) => panic!("opened as `{}`", source.name()),
        Err(error) => error,
    };
    let nothing = tempfile::tempdir().unwrap();
    assert!(matches!(look(nothing.path()), ReadError::Absent { .. }));
    // A neutral recording whose pictures are not there.
    let folder = tempfile::tempdir().unwrap();
    neutral_folder(folder.path(), 30.0, 0.0);
    std::fs::create_dir(folder.path().join("frames")).unwrap();
    let path = folder.path().join("recording.yaml");
    let text = std::fs::read_to_string(&path).unwrap();
    std::fs::write(&path, text.replace("rgb.mp4", "frames")).unwrap();
    let error = look(folder.path());
    assert!(matches!(error, ReadError::Missing { .. }), "{error}");
    // An ADT sequence without its factory calibration.
    let folder = tempfile::tempdir().unwrap();
    let vrs = small_vrs().finish(true, true);
    std::fs::write(folder.path().join("video.vrs"), vrs).unwrap();
    std::fs::write(folder.path().join("aria_trajectory.csv"), "").unwrap();
    let error = look(folder.path()).to_string();
    assert!(error.contains("calib_json"), "{error}");
}

#[test]
fn poses_of_the_ancestors_are_missing_where_they_are_zero_and_refused_where_they_are_none() {
    let root = tempfile::tempdir().unwrap();
    let folder = root.path().join("cam/holoassist");
    std::fs::create_dir_all(&folder).unwrap();
    let clip = |bad: f64| {
        let mut poses =
            ndarray::Array3::from_shape_fn((60, 4, 4), |(_, r, c)| f64::from(u8::from(r == c)));
        for row in 27..34 {
            poses.index_axis_mut(ndarray::Axis(0), row).fill(0.0);
        }
        for k in 0..3 {
            poses[[40, k, k]] = bad;
        }
        reviv::formats::npy::write(&folder.join("a.npy"), &NpyArray::from(&poses)).unwrap();
        let source = egom2p::Arrays::open(root.path(), None, None, small()).unwrap();
        source.clip(0).map(|outcome| outcome.into_clip().unwrap())
    };
    let camera = clip(1.0).unwrap().take(CAMERA).unwrap();
    assert!(camera.valid[26] && !camera.valid[30] && camera.valid[34]);
    let error = clip(1e160).unwrap_err().to_string();
    assert!(
        error.contains("a.npy") && error.contains("frame 40"),
        "{error}"
    );
}

#[test]
fn the_ancestors_arrays_and_tokens_are_read() {
    let root = tempfile::tempdir().unwrap();
    for folder in ["rgb", "cam", "gaze", "lhand"] {
        std::fs::create_dir_all(root.path().join(folder).join("holoassist")).unwrap();
    }
    let synthetic = Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/data/synthetic_30fps.mp4");
    std::fs::copy(synthetic, root.path().join("rgb/holoassist/a-0.mp4")).unwrap();
    let poses = ndarray::Array3::from_shape_fn((60, 4, 4), |(t, r, c)| {
        if r == c {
            1.0
        } else if (r, c) == (0, 3) {
            t as f64
        } else {
            0.0
        }
    });
    reviv::formats::npy::write(
        &root.path().join("cam/holoassist/a-0.npy"),
        &NpyArray::from(&poses),
    )
    .unwrap();
    let gaze =
        ndarray::Array2::from_shape_fn(
            (60, 2),
            |(t, k)| if t == 18 { f64::NAN } else { [448.0, 12.0][k] },
        );
    Npz::default()
        .with("arr_0", NpyArray::from(&gaze))
        .write(&root.path().join("gaze/holoassist/a-0.npz"))
        .unwrap();
    let hand = ndarray::Array3::from_shape_fn((60, 21, 4), |(_, j, k)| {
        [0.0, 0.0, 0.4, f64::from(u8::from(j != 5))][k]
    });
    reviv::formats::npy::write(
        &root.path().join("lhand/holoassist/a-0.npy"),
        &NpyArray::from(&hand),
    )
    .unwrap();

    let source = egom2p::Arrays::open(root.path(), None, None, small()).unwrap();
    assert_eq!((source.name(), source.len()), ("holoassist", 1));
    assert_eq!(source.modalities(), ["rgb", "camera", "gaze", "left_hand"]);
    let clip = source.clip(0).unwrap().into_clip().unwrap();
    assert_eq!(clip.id, "holoassist/a-0");
    let gaze = clip.gaze().unwrap();
    // The middle of 896 pixels, and the top edge of the 480-pixel crop.
    assert!((gaze.points[[0, 0]] - 0.5).abs() < 1e-6 && gaze.points[[0, 1]].abs() < 1e-6);
    assert_eq!(
        (gaze.valid[17], gaze.valid[18], gaze.valid[19]),
        (true, false, true)
    );
    let camera = clip.camera().unwrap();
    assert!((camera.T_world_camera[59].translation.x - 59.0).abs() < 1e-6);
    let hand = clip.left_hand().unwrap();
    assert!(hand.valid[[0, 4]] && !hand.valid[[0, 5]]);

    let tokens = root.path().join("tok.npz");
    Npz::default()
        .with(
            "arr_0",
            NpyArray::from(&ndarray::Array1::from_iter((0..30_i64).map(|k| k * 8))),
        )
        .write(&tokens)
        .unwrap();
    assert_eq!(egom2p::read_tokens(&tokens, &[30]).unwrap()[29], 232);
    assert!(egom2p::read_tokens(&tokens, &[5, 32, 32]).is_err());
}

#[test]
fn the_ancestors_sample_files_are_read() {
    let Some(shared) = crate::shared::folder() else {
        return;
    };
    let examples = shared.join("data/egom2p_examples");
    let tokens = egom2p::read_tokens(&examples.join("rgb2cam_egoexo.npz"), &[5, 32, 32]).unwrap();
    assert_eq!(tokens.len(), 5120);
    assert!(tokens.iter().all(|token| (82..=63955).contains(token)));
    assert_eq!(
        egom2p::read_tokens(&examples.join("token/cam-tok.npz"), &[30])
            .unwrap()
            .len(),
        30
    );
    let root = tempfile::tempdir().unwrap();
    for (folder, file) in [("cam", "cam.npy"), ("gaze", "gaze.npy")] {
        let to = root.path().join(folder).join("holoassist");
        std::fs::create_dir_all(&to).unwrap();
        std::fs::copy(examples.join(file), to.join("clip.npy")).unwrap();
    }
    let source = egom2p::Arrays::open(root.path(), None, None, CutSettings::default()).unwrap();
    let clip = source.clip(0).unwrap().into_clip().unwrap();
    let gaze = clip.gaze().unwrap();
    // Two rows of NaN (18 and 53); the others lie in the crop.
    assert_eq!(gaze.valid.iter().filter(|v| **v).count(), 58);
    assert!(!gaze.valid[18] && !gaze.valid[53]);
}
