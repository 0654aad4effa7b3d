//! `op: clips`: makes clips by split and stores them in shards, from the built-in world or from recordings.
//!
//! `<split>/<modality>/<data set>/shard-000000.tar`, see [`crate::clip::store`]. A shard that is complete survives an
//! interruption. Clip `i` of a split of the world is the same whatever the other numbers are.

mod settings;
mod splits;

pub use settings::{ClipsSettings, SourceSettings};

use settings::MARKERS;
use splits::{deliver, parts, refused};

use super::modality_entry::{self, DEFAULTS};
use crate::datasets::convert::{ConvertSettings, Share, convert};
use crate::datasets::shards::TarSink;
use crate::experiment::artifact::{ArtifactKind, Description, SignalFacts};
use crate::experiment::context::{StageContext, StageError};
use crate::experiment::problem::{Code, Problem};
use crate::experiment::stage::{Inputs, Op, OpEntry, Port, StagePlan};
use crate::modality::{self, Modality, Shape};
use serde_json::{Value, json};
use std::collections::BTreeMap;
use std::ops::ControlFlow;

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
        4
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

    fn data(&self, settings: &ClipsSettings) -> Vec<(String, String)> {
        let data = settings.source.settings.data.clone();
        data.map(|name| (name, "source.data".to_owned()))
            .into_iter()
            .collect()
    }

    fn optional_data(&self, settings: &ClipsSettings) -> Vec<(String, String)> {
        let mano = settings.source.settings.mano();
        mano.map(|name| (name.to_owned(), "source.mano".to_owned()))
            .into_iter()
            .collect()
    }

    fn check(
        &self,
        settings: &ClipsSettings,
        _inputs: &Inputs<'_>,
        problems: &mut Vec<Problem>,
    ) -> Description {
        let source = &settings.source.settings;
        if source.data.is_some() {
            if let Err(error) = source.cut.check() {
                problems.push(Problem::new(Code::E0202, "source.cut", error.to_string()));
            }
            if let Some((key, reason)) = source.split.problem() {
                problems.push(Problem::new(
                    Code::E0202,
                    format!("source.split.{key}"),
                    reason,
                ));
            }
        } else if let Some((key, reason)) = source.world.problem() {
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
            let from_world = source.data.is_none();
            for mut problem in modality_entry::problems(entry, from_world) {
                problem.key = format!("declared.{i}{}", problem.key);
                problems.push(problem);
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
            extra: BTreeMap::from([
                ("format".to_owned(), json!(format)),
                (DEFAULTS.to_owned(), json!(settings.defaults())),
            ]),
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
            core_seconds: settings.core_seconds().map(|each| each * clips as f64),
            memory: Some(settings.clip_bytes() * 4 * rayon::current_num_threads() as u64),
            ..StagePlan::default()
        }
    }

    fn run(
        &self,
        settings: &ClipsSettings,
        context: &mut dyn StageContext,
    ) -> Result<Value, StageError> {
        let format = settings.format();
        let parts = parts(settings, &format, context)?;
        let total: u64 = parts.iter().map(|(_, source)| source.len() as u64).sum();
        let how = ConvertSettings {
            clips_per_shard: settings.clips_per_shard() as usize,
            skip_damaged: settings.source.settings.skip_damaged,
        };
        let mut done = 0;
        let mut splits = serde_json::Map::new();
        let mut remarks: Vec<String> = Vec::new();
        let mut name = "world".to_owned();
        if let Some((_, source)) = parts.first() {
            for (note, count) in source.notes() {
                context.log(&format!("{note} ({count} recordings)"));
            }
            for excluded in source.excluded() {
                context.log(&format!(
                    "left out: `{}`: {}",
                    excluded.recording, excluded.reason
                ));
            }
        }
        for (split, source) in &parts {
            source.name().clone_into(&mut name);
            let folder = context.checkpoints().join("clips").join(split);
            let sink = TarSink::new(&folder, &folder.join(MARKERS)).map_err(refused)?;
            let converted = convert(
                source.as_ref(),
                &sink,
                &how,
                Share::WHOLE,
                &mut |progress| {
                    context.progress(done + progress.done as u64, total, "clips");
                    if context.interrupted() {
                        return ControlFlow::Break(());
                    }
                    ControlFlow::Continue(())
                },
            )
            .map_err(refused)?;
            if converted.interrupted {
                return Err(StageError::Interrupted);
            }
            done += source.len() as u64;
            let tally = converted.tally;
            for remark in tally.remarks() {
                context.log(&format!("{split}: {remark}"));
                remarks.push(format!("{split}: {remark}"));
            }
            for (note, _) in source.notes() {
                if !remarks.contains(&note) {
                    remarks.push(note);
                }
            }
            for excluded in source.excluded() {
                let text = format!("excluded: `{}`: {}", excluded.recording, excluded.reason);
                if !remarks.contains(&text) {
                    remarks.push(text);
                }
            }
            if tally.clips == 0 {
                return Err(StageError::Input {
                    code: Code::E0601,
                    message: format!("not one clip for `{split}`"),
                    help: "`reviv data inspect` shows what is there and why clips are dropped"
                        .to_owned(),
                });
            }
            let mut account = json!({
                "clips": tally.clips, "shards": converted.shards, "dropped": tally.dropped,
                "damaged": tally.damaged,
            });
            if !tally.lost.is_empty() {
                account["lost"] = json!(tally.lost);
            }
            splits.insert((*split).to_owned(), account);
        }
        for (split, _, _) in settings.splits() {
            let folder = context.checkpoints().join("clips").join(split);
            deliver(&folder, &context.output().join(split))?;
        }
        let mut contents = json!({
            "source": name, "format": format, "splits": splits, (DEFAULTS): settings.defaults(),
        });
        if !remarks.is_empty() {
            let list = format!("* {}\n", remarks.join("\n* "));
            let report = context.output().join("report");
            std::fs::create_dir_all(&report).map_err(StageError::other)?;
            std::fs::write(report.join("remarks.md"), list).map_err(StageError::other)?;
            contents["remarks"] = json!(remarks);
        }
        Ok(contents)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::clip::store::ClipSet;
    use crate::experiment::context::InputArtifact;
    use crate::modality::ClipFormat;
    use std::path::Path;
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
