//! Which of a model's two kinds of video a clip goes through. A released model of the 512 pathway carries the video of both, under
//! names of its own; clips have one, and it is `rgb`, `depth` and `pixels` there.

use crate::decoding::DecodingSettings;
use crate::masking::PIXELS;
use crate::mget::MgetSpec;
use crate::modality::ClipFormat;
use std::borrow::Cow;

/// What the names of the 512 pathway's video end with.
const WIDE: &str = "_512";
const PICTURES: [&str; 3] = ["rgb", "depth", PIXELS];

/// The names that a model gives to the video of its clips.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Pathway {
    /// The same as the clips do.
    Own,
    /// With `_512` behind them.
    Wide,
}

impl Pathway {
    /// Of a model for clips of `format`: the clips of the 512 pathway have depth in metres.
    pub fn of(spec: &MgetSpec, format: &ClipFormat) -> Self {
        let wide = spec.modalities.iter().any(|slot| slot.name.ends_with(WIDE));
        if wide && format.depth == crate::clip::depth_video::DepthCoding::metric() {
            Self::Wide
        } else {
            Self::Own
        }
    }

    /// What the model calls a modality of the clips.
    pub fn slot(self, modality: &str) -> Cow<'_, str> {
        if self == Self::Wide && PICTURES.contains(&modality) {
            Cow::Owned(format!("{modality}{WIDE}"))
        } else {
            Cow::Borrowed(modality)
        }
    }

    /// What the clips call a modality of the model; `None` for video of the other pathway.
    pub fn modality(self, slot: &str) -> Option<&str> {
        if self == Self::Own {
            return Some(slot);
        }
        match slot.strip_suffix(WIDE) {
            Some(name) if PICTURES.contains(&name) => Some(name),
            _ => (!PICTURES.contains(&slot)).then_some(slot),
        }
    }

    /// Decoding settings by the model's names.
    pub fn decoding(self, settings: &DecodingSettings) -> Cow<'_, DecodingSettings> {
        if self == Self::Own {
            return Cow::Borrowed(settings);
        }
        let mut own = settings.clone();
        let rename = |name: &mut String| *name = self.slot(name).into_owned();
        own.chains.iter_mut().flatten().for_each(rename);
        own.uncond_drop.iter_mut().flatten().for_each(rename);
        own.targets = std::mem::take(&mut own.targets)
            .into_iter()
            .map(|(name, changes)| (self.slot(&name).into_owned(), changes))
            .collect();
        Cow::Owned(own)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::clip::depth_video::DepthCoding;
    use crate::mget::{ModalitySpec, Positions, Size};

    #[test]
    fn clips_of_the_wide_pathway_meet_its_names_and_no_others() {
        let spec = MgetSpec {
            size: Size::LAPTOP_SMALL,
            positions: Positions::Released,
            modalities: ["rgb", "rgb_512", "depth_512"]
                .map(|name| ModalitySpec::tokens(name, &[5, 32, 32], 64_000))
                .to_vec(),
        };
        let narrow = ClipFormat::default();
        assert_eq!(Pathway::of(&spec, &narrow), Pathway::Own);
        let format = ClipFormat {
            depth: DepthCoding::metric(),
            ..narrow
        };
        let wide = Pathway::of(&spec, &format);
        assert_eq!(
            (wide.slot("rgb"), wide.slot("body")),
            ("rgb_512".into(), "body".into())
        );
        assert_eq!(wide.modality("depth_512"), Some("depth"));
        assert_eq!(
            (wide.modality("rgb"), wide.modality("gaze")),
            (None, Some("gaze"))
        );
        let settings = DecodingSettings {
            chains: vec![vec!["depth".into(), "body".into()]],
            ..DecodingSettings::default()
        };
        assert_eq!(wide.decoding(&settings).chains, [["depth_512", "body"]]);
    }
}
