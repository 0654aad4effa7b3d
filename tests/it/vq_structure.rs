//! The names, shapes and kinds of the full-size VQ-VAE tokenizers.

use std::collections::BTreeMap;

use reviv::engine::parameters::Kind;
use reviv::engine::{Compute, Initialise, Parameters};
use reviv::modality::Shape;
use reviv::tokenizer::vq::{VqSettings, VqVae};

#[test]
fn every_entry_of_the_released_state_has_its_name_shape_and_kind() {
    let Some(shared) = crate::shared::folder() else {
        return;
    };
    let compute = Compute::cpu();
    let temporal = |channels| Shape::Temporal {
        samples: 60,
        channels,
    };
    let joints = Shape::Kinematic {
        samples: 60,
        joints: 21,
    };
    for (file, shape, codebook) in [
        ("vq_cam", temporal(9), 256),
        ("vq_gaze", temporal(2), 512),
        ("vq_body", joints.clone(), 2048),
        ("vq_hand", joints, 1024),
    ] {
        let path = shared.join(format!("vectors/parity/structure/{file}.tsv"));
        let text = std::fs::read_to_string(path).unwrap();
        let expected: BTreeMap<String, (Vec<usize>, Kind)> = text
            .lines()
            .filter(|line| !line.starts_with('#'))
            .map(|line| {
                let columns: Vec<&str> = line.split('\t').collect();
                let shape = columns[1]
                    .split('x')
                    .map(|size| size.parse().unwrap())
                    .collect();
                let kind = if columns[3] == "param" {
                    Kind::Trainable
                } else {
                    Kind::Buffer
                };
                (columns[0].to_owned(), (shape, kind))
            })
            .collect();
        let settings = VqSettings {
            codebook,
            compression: if matches!(shape, Shape::Temporal { .. }) {
                vec![2]
            } else {
                vec![2, 3]
            },
            ..VqSettings::default()
        };
        let model = VqVae::new(&Initialise::meta(&compute), &settings, &shape).unwrap();
        let found: BTreeMap<String, (Vec<usize>, Kind)> = model
            .inventory()
            .into_iter()
            .map(|(name, shape, kind)| (name, (shape, kind)))
            .collect();
        assert_eq!(found, expected, "{file}");
    }
}
