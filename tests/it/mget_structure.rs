//! The model's parameters against the release's lists, name by name, and its position tables against the reference's.

use crate::shared::shared;
use reviv::engine::Weights;
use reviv::mget::names::{Entry, modality_from_release, release_entries};
use reviv::mget::{MgetSpec, ModalitySpec, Positions, Size, positions};
use std::collections::BTreeMap;

fn size(width: usize, heads: usize, depth: usize) -> Size {
    Size {
        width,
        heads,
        encoder_depth: depth,
        decoder_depth: depth,
        hidden: 0,
    }
}

fn modality(release_name: &str, body: usize, gaze: usize) -> ModalitySpec {
    let name = modality_from_release(release_name).unwrap();
    match name {
        "rgb" | "depth" | "rgb_512" | "depth_512" => {
            ModalitySpec::tokens(name, &[5, 32, 32], 64_000)
        }
        "camera" => ModalitySpec::tokens(name, &[30], 256),
        "gaze" => ModalitySpec::tokens(name, &[30], gaze),
        "body" => ModalitySpec::tokens(name, &[30, 7], body),
        "left_hand" | "right_hand" => ModalitySpec::tokens(name, &[30, 7], 1024),
        "pixels" => ModalitySpec::pixels(name, [16, 256, 256, 3], [4, 8, 8]),
        "pixels_512" => ModalitySpec::pixels(name, [32, 512, 512, 3], [8, 16, 16]),
        other => panic!("{other}"),
    }
}

fn spec(size: Size, modalities: &[&str], body: usize, gaze: usize) -> MgetSpec {
    MgetSpec {
        size,
        positions: Positions::Released,
        modalities: modalities
            .iter()
            .map(|name| modality(name, body, gaze))
            .collect(),
    }
}

fn table(text: &str) -> BTreeMap<String, (Vec<usize>, Entry)> {
    text.lines()
        .filter(|line| !line.starts_with('#') && !line.contains("tok_caption"))
        .map(|line| {
            let columns: Vec<&str> = line.split('\t').collect();
            let shape = columns[1].split('x').map(|n| n.parse().unwrap()).collect();
            let kind = match columns[3] {
                "param" => Entry::Parameter,
                "buffer" => Entry::Buffer,
                other => Entry::Alias(other.strip_prefix("alias of ").unwrap().to_owned()),
            };
            (columns[0].to_owned(), (shape, kind))
        })
        .collect()
}

#[test]
fn every_entry_of_the_released_models_is_ours_and_ours_are_theirs() {
    let egom2p = ["tok_cam", "tok_depth", "tok_gaze", "tok_rgb"];
    let small = [
        "rgb@256",
        "tok_body",
        "tok_cam",
        "tok_depth",
        "tok_gaze",
        "tok_lhand",
        "tok_rgb",
        "tok_rhand",
    ];
    let large = [&small[..], &["rgb512", "tok_depth_512", "tok_rgb_512"]].concat();
    let (tiny, base) = (size(384, 6, 6), size(768, 12, 12));
    for (file, spec, entries) in [
        ("egom2p", spec(base, &egom2p, 0, 256), 335),
        ("mget_reviv_256_tiny", spec(tiny, &small, 2048, 512), 209),
        (
            "mget_reviv_256_base_body1024",
            spec(base, &small, 1024, 512),
            359,
        ),
        ("mget_reviv_512", spec(base, &large, 2048, 512), 376),
        ("mget_reviv_512_caption", spec(base, &large, 2048, 512), 376),
    ] {
        let Some(path) = shared(&format!("vectors/parity/structure/{file}.tsv")) else {
            return;
        };
        let expected = table(&std::fs::read_to_string(path).unwrap());
        let own: BTreeMap<_, _> = release_entries(&spec)
            .into_iter()
            .map(|(name, shape, kind)| (name, (shape, kind)))
            .collect();
        assert_eq!(expected.len(), entries, "{file}");
        assert_eq!(own, expected, "{file}");
    }
}

#[test]
fn position_tables_are_the_reference_s() {
    let Some(path) = shared("vectors/parity/mget/position_tables.safetensors") else {
        return;
    };
    let file = Weights::read(&path).unwrap();
    for (kind, grid) in [
        ("1d_30", vec![30]),
        ("hand_210", vec![30, 7]),
        ("video_5x32x32", vec![5, 32, 32]),
        ("raw_4x32x32", vec![4, 32, 32]),
        ("vq_hand_30x7", vec![30, 7]),
    ] {
        for width in [384, 768] {
            let own = positions::table(&grid, width, Positions::Released).unwrap();
            let name = format!("{kind}.d{width}");
            let rows = file.tensors[&format!("{name}.rows")]
                .i64("rows")
                .unwrap()
                .to_vec();
            let expected = file.tensors[&format!("{name}.values")]
                .f32("values")
                .unwrap();
            let found: Vec<f32> = rows
                .iter()
                .flat_map(|row| &own[*row as usize * width..][..width])
                .copied()
                .collect();
            let distance =
                |pairs: &mut dyn Iterator<Item = f64>| pairs.map(|d| d * d).sum::<f64>().sqrt();
            let off = distance(&mut found.iter().zip(expected).map(|(a, b)| f64::from(a - b)));
            let norm = distance(&mut expected.iter().map(|b| f64::from(*b)));
            assert!(off / norm < 1e-5, "{name}: {}", off / norm);
        }
    }
}
