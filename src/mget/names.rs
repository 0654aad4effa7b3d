//! The release's names: what its checkpoints call our modalities and which entries they hold besides our parameters.
//!
//! Below the modality, our parameters bear the release's names, so the map is one of modality names alone.

use super::spec::MgetSpec;

/// Our modality names and the release's.
pub const MODALITIES: [(&str, &str); 12] = [
    ("body", "tok_body"),
    ("camera", "tok_cam"),
    ("caption", "tok_caption"),
    ("depth", "tok_depth"),
    ("depth_512", "tok_depth_512"),
    ("gaze", "tok_gaze"),
    ("left_hand", "tok_lhand"),
    ("pixels", "rgb@256"),
    ("pixels_512", "rgb512"),
    ("rgb", "tok_rgb"),
    ("rgb_512", "tok_rgb_512"),
    ("right_hand", "tok_rhand"),
];

/// The release's name of a modality.
#[must_use]
pub fn modality_to_release(name: &str) -> Option<&'static str> {
    MODALITIES
        .iter()
        .find(|(ours, _)| *ours == name)
        .map(|(_, theirs)| *theirs)
}

/// Our name of a modality of the release.
#[must_use]
pub fn modality_from_release(name: &str) -> Option<&'static str> {
    MODALITIES
        .iter()
        .find(|(_, theirs)| *theirs == name)
        .map(|(ours, _)| *ours)
}

/// The release's name of a parameter; unknown modalities keep their name.
#[must_use]
pub fn to_release(name: &str) -> String {
    map(name, modality_to_release)
}

/// Our name of a checkpoint entry; unknown modalities keep their name.
#[must_use]
pub fn from_release(name: &str) -> String {
    map(name, modality_from_release)
}

fn map(name: &str, modality: fn(&str) -> Option<&'static str>) -> String {
    let mut parts: Vec<&str> = name.splitn(3, '.').collect();
    if let ["encoder_embeddings" | "decoder_embeddings", middle, _] = parts.as_mut_slice()
        && let Some(mapped) = modality(middle)
    {
        *middle = mapped;
    }
    parts.join(".")
}

/// What a checkpoint entry is.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Entry {
    /// A parameter.
    Parameter,
    /// A fixed table: position codes, or the zero bias of a norm.
    Buffer,
    /// A second name of the entry given.
    Alias(String),
}

/// Every entry of the release's checkpoint of such a model: name, shape and kind, in no particular order.
///
/// Shapes are the release's: vectors that are added to tokens have two leading ones.
#[must_use]
pub fn release_entries(spec: &MgetSpec) -> Vec<(String, Vec<usize>, Entry)> {
    let width = spec.size.width;
    let mut entries = Vec::new();
    for (name, shape) in spec.parameters() {
        let shape = if name == "mask_token" || name.ends_with(".mod_emb") {
            vec![1, 1, width]
        } else {
            shape
        };
        let name = to_release(&name);
        let norm = name.strip_suffix(".weight").filter(|path| {
            path.rsplit('.')
                .next()
                .is_some_and(|last| last.contains("norm"))
        });
        if let Some(path) = norm {
            entries.push((format!("{path}.bias"), shape.clone(), Entry::Buffer));
        }
        entries.push((name, shape, Entry::Parameter));
    }
    for modality in &spec.modalities {
        let theirs = modality_to_release(&modality.name).unwrap_or(&modality.name);
        let positions = vec![1, modality.count(), width];
        let encoder = format!("encoder_embeddings.{theirs}");
        entries.push((
            format!("{encoder}.pos_emb"),
            positions.clone(),
            Entry::Buffer,
        ));
        if let Some(vocabulary) = modality.vocabulary() {
            let decoder = format!("decoder_embeddings.{theirs}");
            let table = vec![vocabulary, width];
            entries.push((format!("{decoder}.pos_emb"), positions, Entry::Buffer));
            entries.push((
                format!("{decoder}.mod_emb"),
                vec![1, 1, width],
                Entry::Alias(format!("{encoder}.mod_emb")),
            ));
            entries.push((
                format!("{decoder}.to_logits.weight"),
                table,
                Entry::Alias(format!("{decoder}.token_emb.weight")),
            ));
        }
    }
    entries
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn names_map_there_and_back() {
        for (ours, theirs) in [
            (
                "encoder_embeddings.pixels.proj.weight",
                "encoder_embeddings.rgb@256.proj.weight",
            ),
            (
                "decoder_embeddings.camera.token_emb.weight",
                "decoder_embeddings.tok_cam.token_emb.weight",
            ),
            (
                "encoder_embeddings.head_imu.mod_emb",
                "encoder_embeddings.head_imu.mod_emb",
            ),
            ("decoder.3.norm1.weight", "decoder.3.norm1.weight"),
            ("mask_token", "mask_token"),
        ] {
            assert_eq!(to_release(ours), theirs);
            assert_eq!(from_release(theirs), ours);
        }
    }
}
