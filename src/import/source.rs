//! One given checkpoint: recognised, checked entry by entry, and accounted for.

use super::rules::{Plan, Rule};
use super::{Checkpoint, ImportError, ImportOptions, cosmos, mget, tmr, vda, vq};
use serde_json::{Map, Value, json};
use std::collections::BTreeMap;
use std::fmt::Write as _;
use std::path::{Path, PathBuf};

/// A recognised checkpoint.
pub(super) struct Source {
    pub checkpoint: Checkpoint,
    pub plan: Plan,
    /// What became of each entry.
    pub accounts: BTreeMap<String, String>,
}

impl Source {
    /// Opens a file and finds out what it is; no tensor is read.
    pub fn open(path: &Path, options: &ImportOptions) -> Result<Self, ImportError> {
        let mut checkpoint = Checkpoint::open(path)?;
        if let Some(reason) = checkpoint.overlap() {
            return Err(ImportError::refused(path, reason));
        }
        if !known(&checkpoint) || checkpoint.has_wrapped_layers() {
            checkpoint.unwrap_names();
        }
        if let (true, Some((name, what))) = (known(&checkpoint), checkpoint.opaque().first()) {
            return Err(ImportError::refused(
                path,
                format!("`{name}` is {what}, which no part of a model is"),
            ));
        }
        let plan = if mget::matches(&checkpoint) {
            mget::plan(&checkpoint, options.heads)
        } else if vq::matches(&checkpoint) {
            vq::plan(&checkpoint, options.heads)
        } else if cosmos::matches(&checkpoint) {
            cosmos::plan(&checkpoint, options.compression)
        } else if vda::matches(&checkpoint) {
            vda::plan(&checkpoint, options.depth)
        } else if tmr::matches(&checkpoint) {
            tmr::plan(&checkpoint, options.heads)
        } else {
            let mut reason =
                "no transformer, tokenizer, depth network or motion encoder of a known release"
                    .to_owned();
            if let Some(entry) = checkpoint.entries().first() {
                let _ = write!(reason, "; its first tensor is called `{}`", entry.name);
            }
            Err(reason)
        };
        Ok(Self {
            plan: plan.map_err(|reason| ImportError::refused(path, reason))?,
            checkpoint,
            accounts: BTreeMap::new(),
        })
    }

    pub fn path(&self) -> &Path {
        self.checkpoint.path()
    }

    pub fn refuse(&self, reason: impl Into<String>) -> ImportError {
        ImportError::refused(self.path(), reason)
    }

    /// Carries out the checks of all entries, and completes the settings with what position tables say.
    pub fn check(&mut self, notices: &mut Vec<String>) -> Result<(), ImportError> {
        let mut left_out: BTreeMap<&'static str, usize> = BTreeMap::new();
        for (index, rule) in self.plan.rules.clone().iter().enumerate() {
            let verdict = rule.check(&mut self.checkpoint, index)?;
            let name = self.checkpoint.entries()[index].name.clone();
            if let Some(grid) = verdict.grid {
                if self.plan.family == "mget" {
                    mget::set_grid(&mut self.plan.settings, &name, &grid);
                } else if self.plan.grid.get_or_insert_with(|| grid.clone()) != &grid {
                    return Err(self.refuse("encoder and decoder have different grids"));
                }
            }
            if let Rule::Unsupported { why } = rule {
                *left_out.entry(why).or_default() += 1;
            }
            self.accounts.insert(name, verdict.action);
        }
        let wrappers = self.checkpoint.wrappers();
        // Every trainer has one of these around its weights.
        if !matches!(wrappers, [] | [_] if wrappers.iter().all(|w| w == "model" || w == "state_dict"))
        {
            notices.push(format!(
                "{}: read without what is wrapped around its names: `{}`",
                self.path().display(),
                wrappers.join("`, `")
            ));
        }
        let averages = self.checkpoint.others().iter();
        for name in averages.filter(|name| name.contains("ema")) {
            let path = self.path().display();
            notices.push(format!(
                "{path}: its averaged weights, `{name}`, are not used"
            ));
        }
        for (why, count) in left_out {
            let path = self.path().display();
            notices.push(format!("{path}: {count} entries left out: {why}"));
        }
        Ok(())
    }

    /// What the manifest says of this file.
    pub fn account(&self, sha256: &str, bytes: u64) -> Value {
        let file = self.path().file_name();
        let entries: Map<String, Value> = self
            .accounts
            .iter()
            .map(|(name, action)| (name.clone(), action.as_str().into()))
            .collect();
        json!({
            "file": file.map(|f| f.to_string_lossy().into_owned()),
            "sha256": sha256,
            "bytes": bytes,
            "part": self.plan.part,
            "not_weights": self.checkpoint.others(),
            "wrappers": self.checkpoint.wrappers(),
            "arguments": self.checkpoint.arguments(),
            "entries": entries,
        })
    }
}

/// Whether the names are those of a release.
fn known(checkpoint: &Checkpoint) -> bool {
    [
        mget::matches,
        vq::matches,
        cosmos::matches,
        vda::matches,
        tmr::matches,
    ]
    .iter()
    .any(|matches| matches(checkpoint))
}

/// Files, and those in folders (and their `norm_stats`), sorted.
pub(super) fn expand(files: &[PathBuf]) -> Result<Vec<PathBuf>, ImportError> {
    const EXTENSIONS: [&str; 6] = ["pth", "pt", "ckpt", "jit", "safetensors", "npy"];
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
            // macOS lays `._name` beside every file that it copies to another disk.
            let hidden = path
                .file_name()
                .is_some_and(|name| name.as_encoded_bytes().starts_with(b"."));
            if known && !hidden && path.is_file() {
                all.push(path);
            }
        }
    }
    all.sort();
    all.dedup();
    Ok(all)
}
