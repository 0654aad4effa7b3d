//! `reviv data status`: which data sets are there, and what is in them.

use super::super::terminal::{Failure, Terminal};
use super::source_entry;
use crate::datasets::ReadError;
use crate::datasets::cut::CutSettings;
use crate::datasets::open::{Dataset, HandModel, OpenWith, open};
use crate::datasets::split::SplitSettings;
use crate::datasets::status::{Status, status};
use crate::experiment::catalog::Catalog;
use crate::experiment::data::{DataRoot, roots};
use crate::experiment::files;
use crate::experiment::registry::Registry;
use crate::experiment::source::Sources;
use crate::formats::place;
use serde::Serialize;
use std::collections::BTreeMap;
use std::fmt::Write as _;
use std::path::Path;

/// Excluded recordings that are printed for each data set; `--json` has all.
const SHOWN: usize = 5;
/// Participants that are named for each split.
const NAMED: usize = 12;

/// Show which data sets of data.yaml are there: recordings, hours, modalities, splits, and what is left out and why
#[derive(Debug, clap::Args)]
pub(super) struct StatusCommand {
    /// Names of registry sources or of `data.yaml`; left out: all
    #[arg(value_name = "NAME")]
    names: Vec<String>,
    /// Write it as JSON to stdout
    #[arg(long)]
    json: bool,
}

/// One data set: how it would be opened, and what came of it.
#[derive(Debug, Serialize)]
struct Row {
    /// The registry source, or the name in `data.yaml` where no source reads it.
    name: String,
    /// The name in `data.yaml`.
    data: String,
    path: Option<String>,
    set_by: Option<String>,
    /// `found`, `not configured`, `not found` or `unreadable`.
    state: &'static str,
    #[serde(skip_serializing_if = "Option::is_none")]
    reason: Option<String>,
    #[serde(flatten)]
    status: Option<Status>,
}

/// How a name is opened.
struct Plan {
    data: String,
    dataset: Option<Dataset>,
    cut: CutSettings,
    split: SplitSettings,
    /// The name in `data.yaml` of the MANO models, where the set may need them.
    mano: Option<String>,
    hands: HandModel,
}

impl StatusCommand {
    pub(super) fn run(self, terminal: &Terminal) -> Result<(), Failure> {
        let environment = std::env::vars().collect();
        let mut diagnostics = Vec::new();
        let roots = roots(
            Path::new("./x"),
            &environment,
            &mut Sources::default(),
            &mut diagnostics,
        );
        if let Some(diagnostic) = diagnostics.first() {
            return Err(Failure::input(
                format!("data.yaml: {}", diagnostic.message),
                "a map of names to folders: `adt: /data/adt`",
            ));
        }
        let mut plans = plans(&roots)?;
        for name in &self.names {
            if !plans.contains_key(name) {
                let known: Vec<&str> = plans.keys().map(String::as_str).collect();
                return Err(Failure::input(
                    format!("there is no data set `{name}`"),
                    format!("data sets: {}", known.join(", ")),
                ));
            }
        }
        if !self.names.is_empty() {
            plans.retain(|name, _| self.names.contains(name));
        }
        let rows: Vec<Row> = plans
            .into_iter()
            .map(|(name, plan)| look(name, &plan, &roots))
            .collect();
        if self.json {
            terminal.json(&rows);
            return Ok(());
        }
        for row in &rows {
            terminal.data(describe(row));
        }
        if rows.iter().all(|row| row.path.is_none()) {
            terminal.note("note: name the folders of data sets in `data.yaml`: `adt: /data/adt`\n");
        }
        Ok(())
    }
}

/// The registry's sources that read data, and what else `data.yaml` names.
fn plans(roots: &BTreeMap<String, DataRoot>) -> Result<BTreeMap<String, Plan>, Failure> {
    let catalog = Catalog::linked();
    let registry = Registry::new(
        &catalog,
        files::beside(Path::new("./x"), "registry").as_deref(),
    );
    let mut plans = BTreeMap::new();
    for name in registry.names("source") {
        let name = name.to_owned();
        let entry = source_entry(&name)?;
        let mano = entry.mano().map(str::to_owned);
        if let Some(data) = entry.data {
            let plan = Plan {
                mano,
                hands: entry.hands,
                data,
                dataset: entry.dataset,
                cut: entry.cut,
                split: entry.split,
            };
            plans.insert(name.clone(), plan);
        }
    }
    for name in roots.keys() {
        // The MANO models are no data set.
        let models = plans.values().any(|plan| plan.mano.as_ref() == Some(name));
        if !models && plans.values().all(|plan| plan.data != *name) {
            let plan = Plan {
                data: name.clone(),
                dataset: None,
                cut: CutSettings::default(),
                split: SplitSettings::default(),
                mano: Some("mano".to_owned()),
                hands: HandModel::default(),
            };
            plans.insert(name.clone(), plan);
        }
    }
    Ok(plans)
}

fn look(name: String, plan: &Plan, roots: &BTreeMap<String, DataRoot>) -> Row {
    let root = roots.get(&plan.data);
    let mut row = Row {
        name,
        data: plan.data.clone(),
        path: root.map(|root| root.path.display().to_string()),
        set_by: root.map(|root| root.set_by.clone()),
        state: "not configured",
        reason: None,
        status: None,
    };
    let Some(root) = root else {
        return row;
    };
    if !root.path.exists() && !place::is_remote(&root.path) {
        row.state = "not found";
        row.reason = Some("the folder does not exist".to_owned());
        return row;
    }
    let mano = plan.mano.as_ref().and_then(|name| roots.get(name));
    let with = OpenWith {
        mano: mano.map(|root| root.path.as_path()),
        hands: plan.hands,
        ..OpenWith::default()
    };
    match open(&root.path, plan.dataset, &plan.cut, with) {
        Ok(source) => {
            row.state = "found";
            row.status = Some(status(source.as_ref(), &plan.split, plan.cut.stride));
        }
        Err(error @ (ReadError::Absent { .. } | ReadError::Missing { .. })) => {
            row.state = "not found";
            row.reason = Some(error.to_string());
        }
        Err(error) => {
            row.state = "unreadable";
            row.reason = Some(error.to_string());
        }
    }
    row
}

fn describe(row: &Row) -> String {
    let mut text = format!("{}: {}", row.name, row.state);
    if let (Some(path), Some(set_by)) = (&row.path, &row.set_by) {
        let _ = write!(text, ", `{path}` ({set_by})");
    } else {
        let _ = write!(text, "; `{}: FOLDER` in data.yaml", row.data);
    }
    text.push('\n');
    if let Some(reason) = &row.reason {
        let _ = writeln!(text, "  {reason}");
    }
    let Some(status) = &row.status else {
        return text;
    };
    let _ = writeln!(
        text,
        "  {} recordings, {} clips, {:.2} h: {}",
        status.recordings,
        status.clips,
        status.hours,
        status.modalities.join(" ")
    );
    for share in status.splits.iter().filter(|share| share.recordings > 0) {
        let mut groups: Vec<&str> = share.groups.keys().map(String::as_str).collect();
        let more = groups.len().saturating_sub(NAMED);
        groups.truncate(NAMED);
        let more = if more > 0 {
            format!(", ... and {more} more")
        } else {
            String::new()
        };
        let _ = writeln!(
            text,
            "  {}: {} recordings, {} clips ({}{more})",
            share.split,
            share.recordings,
            share.clips,
            groups.join(", ")
        );
    }
    for (note, count) in &status.notes {
        let _ = writeln!(text, "  note: {note} ({count})");
    }
    for excluded in status.excluded.iter().take(SHOWN) {
        let _ = writeln!(
            text,
            "  excluded: `{}`: {}",
            excluded.recording, excluded.reason
        );
    }
    let more = status.excluded.len().saturating_sub(SHOWN);
    if more > 0 {
        let _ = writeln!(text, "  excluded: {more} more (`--json` has all)");
    }
    text
}
