//! A look at a source: what its clips hold, which are dropped and why, and a few of them to look at.

use super::convert::Tally;
use super::pipeline::in_order;
use super::{ClipSource, Excluded, Outcome, ReadError};
use crate::clip::Clip;
use crate::modality::ClipFormat;
use crate::modality::inventory::{Inventory, count};
use serde::Serialize;
use std::ops::ControlFlow;

/// What was found.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Survey {
    /// The data set's own name, which clips carry.
    pub source: String,
    /// Clips there are, dropped ones included, and how many were looked at.
    pub clips: usize,
    /// How many of them were looked at: fewer than asked for where it was interrupted.
    pub looked_at: usize,
    /// Recordings that can be read.
    pub recordings: usize,
    /// Recordings that give no clips, with the reason.
    pub excluded: Vec<Excluded>,
    /// What is absent and what to supply for it, with the number of recordings that lack it.
    pub notes: Vec<(String, usize)>,
    /// What reads the videos, with the number of recordings.
    pub decoders: Vec<(String, usize)>,
    /// Sizes of its clips; of the first one where the source does not say them.
    pub format: ClipFormat,
    /// What became of the clips that were looked at.
    pub tally: Tally,
    /// What those of them hold that were not dropped.
    pub inventory: Inventory,
    /// Clips spread over those that were looked at.
    #[serde(skip)]
    pub examples: Vec<Clip>,
    /// It was asked to stop before the end.
    pub interrupted: bool,
}

/// Looks at `most` clips spread over `source` (or all) on all cores, keeping `examples` of them. Damaged clips are counted.
///
/// # Errors
/// When the source does not say the sizes of its clips and its first ones cannot be made, or it has none.
pub fn survey(
    source: &dyn ClipSource,
    most: Option<usize>,
    examples: usize,
    watch: &mut dyn FnMut(usize, usize) -> ControlFlow<()>,
) -> Result<Survey, ReadError> {
    let clips = source.len();
    let looked_at = most.unwrap_or(clips).min(clips);
    let chosen = |position: usize| position * clips / looked_at.max(1);
    let format = match source.format() {
        Some(format) => format,
        None => format_of_first(source)?,
    };
    let kept: Vec<usize> = (0..examples.min(looked_at))
        .map(|k| k * looked_at / examples.min(looked_at))
        .collect();
    let mut survey = Survey {
        source: source.name().to_owned(),
        clips,
        looked_at: 0,
        recordings: source.recordings().len(),
        excluded: source.excluded(),
        notes: source.notes(),
        decoders: source.decoders(),
        inventory: Inventory::of(&format),
        format: format.clone(),
        tally: Tally::default(),
        examples: Vec::new(),
        interrupted: false,
    };
    let make = |position: usize| {
        let outcome = source.clip(chosen(position));
        let counted = match &outcome {
            Ok(Outcome::Clip(clip)) => Some(count(clip, &format)),
            _ => None,
        };
        // Only what is shown later travels on.
        let outcome = outcome.map(|outcome| match outcome {
            Outcome::Clip(clip) if kept.binary_search(&position).is_err() => {
                Outcome::Clip(Box::new(Clip::empty(clip.id, clip.source)))
            }
            other => other,
        });
        let lost = match &outcome {
            Ok(Outcome::Clip(_)) => source.lost(chosen(position)),
            _ => Vec::new(),
        };
        (outcome, counted, lost)
    };
    in_order(looked_at, rayon::current_num_threads(), make, |results| {
        for (position, (outcome, counted, lost)) in results.enumerate() {
            survey.looked_at += 1;
            match outcome {
                Ok(Outcome::Clip(clip)) => {
                    survey.tally.clips += 1;
                    survey.tally.lose(lost);
                    if kept.binary_search(&position).is_ok() {
                        survey.examples.push(*clip);
                    }
                }
                Ok(Outcome::Dropped { reason, .. }) => survey.tally.drop(reason),
                Err(error) => survey.tally.damaged.push(error.to_string()),
            }
            if let Some(counted) = counted {
                survey.inventory.merge(&counted);
            }
            if watch(survey.looked_at, looked_at).is_break() {
                survey.interrupted = survey.looked_at < looked_at;
                break;
            }
        }
    });
    Ok(survey)
}

fn format_of_first(source: &dyn ClipSource) -> Result<ClipFormat, ReadError> {
    for outcome in super::clips(source) {
        if let Outcome::Clip(clip) = outcome? {
            return Ok(ClipFormat::of(&clip));
        }
    }
    Err(ReadError::Settings(format!(
        "`{}` has not one clip",
        source.name()
    )))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::world::{World, WorldClips, WorldSettings};

    #[test]
    fn a_survey_looks_everywhere_and_keeps_a_few() {
        let settings = WorldSettings {
            size: 8,
            ..WorldSettings::default()
        };
        let source = WorldClips::new(World::new(settings, 1), 0..40);
        let mut calls = 0;
        let survey = survey(&source, Some(4), 2, &mut |done, total| {
            calls += 1;
            assert_eq!((done, total), (calls, 4));
            ControlFlow::Continue(())
        })
        .unwrap();
        assert_eq!(
            (survey.clips, survey.looked_at, survey.tally.clips),
            (40, 4, 4)
        );
        assert_eq!(survey.inventory.clips, 4);
        let ids: Vec<&str> = survey
            .examples
            .iter()
            .map(|clip| clip.id.as_str())
            .collect();
        assert_eq!(ids, ["world/000000", "world/000020"]);
        assert!(survey.examples[0].rgb().is_some());
    }
}
