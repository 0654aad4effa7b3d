//! The arrays and files of a reconstruction folder, as the tracks of its modalities write them.

use super::manifest::{ArrayFacts, ArrayFile};
use crate::clip::Intrinsics;
use crate::clip::clock::SIGNAL_RATE;
use crate::formats::npy::NpyArray;
use crate::reconstruction::folder_error::FolderError;
use crate::reconstruction::predictions::ScaleStatus;
use std::fs::File;
use std::io::{BufWriter, Write};
use std::path::Path;

/// A folder that is being written.
#[derive(Debug)]
pub struct Files<'a> {
    path: &'a Path,
    /// Of the square frames.
    pub intrinsics: Intrinsics,
    /// Hz of the arrays that are added.
    pub rate: f64,
    /// Frames of the video, and their rate.
    frames: (usize, f64),
    arrays: Vec<(String, ArrayFile)>,
    names: Vec<String>,
}

impl<'a> Files<'a> {
    /// A folder of a video of so many frames at this rate.
    #[must_use]
    pub fn new(path: &'a Path, intrinsics: Intrinsics, frames: (usize, f64)) -> Self {
        Self {
            path,
            intrinsics,
            rate: SIGNAL_RATE,
            frames,
            arrays: Vec::new(),
            names: Vec::new(),
        }
    }

    /// What an array is; `validity` names the array that says which entries are known.
    #[must_use]
    pub fn facts(
        &self,
        name: &str,
        unit: &str,
        frame: &str,
        scale: ScaleStatus,
        validity: Option<&str>,
    ) -> ArrayFacts {
        ArrayFacts {
            file: String::new(),
            name: name.into(),
            shape: Vec::new(),
            unit: unit.into(),
            frame: frame.into(),
            rate: Some(self.rate),
            scale,
            validity: validity.map(Into::into),
        }
    }

    /// Adds an array to the npz `file`, which several tracks may share.
    pub fn array(&mut self, file: &str, array: impl Into<NpyArray>, facts: ArrayFacts) {
        let at = self
            .arrays
            .iter()
            .position(|(name, _)| name == file)
            .unwrap_or_else(|| {
                self.arrays.push((file.to_owned(), ArrayFile::default()));
                self.arrays.len() - 1
            });
        let held = std::mem::take(&mut self.arrays[at].1);
        self.arrays[at].1 = held.with(array, facts);
    }

    /// Adds an array, and beside it `<name>_valid`.
    #[expect(clippy::too_many_arguments, reason = "one line of the manifest")]
    pub fn array_with_validity(
        &mut self,
        file: &str,
        name: &str,
        values: impl Into<NpyArray>,
        valid: impl Into<NpyArray>,
        unit: &str,
        frame: &str,
        scale: ScaleStatus,
    ) {
        let validity = format!("{name}_valid");
        let facts = self.facts(name, unit, frame, scale, Some(&validity));
        self.array(file, values, facts);
        let facts = self.facts(&validity, "true or false", frame, ScaleStatus::None, None);
        self.array(file, valid, facts);
    }

    /// Writes a file.
    ///
    /// # Errors
    /// When the disk refuses.
    pub fn file(
        &mut self,
        name: &str,
        write: impl FnOnce(&mut BufWriter<File>) -> std::io::Result<()>,
    ) -> Result<(), FolderError> {
        let path = self.path.join(name);
        let made = File::create(&path).map(BufWriter::new).and_then(|mut out| {
            write(&mut out)?;
            out.flush()
        });
        made.map_err(FolderError::io(&path))?;
        self.names.push(name.into());
        Ok(())
    }

    /// Writes a folder of these files.
    ///
    /// # Errors
    /// When the disk refuses.
    pub fn folder<const N: usize>(
        &mut self,
        name: &str,
        files: [&str; N],
        write: impl FnOnce(&Path) -> std::io::Result<()>,
    ) -> Result<(), FolderError> {
        let path = self.path.join(name);
        write(&path).map_err(FolderError::io(&path))?;
        self.names
            .extend(files.map(|file| format!("{name}/{file}")));
        Ok(())
    }

    /// The sample of a track of `count` samples, at least one, that belongs to each frame of the video.
    pub fn samples_of_frames(&self, count: usize) -> impl Iterator<Item = usize> + use<> {
        let (frames, rate) = self.frames;
        (0..frames).map(move |frame| sample_of(frame, rate, count))
    }

    /// Writes the arrays; what each is, and the names of all files.
    ///
    /// # Errors
    /// When the disk refuses.
    pub fn finish(mut self) -> Result<(Vec<ArrayFacts>, Vec<String>), FolderError> {
        let mut facts = Vec::new();
        for (name, arrays) in std::mem::take(&mut self.arrays) {
            facts.extend(arrays.write(self.path, &name)?);
            self.names.push(name);
        }
        Ok((facts, self.names))
    }
}

/// The sample at 30 Hz of a frame, at most the last of `count`.
#[must_use]
pub fn sample_of(frame: usize, rate: f64, count: usize) -> usize {
    let sample = (frame as f64 / rate * SIGNAL_RATE).round_ties_even();
    (sample as usize).min(count.saturating_sub(1))
}
