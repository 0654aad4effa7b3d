//! [`Joined`]: the clips of several sources, one source after the other.

use super::source::{ClipSource, Excluded, Outcome};
use crate::formats::ReadError;
use crate::modality::ClipFormat;
use std::ops::Range;
use std::sync::Arc;

/// The first clips of each of several sources as one source. It has the name and the format of the first.
#[derive(Clone, Default)]
pub struct Joined {
    /// Each source, and how many of its clips take part.
    parts: Vec<(Arc<dyn ClipSource>, usize)>,
}

impl std::fmt::Debug for Joined {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_list()
            .entries(self.parts.iter().map(|(part, clips)| (part.name(), clips)))
            .finish()
    }
}

impl Joined {
    /// All clips of all `sources`.
    #[must_use]
    pub fn new(sources: Vec<Arc<dyn ClipSource>>) -> Self {
        let whole = |source: Arc<dyn ClipSource>| (Arc::clone(&source), source.len());
        Joined {
            parts: sources.into_iter().map(whole).collect(),
        }
    }

    /// At most `most` clips, of each source in proportion to its size, and of none less than one.
    #[must_use]
    pub fn at_most(sources: Vec<Arc<dyn ClipSource>>, most: usize) -> Self {
        let mut joined = Self::new(sources);
        let total: usize = joined.lengths().sum();
        if total > most {
            for (_, clips) in &mut joined.parts {
                *clips = (*clips * most / total).clamp(1.min(*clips), *clips);
            }
        }
        joined
    }

    /// How many clips each source contributes.
    pub fn lengths(&self) -> impl Iterator<Item = usize> + '_ {
        self.parts.iter().map(|(_, clips)| *clips)
    }

    fn place(&self, index: usize) -> Result<(&dyn ClipSource, usize), ReadError> {
        let mut inside = index;
        for (source, clips) in &self.parts {
            if inside < *clips {
                return Ok((source.as_ref(), inside));
            }
            inside -= clips;
        }
        Err(ReadError::OutOfRange {
            source_name: self.name().to_owned(),
            index,
            len: self.len(),
        })
    }
}

impl ClipSource for Joined {
    fn name(&self) -> &str {
        self.parts
            .first()
            .map_or("clips", |(first, _)| first.name())
    }

    fn len(&self) -> usize {
        self.lengths().sum()
    }

    fn modalities(&self) -> Vec<String> {
        let mut names: Vec<String> = Vec::new();
        for name in self.parts.iter().flat_map(|(part, _)| part.modalities()) {
            if !names.contains(&name) {
                names.push(name);
            }
        }
        names
    }

    fn format(&self) -> Option<ClipFormat> {
        self.parts.first()?.0.format()
    }

    fn recordings(&self) -> Vec<(String, Range<usize>)> {
        let mut found = Vec::new();
        let mut start = 0;
        for (source, clips) in &self.parts {
            for (name, range) in source.recordings() {
                let range = range.start.min(*clips)..range.end.min(*clips);
                if !range.is_empty() {
                    found.push((name, start + range.start..start + range.end));
                }
            }
            start += clips;
        }
        found
    }

    fn excluded(&self) -> Vec<Excluded> {
        self.parts.iter().flat_map(|(p, _)| p.excluded()).collect()
    }

    fn lost(&self, index: usize) -> Vec<String> {
        let place = self.place(index);
        place.map_or_else(|_| Vec::new(), |(source, index)| source.lost(index))
    }

    fn clip(&self, index: usize) -> Result<Outcome, ReadError> {
        let (source, index) = self.place(index)?;
        source.clip(index)
    }

    fn clip_with(&self, index: usize, modalities: &[&str]) -> Result<Outcome, ReadError> {
        let (source, index) = self.place(index)?;
        source.clip_with(index, modalities)
    }

    fn may_have(&self, index: usize, modality: &str) -> bool {
        self.place(index)
            .is_ok_and(|(source, index)| source.may_have(index, modality))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::world::{World, WorldClips, WorldSettings};

    #[test]
    fn clips_of_all_sources_follow_each_other() {
        let settings = WorldSettings {
            size: 8,
            ..WorldSettings::default()
        };
        let world = |range| -> Arc<dyn ClipSource> {
            Arc::new(WorldClips::new(World::new(settings.clone(), 0), range))
        };
        let all = || vec![world(0..3), world(10..11), world(20..26)];
        let joined = Joined::new(all());
        assert_eq!((joined.len(), joined.name()), (10, "world"));
        let id =
            |source: &dyn ClipSource, index| source.clip(index).unwrap().into_clip().unwrap().id;
        let ids: Vec<String> = (0..10).map(|index| id(&joined, index)).collect();
        assert_eq!(ids[2..5], ["world/000002", "world/000010", "world/000020"]);
        assert!(joined.clip(10).is_err() && !joined.may_have(10, "rgb"));
        let some = Joined::at_most(all(), 4);
        assert_eq!(some.lengths().collect::<Vec<_>>(), [1, 1, 2]);
        assert_eq!(id(&some, 3), "world/000021");
        let recordings: usize = some.recordings().iter().map(|(_, range)| range.len()).sum();
        assert_eq!(recordings, some.len());
    }
}
