//! What `registry/modality/*.yaml` hold: a signal beyond the built-in ones, where it comes from, how it becomes tokens and what
//! scores it. The signal travels with the clips; the rest are defaults of the stages that follow.

use super::tokenizer_entry::TokenizerEntry;
use crate::evaluation::columns::Column;
use crate::evaluation::metric::metrics_of;
use crate::experiment::{Code, Entry, Kind, KindEntry, Problem};
use crate::modality::DeclaredSettings;
use crate::modality::code;
use crate::modality::declared::{Normalize, SignalSettings, SignalSource};
use crate::world::clips::{SENSORS, sensor_of};
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use serde_json::Value;
use std::collections::BTreeMap;

/// A modality as a registry entry declares it.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct ModalityEntry {
    /// What is measured.
    pub signal: SignalSettings,
    /// How the tokenizer scales the values.
    #[serde(default)]
    pub normalize: Normalize,
    /// The tokenizer that a stage `train_tokenizer` of this modality trains where it names none.
    #[serde(default)]
    pub tokenizer: Option<Entry<TokenizerEntry>>,
    /// Where clips get it from.
    #[serde(default)]
    pub source: SignalSource,
    /// Metrics that score predictions of it whatever the suite; `rmse` is the column `<modality>.rmse`.
    #[serde(default)]
    pub metrics: Vec<String>,
}

impl Kind for ModalityEntry {
    const KIND: &'static str = "modality";
    const ABOUT: &'static str = "Signals beyond the built-in ones, declared in YAML.";
}
inventory::submit! { KindEntry::of::<ModalityEntry>() }

/// The key under which clips pass on [`Defaults`].
pub(super) const DEFAULTS: &str = "defaults";

/// By modality: what later stages do where they are not told otherwise.
pub(super) type Defaults = BTreeMap<String, ModalityDefaults>;

/// What an entry says beyond the signal itself.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub(super) struct ModalityDefaults {
    pub tokenizer: Option<Entry<TokenizerEntry>>,
    pub metrics: Vec<String>,
}

/// The signal of an entry.
pub(super) fn declared(entry: &Entry<ModalityEntry>) -> DeclaredSettings {
    let settings = &entry.settings;
    DeclaredSettings {
        name: entry.name.clone(),
        about: String::new(),
        signal: settings.signal.clone(),
        normalize: settings.normalize,
        source: settings.source.clone(),
    }
}

/// The defaults of all entries.
pub(super) fn defaults(entries: &[Entry<ModalityEntry>]) -> Defaults {
    let one = |entry: &Entry<ModalityEntry>| {
        let default = ModalityDefaults {
            tokenizer: entry.settings.tokenizer.clone(),
            metrics: entry.settings.metrics.clone(),
        };
        (entry.name.clone(), default)
    };
    entries.iter().map(one).collect()
}

/// What a clips artifact passed on; empty where it passed on nothing.
pub(super) fn read_defaults(passed: Option<&Value>) -> Defaults {
    passed
        .and_then(|value| serde_json::from_value(value.clone()).ok())
        .unwrap_or_default()
}

/// What is wrong with an entry, by key below it (`.signal.rate`), for clips of the world or of recordings.
pub(super) fn problems(entry: &Entry<ModalityEntry>, from_world: bool) -> Vec<Problem> {
    let (name, settings) = (&entry.name, declared(entry));
    let mut problems = Vec::new();
    if let Some((key, reason)) = settings.problem() {
        problems.push(Problem::new(Code::E0206, format!(".{key}"), reason));
    }
    for (i, metric) in entry.settings.metrics.iter().enumerate() {
        if Column::named(&format!("{name}.{metric}")).is_none() {
            let own = metrics_of(name);
            let (message, known) = if own.is_empty() {
                let message = format!("declared modalities have no metric `{metric}`");
                (message, vec!["rmse"])
            } else {
                (format!("`{name}` has no metric `{metric}`"), own)
            };
            let help = format!("there is {}", quoted(&known));
            problems.push(Problem::new(Code::E0203, format!(".metrics.{i}"), message).help(help));
        }
    }
    let source = &settings.source;
    if let Some(wanted) = &source.code {
        if code::find(wanted).is_none() {
            let known: Vec<&str> = code::linked().iter().map(|code| code.name).collect();
            let help = match known.as_slice() {
                [] => "no plug-in is linked into this binary; build the plug-in's own".to_owned(),
                known => format!("there is {}", quoted(known)),
            };
            let message = format!("no code `{wanted}` is linked into this binary");
            problems.push(Problem::new(Code::E0203, ".source.code", message).help(help));
        }
    } else if from_world {
        let sensor = sensor_of(name, &settings);
        if !SENSORS.contains(&sensor) {
            let message = format!("the built-in world has no sensor `{sensor}`");
            let help = format!("it has {}", quoted(&SENSORS));
            problems.push(Problem::new(Code::E0203, "", message).help(help));
        }
    } else if source.npz.is_none() {
        let message = format!("`{name}` does not say where recordings have it");
        problems.push(
            Problem::new(Code::E0204, "", message)
                .help("`source: {npz: FILE, key: ARRAY}`, a file of each recording"),
        );
    }
    problems
}

fn quoted(names: &[&str]) -> String {
    let names: Vec<String> = names.iter().map(|name| format!("`{name}`")).collect();
    names.join(", ")
}
