//! The tokenizers of a model, one per modality, and the clips they take.

use super::error::{ModelError, wrong_clip};
use crate::clip::Clip;
use crate::modality::{self, ClipFormat, Modality};
use crate::tokenizer::{TokenGrid, Tokenizer};
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::sync::Arc;

/// One tokenizer per modality, for clips of one format. Copies share the weights.
#[derive(Clone)]
pub struct Tokenizers {
    format: ClipFormat,
    modalities: BTreeMap<String, Arc<dyn Modality>>,
    by_modality: BTreeMap<String, Arc<dyn Tokenizer>>,
}

impl std::fmt::Debug for Tokenizers {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        let grids = self.by_modality.iter().map(|(name, t)| (name, t.grid()));
        f.debug_map().entries(grids).finish()
    }
}

impl Tokenizers {
    /// None yet, for clips of `format`.
    #[must_use]
    pub fn new(format: ClipFormat) -> Self {
        let modalities = modality::all(&format)
            .into_iter()
            .map(|modality| (modality.name().to_owned(), modality.into()))
            .collect();
        Self {
            format,
            modalities,
            by_modality: BTreeMap::new(),
        }
    }

    /// Adds a tokenizer, in the place of an earlier one of its modality.
    pub fn insert(&mut self, tokenizer: Arc<dyn Tokenizer>) {
        let name = tokenizer.modality().to_owned();
        self.insert_as(&name, tokenizer);
    }

    pub(super) fn insert_as(&mut self, name: &str, tokenizer: Arc<dyn Tokenizer>) {
        self.by_modality.insert(name.to_owned(), tokenizer);
    }

    /// The sizes of the clips.
    #[must_use]
    pub fn format(&self) -> &ClipFormat {
        &self.format
    }

    /// The modalities that have a tokenizer, in the order of their names.
    pub fn names(&self) -> impl Iterator<Item = &str> {
        let known = |name: &&String| self.knows(name);
        self.by_modality.keys().filter(known).map(String::as_str)
    }

    /// The tokenizer of a modality.
    #[must_use]
    pub fn get(&self, name: &str) -> Option<&dyn Tokenizer> {
        self.by_modality.get(name).map(AsRef::as_ref)
    }

    /// A modality that has a tokenizer.
    #[must_use]
    pub fn modality(&self, name: &str) -> Option<&dyn Modality> {
        self.by_modality.get(name).and_then(|_| self.known(name))
    }

    /// A modality of the clips, with a tokenizer or without.
    pub(super) fn known(&self, name: &str) -> Option<&dyn Modality> {
        self.modalities.get(name).map(AsRef::as_ref)
    }

    pub(super) fn knows(&self, name: &str) -> bool {
        self.modalities.contains_key(name)
    }

    /// The tokens of a clip, by modality; a modality that the clip does not have is absent.
    ///
    /// # Errors
    /// When a signal has another form than the tokenizer was trained on.
    pub fn encode(&self, clip: &Clip) -> Result<BTreeMap<String, TokenGrid>, ModelError> {
        let mut tokens = BTreeMap::new();
        for (name, tokenizer) in &self.by_modality {
            let Some(modality) = self.known(name) else {
                continue;
            };
            let signal = modality
                .extract(clip)
                .map_err(|error| wrong_clip(clip, error))?;
            if let Some(signal) = signal {
                let grids = tokenizer.encode(std::slice::from_ref(&signal))?;
                tokens.extend(grids.into_iter().map(|grid| (name.clone(), grid)));
            }
        }
        Ok(tokens)
    }

    /// Writes every tokenizer into a folder of its name below `folder`.
    ///
    /// # Errors
    /// When a file cannot be written.
    pub fn write(&self, folder: &Path) -> Result<(), ModelError> {
        self.write_each(|name| folder.join(name))
    }

    /// Writes every tokenizer into the folder that `place` names for its modality.
    pub(super) fn write_each(&self, place: impl Fn(&str) -> PathBuf) -> Result<(), ModelError> {
        for (name, tokenizer) in &self.by_modality {
            let path = place(name);
            std::fs::create_dir_all(&path).map_err(|error| ModelError::Io {
                path: path.clone(),
                error,
            })?;
            tokenizer.write(&path)?;
        }
        Ok(())
    }
}
