//! `op: evaluate`: scores predictions on a suite (Sec. 5). Writes `scores.json` and a table for the report page.
//!
//! Truth and predictions are folders of [`crate::reconstruction::predictions`]: those of other systems stand in `data.yaml` by
//! name, so that EgoAllo, HaMeR or EgoM2P can be rows that we computed.

use super::modality_entry::{DEFAULTS, read_defaults};
use crate::clip::store::ClipSet;
use crate::engine::Compute;
use crate::evaluation::compare::{CompareSettings, Method, compare};
use crate::evaluation::evaluate::Pairs;
use crate::evaluation::evaluate::{Embeddings, EvaluationError, evaluate};
use crate::evaluation::folders::{Folders, Stored};
use crate::evaluation::render::{Format, render};
use crate::evaluation::suite::Suite;
use crate::evaluation::tmr::{FeatureRate, Tmr};
use crate::experiment::{
    Arity, ArtifactKind, Code, Description, Entry, FileInput, FilePath, Inputs, Op, OpEntry, Port,
    Problem, StageContext, StageError,
};
use crate::formats::FormatError;
use crate::formats::npz::Npz;
use crate::reconstruction::predictions::Predictions;
use ndarray::Ix2;
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use serde_json::{Value, json};
use std::path::Path;

/// Settings of [`Evaluate`].
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct EvaluateSettings {
    /// What is computed.
    pub suite: Entry<Suite>,
    /// Predictions that no stage makes: a data set of `data.yaml`, a folder of npz files.
    pub predictions_data: Option<String>,
    /// The true clips where no stage makes them: a data set of `data.yaml`, a folder of npz files with the same arrays.
    pub truth_data: String,
    /// The split of the stage in `clips` that was predicted.
    pub split: String,
    /// The name of the row; absent: what the predictions call themselves.
    pub system: Option<String>,
    /// Motion embeddings of a model that is not part of this program (TMR): an npz with `predicted` and `truth`, `[clips, 256]`.
    pub embeddings: Option<FilePath>,
    /// The folder of a motion encoder (TMR), as `reviv import` makes it: what `motion.fid` and `motion.similarity` embed bodies with.
    pub motion_encoder: Option<FilePath>,
    /// At which rate the motions are embedded; numbers of different rates do not compare.
    pub motion_rate: FeatureRate,
}

impl Default for EvaluateSettings {
    fn default() -> Self {
        Self {
            suite: Entry {
                name: "world_all".to_owned(),
                settings: Suite::default(),
            },
            predictions_data: None,
            truth_data: String::new(),
            split: "test".to_owned(),
            system: None,
            embeddings: None,
            motion_encoder: None,
            motion_rate: FeatureRate::default(),
        }
    }
}

/// The op.
#[derive(Debug)]
pub struct Evaluate;
inventory::submit! { OpEntry(&Evaluate) }

impl Op for Evaluate {
    type Settings = EvaluateSettings;

    fn name(&self) -> &'static str {
        "evaluate"
    }

    fn version(&self) -> u32 {
        5
    }

    fn about(&self) -> &'static str {
        "Scores predictions against the truth, beside the trivial baselines."
    }

    fn inputs(&self) -> &'static [Port] {
        &[
            Port {
                name: "predictions",
                kinds: &[ArtifactKind::Predictions],
                arity: Arity::Optional,
                about: "what a model says about the clips; or name a data set in `predictions_data`",
            },
            Port {
                name: "clips",
                kinds: &[ArtifactKind::Clips],
                arity: Arity::Optional,
                about: "the true clips; or name a data set in `truth_data`",
            },
        ]
    }

    fn output(&self) -> ArtifactKind {
        ArtifactKind::Scores
    }

    fn seeded(&self) -> bool {
        false
    }

    fn files(&self, settings: &EvaluateSettings) -> Vec<FileInput> {
        let file = |key: &str, path: &Option<FilePath>| {
            path.as_ref().map(|path| FileInput {
                key: key.to_owned(),
                path: path.0.clone().into(),
            })
        };
        [
            file("embeddings", &settings.embeddings),
            file("motion_encoder", &settings.motion_encoder),
        ]
        .into_iter()
        .flatten()
        .collect()
    }

    fn data(&self, settings: &EvaluateSettings) -> Vec<(String, String)> {
        let mut data = vec![(settings.truth_data.clone(), "truth_data".to_owned())];
        data.extend(
            settings
                .predictions_data
                .clone()
                .map(|name| (name, "predictions_data".to_owned())),
        );
        data.retain(|(name, _)| !name.is_empty());
        data
    }

    fn check(
        &self,
        settings: &EvaluateSettings,
        inputs: &Inputs<'_>,
        problems: &mut Vec<Problem>,
    ) -> Description {
        if settings.embeddings.is_some() && settings.motion_encoder.is_some() {
            problems.push(
                Problem::new(
                    Code::E0206,
                    "embeddings",
                    "motions are embedded once: by `motion_encoder`, or elsewhere",
                )
                .help("leave one of the two out"),
            );
        }
        let connected = inputs.one("predictions").is_some();
        if connected == settings.predictions_data.is_some() {
            problems.push(
                Problem::new(
                    Code::E0206,
                    "predictions",
                    "an evaluation has one source of predictions",
                )
                .help("name a stage in `predictions`, or a data set in `predictions_data`"),
            );
        }
        if inputs.one("clips").is_some() != settings.truth_data.is_empty() {
            problems.push(
                Problem::new(
                    Code::E0206,
                    "clips",
                    "an evaluation has one source of true clips",
                )
                .help("name a stage in `clips`, or a data set of `data.yaml` in `truth_data`"),
            );
        }
        let predicted = inputs.one("predictions").map(|p| p.signals.keys());
        let defaults = inputs.one("clips").and_then(|c| c.extra.get(DEFAULTS));
        let suite = suite(settings, defaults, predicted.into_iter().flatten());
        match suite.columns() {
            Ok(columns) => Description {
                columns: columns.into_iter().map(|c| c.name).collect(),
                ..Description::default()
            },
            Err(error) => {
                let help = format!("there are: {}", error.known.join(" "));
                problems
                    .push(Problem::new(Code::E0203, "suite.metrics", error.to_string()).help(help));
                Description::default()
            }
        }
    }

    fn run(
        &self,
        settings: &EvaluateSettings,
        context: &mut dyn StageContext,
    ) -> Result<Value, StageError> {
        let predictions = match (
            &settings.predictions_data,
            context.inputs("predictions").first(),
        ) {
            (Some(name), _) => open(data_root(context, name)?)?,
            (None, Some(artifact)) => open(&artifact.path)?,
            (None, None) => return Err(input("no predictions", "name a stage in `predictions`")),
        };
        let mut embeddings = settings
            .embeddings
            .as_ref()
            .map(|path| read_embeddings(path.as_ref()))
            .transpose()
            .map_err(StageError::other)?;
        let encoder = settings
            .motion_encoder
            .as_ref()
            .map(|path| Tmr::open(path.as_ref(), &Compute::cpu()))
            .transpose()
            .map_err(|error| {
                let help =
                    "`reviv import motion_encoder.pt mean.pt std.pt -o DIR` makes the folder";
                input(&error.to_string(), help)
            })?;
        let system = settings
            .system
            .clone()
            .unwrap_or_else(|| predictions.index.system.clone());
        let clips = context.inputs("clips").first();
        let suite = suite(
            settings,
            clips.and_then(|clips| clips.contents.get(DEFAULTS)),
            predictions.index.signals.keys(),
        );
        let mut notes = Vec::new();
        let samples = predictions.samples().map_err(StageError::other)?.len();
        if samples > 0 {
            notes.push(format!(
                "{samples} samples per clip; `samples: best` is chosen with the truth in hand and is no result of the system"
            ));
        }
        let pairs: Box<dyn Pairs> = if let Some(clips) = context.inputs("clips").first() {
            let root = clips.path.join(&settings.split);
            let truth = ClipSet::open(&root).map_err(StageError::other)?;
            let stored = Stored::new(truth, predictions).map_err(|error| {
                input(&error.to_string(), "predict the split that `split` names")
            })?;
            Box::new(stored)
        } else {
            let truth = open(data_root(context, &settings.truth_data)?)?;
            Box::new(Folders::new(truth, predictions).map_err(StageError::other)?)
        };
        if let Some(tmr) = &encoder {
            let chosen = suite.chosen(pairs.ids());
            let made = tmr.embed_pairs(pairs.as_ref(), &chosen, settings.motion_rate);
            let (made, about) = made.map_err(|error| input(&error.to_string(), &help(&error)))?;
            embeddings = Some(made);
            notes.push(about);
        }
        let outcome = evaluate(
            &settings.suite.name,
            &suite,
            &system,
            pairs.as_ref(),
            embeddings.as_ref(),
            &mut |done, total| {
                context.progress(done as u64, total as u64, "clips");
                !context.interrupted()
            },
        );
        let mut scores = match outcome {
            Ok(scores) => scores,
            Err(EvaluationError::Interrupted) => return Err(StageError::Interrupted),
            Err(error) => return Err(input(&error.to_string(), &help(&error))),
        };
        scores.notes.extend(notes);
        scores.write(context.output()).map_err(StageError::other)?;
        let clips = scores.clips.len();
        let entrant = Method {
            label: system.clone(),
            seeds: vec![scores],
        };
        let table = compare(
            &settings.suite.name,
            &[entrant],
            &CompareSettings::default(),
            None,
        )
        .map_err(StageError::other)?;
        write_text(
            context.output(),
            "report/table.md",
            &render(&table, Format::Markdown),
        )?;
        Ok(json!({"suite": settings.suite.name, "system": system, "clips": clips}))
    }
}

/// The suite, and beside it what the entries of declared modalities say should score them, where they were predicted.
fn suite<'a>(
    settings: &EvaluateSettings,
    defaults: Option<&Value>,
    predicted: impl Iterator<Item = &'a String>,
) -> Suite {
    let mut suite = settings.suite.settings.clone();
    let defaults = read_defaults(defaults);
    for name in predicted {
        let metrics = defaults.get(name).map(|of| of.metrics.as_slice());
        for metric in metrics.unwrap_or_default() {
            let column = format!("{name}.{metric}");
            if !suite.metrics.contains(&column) {
                suite.metrics.push(column);
            }
        }
    }
    suite
}

/// What to do about an evaluation that stopped.
fn help(error: &EvaluationError) -> String {
    match error {
        EvaluationError::Metric(error) => format!("there are: {}", error.known.join(" ")),
        EvaluationError::Load { .. } => {
            "bring the file back, or run the stage that makes it again".to_owned()
        }
        EvaluationError::NoOverlap { .. } => {
            "clips are matched by id: the path of a file below its folder, without `.npz`"
                .to_owned()
        }
        _ => "left out, a refused prediction would look like a good score".to_owned(),
    }
}

fn input(message: &str, help: &str) -> StageError {
    StageError::Input {
        code: Code::E0601,
        message: message.to_owned(),
        help: help.to_owned(),
    }
}

fn data_root<'a>(context: &'a dyn StageContext, name: &str) -> Result<&'a Path, StageError> {
    context.data_root(name).ok_or_else(|| {
        input(
            &format!("data set `{name}` is not configured"),
            "add it to `data.yaml`",
        )
    })
}

fn open(folder: &Path) -> Result<Predictions, StageError> {
    Predictions::open(folder).map_err(|error| {
        input(
            &error.to_string(),
            "a folder of npz files, or one with an index",
        )
    })
}

fn read_embeddings(path: &Path) -> Result<Embeddings, FormatError> {
    let npz = Npz::read_some(path, &["predicted", "truth"])?;
    Ok(Embeddings {
        predicted: npz.get("predicted")?.to_dim::<f64, Ix2>()?,
        truth: npz.get("truth")?.to_dim::<f64, Ix2>()?,
    })
}

/// Writes a text file below an artifact, making its folder.
pub(super) fn write_text(root: &Path, name: &str, text: &str) -> Result<(), StageError> {
    let path = root.join(name);
    if let Some(folder) = path.parent() {
        std::fs::create_dir_all(folder).map_err(StageError::io(folder))?;
    }
    std::fs::write(&path, text).map_err(StageError::io(&path))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::evaluation::outcome::MetricError;

    #[test]
    fn the_help_fits_the_reason() {
        let refused = EvaluationError::Refused {
            clip: "a".to_owned(),
            refusal: MetricError::ZeroEmbedding { row: 0 },
        };
        let damaged = EvaluationError::Load {
            clip: "a".to_owned(),
            error: "cut short".into(),
        };
        let apart = EvaluationError::NoOverlap {
            truth: 3,
            example: "a".to_owned(),
        };
        assert!(help(&refused).contains("refused"));
        assert!(help(&damaged).contains("again"));
        assert!(help(&apart).contains("matched by id"));
    }
}
