//! `op: import`: a model folder that no stage makes, of `reviv import` or of another run, becomes an artifact that stages can
//! read: predictions and scores of released weights.
//!
//! The artifact is a copy, so that what it was made from can be seen and used whatever becomes of the folder. Its identity is
//! that of the folder's bytes, wherever it lies.

use crate::experiment::{
    ArtifactKind, Code, Description, FileInput, FilePath, Inputs, Op, OpEntry, Port, Problem,
    StageContext, StageError, StagePlan, TokenFacts,
};
use crate::mget::MgetSpec;
use crate::mget::stored::{WEIGHTS, read_spec};
use crate::model::{FILE, ModelManifest};
use crate::run::files::{copy_tree, size_below};
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use serde_json::{Value, json};
use std::path::Path;

/// What `reviv import` says of its inputs lies under this name in the artifact, whose own manifest has the name it had.
const PROVENANCE: &str = "imported.json";
const MANIFEST: &str = "manifest.json";

/// Settings of [`Import`].
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct ImportSettings {
    /// The model folder, as `reviv import` makes it.
    pub folder: FilePath,
}

/// The op.
#[derive(Debug)]
pub struct Import;
inventory::submit! { OpEntry(&Import) }

impl Op for Import {
    type Settings = ImportSettings;

    fn name(&self) -> &'static str {
        "import"
    }

    fn version(&self) -> u32 {
        1
    }

    fn about(&self) -> &'static str {
        "Takes a model folder that no stage makes, such as imported weights."
    }

    fn inputs(&self) -> &'static [Port] {
        &[]
    }

    fn output(&self) -> ArtifactKind {
        ArtifactKind::Mget
    }

    fn seeded(&self) -> bool {
        false
    }

    fn files(&self, settings: &ImportSettings) -> Vec<FileInput> {
        let path: &Path = settings.folder.as_ref();
        // A folder that is not there is refused by `check`, once.
        path.exists()
            .then(|| FileInput {
                key: "folder".to_owned(),
                path: path.to_owned(),
            })
            .into_iter()
            .collect()
    }

    /// What the model is stands in a file of a few kilobytes, which is read; its weights are not.
    fn check(
        &self,
        settings: &ImportSettings,
        _inputs: &Inputs<'_>,
        problems: &mut Vec<Problem>,
    ) -> Description {
        let folder: &Path = settings.folder.as_ref();
        let spec = match described(folder) {
            Ok(spec) => spec,
            Err(reason) => {
                problems.push(
                    Problem::new(
                        Code::E0601,
                        "folder",
                        format!("`{}` is no model folder: {reason}", folder.display()),
                    )
                    .help("`reviv import FILE... -o DIR` makes one of released weights"),
                );
                return Description::default();
            }
        };
        let tokens = spec.modalities.iter().filter_map(|modality| {
            let facts = TokenFacts {
                grid: modality.grid(),
                vocabulary: modality.vocabulary()? as u64,
            };
            Some((modality.name.clone(), facts))
        });
        Description {
            tokens: tokens.collect(),
            extra: [("mget".to_owned(), json!(spec))].into(),
            ..Description::default()
        }
    }

    fn plan(&self, settings: &ImportSettings, _inputs: &Inputs<'_>, _seed: u64) -> StagePlan {
        let folder: &Path = settings.folder.as_ref();
        StagePlan {
            parameters: described(folder)
                .ok()
                .map(|spec| spec.parameter_count() as u64),
            disk: size_below(folder).ok(),
            ..StagePlan::default()
        }
    }

    fn run(
        &self,
        settings: &ImportSettings,
        context: &mut dyn StageContext,
    ) -> Result<Value, StageError> {
        let folder: &Path = settings.folder.as_ref();
        let spec = described(folder).map_err(|reason| StageError::Input {
            code: Code::E0601,
            message: format!("`{}` is no model folder: {reason}", folder.display()),
            help: "`reviv import FILE... -o DIR` makes one of released weights".to_owned(),
        })?;
        let output = context.output().to_path_buf();
        copy_tree(folder, &output).map_err(StageError::other)?;
        let manifest = output.join(MANIFEST);
        if manifest.is_file() {
            let kept = output.join(PROVENANCE);
            std::fs::rename(&manifest, &kept).map_err(StageError::io(&kept))?;
        }
        Ok(json!({
            "mget": spec,
            "parameters": spec.parameter_count(),
        }))
    }
}

/// What the model in `folder` is, without its weights.
fn described(folder: &Path) -> Result<MgetSpec, String> {
    if !folder.is_dir() {
        return Err("there is no such folder".to_owned());
    }
    for file in [FILE, WEIGHTS] {
        if !folder.join(file).is_file() {
            return Err(format!("it has no `{file}`"));
        }
    }
    ModelManifest::read(folder).map_err(|error| error.to_string())?;
    let spec = read_spec(folder).map_err(|error| error.to_string())?;
    spec.check().map_err(|error| error.to_string())?;
    Ok(spec)
}
