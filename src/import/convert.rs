//! The whole import: recognise, check, convert, and account for every entry.

use super::rules::{Plan, Rule};
use super::statistics::{self, Statistics};
use super::{Checkpoint, ImportError, cosmos, mget, vq};
use crate::mget::MgetSpec;
use serde_json::{Map, Value, json};
use sha2::{Digest, Sha256};
use std::collections::BTreeMap;
use std::fs::File;
use std::io::{BufWriter, Read, Write};
use std::path::{Path, PathBuf};

/// What the files do not say.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct ImportOptions {
    /// Attention heads, for checkpoints that do not name their builder.
    pub heads: Option<usize>,
    /// Frames and pixels per token of a video tokenizer whose file is not named after them.
    pub compression: Option<[usize; 2]>,
}

/// What an import did.
#[derive(Debug, Clone, PartialEq)]
pub struct ImportReport {
    pub folder: PathBuf,
    pub parts: Vec<PartReport>,
    /// Things a user should know: left-out modalities, missing statistics.
    pub notices: Vec<String>,
}

/// One converted model.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct PartReport {
    pub name: String,
    /// Entries of its files, and how many of them were written.
    pub entries: usize,
    pub written: usize,
    /// Numbers written.
    pub values: u64,
}

/// The form of our manifest.
const FORMAT: u64 = 1;

/// Imports released files (weights, statistics, or folders of them) into `folder`, which must not exist yet: one safetensors
/// file per model and a `manifest.json` that accounts for every entry.
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
    std::fs::create_dir_all(parent).map_err(ImportError::io(parent))?;
    let work = tempfile::Builder::new()
        .prefix(".import-")
        .tempdir_in(parent)
        .map_err(ImportError::io(parent))?;
    let report = Import::read(files, options)?.write(work.path(), folder)?;
    let work = work.keep();
    std::fs::rename(&work, folder).map_err(ImportError::io(folder))?;
    Ok(report)
}

/// A recognised checkpoint.
struct Source {
    checkpoint: Checkpoint,
    plan: Plan,
    sha256: String,
    bytes: u64,
}

/// Everything that was given, recognised.
struct Import {
    sources: Vec<Source>,
    statistics: BTreeMap<String, Statistics>,
}

impl Import {
    fn read(files: &[PathBuf], options: &ImportOptions) -> Result<Self, ImportError> {
        let files = expand(files)?;
        let (arrays, checkpoints): (Vec<PathBuf>, Vec<PathBuf>) = files
            .into_iter()
            .partition(|path| path.extension().is_some_and(|e| e == "npy"));
        let mut hashes = BTreeMap::new();
        for path in &arrays {
            hashes.insert(path.clone(), hash_file(path)?.0);
        }
        let statistics = statistics::read(&arrays, &hashes)?;
        let mut sources = Vec::new();
        for path in checkpoints {
            let checkpoint = Checkpoint::open(&path)?;
            let plan = if mget::matches(&checkpoint) {
                mget::plan(&checkpoint, options.heads)
            } else if vq::matches(&checkpoint) {
                vq::plan(&checkpoint, options.heads)
            } else if cosmos::matches(&checkpoint) {
                cosmos::plan(&checkpoint, options.compression)
            } else {
                Err("neither a transformer nor a tokenizer of a known release".to_owned())
            };
            let plan = plan.map_err(|reason| ImportError::refused(&path, reason))?;
            let (sha256, bytes) = hash_file(&path)?;
            sources.push(Source {
                checkpoint,
                plan,
                sha256,
                bytes,
            });
        }
        if sources.is_empty() {
            let path = PathBuf::from("import");
            return Err(ImportError::refused(&path, "no checkpoint was given"));
        }
        Ok(Self {
            sources,
            statistics,
        })
    }

    fn write(mut self, work: &Path, folder: &Path) -> Result<ImportReport, ImportError> {
        let mut inputs = Vec::new();
        let mut notices = Vec::new();
        for source in &mut self.sources {
            inputs.push(check(source, &mut notices)?);
        }
        let mut groups: BTreeMap<String, Vec<Source>> = BTreeMap::new();
        for source in self.sources {
            groups
                .entry(source.plan.part.clone())
                .or_default()
                .push(source);
        }
        for (modality, statistics) in &mut self.statistics {
            if !groups.contains_key(modality) {
                notices.push(format!(
                    "statistics of `{modality}` without its tokenizer ({} values)",
                    statistics.mean.len()
                ));
            }
        }
        let egom2p = groups.get("mget").and_then(|sources| {
            let model = sources[0].checkpoint.arguments().get("model")?.as_str()?;
            Some(model.starts_with("egom2p"))
        });
        if egom2p == Some(true) && groups.contains_key("camera") {
            self.statistics
                .entry("camera".to_owned())
                .or_insert_with(statistics::egom2p_camera);
        }
        compare_vocabularies(&groups)?;
        let mut parts = Map::new();
        let mut reports = Vec::new();
        for (name, mut sources) in groups {
            let (report, sha256) = convert(&name, &mut sources, work)?;
            let family = sources[0].plan.family;
            let mut part = json!({
                "family": family,
                "weights": format!("{name}.safetensors"),
                "sha256": sha256,
                "values": report.values,
                "settings": sources[0].plan.settings,
            });
            match self.statistics.get(&name) {
                Some(statistics) => part["statistics"] = json!(statistics),
                None if family == "vq" && name != "gaze" => notices.push(format!(
                    "no statistics for `{name}`: its signals cannot be de-normalised; give `{{cam,body,lhand,rhand}}_{{mean,std}}.npy` too"
                )),
                None => {}
            }
            parts.insert(name, part);
            reports.push(report);
        }
        let manifest = json!({
            "kind": if parts.contains_key("mget") { "mget" } else { "tokenizer" },
            "format": FORMAT,
            "imported": true,
            "parts": parts,
            "notices": notices,
            "inputs": inputs,
        });
        let path = work.join("manifest.json");
        let mut text = serde_json::to_string_pretty(&manifest)
            .map_err(|e| ImportError::refused(&path, e.to_string()))?;
        text.push('\n');
        std::fs::write(&path, text).map_err(ImportError::io(&path))?;
        Ok(ImportReport {
            folder: folder.to_owned(),
            parts: reports,
            notices,
        })
    }
}

/// Files, and those in folders (and their `norm_stats`), sorted.
fn expand(files: &[PathBuf]) -> Result<Vec<PathBuf>, ImportError> {
    const EXTENSIONS: [&str; 5] = ["pth", "pt", "jit", "safetensors", "npy"];
    let mut all = Vec::new();
    let mut folders = Vec::new();
    for path in files {
        if path.is_dir() {
            folders.push(path.clone());
            folders.push(path.join("norm_stats"));
        } else {
            all.push(path.clone());
        }
    }
    for folder in folders.into_iter().filter(|f| f.is_dir()) {
        for entry in std::fs::read_dir(&folder).map_err(ImportError::io(&folder))? {
            let path = entry.map_err(ImportError::io(&folder))?.path();
            let known = path
                .extension()
                .and_then(|e| e.to_str())
                .is_some_and(|e| EXTENSIONS.contains(&e));
            if known && path.is_file() {
                all.push(path);
            }
        }
    }
    all.sort();
    all.dedup();
    Ok(all)
}

/// SHA-256 and size of a file.
fn hash_file(path: &Path) -> Result<(String, u64), ImportError> {
    let mut file = File::open(path).map_err(ImportError::io(path))?;
    let mut hasher = Sha256::new();
    let mut buffer = vec![0; 1 << 20];
    let mut bytes = 0;
    loop {
        let got = file.read(&mut buffer).map_err(ImportError::io(path))?;
        if got == 0 {
            return Ok((hex(&hasher.finalize()), bytes));
        }
        hasher.update(&buffer[..got]);
        bytes += got as u64;
    }
}

fn hex(bytes: &[u8]) -> String {
    use std::fmt::Write;
    bytes.iter().fold(String::new(), |mut text, byte| {
        let _ = write!(text, "{byte:02x}");
        text
    })
}

/// Carries out the checks of all entries of one file, completes its settings, and gives its part of the manifest.
fn check(source: &mut Source, notices: &mut Vec<String>) -> Result<Value, ImportError> {
    let path = source.checkpoint.path().to_owned();
    let mut accounts = Map::new();
    let mut left_out: BTreeMap<&'static str, usize> = BTreeMap::new();
    for (index, rule) in source.plan.rules.clone().iter().enumerate() {
        let verdict = rule.check(&mut source.checkpoint, index)?;
        let name = source.checkpoint.entries()[index].name.clone();
        if let (Some(grid), "mget") = (&verdict.grid, source.plan.family) {
            mget::set_grid(&mut source.plan.settings, &name, grid);
        }
        if let Rule::Unsupported { why } = rule {
            *left_out.entry(why).or_default() += 1;
        }
        accounts.insert(name, verdict.action.into());
    }
    for (why, count) in left_out {
        notices.push(format!(
            "{}: {count} entries left out: {why}",
            path.display()
        ));
    }
    if source.plan.family == "mget" {
        let spec: MgetSpec = serde_json::from_value(source.plan.settings.clone())
            .map_err(|e| ImportError::refused(&path, format!("incomplete model: {e}")))?;
        spec.check()
            .map_err(|e| ImportError::refused(&path, e.to_string()))?;
        let kept = source.plan.rules.iter().zip(source.checkpoint.entries());
        let kept: BTreeMap<String, Vec<usize>> = kept
            .filter_map(|(rule, entry)| rule.written(entry))
            .collect();
        let expected: BTreeMap<String, Vec<usize>> = spec.parameters().into_iter().collect();
        if let Some((name, shape)) = expected.iter().find(|(n, s)| kept.get(*n) != Some(s)) {
            let reason = format!(
                "`{name}` should have shape {shape:?}, the file has {:?}",
                kept.get(name)
            );
            return Err(ImportError::refused(&path, reason));
        }
    }
    let file = path.file_name().map(|f| f.to_string_lossy().into_owned());
    Ok(json!({
        "file": file,
        "sha256": source.sha256,
        "bytes": source.bytes,
        "part": source.plan.part,
        "not_weights": source.checkpoint.others(),
        "arguments": source.checkpoint.arguments(),
        "entries": accounts,
    }))
}

/// Tokenizers and transformer of one set have the same vocabularies.
fn compare_vocabularies(groups: &BTreeMap<String, Vec<Source>>) -> Result<(), ImportError> {
    let Some(model) = groups.get("mget").map(|sources| &sources[0]) else {
        return Ok(());
    };
    let modalities = model.plan.settings["modalities"].as_array();
    for modality in modalities.into_iter().flatten() {
        let name = modality["name"].as_str().unwrap_or_default();
        let vocabulary = &modality["input"]["tokens"]["vocabulary"];
        if let Some(source) = groups.get(name).map(|sources| &sources[0])
            && source.plan.settings["codebook"] != *vocabulary
        {
            return Err(ImportError::refused(
                source.checkpoint.path(),
                format!(
                    "a codebook of {}, but `{}` was trained with {vocabulary} tokens of `{name}`: files of different sets",
                    source.plan.settings["codebook"],
                    model.checkpoint.path().display()
                ),
            ));
        }
    }
    Ok(())
}

/// One entry to write.
struct Write1 {
    source: usize,
    index: usize,
    shape: Vec<usize>,
}

/// Writes `<name>.safetensors` from one or several sources, tensor by tensor, and gives its SHA-256.
fn convert(
    name: &str,
    sources: &mut [Source],
    work: &Path,
) -> Result<(PartReport, String), ImportError> {
    let mut writes: BTreeMap<String, Write1> = BTreeMap::new();
    let settings = sources[0].plan.settings.clone();
    let mut entries = 0;
    for (s, source) in sources.iter().enumerate() {
        let path = source.checkpoint.path();
        if source.plan.settings != settings {
            let reason = format!("differs in its sizes from the other file of `{name}`");
            return Err(ImportError::refused(path, reason));
        }
        for (index, (rule, entry)) in source
            .plan
            .rules
            .iter()
            .zip(source.checkpoint.entries())
            .enumerate()
        {
            entries += 1;
            if let Some((target, shape)) = rule.written(entry) {
                let write = Write1 {
                    source: s,
                    index,
                    shape,
                };
                if writes.insert(target.clone(), write).is_some() {
                    let reason = format!("a second `{target}` for `{name}`");
                    return Err(ImportError::refused(path, reason));
                }
            }
        }
    }
    let mut header = Map::new();
    let mut end = 0u64;
    for (target, write) in &writes {
        let bytes = 4 * write.shape.iter().map(|d| *d as u64).product::<u64>();
        let entry = json!({
            "dtype": "F32",
            "shape": write.shape,
            "data_offsets": [end, end + bytes],
        });
        header.insert(target.clone(), entry);
        end += bytes;
    }
    let path = work.join(format!("{name}.safetensors"));
    let file = File::create(&path).map_err(ImportError::io(&path))?;
    let mut out = Hashed {
        out: BufWriter::with_capacity(1 << 20, file),
        hasher: Sha256::new(),
    };
    let mut text = serde_json::to_vec(&Value::Object(header))
        .map_err(|e| ImportError::refused(&path, e.to_string()))?;
    while !text.len().is_multiple_of(8) {
        text.push(b' ');
    }
    let io = |result: std::io::Result<()>| result.map_err(ImportError::io(&path));
    io(out.put(&(text.len() as u64).to_le_bytes()))?;
    io(out.put(&text))?;
    let mut bytes = Vec::new();
    for (target, write) in &writes {
        let checkpoint = &mut sources[write.source].checkpoint;
        let from = checkpoint.path().to_owned();
        checkpoint.stream(write.index, &mut |values| {
            if values.iter().any(|v| !v.is_finite()) {
                let reason = format!("`{target}` holds a value that is not finite");
                return Err(ImportError::refused(&from, reason));
            }
            bytes.clear();
            bytes.extend(values.iter().flat_map(|v| v.to_le_bytes()));
            io(out.put(&bytes))
        })?;
    }
    let (file, sha256) = out.finish().map_err(ImportError::io(&path))?;
    io(file.sync_all())?;
    let report = PartReport {
        name: name.to_owned(),
        entries,
        written: writes.len(),
        values: end / 4,
    };
    Ok((report, sha256))
}

/// A file that is hashed while it is written.
struct Hashed {
    out: BufWriter<File>,
    hasher: Sha256,
}

impl Hashed {
    fn put(&mut self, bytes: &[u8]) -> std::io::Result<()> {
        self.hasher.update(bytes);
        self.out.write_all(bytes)
    }

    fn finish(self) -> std::io::Result<(File, String)> {
        let file = self
            .out
            .into_inner()
            .map_err(std::io::IntoInnerError::into_error)?;
        Ok((file, hex(&self.hasher.finalize())))
    }
}
