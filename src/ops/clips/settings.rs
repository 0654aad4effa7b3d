//! What an experiment says of its clips.

use crate::clip::depth_video::DepthCoding;
use crate::datasets::open::{Dataset, HandModel};
use crate::datasets::recording::CutSettings;
use crate::datasets::split::SplitSettings;
use crate::experiment::entry::{Entry, Kind, KindEntry};
use crate::modality::ClipFormat;
use crate::ops::modality_entry::{self, Defaults, ModalityEntry};
use crate::world::WorldSettings;
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

/// Where clips come from: a registry entry of kind `source`.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct SourceSettings {
    /// The built-in synthetic world, where no `data` is named.
    pub world: WorldSettings,
    /// A data set of `data.yaml` instead of the world: recordings, videos, or clips that were converted before.
    pub data: Option<String>,
    /// What lies there; left out: what it looks like.
    pub dataset: Option<Dataset>,
    /// The folder of `data.yaml` with the MANO models; left out: `mano`. Sets whose hands are MANO parameters go without hands where it
    /// is not there.
    pub mano: Option<String>,
    /// Which model gives a hand its joints, where a data set has the parameters of both.
    pub hands: HandModel,
    /// How clips are cut from recordings.
    pub cut: CutSettings,
    /// Which recordings are for training, which for validation and which for the test.
    pub split: SplitSettings,
    /// Leave out clips whose files are damaged instead of stopping at the first one.
    pub skip_damaged: bool,
}

impl SourceSettings {
    /// The name in `data.yaml` of the MANO models, for sets that may need them.
    pub fn mano(&self) -> Option<&str> {
        let needed = self.data.is_some() && HandModel::may_need_mano(self.dataset);
        needed.then(|| self.mano.as_deref().unwrap_or("mano"))
    }

    /// The sizes of the clips.
    pub fn format(&self) -> ClipFormat {
        match self.data {
            Some(_) => self.cut.format(),
            None => self.world.format(),
        }
    }
}

impl Kind for SourceSettings {
    const KIND: &'static str = "source";
    const ABOUT: &'static str = "Where clips come from: the built-in world, or recordings.";
}

inventory::submit! { KindEntry::of::<SourceSettings>() }

/// Settings of `op: clips`.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct ClipsSettings {
    /// Where the clips come from.
    pub source: Entry<SourceSettings>,
    /// Clips to train on; from recordings at most so many.
    #[serde(default)]
    pub train: u64,
    /// Clips to watch training with.
    #[serde(default)]
    pub validation: u64,
    /// Clips that nothing was tuned on.
    #[serde(default)]
    pub test: u64,
    /// How depth becomes video.
    #[serde(default)]
    pub depth: DepthCoding,
    /// Modalities beyond the built-in ones, by registry name.
    #[serde(default)]
    pub declared: Vec<Entry<ModalityEntry>>,
}

/// The first clip number of each split: far apart, so that the size of one split never changes another.
pub(super) const SPLITS: [(&str, u64); 3] = [
    ("train", 0),
    ("validation", 1_000_000_000),
    ("test", 2_000_000_000),
];

/// Where the markers of finished shards are while a stage runs.
pub(super) const MARKERS: &str = ".finished";

impl ClipsSettings {
    pub(super) fn count(&self, split: &str) -> u64 {
        match split {
            "train" => self.train,
            "validation" => self.validation,
            _ => self.test,
        }
    }

    /// The splits that are not empty: name, first clip number, clips.
    pub(super) fn splits(&self) -> impl Iterator<Item = (&'static str, u64, u64)> + '_ {
        SPLITS
            .into_iter()
            .map(|(name, first)| (name, first, self.count(name)))
            .filter(|(_, _, count)| *count > 0)
    }

    /// The sizes of the clips.
    pub fn format(&self) -> ClipFormat {
        let declared = self.declared.iter().map(modality_entry::declared);
        ClipFormat {
            depth: self.depth,
            declared: declared.collect(),
            ..self.source.settings.format()
        }
    }

    /// What later stages do with declared modalities where they are not told otherwise.
    pub(super) fn defaults(&self) -> Defaults {
        modality_entry::defaults(&self.declared)
    }

    /// Bytes of one clip on disk.
    pub(super) fn clip_bytes(&self) -> u64 {
        let format = self.source.settings.format();
        (format.size * format.size * format.frames * 7) as u64 + 80_000
    }

    /// Seconds of one core that a clip of recordings takes, nearly all of it decoding. An assumption: `cargo bench -p reviv-data --bench
    /// sets` measures what a data set takes.
    pub(super) fn core_seconds(&self) -> Option<f64> {
        self.source.settings.data.as_ref().map(|_| 1.0)
    }

    /// Shards of about 64 MB.
    pub(super) fn clips_per_shard(&self) -> u64 {
        ((64 << 20) / self.clip_bytes()).clamp(8, 500)
    }
}
