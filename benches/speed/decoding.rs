//! Generation with the tiny MGET: camera, gaze and body of one clip from its video tokens, as two shipped presets do it.

use crate::measure::Meter;
use crate::mget;
use reviv::decoding::{DecodingSettings, MgetTokens, Sample, Slot, generate};
use serde_json::{Map, Value};

/// One encoder pass for all targets, every token at once, no guidance.
pub const FAST: &str = include_str!("../../registry/decoding/fast.yaml");

/// Every target by itself, three steps, guidance 2.
pub const RELEASE: &str = include_str!("../../registry/decoding/release.yaml");

/// What a registry entry holds besides its name.
fn settings(entry: &str) -> DecodingSettings {
    let mut entry: Map<String, Value> =
        serde_saphyr::from_str(entry).expect("shipped entries are YAML");
    entry.remove("decoding");
    entry.remove("about");
    serde_json::from_value(Value::Object(entry)).expect("shipped entries are valid")
}

pub fn run(meter: &Meter, entry: &str) {
    let settings = settings(entry);
    let spec = mget::spec(mget::TINY);
    let model = mget::model(&spec);
    let tokens = MgetTokens::new(&model);
    let slots = spec
        .modalities
        .iter()
        .zip(mget::ids(&spec, 0))
        .map(|(modality, ids)| match modality.name.as_str() {
            "rgb" => Slot::input(ids),
            _ => Slot::masked(modality.count()),
        })
        .collect();
    let clip = [Sample { id: 0, slots }];
    meter.measure("generate", || {
        let generated = generate(&tokens, &settings, &clip, &["camera", "gaze", "body"], 0);
        std::hint::black_box(generated.expect("the clip fits the model"));
    });
}
