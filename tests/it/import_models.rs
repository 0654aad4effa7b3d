//! Imported models are the same functions: they reproduce the reference's numbers, and a set decodes a clip end to end.

use crate::parity::check_parity;
use crate::released::{self, Small};
use crate::shared;
use reviv::decoding::DecodingSettings;
use reviv::engine::{Compute, Parameters, Weights};
use reviv::import::{ImportOptions, import};
use reviv::mget::names::to_release;
use reviv::mget::{Mget, MgetSpec, ModalitySpec, Size};
use reviv::model::{GenerationRequest, Model};
use reviv::tokenizer::trained::VqTokenizer;
use reviv::tokenizer::{self, Tokenizer};
use reviv::world::{World, WorldSettings};
use serde_json::Value;
use std::path::{Path, PathBuf};

/// A copy of one folder of vectors whose checkpoints are replaced.
fn copy_of(vectors: &Path, set: &Path, name: &str, replaced: &[(&str, Weights)]) -> PathBuf {
    let folder = set.join(name);
    std::fs::create_dir_all(&folder).unwrap();
    for entry in std::fs::read_dir(vectors.join(name)).unwrap() {
        let path = entry.unwrap().path();
        let file = path.file_name().unwrap().to_str().unwrap();
        if !file.contains("_model.") {
            std::fs::copy(&path, folder.join(file)).unwrap();
        }
    }
    for (stem, weights) in replaced {
        let path = folder.join(format!("{stem}_model.safetensors"));
        weights.write(&path).unwrap();
    }
    folder
}

#[test]
fn an_imported_transformer_reproduces_every_number_of_the_reference() {
    let Some(shared) = shared::folder() else {
        return;
    };
    let vectors = shared.join("vectors/parity");
    let temporary = tempfile::tempdir().unwrap();
    let mut replaced = Vec::new();
    for name in ["reviv256", "egom2p"] {
        let pth = vectors.join(format!("mget/{name}_model.pth"));
        let folder = temporary.path().join(format!("{name}-imported"));
        import(&[pth], &folder, &ImportOptions::default()).unwrap();
        let model = Mget::open(&folder, &Compute::cpu()).unwrap();
        let mut weights = Weights::default();
        for (name, tensor) in model.weights().tensors {
            weights.tensors.insert(to_release(&name), tensor);
        }
        replaced.push((name, weights));
    }
    let set = temporary.path().join("set");
    for name in ["mget", "gen"] {
        let own = if name == "mget" { &replaced[..] } else { &[] };
        copy_of(&vectors, &set, name, own);
    }
    let report = check_parity::check(&set, &reviv::Compute::cpu()).unwrap();
    assert!(report.passed(), "{report}");
}

/// Statistics that change nothing, so that normalised vectors go through.
fn unit_statistics(folder: &Path, name: &str, shape: &[usize]) -> Vec<PathBuf> {
    use reviv::formats::npy::{self, NpyArray, NpyData};
    let count = shape.iter().product();
    let write = |half: &str, value: f32| {
        let path = folder.join(format!("{name}_{half}.npy"));
        let array = NpyArray {
            shape: shape.to_vec(),
            data: NpyData::F32(vec![value; count]),
        };
        npy::write(&path, &array).unwrap();
        path
    };
    vec![write("mean", 0.0), write("std", 1.0)]
}

#[test]
fn imported_signal_tokenizers_reproduce_every_number_of_the_reference() {
    let Some(shared) = shared::folder() else {
        return;
    };
    let vectors = shared.join("vectors/parity");
    let temporary = tempfile::tempdir().unwrap();
    let mut replaced = Vec::new();
    for (stem, file, modality, heads) in [
        ("cam", "reviv_tok_cam.pth", "camera", None),
        ("gaze", "reviv_tok_gaze.pth", "gaze", Some(3)),
        ("hand", "reviv_tok_rhand.pth", "right_hand", None),
        ("body", "reviv_tok_body.pth", "body", None),
    ] {
        let own = temporary.path().join(stem);
        std::fs::create_dir(&own).unwrap();
        let pth = own.join(file);
        std::fs::copy(vectors.join(format!("vq/{stem}_model.pth")), &pth).unwrap();
        let mut files = vec![pth];
        match modality {
            "gaze" => {}
            "camera" => files.extend(unit_statistics(&own, "cam", &[9])),
            "body" => files.extend(unit_statistics(&own, "body", &[21, 3])),
            _ => files.extend(unit_statistics(&own, "rhand", &[21, 3])),
        }
        let folder = own.join("imported");
        let options = ImportOptions {
            heads,
            ..ImportOptions::default()
        };
        import(&files, &folder, &options).unwrap();
        let path = folder.join("tokenizers").join(modality);
        let opened = tokenizer::open(&path, &Compute::cpu()).unwrap();
        assert_eq!((opened.modality(), opened.vocabulary()), (modality, 64));

        // Through the public door: a clip to the reference's tokens, and these to its clip.
        let file = Weights::read(&vectors.join(format!("vq/{stem}.safetensors"))).unwrap();
        let text = std::fs::read_to_string(vectors.join(format!("vq/{stem}.json"))).unwrap();
        let json: Value = serde_json::from_str(&text).unwrap();
        codes_and_signals_agree(opened.as_ref(), &file, &json);

        let trained = VqTokenizer::read(&path, modality, &Compute::cpu()).unwrap();
        replaced.push((stem, trained.model().weights()));
    }
    let set = temporary.path().join("set");
    copy_of(&vectors, &set, "vq", &replaced);
    let report = check_parity::check(&set, &reviv::Compute::cpu()).unwrap();
    assert!(report.passed(), "{report}");
}

fn codes_and_signals_agree(opened: &dyn Tokenizer, file: &Weights, json: &Value) {
    use ndarray::{ArrayD, IxDyn};
    use reviv::clip::Signal;
    let clip = &file.tensors["clip"];
    let stored = *clip.shape.last().unwrap();
    let gaze = opened.modality() == "gaze";
    let channels = match (opened.modality(), stored) {
        ("gaze", _) => 2,
        (_, 4) => 3,
        _ => stored,
    };
    // Gaze comes in [0, 1], the reference's clip in [-1, 1].
    let raw = |value: f32| if gaze { value * 0.5 + 0.5 } else { value };
    let mut shape = clip.shape[1..].to_vec();
    *shape.last_mut().unwrap() = channels;
    let samples = clip.shape[0];
    let values = clip.f32("clip").unwrap();
    let signals: Vec<Signal> = values
        .chunks_exact(values.len() / samples)
        .map(|signal| Signal {
            values: ArrayD::from_shape_vec(
                IxDyn(&shape),
                signal
                    .chunks_exact(stored)
                    .flat_map(|row| row[..channels].iter().map(|v| raw(*v)))
                    .collect(),
            )
            .unwrap(),
            valid: (channels < stored).then(|| {
                let flags = signal.chunks_exact(stored).map(|row| row[channels] != 0.0);
                let shape = IxDyn(&shape[..shape.len() - 1]);
                ArrayD::from_shape_vec(shape, flags.collect()).unwrap()
            }),
        })
        .collect();
    let tokens = opened.encode(&signals).unwrap();
    let found: Vec<i64> = tokens
        .iter()
        .flat_map(|grid| grid.ids.iter().map(|id| i64::from(*id)))
        .collect();
    let expected = file.tensors["indices"].i64("indices").unwrap();
    assert_eq!(found, expected, "{}", opened.modality());

    let back = opened.decode(&tokens).unwrap();
    let tolerance = json["outputs"]["recon"]["tol"].as_f64().unwrap();
    let recon = file.tensors["recon"].f32("recon").unwrap();
    let found: Vec<f64> = back
        .iter()
        .flat_map(|signal| signal.values.iter().map(|v| f64::from(*v)))
        .collect();
    let (mut off, mut all) = (0.0, 0.0);
    for (a, b) in found.iter().zip(recon) {
        let expected = f64::from(*b);
        let a = if gaze { 2.0 * a - 1.0 } else { *a };
        off += (a - expected).powi(2);
        all += expected.powi(2);
    }
    let error = (off / all).sqrt();
    // Gaze is rounded once more on its way to [0, 1] and back.
    let tolerance = if gaze { tolerance.max(1e-6) } else { tolerance };
    assert!(error <= tolerance, "{}: {error:.1e}", opened.modality());
}

#[test]
fn an_imported_video_tokenizer_reproduces_every_number_of_the_reference() {
    let Some(shared) = shared::folder() else {
        return;
    };
    let vectors = shared.join("vectors/parity");
    let temporary = tempfile::tempdir().unwrap();
    let mut replaced = Vec::new();
    for stem in ["dv4x8x8", "dv8x16x16"] {
        let file = vectors.join(format!("cosmos/{stem}_model.safetensors"));
        let folder = temporary.path().join(stem);
        import(&[file], &folder, &ImportOptions::default()).unwrap();
        let opened = tokenizer::open(&folder.join("tokenizers/rgb"), &Compute::cpu()).unwrap();
        assert_eq!(
            (opened.grid(), opened.vocabulary()),
            (&[5, 32, 32][..], 64_000)
        );
        let depth = tokenizer::open(&folder.join("tokenizers/depth"), &Compute::cpu()).unwrap();
        assert_eq!(depth.modality(), "depth");
        let path = folder.join("tokenizers/rgb/tokenizer.safetensors");
        let mut weights = Weights::read(&path).unwrap();
        weights.metadata.clear();
        replaced.push((stem, weights));
    }
    let set = temporary.path().join("set");
    let folder = copy_of(&vectors, &set, "cosmos", &replaced);
    assert!(folder.join("padding.json").is_file());
    let report = check_parity::check(&set, &reviv::Compute::cpu()).unwrap();
    assert!(report.passed(), "{report}");
}

/// A set of small dimensions that takes clips of 16 x 16 pixels.
pub fn small_set(folder: &Path, with_main: bool) {
    let size = Size {
        width: 24,
        heads: 6,
        encoder_depth: 1,
        decoder_depth: 1,
        hidden: 64,
    };
    let spec = released::spec(size, [5, 2, 2], [16, 20, 24, 28]);
    if with_main {
        let path = folder.join("reviv_main.pth");
        released::main_model(&path, &spec, "fm_tiny_6e_6d_swiglu_nobias");
    }
    let small = Small {
        width: 24,
        depth: 1,
        channels: 4,
    };
    released::tokenizers(folder, &spec, small);
}

/// A model of the 512 pathway, with the video of both: 32 frames and `16 * side` pixels a side.
fn wide_spec(size: Size, side: usize, vocabularies: [usize; 4]) -> MgetSpec {
    let mut spec = released::spec(size, [5, side, side], vocabularies);
    let grid = [5, side, side];
    spec.modalities.extend([
        ModalitySpec::tokens("depth_512", &grid, 64_000),
        ModalitySpec::pixels("pixels_512", [32, 16 * side, 16 * side, 3], [8, 16, 16]),
        ModalitySpec::tokens("rgb_512", &grid, 64_000),
    ]);
    spec.modalities.sort_by(|a, b| a.name.cmp(&b.name));
    spec
}

/// 32 frames at 16 Hz go through the tokenizers and names of the 512 pathway, and its depth is in metres as it stands.
#[test]
fn the_512_pathway_reconstructs_and_its_depth_is_metric() {
    let temporary = tempfile::tempdir().unwrap();
    let released = temporary.path().join("metric_depth");
    std::fs::create_dir(&released).unwrap();
    let size = Size {
        width: 24,
        heads: 6,
        encoder_depth: 1,
        decoder_depth: 1,
        hidden: 64,
    };
    let spec = wide_spec(size, 2, [16, 20, 24, 28]);
    let main = released.join("reviv_main.pth");
    released::main_model(&main, &spec, "fm_tiny_6e_6d_swiglu_nobias");
    let small = Small {
        width: 24,
        depth: 1,
        channels: 4,
    };
    released::tokenizers(&released, &spec, small);
    let folder = temporary.path().join("model");
    // The folder's name says which of NVIDIA's tokenizers it is.
    let video = released.join("Cosmos-0.1-Tokenizer-DV8x16x16");
    std::fs::rename(released::video(&released), &video).unwrap();
    import(
        &[released.clone(), video],
        &folder,
        &ImportOptions::default(),
    )
    .unwrap();
    let model = Model::open(&folder, &Compute::cpu()).unwrap();
    let format = model.format();
    assert_eq!(
        (format.frames, format.video_rate, format.size),
        (32, 16.0, 32)
    );
    let names: Vec<&str> = model.names().collect();
    assert_eq!(
        names,
        [
            "body",
            "camera",
            "depth",
            "gaze",
            "left_hand",
            "rgb",
            "right_hand"
        ]
    );

    let settings = WorldSettings {
        size: 32,
        frames: 32,
        video_rate: 16.0,
        ..WorldSettings::default()
    };
    let clip = World::new(settings, 7).clip(0);
    let options = reviv::reconstruction::ReconstructOptions {
        samples: 2,
        ..reviv::reconstruction::ReconstructOptions::default()
    };
    let recording =
        reviv::reconstruction::Recording::of_clip(clip, &options.camera, format).unwrap();
    let made = reviv::reconstruction::reconstruct_recording(
        &recording,
        &model,
        &options,
        reviv::reconstruction::frame_buffer::DepthFrames::in_memory(),
        &mut |_| reviv::Flow::Continue,
    )
    .unwrap();
    assert_eq!(made.depth().len(), 32);
    let depth = made.depth();
    assert!(
        matches!(depth.scale(), reviv::reconstruction::predictions::ScaleStatus::Metric { by } if by.contains("learning")),
        "{:?} {:?}",
        depth.scale(),
        depth.refused()
    );
    assert!(depth.fit().is_none());
    let frame = depth.frames().next().unwrap().unwrap();
    assert!(frame.iter().all(|d| (0.0..=15.0).contains(d)));
    assert_eq!(made.body().positions().len(), 60);
    assert_eq!(made.samples().len(), 2);
    assert_eq!(made.samples()[0].body(), made.body().positions());
    let spread = made.spread();
    assert_eq!(spread["body"].shape(), [60, 21]);
    assert_eq!(spread["gaze"].shape(), [60, 1]);

    let again = temporary.path().join("again");
    model.write(&again).unwrap();
    assert!(again.join("tokenizers/rgb_512").is_dir());
    assert_eq!(
        *Model::open(&again, &Compute::cpu()).unwrap().format(),
        *format
    );
}

#[test]
fn an_imported_set_decodes_a_clip_end_to_end() {
    let temporary = tempfile::tempdir().unwrap();
    let released = temporary.path().join("reviv_500b");
    std::fs::create_dir(&released).unwrap();
    small_set(&released, true);
    let folder = temporary.path().join("model");
    let files = [released.clone(), released::video(&released)];
    let report = import(&files, &folder, &ImportOptions::default()).unwrap();
    assert_eq!(report.notices, Vec::<String>::new());
    assert_eq!(report.parts.len(), 8);
    for part in &report.parts {
        assert!(part.written <= part.entries);
    }

    let settings = WorldSettings {
        size: 16,
        ..WorldSettings::default()
    };
    let world = World::new(settings, 7);
    let model = Model::open(&folder, &Compute::cpu()).unwrap();
    assert_eq!(*model.format(), world.settings().format());
    let inputs = ["rgb".to_owned()];
    let targets = ["body", "camera", "depth", "gaze", "left_hand", "right_hand"].map(str::to_owned);
    let request = GenerationRequest {
        inputs: &inputs,
        targets: &targets,
        decoding: &DecodingSettings::default(),
        seed: 0,
    };
    let clips = [world.clip(0), world.clip(1)];
    let made = model.predict(&clips, &[0, 1], &request).unwrap();
    for one in &made {
        let clip = &one.clip;
        assert!(clip.camera().is_some() && clip.depth().is_some() && clip.gaze().is_some());
        assert!(clip.body().is_some() && clip.left_hand().is_some() && clip.right_hand().is_some());
        assert_eq!(one.certainty["camera"].len(), 60);
    }

    // Another tokenizer in its place is noticed.
    let other = folder.join("tokenizers/left_hand/tokenizer.safetensors");
    std::fs::copy(
        folder.join("tokenizers/right_hand/tokenizer.safetensors"),
        other,
    )
    .unwrap();
    let error = Model::open(&folder, &Compute::cpu()).err().unwrap();
    assert!(error.to_string().contains("left_hand"), "{error}");
}

#[test]
fn statistics_and_weights_are_one_file_that_names_both() {
    let temporary = tempfile::tempdir().unwrap();
    let released = temporary.path().join("set");
    std::fs::create_dir(&released).unwrap();
    small_set(&released, false);
    let folder = temporary.path().join("model");
    let files = [released.clone(), released::video(&released)];
    import(&files, &folder, &ImportOptions::default()).unwrap();
    let text = std::fs::read_to_string(folder.join("manifest.json")).unwrap();
    let manifest: Value = serde_json::from_str(&text).unwrap();
    let weights = Weights::read(&folder.join("tokenizers/camera/tokenizer.safetensors")).unwrap();
    let input = manifest["inputs"].as_array().unwrap().iter();
    let mut input = input.filter(|input| input["file"] == "reviv_tok_cam.pth");
    let sha256 = input.next().unwrap()["sha256"].as_str().unwrap();
    assert_eq!(weights.metadata["weights_sha256"], sha256);
    let statistics = &manifest["parts"]["camera"]["statistics"]["sha256"];
    let both: Vec<&str> = statistics
        .as_array()
        .unwrap()
        .iter()
        .map(|s| s.as_str().unwrap())
        .collect();
    assert_eq!(weights.metadata["statistics_sha256"], both.join(" "));
    let mean = weights.tensors["normalise.mean"].f32("mean").unwrap();
    assert_eq!(mean[3], 0.03);

    // Without its statistics a tokenizer is converted, said to be incomplete, and not opened.
    let folder = temporary.path().join("bare");
    let files = [released.join("reviv_tok_cam.pth")];
    let report = import(&files, &folder, &ImportOptions::default()).unwrap();
    assert!(report.notices[0].contains("no statistics for `camera`"));
    let error = tokenizer::open(&folder.join("tokenizers/camera"), &Compute::cpu())
        .err()
        .unwrap();
    assert!(error.to_string().contains("norm_stats"), "{error}");
    // An encoder alone is no tokenizer; both twice are one.
    let cosmos = released::video(&released);
    let folder = temporary.path().join("video");
    let error = import(
        &[cosmos.join("encoder.pth")],
        &folder,
        &ImportOptions::default(),
    );
    assert!(error.unwrap_err().to_string().contains("give the decoder"));
    let encoder = cosmos.join("encoder-again-dv4x8x8.pth");
    std::fs::copy(cosmos.join("encoder.pth"), encoder).unwrap();
    let report = import(&[cosmos], &folder, &ImportOptions::default()).unwrap();
    let [rgb, depth] = report.parts.as_slice() else {
        panic!("{report:?}")
    };
    assert_eq!((rgb.name.as_str(), depth.name.as_str()), ("rgb", "depth"));
    assert!(rgb.written < rgb.entries);
}
