//! A pipeline of small ops that do nothing, and a registry of a few entries: what the language is tested on.

#![allow(clippy::unwrap_used)]

use reviv::experiment::catalog::{Catalog, EntryText};
use reviv::experiment::diagnostic::Report;
use reviv::experiment::load::{Request, load_in};
use reviv::experiment::{
    Arity, ArtifactKind, Code, Description, Entry, Experiment, FileInput, FilePath, Inputs, Kind,
    KindEntry, Op, Port, Problem, SignalFacts, StageContext, StageError, StagePlan, TokenFacts,
};
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use serde_json::Value;
use std::collections::BTreeMap;
use std::path::PathBuf;

#[derive(Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct World {
    /// Rooms to walk through.
    #[schemars(range(min = 1, max = 100))]
    rooms: u32,
    /// A data set instead of the world.
    data: Option<String>,
}

impl Default for World {
    fn default() -> Self {
        Self {
            rooms: 2,
            data: None,
        }
    }
}

impl Kind for World {
    const KIND: &'static str = "source";
    const ABOUT: &'static str = "Where clips come from.";
}

#[derive(Serialize, Deserialize, JsonSchema)]
#[serde(tag = "policy", rename_all = "snake_case", deny_unknown_fields)]
pub enum Masking {
    /// Every modality by its share.
    Dirichlet {
        #[serde(default = "one")]
        #[schemars(range(min = 0.0001))]
        alpha: f64,
    },
    /// Every token alike.
    Uniform {},
}

fn one() -> f64 {
    1.0
}

impl Kind for Masking {
    const KIND: &'static str = "masking";
    const ABOUT: &'static str = "Which tokens are seen.";
}

#[derive(Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct ClipsSettings {
    /// Where clips come from.
    source: Entry<World>,
    /// Clips to train on.
    #[schemars(range(min = 1))]
    train: u64,
    /// A list of file names.
    only: Option<FilePath>,
    /// Keep signals that are not valid.
    keep_invalid: bool,
}

impl Default for ClipsSettings {
    fn default() -> Self {
        Self {
            source: Entry {
                name: "world_small".to_owned(),
                settings: World::default(),
            },
            train: 10,
            only: None,
            keep_invalid: false,
        }
    }
}

pub struct Clips;

impl Op for Clips {
    type Settings = ClipsSettings;
    fn name(&self) -> &'static str {
        "clips"
    }
    fn version(&self) -> u32 {
        1
    }
    fn about(&self) -> &'static str {
        "Makes clips."
    }
    fn inputs(&self) -> &'static [Port] {
        &[]
    }
    fn output(&self) -> ArtifactKind {
        ArtifactKind::Clips
    }
    fn files(&self, settings: &ClipsSettings) -> Vec<FileInput> {
        settings
            .only
            .iter()
            .map(|path| FileInput {
                key: "only".to_owned(),
                path: PathBuf::from(&path.0),
            })
            .collect()
    }
    fn data(&self, settings: &ClipsSettings) -> Vec<(String, String)> {
        settings
            .source
            .settings
            .data
            .iter()
            .map(|name| (name.clone(), "source.data".to_owned()))
            .collect()
    }
    fn check(&self, s: &ClipsSettings, _: &Inputs<'_>, _: &mut Vec<Problem>) -> Description {
        let signal = |shape: &[usize]| SignalFacts {
            shape: shape.to_vec(),
            rate: 30.0,
        };
        Description {
            clips: BTreeMap::from([("train".to_owned(), s.train)]),
            signals: BTreeMap::from([
                ("camera".to_owned(), signal(&[60, 9])),
                ("body".to_owned(), signal(&[60, 21, 3])),
            ]),
            ..Description::default()
        }
    }
    fn run(&self, _: &ClipsSettings, _: &mut dyn StageContext) -> Result<Value, StageError> {
        Ok(Value::Null)
    }
}

#[derive(Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct TokenizerSettings {
    /// The modality it is for.
    modality: String,
    /// Different tokens.
    #[serde(default = "codes")]
    #[schemars(range(min = 2, max = 65536))]
    codebook: u64,
    #[serde(default = "codes")]
    steps: u64,
}

fn codes() -> u64 {
    256
}

pub struct TrainTokenizer;

impl Op for TrainTokenizer {
    type Settings = TokenizerSettings;
    fn name(&self) -> &'static str {
        "train_tokenizer"
    }
    fn version(&self) -> u32 {
        1
    }
    fn about(&self) -> &'static str {
        "Trains a tokenizer of one modality."
    }
    fn inputs(&self) -> &'static [Port] {
        &[Port {
            name: "clips",
            kinds: &[ArtifactKind::Clips],
            arity: Arity::One,
            about: "the clips to learn from",
        }]
    }
    fn output(&self) -> ArtifactKind {
        ArtifactKind::Tokenizer
    }
    fn check(
        &self,
        s: &TokenizerSettings,
        inputs: &Inputs<'_>,
        problems: &mut Vec<Problem>,
    ) -> Description {
        let known = inputs.one("clips").map(|clips| &clips.signals);
        if known.is_some_and(|known| !known.contains_key(&s.modality)) {
            problems.push(
                Problem::new(
                    Code::E0401,
                    "modality",
                    format!("the clips have no {}", s.modality),
                )
                .label("not in the clips"),
            );
        }
        Description {
            tokens: BTreeMap::from([(
                s.modality.clone(),
                TokenFacts {
                    grid: vec![30],
                    vocabulary: s.codebook,
                },
            )]),
            ..Description::default()
        }
    }
    fn run(&self, _: &TokenizerSettings, _: &mut dyn StageContext) -> Result<Value, StageError> {
        Ok(Value::Null)
    }
}

#[derive(Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct MgetSettings {
    /// Which tokens are seen.
    masking: Entry<Masking>,
    /// Training steps.
    #[schemars(range(min = 1))]
    steps: u64,
    /// Peak learning rate.
    #[schemars(range(min = 0.0, max = 1.0))]
    rate: f64,
    precision: Precision,
}

#[derive(Serialize, Deserialize, JsonSchema, Default)]
#[serde(rename_all = "snake_case")]
pub enum Precision {
    /// 32 bits.
    #[default]
    Single,
    /// 16 bits where it is safe.
    Mixed,
}

impl Default for MgetSettings {
    fn default() -> Self {
        Self {
            masking: Entry {
                name: "uniform".to_owned(),
                settings: Masking::Uniform {},
            },
            steps: 100,
            rate: 1e-3,
            precision: Precision::Single,
        }
    }
}

pub struct TrainMget;

impl Op for TrainMget {
    type Settings = MgetSettings;
    fn name(&self) -> &'static str {
        "train_mget"
    }
    fn version(&self) -> u32 {
        3
    }
    fn about(&self) -> &'static str {
        "Trains a model on the tokens of several tokenizers."
    }
    fn inputs(&self) -> &'static [Port] {
        &[Port {
            name: "tokenizers",
            kinds: &[ArtifactKind::Tokenizer],
            arity: Arity::Many,
            about: "one tokenizer per modality",
        }]
    }
    fn output(&self) -> ArtifactKind {
        ArtifactKind::Mget
    }
    fn check(&self, _: &MgetSettings, inputs: &Inputs<'_>, _: &mut Vec<Problem>) -> Description {
        Description {
            tokens: inputs
                .all("tokenizers")
                .iter()
                .flat_map(|input| input.description.tokens.clone())
                .collect(),
            ..Description::default()
        }
    }
    fn plan(&self, _: &MgetSettings, inputs: &Inputs<'_>, _: u64) -> StagePlan {
        let vocabulary: u64 = inputs
            .all("tokenizers")
            .iter()
            .flat_map(|input| input.description.tokens.values())
            .map(|tokens| tokens.vocabulary)
            .sum();
        StagePlan {
            parameters: Some(vocabulary * 16),
            ..StagePlan::default()
        }
    }
    fn run(&self, _: &MgetSettings, _: &mut dyn StageContext) -> Result<Value, StageError> {
        Ok(Value::Null)
    }
}

#[derive(Serialize, Deserialize, JsonSchema, Default)]
#[serde(deny_unknown_fields, default)]
pub struct Nothing {}

pub struct Evaluate;

impl Op for Evaluate {
    type Settings = Nothing;
    fn name(&self) -> &'static str {
        "evaluate"
    }
    fn version(&self) -> u32 {
        1
    }
    fn about(&self) -> &'static str {
        "Scores a model."
    }
    fn seeded(&self) -> bool {
        false
    }
    fn inputs(&self) -> &'static [Port] {
        &[Port {
            name: "model",
            kinds: &[ArtifactKind::Mget],
            arity: Arity::One,
            about: "the model to score",
        }]
    }
    fn output(&self) -> ArtifactKind {
        ArtifactKind::Scores
    }
    fn check(&self, _: &Nothing, _: &Inputs<'_>, _: &mut Vec<Problem>) -> Description {
        Description {
            columns: vec!["body.ga_mpjpe".to_owned(), "camera.ate".to_owned()],
            ..Description::default()
        }
    }
    fn run(&self, _: &Nothing, _: &mut dyn StageContext) -> Result<Value, StageError> {
        Ok(Value::Null)
    }
}

fn entry(place: &str, text: &'static str) -> EntryText {
    EntryText {
        place: format!("{place} (built in)"),
        text: text.into(),
    }
}

pub fn catalog() -> Catalog {
    Catalog::of(
        &[&Clips, &TrainTokenizer, &TrainMget, &Evaluate],
        &[&KindEntry::of::<World>(), &KindEntry::of::<Masking>()],
        vec![
            entry(
                "registry/source/world_small.yaml",
                "source: world_small\nabout: A small world.\nrooms: 3\n",
            ),
            entry(
                "registry/source/recorded.yaml",
                "source: recorded\nabout: Recordings.\ndata: adt\n",
            ),
            entry(
                "registry/masking/dirichlet.yaml",
                "masking: dirichlet\nabout: One alpha.\npolicy: dirichlet\nalpha: 1.0\n",
            ),
            entry(
                "registry/masking/dirichlet_mixture.yaml",
                "masking: dirichlet_mixture\nabout: Several.\nextends: dirichlet\nalpha: 0.5\n",
            ),
            entry(
                "registry/masking/uniform.yaml",
                "masking: uniform\nabout: Every token alike.\npolicy: uniform\n",
            ),
        ],
    )
}

/// A folder of files that is gone afterwards.
pub struct Folder(pub tempfile::TempDir);

impl Folder {
    pub fn new(files: &[(&str, &str)]) -> Self {
        let folder = Self(tempfile::tempdir().unwrap());
        for (name, text) in files {
            folder.write(name, text.as_bytes());
        }
        folder
    }

    pub fn write(&self, name: &str, bytes: &[u8]) {
        let path = self.0.path().join(name);
        std::fs::create_dir_all(path.parent().unwrap()).unwrap();
        std::fs::write(path, bytes).unwrap();
    }

    pub fn path(&self, name: &str) -> PathBuf {
        self.0.path().join(name)
    }

    pub fn load(&self, name: &str, set: &[&str]) -> (Option<Experiment>, Report) {
        self.load_with(name, set, &[])
    }

    pub fn load_with(
        &self,
        name: &str,
        set: &[&str],
        environment: &[(&str, &str)],
    ) -> (Option<Experiment>, Report) {
        let request = Request {
            path: self.path(name),
            set: set.iter().map(|&text| text.to_owned()).collect(),
            ..Request::default()
        };
        let environment = environment
            .iter()
            .map(|(name, value)| ((*name).to_owned(), (*value).to_owned()))
            .collect();
        load_in(&catalog(), &request, &environment)
    }

    /// What `reviv check` says, with the folder's name taken out.
    pub fn says(&self, name: &str, set: &[&str]) -> String {
        let (_, report) = self.load(name, set);
        self.clean(&report)
    }

    pub fn clean(&self, report: &Report) -> String {
        let folder = format!("{}/", self.0.path().display());
        report
            .render(false)
            .replace(&folder, "")
            .trim_end()
            .to_owned()
    }

    /// The experiment, which must be sound.
    pub fn sound(&self, name: &str, set: &[&str]) -> Experiment {
        let (experiment, report) = self.load(name, set);
        experiment.unwrap_or_else(|| panic!("{}", report.render(false)))
    }
}

/// An experiment of four stages.
pub const TINY: &str = "\
experiment: tiny
about: A test.
seed: 7
stages:
  clips: {op: clips, train: 20}
  tok_body: {op: train_tokenizer, clips: clips, modality: body, codebook: 512}
  tok_camera: {op: train_tokenizer, clips: clips, modality: camera}
  mget:
    op: train_mget
    tokenizers: [tok_body, tok_camera]
    masking: {use: dirichlet, alpha: 0.5}
    steps: 50
  scores: {op: evaluate, model: mget}
";
