//! `op: tokenize`: clips become token grids, once for all models that train on them (Sec. 4.2).
//!
//! Writes `<split>/<modality>/shard-000000.tar` as [`crate::training::shards`] reads them, `<split>/pixels/` with raw colour
//! video where it is asked for, and every tokenizer in `tokenizers/<modality>/`, so that what is trained on the tokens can be
//! used on its own. A clip without a modality, or with all of it invalid, has no member in that modality's shards. A shard
//! that is complete survives an interruption. Several ranks make a shard each at a time.

use super::clip_signals::{SPLITS, damaged, format, modality, open_split};
use super::device::{SMALLER_FORWARD, compute, memory_is_full};
use super::together::{in_rounds, unseen};
use crate::clip::shard::{ShardWriter, TOKENS_PER_SHARD};
use crate::clip::store::ClipSet;
use crate::datasets::shards::tars;
use crate::engine::{Communicator, DeviceChoice, Precision};
use crate::experiment::{
    Arity, ArtifactKind, Code, Description, Inputs, Op, OpEntry, Port, Problem, StageContext,
    StageError, StagePlan, TokenFacts, TokenPlan,
};
use crate::flow::Flow;
use crate::formats::ReadError;
use crate::formats::place;
use crate::masking::PIXELS;
use crate::modality::ClipFormat;
use crate::tokenizer;
use crate::training::TrainingError;
use crate::training::token_folder::{ModalityTokens, TokenHeader, write_shard};
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use serde_json::{Value, json};
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

/// Where the description of a tokenizer says how many seconds of one core a clip takes it.
pub(super) const ENCODE_SECONDS: &str = "encode_core_seconds";
/// The folder of the checkpoints where shards lie until all are finished.
const SHARDS: &str = "tokens";
/// The folder of the checkpoints with an empty file for every finished shard, `{split}-{number}`.
const MARKERS: &str = "tokens_done";

/// Whether raw video travels with the tokens.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "snake_case")]
pub enum RawVideo {
    /// Tokens alone.
    #[default]
    None,
    /// Colour video as bytes, for models that see pixels.
    Rgb,
}

/// Settings of [`Tokenize`].
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct TokenizeSettings {
    /// The modalities to tokenize; empty means all that have a tokenizer.
    pub modalities: Vec<String>,
    /// Raw video beside the tokens.
    pub pixels: RawVideo,
    /// Where the tokenizers run.
    pub device: DeviceChoice,
    /// The folder of `data.yaml` with the shards that `reviv data tokenize` made of the same clips with the same tokenizers: they are
    /// taken instead of made again.
    pub made: Option<String>,
}

impl TokenizeSettings {
    fn takes(&self, modality: &str) -> bool {
        self.modalities.is_empty() || self.modalities.iter().any(|name| name == modality)
    }
}

/// The op.
#[derive(Debug)]
pub struct Tokenize;
inventory::submit! { OpEntry(&Tokenize) }

impl Op for Tokenize {
    type Settings = TokenizeSettings;

    fn name(&self) -> &'static str {
        "tokenize"
    }

    fn version(&self) -> u32 {
        3
    }

    fn about(&self) -> &'static str {
        "Turns clips into token grids, by split and modality."
    }

    fn inputs(&self) -> &'static [Port] {
        &[
            Port {
                name: "clips",
                kinds: &[ArtifactKind::Clips],
                arity: Arity::One,
                about: "what to tokenize",
            },
            Port {
                name: "tokenizers",
                kinds: &[ArtifactKind::Tokenizer],
                arity: Arity::OneOrMore,
                about: "one per modality: a stage of `train_tokenizers`, or a list",
            },
        ]
    }

    fn output(&self) -> ArtifactKind {
        ArtifactKind::Tokens
    }

    fn seeded(&self) -> bool {
        false
    }

    fn together(&self) -> bool {
        true
    }

    fn data(&self, settings: &TokenizeSettings) -> Vec<(String, String)> {
        let made = settings.made.clone().into_iter();
        made.map(|name| (name, "made".to_owned())).collect()
    }

    fn check(
        &self,
        settings: &TokenizeSettings,
        inputs: &Inputs<'_>,
        problems: &mut Vec<Problem>,
    ) -> Description {
        let Some(clips) = inputs.one("clips") else {
            return Description::default();
        };
        let mut tokens: BTreeMap<String, TokenFacts> = BTreeMap::new();
        for (i, input) in inputs.all("tokenizers").iter().enumerate() {
            for (name, facts) in &input.description.tokens {
                let key = format!("tokenizers.{i}");
                let found = clips.signals.get(name);
                let fitted = input.description.signals.get(name);
                if let (Some(found), Some(fitted)) = (found, fitted)
                    && found.shape != fitted.shape
                {
                    problems.push(Problem::new(
                        Code::E0401,
                        &key,
                        format!(
                            "`{}` was trained on `{name}` of shape {:?}, the clips have {:?}",
                            input.stage, fitted.shape, found.shape
                        ),
                    ));
                }
                if found.is_none() {
                    problems.push(super::clip_signals::unknown_modality(key, name, clips));
                } else if tokens.insert(name.clone(), facts.clone()).is_some() {
                    let message = format!("two tokenizers of `{name}`");
                    problems.push(Problem::new(Code::E0205, key, message));
                }
            }
        }
        for (i, name) in settings.modalities.iter().enumerate() {
            if !tokens.contains_key(name) {
                let known: Vec<&str> = tokens.keys().map(String::as_str).collect();
                let message = format!("modality `{name}` has no tokenizer");
                problems.push(
                    Problem::new(Code::E0203, format!("modalities.{i}"), message)
                        .help(format!("there are tokenizers of: {}", known.join(", "))),
                );
            }
        }
        tokens.retain(|name, _| settings.takes(name));
        let mut extra = BTreeMap::new();
        if let Some(format) = clips.extra.get("format") {
            extra.insert("format".to_owned(), format.clone());
        }
        if settings.pixels == RawVideo::Rgb {
            match clips.signals.get("rgb") {
                Some(facts) => {
                    extra.insert(PIXELS.to_owned(), json!(facts.shape));
                }
                None => problems.push(Problem::new(
                    Code::E0401,
                    "pixels",
                    "the clips have no `rgb`",
                )),
            }
        }
        Description {
            clips: clips.clips.clone(),
            signals: clips.signals.clone(),
            tokens,
            extra,
            ..Description::default()
        }
    }

    fn plan(&self, settings: &TokenizeSettings, inputs: &Inputs<'_>, _seed: u64) -> StagePlan {
        let mut problems = Vec::new();
        let found = self.check(settings, inputs, &mut problems);
        let clips: u64 = found.clips.values().sum();
        let tokens: u64 = found.tokens.values().map(TokenFacts::count).sum();
        let pixels: u64 = match settings.pixels {
            RawVideo::None => 0,
            RawVideo::Rgb => found
                .signals
                .get("rgb")
                .map_or(0, |facts| facts.shape.iter().map(|n| *n as u64).product()),
        };
        // Eight bytes per token, and the headers of a member.
        let member = 8 * tokens + 2048 * found.tokens.len() as u64;
        StagePlan {
            tokens: found
                .tokens
                .iter()
                .map(|(name, facts)| TokenPlan {
                    modality: name.clone(),
                    tokens: facts.count(),
                    vocabulary: facts.vocabulary,
                    mean_input: None,
                    mean_target: None,
                })
                .collect(),
            work: Some((clips, "clips".to_owned())),
            disk: Some(clips * (member + pixels)),
            core_seconds: inputs
                .all("tokenizers")
                .iter()
                .map(|input| input.description.extra.get(ENCODE_SECONDS)?.as_f64())
                .sum::<Option<f64>>()
                .map(|each| each * clips as f64),
            ..StagePlan::default()
        }
    }

    fn explain_panic(&self, text: &str) -> Option<StageError> {
        memory_is_full(text, SMALLER_FORWARD)
    }

    fn run(
        &self,
        settings: &TokenizeSettings,
        context: &mut dyn StageContext,
    ) -> Result<Value, StageError> {
        let _memory = crate::engine::memory::Stage;
        let clips = context
            .inputs("clips")
            .first()
            .cloned()
            .ok_or_else(|| damaged("no clips arrived"))?;
        let format = format(&clips)?;
        let compute = compute(settings.device, Precision::F32, context)?;
        let ranks = Communicator::world();
        let mut writers = Vec::new();
        let mut tokens = BTreeMap::new();
        for artifact in context.inputs("tokenizers").to_vec() {
            let tokenizer = tokenizer::open(&artifact.path, &compute)
                .map_err(|error| damaged(&error.to_string()))?;
            let name = tokenizer.modality().to_owned();
            if !settings.takes(&name) {
                continue;
            }
            let modality = modality(&format, &name)
                .ok_or_else(|| damaged(&format!("the clips have no modality `{name}`")))?;
            let facts = TokenFacts {
                grid: tokenizer.grid().to_vec(),
                vocabulary: tokenizer.vocabulary() as u64,
            };
            tokens.insert(name.clone(), facts);
            if ranks.is_root() {
                let place = context.output().join("tokenizers").join(name);
                deliver(&artifact.path, &place, false)?;
            }
            writers.push(ModalityTokens {
                modality,
                tokenizer,
            });
        }
        let mut sets = Vec::new();
        for split in SPLITS {
            if let Some(set) = open_split(&clips.path, split)? {
                sets.push((split, set));
            }
        }
        let pixels = settings.pixels == RawVideo::Rgb;
        let splits = sets.iter();
        let splits = splits.map(|(split, set)| ((*split).to_owned(), json!({"clips": set.len()})));
        let splits: serde_json::Map<_, _> = splits.collect();
        let mut contents = json!({ "tokens": tokens, "splits": splits, "format": format });
        if let Some(source) = clips.contents.get("source") {
            contents["source"] = source.clone();
        }
        if pixels {
            contents[PIXELS] = json!([format.frames, format.size, format.size, 3]);
        }
        if let Some(name) = &settings.made {
            if ranks.is_root() {
                let root = context.data_root(name).map(Path::to_owned);
                let root =
                    root.ok_or_else(|| damaged(&format!("`{name}` is not in `data.yaml`")))?;
                take_made(&root, &format, &writers, pixels, &sets, context.output())?;
            }
            return Ok(contents);
        }
        let total: usize = sets.iter().map(|(_, set)| set.len()).sum();
        let markers = context.checkpoints().join(MARKERS);
        std::fs::create_dir_all(&markers).map_err(StageError::io(&markers))?;
        let mut shards = Vec::new();
        for (split, set) in &sets {
            let folder = context.checkpoints().join(SHARDS).join(split);
            std::fs::create_dir_all(&folder).map_err(StageError::io(&folder))?;
            for (number, start) in (0..set.len()).step_by(TOKENS_PER_SHARD).enumerate() {
                let end = (start + TOKENS_PER_SHARD).min(set.len());
                let marker = markers.join(format!("{split}-{number:06}"));
                shards.push((set, start..end, number as u32, folder.clone(), marker));
            }
        }
        let before = |index: usize| -> usize {
            let done = shards.iter().take(index);
            done.map(|(_, range, ..)| range.len()).sum()
        };
        in_rounds(&ranks, shards.len(), context, |index, context| {
            let (set, range, number, folder, marker) = &shards[index];
            let done = before(index);
            if !marker.exists() {
                let shard = ShardWriter::new(folder, *number);
                let mut watch = |clips: usize| {
                    context.progress((done + clips) as u64, total as u64, "clips");
                    let stop = context.interrupted();
                    Ok::<_, TrainingError>(if stop { Flow::Stop } else { Flow::Continue })
                };
                if !write_shard(&writers, pixels, *set, range.clone(), shard, &mut watch)
                    .map_err(unusable)?
                {
                    return Err(StageError::Interrupted);
                }
                std::fs::write(marker, b"").map_err(StageError::io(marker))?;
            }
            let round = index + ranks.size();
            context.progress(before(round) as u64, total as u64, "clips");
            Ok(())
        })?;
        if !ranks.is_root() {
            return Ok(contents);
        }
        if let Some((.., marker)) = shards.iter().find(|(.., marker)| !marker.exists()) {
            return Err(unseen(marker));
        }
        let names: Vec<&str> = sets.iter().map(|(split, _)| *split).collect();
        deliver_splits(context.checkpoints(), &names, context.output())?;
        Ok(contents)
    }
}

/// Takes the shards of a folder that `reviv data tokenize` made, where they are those that would be made here.
fn take_made(
    root: &Path,
    format: &ClipFormat,
    modalities: &[ModalityTokens],
    pixels: bool,
    sets: &[(&str, ClipSet)],
    output: &Path,
) -> Result<(), StageError> {
    let refused = |message: String, help: &str| StageError::Input {
        code: Code::E0601,
        message: format!("{}: {message}", root.display()),
        help: help.to_owned(),
    };
    if place::is_remote(root) {
        let message = "tokens are taken from a disk, and this is an address of an object store";
        return Err(refused(message.to_owned(), "copy them to a disk"));
    }
    let found = TokenHeader::read(root).map_err(|error| {
        let help = "`reviv data tokenize` makes such a folder";
        refused(error.to_string(), help)
    })?;
    let names = sets.iter();
    let names = names.map(|(split, set)| ((*split).to_owned(), set.ids()));
    let per_shard = found.clips_per_shard;
    let own = TokenHeader::of(format, modalities, pixels, &names.collect(), per_shard)
        .map_err(unusable)?;
    if let Some(difference) = found.difference(&own) {
        let help = "make the tokens again of these clips with these tokenizers";
        return Err(refused(difference, help));
    }
    let missing = found.missing(root);
    if missing > 0 {
        let total = found.shards().count();
        let message = format!("{missing} of {total} shards are not finished");
        return Err(refused(message, "`reviv data verify` says which"));
    }
    for (split, _) in sets {
        let from = root.join(split);
        for file in tars(&from).map_err(|error| unusable(error.into()))? {
            let (file, target) = (from.join(&file), output.join(split).join(&file));
            let folder = target.parent().unwrap_or(output);
            std::fs::create_dir_all(folder).map_err(StageError::io(folder))?;
            // Finished shards are never written again, so that one copy on a disk will do.
            if std::fs::hard_link(&file, &target).is_err() {
                std::fs::copy(&file, &target).map_err(StageError::io(&file))?;
            }
        }
    }
    Ok(())
}

/// What is wrong with clips and tokenizers is for the user to mend, what is wrong with the disk is not.
fn unusable(error: TrainingError) -> StageError {
    match error {
        TrainingError::Clips(ReadError::Io { path, cause }) => StageError::Io {
            path: path.display().to_string(),
            error: cause,
        },
        error => damaged(&error.to_string()),
    }
}

/// Moves the finished shards of every split to where the artifact is written.
///
/// The markers go first: a marker that outlived its shard would make the next try publish an artifact without it.
fn deliver_splits(checkpoints: &Path, splits: &[&str], output: &Path) -> Result<(), StageError> {
    let markers = checkpoints.join(MARKERS);
    std::fs::remove_dir_all(&markers).map_err(StageError::io(&markers))?;
    let kept = checkpoints.join(SHARDS);
    for split in splits {
        deliver(&kept.join(split), &output.join(split), true)?;
    }
    std::fs::remove_dir_all(&kept).map_err(StageError::io(&kept))
}

/// Copies (or moves) a folder without what describes it as an artifact: its manifest, its page, and unfinished shards.
fn deliver(from: &Path, to: &Path, moves: bool) -> Result<(), StageError> {
    std::fs::create_dir_all(to).map_err(StageError::io(to))?;
    let mut paths: Vec<PathBuf> = Vec::new();
    for entry in std::fs::read_dir(from).map_err(StageError::io(from))? {
        paths.push(entry.map_err(StageError::io(from))?.path());
    }
    for path in paths {
        let Some(name) = path.file_name() else {
            continue;
        };
        let leaves_out = name == "manifest.json" || name == "report";
        let target = to.join(name);
        if leaves_out || path.extension().is_some_and(|e| e == "done" || e == "part") {
            continue;
        }
        if path.is_dir() {
            deliver(&path, &target, moves)?;
        } else if !moves || std::fs::rename(&path, &target).is_err() {
            std::fs::copy(&path, &target).map_err(StageError::io(&path))?;
        }
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn no_shard_counts_as_finished_once_shards_are_on_their_way() {
        let folder = tempfile::tempdir().unwrap();
        let checkpoints = folder.path().join("checkpoints");
        for split in ["train", "test"] {
            let place = checkpoints.join(SHARDS).join(split).join("camera");
            std::fs::create_dir_all(&place).unwrap();
            std::fs::write(place.join("shard-000000.tar"), b"tokens").unwrap();
            std::fs::create_dir_all(checkpoints.join(MARKERS)).unwrap();
            let marker = checkpoints.join(MARKERS).join(format!("{split}-000000"));
            std::fs::write(marker, b"").unwrap();
        }
        let output = folder.path().join("output");
        std::fs::create_dir(&output).unwrap();
        std::fs::write(output.join("test"), b"a file in the way of the folder").unwrap();
        assert!(deliver_splits(&checkpoints, &["train", "test"], &output).is_err());
        assert!(output.join("train/camera/shard-000000.tar").is_file());
        assert!(!checkpoints.join(MARKERS).exists());
    }
}
