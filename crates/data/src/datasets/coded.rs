//! A source whose declared modalities are computed by the code of plug-in crates.

use super::{ClipSource, Excluded, Outcome, ReadError};
use crate::modality::{ClipFormat, code};
use std::ops::Range;
use std::sync::Arc;

/// The clips of a source, each with what `format` leaves to code.
pub struct Coded {
    source: Arc<dyn ClipSource>,
    format: ClipFormat,
}

impl Coded {
    /// `source` itself where nothing is left to code.
    pub fn wrap(source: Arc<dyn ClipSource>, format: &ClipFormat) -> Arc<dyn ClipSource> {
        let needed = format.declared.iter().any(|d| d.source.code.is_some());
        if !needed {
            return source;
        }
        let format = format.clone();
        Arc::new(Self { source, format })
    }
}

impl ClipSource for Coded {
    fn name(&self) -> &str {
        self.source.name()
    }

    fn len(&self) -> usize {
        self.source.len()
    }

    fn modalities(&self) -> Vec<String> {
        self.source.modalities()
    }

    fn format(&self) -> Option<ClipFormat> {
        self.source.format()
    }

    fn recordings(&self) -> Vec<(String, Range<usize>)> {
        self.source.recordings()
    }

    fn excluded(&self) -> Vec<Excluded> {
        self.source.excluded()
    }

    fn notes(&self) -> Vec<(String, usize)> {
        self.source.notes()
    }

    fn decoders(&self) -> Vec<(String, usize)> {
        self.source.decoders()
    }

    fn lost(&self, index: usize) -> Vec<String> {
        self.source.lost(index)
    }

    fn clip(&self, index: usize) -> Result<Outcome, ReadError> {
        let mut outcome = self.source.clip(index)?;
        if let Outcome::Clip(clip) = &mut outcome {
            code::fill(clip, &self.format)
                .map_err(|error| ReadError::Settings(error.to_string()))?;
        }
        Ok(outcome)
    }
}
