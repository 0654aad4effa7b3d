//! `structure/`: every entry of the full-size released models, name by name. Nothing is allocated.

use std::collections::BTreeMap;
use std::path::Path;

use reviv::mget::names::{Entry, modality_from_release, release_entries};
use reviv::mget::{MgetSpec, ModalitySpec, Positions, Size};

use super::Outcome;
use super::report::Report;

const EGOM2P: &[&str] = &["tok_cam", "tok_depth", "tok_gaze", "tok_rgb"];
const RELEASE_256: &[&str] = &[
    "rgb@256",
    "tok_body",
    "tok_cam",
    "tok_depth",
    "tok_gaze",
    "tok_lhand",
    "tok_rgb",
    "tok_rhand",
];
const RELEASE_512: &[&str] = &[
    "rgb512",
    "rgb@256",
    "tok_body",
    "tok_cam",
    "tok_depth",
    "tok_depth_512",
    "tok_gaze",
    "tok_lhand",
    "tok_rgb",
    "tok_rgb_512",
    "tok_rhand",
];

/// File, width, heads, depth, modalities, vocabularies of body and gaze. Captions are left out of the last one.
#[allow(clippy::type_complexity)]
const MODELS: &[(&str, [usize; 3], &[&str], [usize; 2])] = &[
    ("egom2p", [768, 12, 12], EGOM2P, [0, 256]),
    ("mget_reviv_256_tiny", [384, 6, 6], RELEASE_256, [2048, 512]),
    (
        "mget_reviv_256_base_body1024",
        [768, 12, 12],
        RELEASE_256,
        [1024, 512],
    ),
    ("mget_reviv_512", [768, 12, 12], RELEASE_512, [2048, 512]),
    (
        "mget_reviv_512_caption",
        [768, 12, 12],
        RELEASE_512,
        [2048, 512],
    ),
];

pub fn check(folder: &Path, report: &mut Report) -> Outcome {
    for (file, [width, heads, depth], modalities, [body, gaze]) in MODELS {
        let path = folder.join(format!("{file}.tsv"));
        if !path.is_file() {
            continue;
        }
        let spec = MgetSpec {
            size: Size {
                width: *width,
                heads: *heads,
                encoder_depth: *depth,
                decoder_depth: *depth,
                hidden: 0,
            },
            positions: Positions::Released,
            modalities: modalities
                .iter()
                .map(|name| modality(name, *body, *gaze))
                .collect::<Outcome<_>>()?,
        };
        let expected: Vec<_> = read(&std::fs::read_to_string(&path)?)?
            .into_iter()
            .collect();
        let mut own = release_entries(&spec);
        own.sort_by(|a, b| a.0.cmp(&b.0));
        let own: Vec<_> = own
            .into_iter()
            .map(|(name, shape, kind)| (name, (shape, kind)))
            .collect();
        report.exact(format!("structure/{file} entries"), &own, &expected);
        let listed: usize = expected
            .iter()
            .filter(|(_, (_, kind))| *kind == Entry::Parameter)
            .map(|(_, (shape, _))| shape.iter().product::<usize>())
            .sum();
        report.exact(
            format!("structure/{file} parameters"),
            &[spec.parameter_count()],
            &[listed],
        );
    }
    Ok(())
}

fn modality(theirs: &str, body: usize, gaze: usize) -> Outcome<ModalitySpec> {
    let name = modality_from_release(theirs).ok_or("an unknown modality")?;
    Ok(match name {
        "camera" => ModalitySpec::tokens(name, &[30], 256),
        "gaze" => ModalitySpec::tokens(name, &[30], gaze),
        "body" => ModalitySpec::tokens(name, &[30, 7], body),
        "left_hand" | "right_hand" => ModalitySpec::tokens(name, &[30, 7], 1024),
        "pixels" => ModalitySpec::pixels(name, [16, 256, 256, 3], [4, 8, 8]),
        "pixels_512" => ModalitySpec::pixels(name, [32, 512, 512, 3], [8, 16, 16]),
        _ => ModalitySpec::tokens(name, &[5, 32, 32], 64_000),
    })
}

type Entries = BTreeMap<String, (Vec<usize>, Entry)>;

fn read(text: &str) -> Outcome<Entries> {
    let mut entries = Entries::new();
    for line in text
        .lines()
        .filter(|line| !line.starts_with('#') && !line.contains("tok_caption"))
    {
        let [name, shape, _, kind] = line.split('\t').collect::<Vec<_>>()[..] else {
            return Err(format!("not four columns: {line}").into());
        };
        let shape = shape.split('x').map(str::parse).collect::<Result<_, _>>()?;
        let kind = match kind.strip_prefix("alias of ") {
            Some(owner) => Entry::Alias(owner.to_owned()),
            None if kind == "param" => Entry::Parameter,
            None => Entry::Buffer,
        };
        entries.insert(name.to_owned(), (shape, kind));
    }
    Ok(entries)
}
