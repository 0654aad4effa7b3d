//! `reviv reconstruct` through the binary, with a model folder of untrained weights: what it takes, what it refuses, and that
//! the same request gives the same bytes.

use assert_cmd::Command;
use reviv::engine::{Compute, Initialise};
use reviv::masking::PIXELS;
use reviv::mget::{Mget, MgetSpec, ModalitySpec, Positions, Size};
use reviv::modality::{self, ClipFormat, Shape};
use reviv::model::{ModelManifest, TOKENIZERS};
use reviv::tokenizer::Tokenizer;
use reviv::tokenizer::normaliser::Normaliser;
use reviv::tokenizer::trained::VqTokenizer;
use reviv::tokenizer::video::{Network, VideoSettings, VideoTokenizer};
use reviv::tokenizer::vq::{VqSettings, VqVae};
use std::collections::BTreeMap;
use std::path::Path;

const SIDE: usize = 32;

/// All that a model can know of.
const ALL: [&str; 7] = [
    "body",
    "camera",
    "depth",
    "gaze",
    "left_hand",
    "rgb",
    "right_hand",
];

/// A whole model folder for 16 frames of 32 x 32 pixels, with tokens of `known`, and raw video if `pixels`. Nothing in it has
/// been trained.
fn model_folder(folder: &Path, seed: u64, known: &[&str], pixels: bool) {
    let compute = Compute::cpu();
    let format = ClipFormat {
        size: SIDE,
        ..ClipFormat::default()
    };
    let mut modalities = Vec::new();
    for &name in known {
        let modality = modality::built_in(name, &format).unwrap();
        let path = folder.join(TOKENIZERS).join(name);
        std::fs::create_dir_all(&path).unwrap();
        let place = Initialise::new(&compute, seed);
        let (grid, vocabulary) = match modality.shape() {
            Shape::Video {
                frames,
                height,
                width,
            } => {
                let settings = VideoSettings {
                    channels: 8,
                    multipliers: vec![1, 1],
                    blocks: 1,
                    patch: 4,
                    latent_channels: 4,
                    levels: vec![4, 4],
                    spatial: 8,
                    temporal: 4,
                };
                let network = Network::new(&place, &settings).unwrap();
                let tokenizer =
                    VideoTokenizer::new(name, [frames, height, width], network, &compute).unwrap();
                tokenizer.write(&path).unwrap();
                (tokenizer.grid().to_vec(), tokenizer.vocabulary())
            }
            shape => {
                let compression = match shape {
                    Shape::Temporal { .. } => vec![2],
                    _ => vec![2, 3],
                };
                let settings = VqSettings {
                    codebook: 16,
                    code_width: 4,
                    compression,
                    width: 24,
                    depth: 1,
                    heads: 2,
                    mlp_ratio: 2,
                    ..VqSettings::default()
                };
                let model = VqVae::new(&place, &settings, &shape).unwrap();
                let values = model.patches().values_per_sample();
                let statistics = Normaliser::constant(values, 0.0, 1.0).unwrap();
                let tokenizer = VqTokenizer::new(name, shape, statistics, &model).unwrap();
                tokenizer.write(&path).unwrap();
                (tokenizer.grid().to_vec(), tokenizer.vocabulary())
            }
        };
        modalities.push(ModalitySpec::tokens(name, &grid, vocabulary));
    }
    if pixels {
        modalities.push(ModalitySpec::pixels(
            PIXELS,
            [16, SIDE, SIDE, 3],
            [4, 16, 16],
        ));
    }
    let spec = MgetSpec {
        size: Size {
            width: 24,
            heads: 2,
            encoder_depth: 1,
            decoder_depth: 1,
            hidden: 0,
        },
        positions: Positions::Aligned,
        modalities,
    };
    let model = Mget::new(&spec, &Initialise::new(&compute, seed)).unwrap();
    model.save(folder).unwrap();
    ModelManifest::of(folder, format)
        .unwrap()
        .write(folder)
        .unwrap();
}

/// A folder of pictures: `frames` of `width` x `height`, in which something moves unless `still`.
fn pictures(folder: &Path, frames: usize, [width, height]: [u32; 2], black: bool) {
    std::fs::create_dir_all(folder).unwrap();
    for frame in 0..frames {
        let file = std::fs::File::create(folder.join(format!("{frame:05}.png"))).unwrap();
        let mut encoder = png::Encoder::new(file, width, height);
        encoder.set_color(png::ColorType::Rgb);
        let mut writer = encoder.write_header().unwrap();
        let value = |x: u32, y: u32, c: u32| {
            if black {
                0
            } else {
                ((x * 3 + y * 5 + c * 40 + frame as u32 * 7) % 256) as u8
            }
        };
        let data: Vec<u8> = (0..height)
            .flat_map(|y| (0..width).flat_map(move |x| (0..3).map(move |c| (x, y, c))))
            .map(|(x, y, c)| value(x, y, c))
            .collect();
        writer.write_image_data(&data).unwrap();
    }
}

/// A folder with a model in it.
pub struct Place {
    root: tempfile::TempDir,
}

impl Place {
    pub fn new() -> Self {
        let place = Self {
            root: tempfile::tempdir().unwrap(),
        };
        model_folder(&place.path("model"), 1, &ALL, false);
        place
    }

    pub fn path(&self, name: &str) -> std::path::PathBuf {
        self.root.path().join(name)
    }

    pub fn command(&self, video: &str, output: &str) -> Command {
        let mut command = Command::new(env!("CARGO_BIN_EXE_reviv"));
        command.current_dir(self.root.path()).args([
            "reconstruct",
            video,
            "--model",
            "model",
            "-o",
            output,
        ]);
        command
    }

    /// Runs it and gives what it said, which must hold `words`.
    pub fn refuses(&self, video: &str, words: &str) {
        let output = self.command(video, "refused").assert().code(1);
        let said = String::from_utf8_lossy(&output.get_output().stderr).into_owned();
        assert!(said.contains(words), "{words:?} is not in:\n{said}");
        assert!(!said.contains("panicked"), "{said}");
    }
}

fn files(folder: &Path) -> BTreeMap<String, Vec<u8>> {
    std::fs::read_dir(folder)
        .unwrap()
        .map(|entry| entry.unwrap().path())
        .filter(|path| path.is_file())
        .map(|path| {
            let name = path.file_name().unwrap().to_string_lossy().into_owned();
            (name, std::fs::read(path).unwrap())
        })
        .collect()
}

#[test]
fn a_video_becomes_a_complete_folder_and_the_same_bytes_again() {
    let place = Place::new();
    pictures(&place.path("walk"), 100, [48, 40], false);
    let said = place.command("walk", "one").assert().success();
    let said = String::from_utf8_lossy(&said.get_output().stderr).into_owned();
    for words in [
        "ASSUMED: 90 degrees",
        "first camera is level",
        "Frame rate",
        "the centre 40 x 40",
    ] {
        assert!(said.contains(words), "{words:?} is not in:\n{said}");
    }
    let one = files(&place.path("one"));
    for name in [
        "camera.tum",
        "camera.npz",
        "gaze.csv",
        "body.npz",
        "body.bvh",
        "hands.npz",
        "depth.npz",
        "points.ply",
        "scene.glb",
        "gaze.npz",
        "certainty.npz",
        "view.html",
        "manifest.json",
    ] {
        assert!(
            one.contains_key(name),
            "{name} is missing: {:?}",
            one.keys()
        );
    }
    // Another place for runs: nothing is found in a cache, everything is made again, on one thread.
    place
        .command("walk", "two")
        .args(["--runs", "elsewhere"])
        .env("RAYON_NUM_THREADS", "1")
        .assert()
        .success();
    assert!(one == files(&place.path("two")), "two runs differ");
}

#[test]
fn what_is_made_from_the_video_once_more_needs_no_second_reconstruction_and_is_no_foreign_file() {
    let place = Place::new();
    pictures(&place.path("walk"), 70, [48, 40], false);
    place.command("walk", "one").assert().success();
    let said = place
        .command("walk", "one")
        .args(["--video", "--export", "nerfstudio"])
        .assert()
        .success();
    let said = String::from_utf8_lossy(&said.get_output().stderr).into_owned();
    assert!(
        said.contains("Overlay") && said.contains("NerfStudio"),
        "{said}"
    );
    let own = files(&place.path("one"));
    let movie = own.get("overlay.mp4").or(own.get("overlay.avi"));
    assert!(movie.is_some_and(|movie| movie.len() > 10_000));
    let data: serde_json::Value =
        serde_json::from_slice(&files(&place.path("one/nerfstudio"))["transforms.json"]).unwrap();
    // 70 pictures at 30 a second, eight of them a second.
    assert_eq!(data["frames"].as_array().unwrap().len(), 19);
    assert_eq!(files(&place.path("one/nerfstudio/images")).len(), 19);
    place.command("walk", "one").assert().success();
}

#[test]
fn a_model_that_has_no_tokens_of_video_is_given_raw_video() {
    let place = Place::new();
    std::fs::remove_dir_all(place.path("model")).unwrap();
    model_folder(&place.path("model"), 1, &["body", "camera", "gaze"], true);
    pictures(&place.path("walk"), 20, [48, 40], false);
    place.command("walk", "one").assert().success();
    assert!(place.path("one").join("camera.tum").is_file());
}

#[test]
fn short_still_black_and_portrait_videos_are_reconstructed() {
    let place = Place::new();
    pictures(&place.path("one_frame"), 1, [40, 40], false);
    pictures(&place.path("black"), 30, [40, 40], true);
    pictures(&place.path("portrait"), 30, [36, 64], false);
    for video in ["one_frame", "black", "portrait"] {
        place
            .command(video, &format!("{video}_out"))
            .assert()
            .success();
        assert!(place.path(&format!("{video}_out/view.html")).is_file());
    }
}

#[test]
fn what_is_no_video_is_refused_with_a_reason() {
    let place = Place::new();
    place.refuses("nowhere.mp4", "no file `nowhere.mp4`");
    std::fs::create_dir(place.path("empty")).unwrap();
    place.refuses("empty", "empty");
    std::fs::write(
        place.path("cut.mp4"),
        b"\0\0\0\x18ftypisom\0\0\x02\0isomiso2avc1mp41\0\0",
    )
    .unwrap();
    place.refuses("cut.mp4", "cut.mp4");
    std::fs::write(
        place.path("text.mp4"),
        b"this is a text, and no video at all",
    )
    .unwrap();
    place.refuses("text.mp4", "text.mp4");
}

#[test]
fn a_model_that_is_none_or_not_whole_is_refused() {
    let place = Place::new();
    pictures(&place.path("walk"), 4, [40, 40], false);
    // Weights and tokenizers of two models.
    let other = tempfile::tempdir().unwrap();
    model_folder(other.path(), 2, &ALL, false);
    let file = "tokenizers/camera/tokenizer.safetensors";
    let own = std::fs::read(place.path("model").join(file)).unwrap();
    std::fs::copy(other.path().join(file), place.path("model").join(file)).unwrap();
    place.refuses("walk", "not the one the model was trained on");
    std::fs::write(place.path("model").join(file), own).unwrap();
    std::fs::write(place.path("model/weights.safetensors"), b"damaged").unwrap();
    place.refuses("walk", "no model folder");
    std::fs::remove_file(place.path("model/model.json")).unwrap();
    place.refuses("walk", "no model folder");
    std::fs::remove_dir_all(place.path("model")).unwrap();
    place.refuses("walk", "no run `model`");
}

#[test]
fn without_a_model_and_a_run_the_one_that_comes_with_the_program_is_used_and_says_what_it_is() {
    let place = Place::new();
    pictures(&place.path("walk"), 20, [48, 40], false);
    let said = Command::new(env!("CARGO_BIN_EXE_reviv"))
        .current_dir(place.root.path())
        .args(["reconstruct", "walk", "-o", "out"])
        .assert()
        .success();
    let said = String::from_utf8_lossy(&said.get_output().stderr).into_owned();
    assert!(said.contains("models/world-"), "{said}");
    assert!(said.contains("synthetic"), "{said}");
    for name in [
        "camera.npz",
        "body.npz",
        "hands.npz",
        "gaze.npz",
        "depth.npz",
    ] {
        assert!(place.path("out").join(name).is_file(), "{name} is missing");
    }
}

#[test]
fn a_folder_that_holds_something_else_is_left_alone() {
    let place = Place::new();
    pictures(&place.path("walk"), 4, [40, 40], false);
    std::fs::create_dir(place.path("precious")).unwrap();
    std::fs::write(place.path("precious/letter.txt"), b"dear").unwrap();
    place.command("walk", "precious").assert().code(1);
    assert!(place.path("precious/letter.txt").is_file());
    // A page alone is no earlier result: `reviv view RUN -o view.html` leaves one anywhere.
    std::fs::write(place.path("precious/view.html"), b"<html>").unwrap();
    place.command("walk", "precious").assert().code(1);
    assert_eq!(files(&place.path("precious")).len(), 2);
}

#[test]
fn an_earlier_result_is_replaced_only_where_nothing_was_put_beside_it() {
    let place = Place::new();
    pictures(&place.path("walk"), 4, [40, 40], false);
    place.command("walk", "out").assert().success();
    let made = files(&place.path("out"));
    std::fs::write(place.path("out/camera.tum"), b"old").unwrap();
    place.command("walk", "out").assert().success();
    assert!(files(&place.path("out")) == made, "it was not replaced");
    let foreign = place.path("out/colmap/notes.txt");
    std::fs::write(&foreign, b"mine").unwrap();
    place.command("walk", "out").assert().code(1);
    assert!(foreign.is_file());
    assert!(files(&place.path("out")) == made, "something is gone");
}

#[test]
fn a_depth_network_gives_the_metric_scale_of_a_whole_video() {
    let place = Place::new();
    crate::labelling::random_network(
        &place.path("network"),
        reviv::labelling::DepthLabelKind::Metric,
    );
    // More than one window of the network.
    pictures(&place.path("walk"), 70, [48, 40], false);
    let with = |output: &str| {
        let mut command = place.command("walk", output);
        let runs = format!("runs_{output}");
        command.args(["--anchor-model", "network", "--runs", runs.as_str()]);
        command.assert().success();
        std::fs::read_to_string(place.path(output).join("manifest.json")).unwrap()
    };
    let manifest: serde_json::Value = serde_json::from_str(&with("one")).unwrap();
    let scale = manifest["scale"].to_string();
    assert!(
        scale.contains("anchor") || manifest["refused"].is_string(),
        "{manifest}"
    );
    place.command("walk", "none").assert().success();
    let none = std::fs::read_to_string(place.path("none/manifest.json")).unwrap();
    assert!(!none.contains("anchor_model"), "{none}");
    // Labels of the other kind have no metres.
    crate::labelling::random_network(
        &place.path("relative"),
        reviv::labelling::DepthLabelKind::Relative,
    );
    let output = place
        .command("walk", "two")
        .args(["--anchor-model", "relative"])
        .assert()
        .code(1);
    let said = String::from_utf8_lossy(&output.get_output().stderr).into_owned();
    assert!(said.contains("relative"), "{said}");
}

#[cfg(unix)]
#[test]
fn a_video_whose_name_is_no_text_is_reconstructed_too() {
    use std::os::unix::ffi::OsStrExt as _;
    let place = Place::new();
    let name = std::ffi::OsStr::from_bytes(b"walk\xff");
    pictures(&place.path("walk"), 20, [40, 40], false);
    std::fs::rename(place.path("walk"), place.path("").join(name)).unwrap();
    let command = place.command("none", "one");
    let arguments: Vec<std::ffi::OsString> = command
        .get_args()
        .map(|argument| {
            if argument == "none" {
                name.to_owned()
            } else {
                argument.to_owned()
            }
        })
        .collect();
    let mut command = Command::new(env!("CARGO_BIN_EXE_reviv"));
    command
        .current_dir(place.path(""))
        .args(arguments)
        .assert()
        .success();
    assert!(place.path("one/camera.tum").is_file());
}

#[cfg(unix)]
#[test]
fn a_recording_for_rerun_is_written_by_python_and_refused_before_the_work_without() {
    use std::os::unix::fs::PermissionsExt as _;
    let place = Place::new();
    pictures(&place.path("walk"), 4, [40, 40], false);
    let missing = place
        .command("walk", "out")
        .args(["--export", "rerun"])
        .env("REVIV_PYTHON", place.path("no_python"))
        .assert()
        .code(1);
    let said = String::from_utf8_lossy(&missing.get_output().stderr).into_owned();
    assert!(
        said.contains("no_python") && said.contains("pip install . rerun-sdk"),
        "{said}"
    );
    assert!(!place.path("out").exists());

    let script = place.path("python");
    let text = "#!/bin/sh\n[ \"$1 $2\" = '-m reviv.rerun' ] || exit 3\nshift 2\n\
                [ \"$1\" = --check ] && exit 0\n[ -f \"$1/view.html\" ] && printf rrd > \"$3\"\n";
    std::fs::write(&script, text).unwrap();
    std::fs::set_permissions(&script, std::fs::Permissions::from_mode(0o755)).unwrap();
    for _ in 0..2 {
        // Asked again, the recording is no foreign file.
        place
            .command("walk", "out")
            .args(["--export", "rerun"])
            .env("REVIV_PYTHON", &script)
            .assert()
            .success();
        let made = std::fs::read_to_string(place.path("out/scene.rrd"));
        assert_eq!(made.unwrap(), "rrd");
    }
}
