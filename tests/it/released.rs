//! A set of released files with random weights, of any size: main model, tokenizers, statistics. For tests and benches.

use crate::torch::{self, Argument, Saved};
use reviv::engine::{Compute, Initialise, Parameters, Values, Weights};
use reviv::formats::npy::{self, NpyArray, NpyData};
use reviv::mget::names::{Entry, modality_to_release, release_entries};
use reviv::mget::{MgetSpec, ModalitySpec, Positions, Size, positions};
use reviv::modality::Shape;
use reviv::tokenizer::video::{Network, VideoSettings};
use reviv::tokenizer::vq::{VqSettings, VqVae};
use std::path::{Path, PathBuf};

/// The 256 model, with video of `video` tokens and vocabularies of signals (camera, gaze, hands, body).
pub fn spec(size: Size, video: [usize; 3], vocabularies: [usize; 4]) -> MgetSpec {
    let [camera, gaze, hand, body] = vocabularies;
    let [times, heights, widths] = video;
    let clip = [4 * (times - 1), 8 * heights, 8 * widths, 3];
    MgetSpec {
        size,
        positions: Positions::Released,
        modalities: vec![
            ModalitySpec::tokens("body", &[30, 7], body),
            ModalitySpec::tokens("camera", &[30], camera),
            ModalitySpec::tokens("depth", &video, 64_000),
            ModalitySpec::tokens("gaze", &[30], gaze),
            ModalitySpec::tokens("left_hand", &[30, 7], hand),
            ModalitySpec::pixels("pixels", clip, [4, 8, 8]),
            ModalitySpec::tokens("rgb", &video, 64_000),
            ModalitySpec::tokens("right_hand", &[30, 7], hand),
        ],
    }
}

/// Numbers of about 0.02 that depend on the name and the place.
fn noise(name: &str, count: usize) -> Vec<f32> {
    let mut state = name.bytes().fold(0x9e37_79b9_7f4a_7c15_u64, |h, b| {
        (h ^ u64::from(b)).wrapping_mul(0x0100_0000_01b3)
    });
    let next = || {
        state = state
            .wrapping_mul(6_364_136_223_846_793_005)
            .wrapping_add(1);
        ((state >> 40) as f32 / (1 << 24) as f32 - 0.5) * 0.07
    };
    std::iter::repeat_with(next).take(count).collect()
}

/// Writes the main model, as the release has it.
pub fn main_model(path: &Path, spec: &MgetSpec, builder: &str) {
    let mut entries = release_entries(spec);
    entries.sort_by_key(|(_, _, kind)| matches!(kind, Entry::Alias(_)));
    let mut tensors: Vec<Saved> = Vec::new();
    for (name, shape, kind) in entries {
        let count: usize = shape.iter().product();
        let alias_of = match &kind {
            Entry::Alias(owner) => tensors.iter().position(|saved| saved.name == *owner),
            _ => None,
        };
        let place = spec.modalities.iter().find(|m| {
            let theirs = modality_to_release(&m.name).unwrap();
            name.contains(&format!("_embeddings.{theirs}."))
        });
        let values: Box<dyn Fn() -> Vec<f32>> = match place {
            Some(modality) if name.ends_with("pos_emb") => {
                let (grid, width) = (modality.grid(), spec.size.width);
                Box::new(move || positions::table(&grid, width, Positions::Released).unwrap())
            }
            _ if matches!(kind, Entry::Buffer) => Box::new(move || vec![0.0; count]),
            _ if name.contains("norm") => Box::new(move || vec![1.0; count]),
            _ => {
                let name = name.clone();
                Box::new(move || noise(&name, count))
            }
        };
        tensors.push(Saved {
            name,
            shape,
            alias_of,
            values,
        });
    }
    let domains = spec.modalities.iter().map(|m| modality_to_release(&m.name));
    let arguments = [
        ("model", Argument::Text(builder.to_owned())),
        (
            "all_domains",
            Argument::Texts(domains.map(|name| name.unwrap().to_owned()).collect()),
        ),
        ("num_register_tokens", Argument::Number(0)),
    ];
    write(path, &tensors, &arguments);
}

fn write(path: &Path, tensors: &[Saved], arguments: &[(&str, Argument)]) {
    let file = std::io::BufWriter::new(std::fs::File::create(path).unwrap());
    torch::save(file, tensors, arguments);
}

/// Tensors of our names, which are the release's too.
fn saved(weights: Weights) -> Vec<Saved> {
    let tensors = weights.tensors.into_iter();
    tensors
        .map(|(name, tensor)| {
            let Values::F32(values) = tensor.values else {
                panic!("`{name}` is not f32")
            };
            Saved {
                name,
                shape: tensor.shape,
                alias_of: None,
                values: Box::new(move || values.clone()),
            }
        })
        .collect()
}

/// Sizes of a tokenizer's networks.
#[derive(Debug, Clone, Copy)]
pub struct Small {
    pub width: usize,
    pub depth: usize,
    /// Channels of the video tokenizer.
    pub channels: usize,
}

/// Writes the tokenizers of `spec` and their statistics beside the main model: the files of one set.
pub fn tokenizers(folder: &Path, spec: &MgetSpec, small: Small) {
    let compute = Compute::cpu();
    let statistics = folder.join("norm_stats");
    std::fs::create_dir_all(&statistics).unwrap();
    for (modality, theirs, channels) in [
        ("camera", "cam", Some(9)),
        ("gaze", "gaze", Some(2)),
        ("left_hand", "lhand", None),
        ("right_hand", "rhand", None),
        ("body", "body", None),
    ] {
        let codebook = spec.modalities[spec.index(modality).unwrap()].vocabulary();
        let shape = match channels {
            Some(channels) => Shape::Temporal {
                samples: 60,
                channels,
            },
            None => Shape::Kinematic {
                samples: 60,
                joints: 21,
            },
        };
        let settings = VqSettings {
            codebook: codebook.unwrap(),
            width: small.width,
            depth: small.depth,
            compression: channels.map_or(vec![2, 3], |_| vec![2]),
            ..VqSettings::default()
        };
        let model = VqVae::new(&Initialise::new(&compute, 3), &settings, &shape).unwrap();
        let path = folder.join(format!("reviv_tok_{theirs}.pth"));
        let domain = Argument::Text(theirs.to_owned());
        write(&path, &saved(model.weights()), &[("domain", domain)]);
        if theirs != "gaze" {
            let shape = channels.map_or(vec![21, 3], |channels| vec![channels]);
            let count: usize = shape.iter().product();
            for (half, offset) in [("mean", 0.0), ("std", 1.0)] {
                let values = (0..count).map(|i| offset + i as f32 * 0.01).collect();
                let array = NpyArray {
                    shape: shape.clone(),
                    data: NpyData::F32(values),
                };
                npy::write(&statistics.join(format!("{theirs}_{half}.npy")), &array).unwrap();
            }
        }
    }
    let wide = spec.index("rgb_512").is_some();
    let settings = VideoSettings {
        channels: small.channels,
        ..if wide {
            VideoSettings::dv8x16x16()
        } else {
            VideoSettings::default()
        }
    };
    let network = Network::new(&Initialise::new(&compute, 4), &settings).unwrap();
    let weights = saved(network.weights());
    let (encoder, decoder): (Vec<Saved>, Vec<Saved>) = weights
        .into_iter()
        .partition(|saved| saved.name.starts_with("encoder") || saved.name.starts_with("quant"));
    let cosmos = video(folder);
    std::fs::create_dir_all(&cosmos).unwrap();
    write(&cosmos.join("encoder.pth"), &encoder, &[]);
    write(&cosmos.join("decoder.pth"), &decoder, &[]);
}

/// The folder of the video tokenizer.
pub fn video(folder: &Path) -> PathBuf {
    folder.join("Cosmos-0.1-Tokenizer-DV4x8x8")
}
