//! `op: table`: scores of several systems in one table, paired on common clips. Writes `table.json`, `table.csv`, `table.tex`
//! and, for the report page, the table and its intervals as a plot.

use super::evaluate::write_text;
use crate::evaluation::compare::{CompareSettings, Method, compare};
use crate::evaluation::intervals;
use crate::evaluation::published::Published;
use crate::evaluation::render::{Format, render};
use crate::evaluation::scores::Scores;
use crate::experiment::{
    Arity, ArtifactKind, Description, Entry, Inputs, Op, OpEntry, Port, Problem, StageContext,
    StageError,
};
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use serde_json::{Value, json};

/// Settings of [`TableOp`].
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct TableSettings {
    /// Printed above.
    pub title: String,
    /// Row labels, one per scores stage; absent: the names of the systems, or of the stages where two are the same.
    pub labels: Vec<String>,
    /// Columns, baseline and intervals.
    pub compare: CompareSettings,
    /// Published rows beside the table.
    pub published: Option<Entry<Published>>,
}

/// The op.
#[derive(Debug)]
pub struct TableOp;
inventory::submit! { OpEntry(&TableOp) }

impl Op for TableOp {
    type Settings = TableSettings;

    fn name(&self) -> &'static str {
        "table"
    }

    fn version(&self) -> u32 {
        4
    }

    fn about(&self) -> &'static str {
        "Puts scores side by side, with intervals and paired differences."
    }

    fn inputs(&self) -> &'static [Port] {
        &[Port {
            name: "scores",
            kinds: &[ArtifactKind::Scores],
            arity: Arity::Many,
            about: "one row each",
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
        settings: &TableSettings,
        inputs: &Inputs<'_>,
        problems: &mut Vec<Problem>,
    ) -> Description {
        let rows = inputs.all("scores");
        if !settings.labels.is_empty() && settings.labels.len() != rows.len() {
            let message = format!("{} labels for {} scores", settings.labels.len(), rows.len());
            problems.push(Problem::new(
                crate::experiment::Code::E0206,
                "labels",
                message,
            ));
        }
        let mut columns: Vec<String> = Vec::new();
        for column in rows.iter().flat_map(|facts| &facts.description.columns) {
            if !columns.contains(column) {
                columns.push(column.clone());
            }
        }
        Description {
            columns,
            ..Description::default()
        }
    }

    fn run(
        &self,
        settings: &TableSettings,
        context: &mut dyn StageContext,
    ) -> Result<Value, StageError> {
        let artifacts = context.inputs("scores");
        let scores = artifacts
            .iter()
            .map(|artifact| Scores::read(&artifact.path))
            .collect::<Result<Vec<_>, _>>()
            .map_err(StageError::other)?;
        let stages: Vec<&str> = artifacts.iter().map(|a| a.stage.as_str()).collect();
        let systems: Vec<&str> = scores.iter().map(|s| s.system.as_str()).collect();
        let labels = labels(&settings.labels, &stages, &systems);
        let mut how = settings.compare.clone();
        how.baseline = how.baseline.map(|name| row(name, &labels, &stages));
        how.baselines = how
            .baselines
            .into_iter()
            .map(|(of, to)| (row(of, &labels, &stages), row(to, &labels, &stages)))
            .collect();
        let entrants: Vec<Method> = labels
            .into_iter()
            .zip(scores)
            .map(|(label, scores)| Method {
                label,
                seeds: vec![scores],
            })
            .collect();
        let published = settings.published.as_ref().map(|entry| &entry.settings);
        let table =
            compare(&settings.title, &entrants, &how, published).map_err(StageError::other)?;
        let output = context.output();
        let json = serde_json::to_string(&table).map_err(StageError::other)?;
        write_text(output, "table.json", &json)?;
        write_text(output, "table.csv", &render(&table, Format::Csv))?;
        write_text(output, "table.tex", &render(&table, Format::Latex))?;
        write_text(output, "report/table.md", &render(&table, Format::Markdown))?;
        if let Some(plot) = intervals::svg(&table) {
            write_text(output, "report/table_intervals.svg", &plot)?;
        }
        Ok(json!({"rows": table.rows.len(), "columns": table.columns.len()}))
    }
}

/// The rows' labels: the chosen ones, else the names of the systems, or of the stages where two are the same.
fn labels(chosen: &[String], stages: &[&str], systems: &[&str]) -> Vec<String> {
    let own = |system: &str| systems.iter().filter(|s| **s == system).count() == 1;
    stages
        .iter()
        .zip(systems)
        .enumerate()
        .map(|(position, (stage, system))| match chosen.get(position) {
            Some(label) => label.clone(),
            None if own(system) => (*system).to_owned(),
            None => (*stage).to_owned(),
        })
        .collect()
}

/// The label that `name` means: a label itself, or the stage of a row.
fn row(name: String, labels: &[String], stages: &[&str]) -> String {
    if labels.contains(&name) {
        return name;
    }
    let position = stages.iter().position(|stage| *stage == name);
    position.map_or(name, |position| labels[position].clone())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn rows_are_named_after_their_stages_where_two_systems_are_the_same() {
        let stages = ["full", "theirs", "small"];
        let named = labels(&[], &stages, &["reviv", "EgoAllo", "reviv"]);
        assert_eq!(named, ["full", "EgoAllo", "small"]);
        let chosen = ["a", "b", "c"].map(str::to_owned);
        assert_eq!(labels(&chosen, &stages, &["reviv"; 3]), chosen);
    }

    #[test]
    fn a_baseline_is_a_label_or_a_stage() {
        let labels = ["reviv", "EgoAllo"].map(str::to_owned);
        let means = |name: &str| row(name.to_owned(), &labels, &["scores", "theirs"]);
        assert_eq!(means("EgoAllo"), "EgoAllo");
        assert_eq!(means("scores"), "reviv");
        assert_eq!(means("nobody"), "nobody");
    }
}
