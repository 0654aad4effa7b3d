//! `op: clips`: makes clips by split and stores them in shards.
//!
//! `<split>/<modality>/<data set>/shard-000000.tar`, see [`crate::clip::store`]. A shard that is complete survives an
//! interruption. Clip `i` of a split is the same whatever the other numbers are.

use crate::clip::shard::ShardError;
use crate::clip::{Clip, depth_video::DepthCoding, store};
use crate::experiment::artifact::{ArtifactKind, Description, SignalFacts};
use crate::experiment::context::{StageContext, StageError};
use crate::experiment::entry::{Entry, Kind, KindEntry};
use crate::experiment::problem::{Code, Problem};
use crate::experiment::stage::{Inputs, Op, OpEntry, Port, StagePlan};
use crate::modality::{self, ClipFormat, DeclaredSettings, Modality, Shape};
use crate::source::world::{World, WorldSettings};
use rayon::prelude::*;
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use serde_json::{Value, json};
use std::collections::BTreeMap;
use std::path::Path;

/// Where clips come from: a registry entry of kind `source`.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct SourceSettings {
    /// The built-in synthetic world.
    pub world: WorldSettings,
}

impl Kind for SourceSettings {
    const KIND: &'static str = "source";
    const ABOUT: &'static str = "Where clips come from: the built-in world.";
}

impl Kind for DeclaredSettings {
    const KIND: &'static str = "modality";
    const ABOUT: &'static str = "Signals beyond the built-in ones, declared in YAML.";
}

inventory::submit! { KindEntry::of::<SourceSettings>() }
inventory::submit! { KindEntry::of::<DeclaredSettings>() }

/// Settings of `op: clips`.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct ClipsSettings {
    /// Where the clips come from.
    pub source: Entry<SourceSettings>,
    /// Clips to train on.
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
    pub declared: Vec<Entry<DeclaredSettings>>,
}

/// The first clip number of each split: far apart, so that the size of one split never changes another.
const SPLITS: [(&str, u64); 3] = [
    ("train", 0),
    ("validation", 1_000_000_000),
    ("test", 2_000_000_000),
];

/// Sensors of the built-in world that a declared modality can be fed from.
const WORLD_SENSORS: [&str; 1] = ["head_imu"];

impl ClipsSettings {
    fn count(&self, split: &str) -> u64 {
        match split {
            "train" => self.train,
            "validation" => self.validation,
            _ => self.test,
        }
    }

    /// The splits that are not empty: name, first clip number, clips.
    fn splits(&self) -> impl Iterator<Item = (&'static str, u64, u64)> + '_ {
        SPLITS
            .into_iter()
            .map(|(name, first)| (name, first, self.count(name)))
            .filter(|(_, _, count)| *count > 0)
    }

    /// The sizes of the clips.
    pub fn format(&self) -> ClipFormat {
        let declared = self.declared.iter().map(|entry| DeclaredSettings {
            name: entry.name.clone(),
            ..entry.settings.clone()
        });
        ClipFormat {
            depth: self.depth,
            declared: declared.collect(),
            ..self.source.settings.world.format()
        }
    }

    /// Bytes of one clip on disk.
    fn clip_bytes(&self) -> u64 {
        let world = &self.source.settings.world;
        let pixels = u64::from(world.size).pow(2) * world.frames as u64;
        pixels * 7 + 80_000
    }

    /// Shards of about 64 MB.
    fn clips_per_shard(&self) -> u64 {
        ((64 << 20) / self.clip_bytes()).clamp(8, 500)
    }
}

/// The shape of a modality's values.
pub fn shape_of(modality: &dyn Modality) -> Vec<usize> {
    match modality.shape() {
        Shape::Temporal { samples, channels } => vec![samples, channels],
        Shape::Kinematic { samples, joints } => vec![samples, joints, 3],
        Shape::Video {
            frames,
            height,
            width,
        } => vec![frames, height, width, 3],
    }
}

/// The op.
pub struct Clips;

inventory::submit! { OpEntry(&Clips) }

impl Op for Clips {
    type Settings = ClipsSettings;

    fn name(&self) -> &'static str {
        "clips"
    }

    fn version(&self) -> u32 {
        1
    }

    fn about(&self) -> &'static str {
        "Makes two-second clips of synchronised signals, by split."
    }

    fn inputs(&self) -> &'static [Port] {
        &[]
    }

    fn output(&self) -> ArtifactKind {
        ArtifactKind::Clips
    }

    fn check(
        &self,
        settings: &ClipsSettings,
        _inputs: &Inputs<'_>,
        problems: &mut Vec<Problem>,
    ) -> Description {
        if let Some((key, reason)) = settings.source.settings.world.problem() {
            problems.push(Problem::new(
                Code::E0202,
                format!("source.world.{key}"),
                reason,
            ));
        }
        if let Some(reason) = settings.depth.problem() {
            problems.push(Problem::new(Code::E0206, "depth", reason));
        }
        for (i, entry) in settings.declared.iter().enumerate() {
            if let Some((key, reason)) = entry.settings.problem() {
                problems.push(Problem::new(
                    Code::E0206,
                    format!("declared.{i}.{key}"),
                    reason,
                ));
            }
            let sensor = sensor_of(&entry.name, &entry.settings);
            if !WORLD_SENSORS.contains(&sensor) {
                let message = format!("the built-in world has no sensor `{sensor}`");
                let help = format!(
                    "it has {}",
                    WORLD_SENSORS.map(|s| format!("`{s}`")).join(", ")
                );
                problems
                    .push(Problem::new(Code::E0203, format!("declared.{i}"), message).help(help));
            }
        }
        if settings.splits().next().is_none() {
            let problem = Problem::new(Code::E0204, "", "no clips are asked for");
            problems.push(problem.help("give `train:`, `validation:` or `test:` a number"));
        }
        let format = settings.format();
        let signals = modality::all(&format);
        Description {
            clips: settings
                .splits()
                .map(|(name, _, count)| (name.to_owned(), count))
                .collect(),
            signals: signals
                .iter()
                .map(|m| {
                    let facts = SignalFacts {
                        shape: shape_of(m.as_ref()),
                        rate: m.rate(),
                    };
                    (m.name().to_owned(), facts)
                })
                .collect(),
            extra: BTreeMap::from([("format".to_owned(), json!(format))]),
            ..Description::default()
        }
    }

    fn plan(&self, settings: &ClipsSettings, _inputs: &Inputs<'_>, _seed: u64) -> StagePlan {
        let clips: u64 = settings.splits().map(|(_, _, count)| count).sum();
        StagePlan {
            shapes: modality::all(&settings.format())
                .iter()
                .map(|m| (m.name().to_owned(), shape_of(m.as_ref())))
                .collect(),
            work: Some((clips, "clips".to_owned())),
            disk: Some(clips * settings.clip_bytes()),
            memory: Some(settings.clip_bytes() * 4 * rayon::current_num_threads() as u64),
            ..StagePlan::default()
        }
    }

    fn run(
        &self,
        settings: &ClipsSettings,
        context: &mut dyn StageContext,
    ) -> Result<Value, StageError> {
        let world = World::new(settings.source.settings.world.clone(), context.seed());
        let total: u64 = settings.splits().map(|(_, _, count)| count).sum();
        let format = settings.format();
        let mut done = 0;
        let mut splits = serde_json::Map::new();
        for (split, first, count) in settings.splits() {
            let folder = context.checkpoints().join("clips").join(split);
            std::fs::create_dir_all(&folder).map_err(StageError::io(&folder))?;
            let per_shard = settings.clips_per_shard();
            let shards = count.div_ceil(per_shard);
            for shard in 0..shards {
                let from = shard * per_shard;
                let to = (from + per_shard).min(count);
                let marker = folder.join(format!("shard-{shard:06}.done"));
                if !marker.exists() {
                    let clips = Generation {
                        world: &world,
                        format: &format,
                        context: &mut *context,
                        next: first + from,
                        end: first + to,
                        ready: Vec::new().into_iter(),
                        done,
                        total,
                    };
                    store::write_clips(&folder, shard as u32, clips)
                        .map_err(|Failure(error)| error)?;
                    std::fs::write(&marker, b"").map_err(StageError::io(&marker))?;
                }
                done += to - from;
                context.progress(done, total, "clips");
            }
            splits.insert(
                split.to_owned(),
                json!({ "clips": count, "shards": shards }),
            );
        }
        for (split, _, _) in settings.splits() {
            let folder = context.checkpoints().join("clips").join(split);
            deliver(&folder, &context.output().join(split))?;
        }
        Ok(json!({ "source": "world", "format": format, "splits": splits }))
    }
}

fn sensor_of<'a>(name: &'a str, settings: &'a DeclaredSettings) -> &'a str {
    settings.source.world.as_deref().unwrap_or(name)
}

/// A [`StageError`] that shard errors turn into.
struct Failure(StageError);

impl From<ShardError> for Failure {
    fn from(error: ShardError) -> Self {
        Self(StageError::other(error))
    }
}

/// Clips made a few at a time on all cores, handed out in order: memory does not grow with their number.
struct Generation<'a> {
    world: &'a World,
    format: &'a ClipFormat,
    context: &'a mut dyn StageContext,
    next: u64,
    end: u64,
    ready: std::vec::IntoIter<Clip>,
    done: u64,
    total: u64,
}

impl Iterator for Generation<'_> {
    type Item = Result<Clip, Failure>;

    fn next(&mut self) -> Option<Self::Item> {
        if let Some(clip) = self.ready.next() {
            return Some(Ok(clip));
        }
        if self.next >= self.end {
            return None;
        }
        if self.context.interrupted() {
            self.next = self.end;
            return Some(Err(Failure(StageError::Interrupted)));
        }
        let batch = (2 * rayon::current_num_threads() as u64).min(self.end - self.next);
        let clips: Vec<Clip> = (0..batch as usize)
            .into_par_iter()
            .map(|i| self.world.clip(self.next + i as u64))
            .map(|clip| keep_declared(clip, self.format))
            .collect();
        self.next += batch;
        self.done += batch;
        self.context.progress(self.done, self.total, "clips");
        self.ready = clips.into_iter();
        self.ready.next().map(Ok)
    }
}

/// Gives each declared modality the world's sensor it asks for.
fn keep_declared(mut clip: Clip, format: &ClipFormat) -> Clip {
    let sensors = std::mem::take(&mut clip.declared);
    for declared in &format.declared {
        if let Some(signal) = sensors.get(sensor_of(&declared.name, declared)) {
            clip.declared.insert(declared.name.clone(), signal.clone());
        }
    }
    clip
}

/// Moves finished shards to where the artifact is written.
fn deliver(from: &Path, to: &Path) -> Result<(), StageError> {
    for entry in std::fs::read_dir(from).map_err(StageError::io(from))? {
        let path = entry.map_err(StageError::io(from))?.path();
        if path.extension().is_some_and(|e| e == "done") {
            continue;
        }
        std::fs::create_dir_all(to).map_err(StageError::io(to))?;
        let target = to.join(path.file_name().unwrap_or_default());
        if std::fs::rename(&path, &target).is_err() {
            copy(&path, &target)?;
        }
    }
    // The shards are gone from here: their markers must not outlive them.
    std::fs::remove_dir_all(from).map_err(StageError::io(from))
}

fn copy(from: &Path, to: &Path) -> Result<(), StageError> {
    if from.is_dir() {
        std::fs::create_dir_all(to).map_err(StageError::io(to))?;
        for entry in std::fs::read_dir(from).map_err(StageError::io(from))? {
            let path = entry.map_err(StageError::io(from))?.path();
            copy(&path, &to.join(path.file_name().unwrap_or_default()))?;
        }
        return Ok(());
    }
    std::fs::copy(from, to)
        .map(|_| ())
        .map_err(StageError::io(from))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::clip::store::ClipSet;
    use crate::experiment::context::InputArtifact;
    use std::path::PathBuf;

    struct Context {
        output: PathBuf,
        checkpoints: PathBuf,
        interrupt_after: Option<u64>,
        seen: u64,
    }

    impl StageContext for Context {
        fn stage(&self) -> &'static str {
            "clips"
        }
        fn inputs(&self, _port: &str) -> &[InputArtifact] {
            &[]
        }
        fn output(&self) -> &Path {
            &self.output
        }
        fn checkpoints(&self) -> &Path {
            &self.checkpoints
        }
        fn seed(&self) -> u64 {
            3
        }
        fn data_root(&self, _name: &str) -> Option<&Path> {
            None
        }
        fn record(&mut self, _step: u64, _scalars: &[(&str, f64)]) -> Result<(), StageError> {
            Ok(())
        }
        fn record_text(&mut self, _step: u64, _name: &str, _text: &str) -> Result<(), StageError> {
            Ok(())
        }
        fn record_histogram(
            &mut self,
            _step: u64,
            _name: &str,
            _values: &[f32],
        ) -> Result<(), StageError> {
            Ok(())
        }
        fn progress(&mut self, done: u64, _total: u64, _unit: &str) {
            self.seen = done;
        }
        fn log(&mut self, _line: &str) {}
        fn interrupted(&self) -> bool {
            self.interrupt_after.is_some_and(|n| self.seen >= n)
        }
    }

    fn settings() -> ClipsSettings {
        serde_json::from_value(json!({
            "source": {"use": "world_small", "world": {"size": 8, "rooms": 4}},
            "train": 12,
            "validation": 3,
            "declared": [{"use": "head_imu", "signal": {
                "channels": ["ax", "ay", "az", "gx", "gy", "gz"], "units": ["si"]
            }}],
        }))
        .unwrap()
    }

    fn context(folder: &Path) -> Context {
        let place = |name: &str| {
            let path = folder.join(name);
            std::fs::create_dir_all(&path).unwrap();
            path
        };
        Context {
            output: place("output"),
            checkpoints: place("checkpoints"),
            interrupt_after: None,
            seen: 0,
        }
    }

    #[test]
    fn splits_are_stored_with_every_modality() {
        let folder = tempfile::tempdir().unwrap();
        let mut context = context(folder.path());
        let contents = Clips.run(&settings(), &mut context).unwrap();
        assert_eq!(contents["splits"]["train"]["clips"], 12);
        let train = ClipSet::open(&context.output.join("train")).unwrap();
        assert_eq!(train.len(), 12);
        assert_eq!(train.ids()[3], "world/000003");
        let clip = train.clip(3).unwrap();
        let format: ClipFormat = serde_json::from_value(contents["format"].clone()).unwrap();
        let names: Vec<String> = modality::all(&format)
            .iter()
            .filter(|m| {
                m.extract(&clip)
                    .unwrap()
                    .is_some_and(|s| s.values.shape() == shape_of(m.as_ref()))
            })
            .map(|m| m.name().to_owned())
            .collect();
        assert!(
            names.len() >= 6 && names.contains(&"head_imu".to_owned()),
            "{names:?}"
        );
        let validation = ClipSet::open(&context.output.join("validation")).unwrap();
        assert_eq!(validation.ids()[0], "world/1000000000");
    }

    #[test]
    fn an_interrupted_stage_goes_on_and_gives_the_same_bytes() {
        let (a, b) = (tempfile::tempdir().unwrap(), tempfile::tempdir().unwrap());
        let mut settings = settings();
        settings.source.settings.world.size = 8;
        Clips.run(&settings, &mut context(a.path())).unwrap();
        let mut stopped = context(b.path());
        stopped.interrupt_after = Some(1);
        assert!(matches!(
            Clips.run(&settings, &mut stopped),
            Err(StageError::Interrupted)
        ));
        stopped.interrupt_after = None;
        Clips.run(&settings, &mut stopped).unwrap();
        let tar = "output/train/body/world/shard-000000.tar";
        assert_eq!(
            std::fs::read(a.path().join(tar)).unwrap(),
            std::fs::read(b.path().join(tar)).unwrap()
        );
    }

    #[test]
    fn what_cannot_be_made_is_said_before_anything_runs() {
        let mut settings = settings();
        settings.train = 0;
        settings.validation = 0;
        settings.source.settings.world.size = 4;
        settings.declared[0].name = "heart_rate".to_owned();
        let mut problems = Vec::new();
        Clips.check(&settings, &Inputs::default(), &mut problems);
        let keys: Vec<&str> = problems.iter().map(|p| p.key.as_str()).collect();
        assert_eq!(keys, ["source.world.size", "declared.0", ""]);
    }
}
