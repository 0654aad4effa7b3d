//! What `registry/tokenizer/*.yaml` hold: the settings of one family of tokenizers.

use crate::experiment::{Kind, KindEntry};

pub use crate::tokenizer::TokenizerSettings as TokenizerEntry;

impl Kind for TokenizerEntry {
    const KIND: &'static str = "tokenizer";
    const ABOUT: &'static str =
        "How a modality becomes tokens: sizes, codebook, compression, loss.";
}
inventory::submit! { KindEntry::of::<TokenizerEntry>() }

#[cfg(test)]
mod tests {
    use super::*;
    use crate::modality::Shape;
    use serde_json::Value;

    fn entry(name: &str) -> TokenizerEntry {
        let path = format!(
            "{}/registry/tokenizer/{name}.yaml",
            env!("CARGO_MANIFEST_DIR")
        );
        let text = std::fs::read_to_string(path).unwrap();
        let mut value: Value = serde_saphyr::from_str(&text).unwrap();
        let map = value.as_object_mut().unwrap();
        assert_eq!(map.remove("tokenizer").unwrap(), name);
        assert!(map.remove("about").unwrap().is_string());
        serde_json::from_value(value).unwrap()
    }

    #[test]
    fn every_shipped_entry_fits_the_signals_it_is_for() {
        let temporal = |channels| Shape::Temporal {
            samples: 60,
            channels,
        };
        let joints = Shape::Kinematic {
            samples: 60,
            joints: 21,
        };
        for (name, shape, codebook, grid) in [
            ("vq_camera", temporal(9), 256, vec![30]),
            ("vq_gaze", temporal(2), 512, vec![30]),
            ("vq_hand", joints.clone(), 1024, vec![30, 7]),
            ("vq_body", joints.clone(), 2048, vec![30, 7]),
            ("vq_temporal_small", temporal(6), 256, vec![15]),
            ("vq_kinematic_small", joints, 512, vec![15, 7]),
        ] {
            let TokenizerEntry::Vq(settings) = entry(name) else {
                panic!("{name}");
            };
            assert_eq!(settings.codebook, codebook, "{name}");
            assert_eq!(settings.patches(&shape).unwrap().grid(), grid, "{name}");
        }
    }

    #[test]
    fn every_shipped_video_entry_has_sizes_that_fit() {
        for (name, vocabulary) in [
            ("cosmos_dv4x8x8", 64_000),
            ("cosmos_dv8x16x16", 64_000),
            ("video_small", 1000),
            ("video_tiny", 200),
        ] {
            let TokenizerEntry::Video(settings) = entry(name) else {
                panic!("{name}");
            };
            settings.check().unwrap();
            assert_eq!(settings.vocabulary(), vocabulary, "{name}");
        }
    }

    #[test]
    fn the_library_s_small_tokenizers_are_those_of_the_registry() {
        use crate::tokenizer::video::VideoSettings;
        use crate::tokenizer::vq::VqSettings;
        for (name, settings) in [
            ("video_tiny", TokenizerEntry::Video(VideoSettings::tiny())),
            (
                "vq_temporal_small",
                TokenizerEntry::Vq(VqSettings::temporal_small()),
            ),
            (
                "vq_kinematic_small",
                TokenizerEntry::Vq(VqSettings::kinematic_small()),
            ),
        ] {
            assert_eq!(entry(name), settings, "{name}");
        }
    }

    #[test]
    fn an_unknown_key_of_an_entry_is_refused() {
        let value = serde_json::json!({"family": "vq", "code_book": 3});
        let message = serde_json::from_value::<TokenizerEntry>(value)
            .unwrap_err()
            .to_string();
        assert!(message.contains("code_book"), "{message}");
    }
}
