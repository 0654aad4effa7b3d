//! The whole import: recognise, check, convert, and account for every entry.

use super::ImportError;
use super::folder::{self, Model};
use super::hash::Hashes;
use super::part::Part;
use super::source::{Source, expand};
use super::statistics::{self, Statistics};
use super::vda;
use crate::labelling::DepthLabelKind;
use crate::mget::MgetSpec;
use crate::model::ModelManifest;
use serde_json::{Map, Value, json};
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

/// What the files do not say.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct ImportOptions {
    /// Attention heads, for checkpoints that do not name their builder.
    pub heads: Option<usize>,
    /// Frames and pixels per token of a video tokenizer whose file is not named after them.
    pub compression: Option<[usize; 2]>,
    /// Frames, height and width of the clips of a video tokenizer that is imported without a transformer.
    pub clip: Option<[usize; 3]>,
    /// Whether a depth network is relative or metric: its file does not say.
    pub depth: Option<DepthLabelKind>,
}

/// What an import did.
#[derive(Debug, Clone, PartialEq)]
pub struct ImportReport {
    /// Where the model was written.
    pub folder: PathBuf,
    /// One per converted model, in the order of writing.
    pub parts: Vec<PartReport>,
    /// Things a user should know: left-out modalities, missing statistics or tokenizers.
    pub notices: Vec<String>,
}

/// One converted model.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct PartReport {
    /// `mget`, or the modality of a tokenizer.
    pub name: String,
    /// Entries of its files, and how many of them were written.
    pub entries: usize,
    /// Entries that were written; the others were shown to be redundant, never run, or of something unsupported.
    pub written: usize,
    /// Numbers written, statistics included.
    pub values: u64,
}

/// The form of our manifest.
const FORMAT: u64 = 2;

/// Imports released files (weights, statistics, or folders of them) into `folder`, which must not exist yet: a model that
/// [`crate::model::Model`] opens, and a `manifest.json` that accounts for every entry.
///
/// # Errors
/// When a file is not what it seems, an entry is unknown, or something that would be dropped is not redundant. Nothing is left
/// behind then.
pub fn import(
    files: &[PathBuf],
    folder: &Path,
    options: &ImportOptions,
) -> Result<ImportReport, ImportError> {
    if folder.exists() {
        return Err(ImportError::refused(folder, "exists already"));
    }
    let parent = match folder.parent() {
        Some(parent) if !parent.as_os_str().is_empty() => parent,
        _ => Path::new("."),
    };
    let (mut set, statistics) = Set::read(files, options)?;
    std::fs::create_dir_all(parent).map_err(ImportError::io(parent))?;
    let temporary = tempfile::Builder::new()
        .prefix(".import-")
        .tempdir_in(parent)
        .map_err(ImportError::io(parent))?;
    let work = temporary.path().join("model");
    std::fs::create_dir(&work).map_err(ImportError::io(&work))?;
    let models = set.models(statistics, options)?;
    let parts = set.write(&models, &work)?;
    std::fs::rename(&work, folder).map_err(ImportError::io(folder))?;
    Ok(ImportReport {
        folder: folder.to_owned(),
        parts,
        notices: set.notices,
    })
}

/// Everything that was given, recognised and checked, by part.
struct Set {
    parts: BTreeMap<String, Part>,
    /// The transformer, once it is known.
    spec: Option<MgetSpec>,
    hashes: Hashes,
    notices: Vec<String>,
}

/// A model to write, and the part it comes from.
type Planned = (String, Model);

impl Set {
    fn read(
        files: &[PathBuf],
        options: &ImportOptions,
    ) -> Result<(Self, BTreeMap<String, Statistics>), ImportError> {
        let (arrays, checkpoints): (Vec<PathBuf>, Vec<PathBuf>) = expand(files)?
            .into_iter()
            .partition(|path| path.extension().is_some_and(|e| e == "npy"));
        let mut notices = Vec::new();
        let mut sources = Vec::new();
        for path in checkpoints {
            sources.push(Source::open(&path, options)?);
        }
        if sources.is_empty() {
            let path = PathBuf::from("import");
            return Err(ImportError::refused(&path, "no checkpoint was given"));
        }
        // In the order of writing: the transformer does not wait for its hash, and the others find theirs made.
        // What has no sizes of its own comes behind what it belongs to.
        sources
            .sort_by_key(|source| (source.plan.family != "mget", source.plan.settings.is_null()));
        let order = sources.iter().map(|source| source.path().to_owned());
        let mut hashes = Hashes::start(arrays.iter().cloned().chain(order).collect());
        let statistics = statistics::read(&arrays, &mut hashes)?;
        let mut groups: BTreeMap<String, Vec<Source>> = BTreeMap::new();
        for mut source in sources {
            source.check(&mut notices)?;
            let part = source.plan.part.clone();
            groups.entry(part).or_default().push(source);
        }
        let mut parts = BTreeMap::new();
        for (name, sources) in groups {
            parts.insert(name, Part::new(sources)?);
        }
        let set = Self {
            parts,
            spec: None,
            hashes,
            notices,
        };
        Ok((set, statistics))
    }

    /// What to write: the transformer first, then tokenizers by modality.
    fn models(
        &mut self,
        mut statistics: BTreeMap<String, Statistics>,
        options: &ImportOptions,
    ) -> Result<Vec<Planned>, ImportError> {
        let mut models: Vec<Planned> = Vec::new();
        if let Some(part) = self.parts.get("mget") {
            let (model, found) = folder::transformer(part)?;
            models.push(("mget".to_owned(), model));
            self.spec = Some(found);
            let builder = part.first().checkpoint.arguments().get("model");
            let egom2p = builder
                .and_then(Value::as_str)
                .is_some_and(|builder| builder.starts_with("egom2p"));
            if egom2p && self.parts.contains_key("camera") {
                let camera = statistics.entry("camera".to_owned());
                camera.or_insert_with(statistics::egom2p_camera);
            }
        }
        for (name, part) in &self.parts {
            match part.first().plan.family {
                "vq" => {
                    let own = statistics
                        .remove(name)
                        .or_else(|| (name == "gaze").then(statistics::gaze));
                    if own.is_none() {
                        self.notices.push(format!(
                            "no statistics for `{name}`: it cannot be used without its `{{cam,body,lhand,rhand}}_{{mean,std}}.npy`; import them together"
                        ));
                    }
                    models.push((name.clone(), folder::signals(part, own)?));
                }
                "cosmos" => {
                    let all = folder::video(part, self.spec.as_ref(), options.clip)?;
                    models.extend(all.into_iter().map(|model| (name.clone(), model)));
                }
                _ => {}
            }
        }
        if let Some(model) = self.alone()? {
            models.push(model);
        }
        for modality in statistics.keys() {
            let notice = format!("statistics of `{modality}` without its tokenizer: left out");
            self.notices.push(notice);
        }
        if let Some(spec) = self.spec.clone() {
            self.compare_vocabularies(&spec, &models)?;
        }
        Ok(models)
    }

    /// A depth network or a motion encoder: each is a folder of its own.
    fn alone(&mut self) -> Result<Option<Planned>, ImportError> {
        let family = |part: &Part| part.first().plan.family;
        let mut parts = self.parts.iter();
        let Some((name, part)) = parts.find(|(_, part)| ["vda", "tmr"].contains(&family(part)))
        else {
            return Ok(None);
        };
        if self.parts.len() > 1 {
            return Err(part.first().refuse(
                "import a depth network or a motion encoder alone: it becomes a folder of its own",
            ));
        }
        let model = match family(part) {
            "vda" => {
                let (model, kind, settings) = folder::depth_network(part)?;
                let path = part.first().path().to_owned();
                let sha256 = self.hashes.get(&path)?.sha256;
                self.notices.extend(vda::doubt(&path, &sha256, kind));
                self.notices.push(vda::licence(&settings).to_owned());
                model
            }
            _ => folder::motion_encoder(part)?,
        };
        Ok(Some((name.clone(), model)))
    }

    /// Tokenizers and transformer of one set have the same vocabularies and grids.
    fn compare_vocabularies(
        &mut self,
        spec: &MgetSpec,
        models: &[Planned],
    ) -> Result<(), ImportError> {
        for modality in &spec.modalities {
            let Some(vocabulary) = modality.vocabulary() else {
                continue;
            };
            let name = &modality.name;
            let Some((part, _)) = models.iter().find(|(_, model)| model.name == *name) else {
                let notice = format!(
                    "no tokenizer of `{name}` was given: the model can neither see nor show it"
                );
                self.notices.push(notice);
                continue;
            };
            let plan = &self.parts[part].first().plan;
            let codes = plan.vocabulary();
            let grid = plan.grid.as_ref();
            if codes != vocabulary as u64 || grid.is_some_and(|grid| *grid != modality.grid()) {
                return Err(self.parts[part].first().refuse(format!(
                    "{codes} tokens on a grid of {grid:?}, but the transformer was trained with {vocabulary} tokens of `{name}` on {:?}: files of different sets",
                    modality.grid()
                )));
            }
        }
        Ok(())
    }

    /// Writes all models and the manifest into `work`.
    fn write(&mut self, models: &[Planned], work: &Path) -> Result<Vec<PartReport>, ImportError> {
        let mut parts = Map::new();
        let mut reports = Vec::new();
        for (from, model) in models {
            let Some(part) = self.parts.get_mut(from) else {
                continue;
            };
            let folder = work.join(&model.folder);
            std::fs::create_dir_all(&folder).map_err(ImportError::io(&folder))?;
            let mut metadata = model.metadata.clone();
            if model.name != "mget" {
                let mut weights = Vec::new();
                for source in &part.sources {
                    weights.push(self.hashes.get(source.path())?.sha256);
                }
                metadata.insert("weights_sha256".to_owned(), weights.join(" "));
            }
            let path = folder.join(model.file);
            let (sha256, values) = part.write(&path, &metadata, &model.more)?;
            if let Some((name, bytes)) = &model.beside {
                let path = folder.join(name);
                std::fs::write(&path, bytes).map_err(ImportError::io(&path))?;
            }
            let mut account = json!({
                "family": part.first().plan.family,
                "file": format!("{}/{}", model.folder, model.file).trim_start_matches('/'),
                "sha256": sha256,
                "values": values,
                "settings": model.settings,
            });
            if let Some(statistics) = &model.statistics {
                account["statistics"] = json!(statistics);
            }
            parts.insert(model.name.clone(), account);
            reports.push(PartReport {
                name: model.name.clone(),
                entries: part.entries(),
                written: part.tensors.len(),
                values,
            });
        }
        if let Some(spec) = &self.spec {
            let clips = folder::clips(spec, models.iter().map(|(_, model)| model));
            ModelManifest::of(work, clips)
                .and_then(|binding| binding.write(work))
                .map_err(|e| ImportError::refused(work, e.to_string()))?;
        }
        let mut inputs = Vec::new();
        for source in self.parts.values().flat_map(|part| &part.sources) {
            let file = self.hashes.get(source.path())?;
            inputs.push(source.account(&file.sha256, file.bytes));
        }
        let kinds = ["mget", "depth_network", "motion_encoder"];
        let kind = kinds.into_iter().find(|kind| parts.contains_key(*kind));
        let kind = kind.unwrap_or("tokenizers");
        let manifest = json!({
            "kind": kind,
            "format": FORMAT,
            "imported": true,
            "parts": parts,
            "notices": self.notices,
            "inputs": inputs,
        });
        let path = work.join("manifest.json");
        let mut text = serde_json::to_string_pretty(&manifest)
            .map_err(|e| ImportError::refused(&path, e.to_string()))?;
        text.push('\n');
        std::fs::write(&path, text).map_err(ImportError::io(&path))?;
        Ok(reports)
    }
}
