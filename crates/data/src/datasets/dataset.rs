//! Many recordings as one [`ClipSource`]: opened when needed, a few of them kept open.

use super::declared::DeclaredTrack;
use super::recording::{CutSettings, Recording};
use super::{ClipSource, Excluded, Outcome, ReadError};
use crate::modality::{BUILT_IN, ClipFormat, DeclaredSettings, put};
use rayon::prelude::*;
use std::collections::BTreeMap;
use std::ops::Range;
use std::path::{Path, PathBuf};
use std::sync::{Arc, Mutex, OnceLock};

/// Opens one recording of a data set, by the folder or file that stands for it.
pub type Open = dyn Fn(&Path, &CutSettings) -> Result<Recording, ReadError> + Send + Sync;

/// An open recording with its declared signals, or room for one.
type Slot = Arc<OnceLock<Arc<(Recording, Vec<DeclaredTrack>)>>>;

/// What is kept of a recording that was opened to be counted.
struct Counted {
    name: String,
    clips: usize,
    modalities: Vec<String>,
    notes: Vec<String>,
    decoder: Option<String>,
}

/// Recordings of one data set.
pub struct Recordings {
    name: String,
    settings: CutSettings,
    open: Box<Open>,
    folders: Vec<PathBuf>,
    excluded: Vec<Excluded>,
    /// What recordings lack, with the number of those that lack it.
    notes: BTreeMap<String, usize>,
    /// What reads their videos.
    decoders: BTreeMap<String, usize>,
    /// Official splits, by recording.
    splits: BTreeMap<String, &'static str>,
    /// First clip of every recording, and the number of all clips at the end.
    starts: Vec<usize>,
    names: Vec<String>,
    modalities: Vec<String>,
    /// Modalities that a file of each folder brings.
    declared: Vec<DeclaredSettings>,
    /// The recordings used last, the newest at the end.
    recent: Mutex<Vec<(usize, Slot)>>,
    keep: usize,
}

impl std::fmt::Debug for Recordings {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("Recordings")
            .field("name", &self.name)
            .field("folders", &self.folders)
            .field("starts", &self.starts)
            .finish_non_exhaustive()
    }
}

impl Recordings {
    /// Opens every recording once to count its clips. One that cannot be opened is excluded, with its reason, where there are
    /// others.
    ///
    /// # Errors
    /// When settings make no sense, or not one recording can be opened.
    pub fn new(
        name: &str,
        folders: Vec<PathBuf>,
        settings: CutSettings,
        open: impl Fn(&Path, &CutSettings) -> Result<Recording, ReadError> + Send + Sync + 'static,
    ) -> Result<Self, ReadError> {
        settings.check()?;
        // Recordings hold open files and tables: only what is counted is kept.
        let counted: Vec<Result<Counted, ReadError>> = folders
            .par_iter()
            .map(|folder| {
                let mut recording = open(folder, &settings)?;
                recording.check(&settings)?;
                recording.notes.extend(recording.partial());
                Ok(Counted {
                    clips: recording.clips(&settings),
                    modalities: recording.modalities(),
                    decoder: recording.colour.as_ref().and_then(|c| c.decoder()),
                    name: recording.id,
                    notes: recording.notes,
                })
            })
            .collect();
        let mut starts = vec![0];
        let (mut modalities, mut names): (Vec<String>, Vec<String>) = Default::default();
        let (mut opened, mut excluded, mut notes) = (Vec::new(), Vec::new(), BTreeMap::new());
        let mut decoders = BTreeMap::new();
        let mut first_error = None;
        for (folder, counted) in folders.into_iter().zip(counted) {
            let counted = match counted {
                Ok(counted) => counted,
                // What the user asked for is wrong for every recording.
                Err(error @ ReadError::Settings(_)) => return Err(error),
                Err(error) => {
                    excluded.push(Excluded {
                        recording: folder.file_name().map_or_else(
                            || folder.display().to_string(),
                            |name| name.to_string_lossy().into_owned(),
                        ),
                        reason: error.to_string(),
                    });
                    first_error = first_error.or(Some(error));
                    continue;
                }
            };
            opened.push(folder);
            starts.push(starts[starts.len() - 1] + counted.clips);
            names.push(counted.name);
            for note in counted.notes {
                *notes.entry(note).or_default() += 1;
            }
            if let Some(decoder) = counted.decoder {
                *decoders.entry(decoder).or_default() += 1;
            }
            for modality in counted.modalities {
                if !modalities.contains(&modality) {
                    modalities.push(modality);
                }
            }
        }
        if let (true, Some(error)) = (opened.is_empty(), first_error) {
            return Err(error);
        }
        modalities.sort_by_key(|name| BUILT_IN.iter().position(|known| known == name));
        Ok(Recordings {
            name: name.to_owned(),
            settings,
            open: Box::new(open),
            folders: opened,
            excluded,
            notes,
            decoders,
            splits: BTreeMap::new(),
            starts,
            names,
            modalities,
            declared: Vec::new(),
            recent: Mutex::new(Vec::new()),
            keep: rayon::current_num_threads() + 1,
        })
    }

    /// Gives the clips these modalities too, from the npz file of each recording that a declaration names.
    #[must_use]
    pub fn with_declared(mut self, declared: &[DeclaredSettings]) -> Self {
        for settings in declared {
            let Some(file) = &settings.source.npz else {
                continue;
            };
            let lack = |folder: &&PathBuf| !folder.join(file).is_file();
            let count = self.folders.iter().filter(lack).count();
            if count > 0 {
                let note = format!("no `{}`: `{file}` is not there", settings.name);
                self.notes.insert(note, count);
            }
        }
        self.declared = declared.to_vec();
        self
    }

    /// Adds the official split of recordings.
    #[must_use]
    pub fn with_splits(mut self, splits: BTreeMap<String, &'static str>) -> Self {
        self.splits = splits;
        self
    }

    /// Adds what is known to be absent before any recording is opened.
    #[must_use]
    pub fn with_note(mut self, note: &str, count: usize) -> Self {
        *self.notes.entry(note.to_owned()).or_default() += count;
        self
    }

    /// The folders, in the order of their clips.
    #[must_use]
    pub fn folders(&self) -> &[PathBuf] {
        &self.folders
    }

    fn recording(&self, number: usize) -> Result<Arc<(Recording, Vec<DeclaredTrack>)>, ReadError> {
        let slot = {
            let mut recent = self
                .recent
                .lock()
                .unwrap_or_else(std::sync::PoisonError::into_inner);
            let slot = match recent.iter().position(|(known, _)| *known == number) {
                Some(at) => recent.remove(at).1,
                None => Arc::default(),
            };
            recent.push((number, Arc::clone(&slot)));
            let surplus = recent.len().saturating_sub(self.keep);
            recent.drain(..surplus);
            slot
        };
        if let Some(recording) = slot.get() {
            return Ok(Arc::clone(recording));
        }
        // Two threads may open the same recording at the same time; one of the two results is kept.
        let folder = &self.folders[number];
        let tracks: Result<Vec<_>, _> = self
            .declared
            .iter()
            .filter_map(|settings| DeclaredTrack::read(folder, settings).transpose())
            .collect();
        let opened = Arc::new(((self.open)(folder, &self.settings)?, tracks?));
        Ok(Arc::clone(slot.get_or_init(|| opened)))
    }
}

impl ClipSource for Recordings {
    fn name(&self) -> &str {
        &self.name
    }

    fn len(&self) -> usize {
        self.starts[self.folders.len()]
    }

    fn modalities(&self) -> Vec<String> {
        self.modalities.clone()
    }

    fn format(&self) -> Option<ClipFormat> {
        Some(ClipFormat {
            declared: self.declared.clone(),
            ..self.settings.format()
        })
    }

    fn recordings(&self) -> Vec<(String, Range<usize>)> {
        let ranges = self.starts.windows(2).map(|pair| pair[0]..pair[1]);
        self.names.iter().cloned().zip(ranges).collect()
    }

    fn splits(&self) -> BTreeMap<String, &'static str> {
        self.splits.clone()
    }

    fn excluded(&self) -> Vec<Excluded> {
        self.excluded.clone()
    }

    fn notes(&self) -> Vec<(String, usize)> {
        let notes = self.notes.iter();
        notes.map(|(note, count)| (note.clone(), *count)).collect()
    }

    fn decoders(&self) -> Vec<(String, usize)> {
        let decoders = self.decoders.iter();
        decoders
            .map(|(name, count)| (name.clone(), *count))
            .collect()
    }

    fn lost(&self, index: usize) -> Vec<String> {
        let number = self.starts.partition_point(|start| *start <= index) - 1;
        let Some(start) = self.starts.get(number).filter(|_| index < self.len()) else {
            return Vec::new();
        };
        // What cannot be read is an error of the clip itself.
        self.recording(number).map_or_else(
            |_| Vec::new(),
            |recording| recording.0.lost(index - start, &self.settings),
        )
    }

    fn clip(&self, index: usize) -> Result<Outcome, ReadError> {
        if index >= self.len() {
            return Err(ReadError::OutOfRange {
                source_name: self.name.clone(),
                index,
                len: self.len(),
            });
        }
        let number = self.starts.partition_point(|start| *start <= index) - 1;
        let (recording, declared) = &*self.recording(number)?;
        let inside = index - self.starts[number];
        let mut outcome = recording.clip(inside, &self.settings)?;
        let format = self.format().unwrap_or_default();
        if let Outcome::Clip(clip) = &mut outcome {
            for track in declared {
                let signal = track.clip(inside as f64 * self.settings.stride);
                put(&track.settings, &format, signal, clip)
                    .map_err(|error| ReadError::Settings(error.to_string()))?;
            }
        }
        Ok(outcome)
    }
}

/// The folders below `root` (itself included) that `is_recording` accepts, in the order of their names; recordings are not
/// looked for inside recordings.
///
/// # Errors
/// When a folder cannot be listed, or there is none.
pub fn find(
    root: &Path,
    what: &str,
    is_recording: fn(&Path) -> bool,
) -> Result<Vec<PathBuf>, ReadError> {
    fn descend(
        folder: &Path,
        depth: usize,
        is_recording: fn(&Path) -> bool,
        found: &mut Vec<PathBuf>,
    ) -> Result<(), ReadError> {
        if is_recording(folder) {
            found.push(folder.to_owned());
            return Ok(());
        }
        if depth == 0 {
            return Ok(());
        }
        let fail = |cause| ReadError::io(folder, cause);
        let mut inside = Vec::new();
        for entry in std::fs::read_dir(folder).map_err(fail)? {
            let entry = entry.map_err(fail)?;
            // Links are not followed: a link to a parent would never end.
            if entry.file_type().map_err(fail)?.is_dir() {
                inside.push(entry.path());
            }
        }
        inside.sort();
        inside
            .iter()
            .try_for_each(|path| descend(path, depth - 1, is_recording, found))
    }
    let mut found = Vec::new();
    descend(root, 4, is_recording, &mut found)?;
    if found.is_empty() {
        return Err(ReadError::absent(root, format!("there is no {what} here")));
    }
    Ok(found)
}
