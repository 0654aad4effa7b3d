//! `op: statistics`: what clips hold, by split: counts, validity, mean, spread and range of every channel in its unit. Writes
//! `statistics.json`, `statistics.csv` and the table of the report page.

use super::clip_signals::{
    SPLITS, damaged, described_format, format, open_split, unknown_modality,
};
use super::evaluate::write_text;
use crate::clip::Clip;
use crate::experiment::{
    Arity, ArtifactKind, Description, Inputs, Op, OpEntry, Port, Problem, StageContext, StageError,
    StagePlan,
};
use crate::modality::inventory::{Counter, Inventory};
use rayon::prelude::*;
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use serde_json::{Value, json};
use std::collections::BTreeMap;
use std::fmt::Write as _;

/// Settings of `op: statistics`.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct StatisticsSettings {
    /// Only these modalities; left out: all that the clips have.
    pub modalities: Vec<String>,
}

/// The op.
#[derive(Debug)]
pub struct Statistics;
inventory::submit! { OpEntry(&Statistics) }

/// Clips held at a time.
const BATCH: usize = 16;

impl Op for Statistics {
    type Settings = StatisticsSettings;

    fn name(&self) -> &'static str {
        "statistics"
    }

    fn version(&self) -> u32 {
        1
    }

    fn about(&self) -> &'static str {
        "Counts what clips hold: validity, mean, spread and range of every channel."
    }

    fn inputs(&self) -> &'static [Port] {
        &[Port {
            name: "clips",
            kinds: &[ArtifactKind::Clips],
            arity: Arity::One,
            about: "what is counted, split by split",
        }]
    }

    fn output(&self) -> ArtifactKind {
        ArtifactKind::Table
    }

    fn seeded(&self) -> bool {
        false
    }

    fn check(
        &self,
        settings: &StatisticsSettings,
        inputs: &Inputs<'_>,
        problems: &mut Vec<Problem>,
    ) -> Description {
        let Some(clips) = inputs.one("clips") else {
            return Description::default();
        };
        for (i, name) in settings.modalities.iter().enumerate() {
            if !clips.signals.contains_key(name) {
                problems.push(unknown_modality(format!("modalities.{i}"), name, clips));
            }
        }
        Description {
            clips: clips.clips.clone(),
            ..Description::default()
        }
    }

    fn plan(&self, _settings: &StatisticsSettings, inputs: &Inputs<'_>, _seed: u64) -> StagePlan {
        let clips = inputs.one("clips");
        let count: u64 = clips.map_or(0, |clips| clips.clips.values().sum());
        let bytes = clips.and_then(described_format).map(|format| {
            // Colour as read, colour and depth as numbers.
            let pixels = format.frames * format.size * format.size;
            (BATCH * pixels * 7 + rayon::current_num_threads() * pixels * 12) as u64
        });
        StagePlan {
            work: Some((count, "clips".to_owned())),
            memory: bytes,
            ..StagePlan::default()
        }
    }

    fn run(
        &self,
        settings: &StatisticsSettings,
        context: &mut dyn StageContext,
    ) -> Result<Value, StageError> {
        let [clips] = context.inputs("clips") else {
            return Err(damaged("no clips"));
        };
        let (path, format) = (clips.path.clone(), format(clips)?);
        let mut sets = Vec::new();
        for split in SPLITS {
            if let Some(set) = open_split(&path, split)? {
                sets.push((split, set));
            }
        }
        let total: usize = sets.iter().map(|(_, set)| set.len()).sum();
        let mut done = 0;
        let mut found = BTreeMap::new();
        for (split, set) in &sets {
            let wanted: Vec<&str> = match settings.modalities.as_slice() {
                [] => set.shards().modalities().collect(),
                names => names.iter().map(String::as_str).collect(),
            };
            let mut counter = Counter::new(&format);
            for from in (0..set.len()).step_by(BATCH) {
                if context.interrupted() {
                    return Err(StageError::Interrupted);
                }
                let to = (from + BATCH).min(set.len());
                let batch: Result<Vec<Clip>, _> = (from..to)
                    .into_par_iter()
                    .map(|index| set.clip_with(index, &wanted))
                    .collect();
                counter.add(&batch.map_err(|error| damaged(&error.to_string()))?);
                done += to - from;
                context.progress(done as u64, total as u64, "clips");
            }
            let mut inventory = counter.inventory().clone();
            inventory
                .modalities
                .retain(|row| wanted.contains(&row.modality.as_str()));
            found.insert((*split).to_owned(), inventory);
        }
        let output = context.output();
        let json = serde_json::to_string_pretty(&found).map_err(StageError::other)?;
        write_text(output, "statistics.json", &json)?;
        write_text(output, "statistics.csv", &csv(&found))?;
        write_text(output, "report/statistics.md", &markdown(&found))?;
        Ok(json!({ "clips": total, "splits": found.keys().collect::<Vec<_>>() }))
    }
}

/// One line per channel.
fn csv(found: &BTreeMap<String, Inventory>) -> String {
    let mut text = String::from(
        "split,modality,channel,unit,clips,without,samples,valid,count,mean,std,min,max\n",
    );
    for (split, inventory) in found {
        for row in &inventory.modalities {
            let s = &row.statistics;
            for (number, c) in s.channels.iter().enumerate() {
                let _ = writeln!(
                    text,
                    "{split},{},{number},{},{},{},{},{},{},{},{},{},{}",
                    row.modality,
                    c.unit,
                    s.clips,
                    s.without,
                    s.samples,
                    s.valid,
                    c.count,
                    c.mean,
                    c.std,
                    c.min,
                    c.max
                );
            }
        }
    }
    text
}

/// A table per split: modalities with their validity and channels.
fn markdown(found: &BTreeMap<String, Inventory>) -> String {
    let mut text = String::new();
    for (split, inventory) in found {
        let _ = writeln!(text, "## {split}: {} clips\n", inventory.clips);
        text += "| modality | clips | valid | channel | unit | mean | std | min | max |\n";
        text += "|---|---|---|---|---|---|---|---|---|\n";
        for row in &inventory.modalities {
            let s = &row.statistics;
            let valid = 100.0 * s.valid_share();
            for (number, c) in s.channels.iter().enumerate() {
                let _ = writeln!(
                    text,
                    "| {} | {} | {valid:.1} % | {number} | {} | {:.4} | {:.4} | {:.4} | {:.4} |",
                    row.modality, s.clips, c.unit, c.mean, c.std, c.min, c.max
                );
            }
        }
        text.push('\n');
    }
    text
}
