//! `op: table`: scores of several systems in one table, paired on common clips. Writes `table.json`, `table.csv`, `table.tex`
//! and, for the report page, the table and its intervals as a plot.

use super::evaluate::write_text;
use crate::evaluation::compare::{CompareSettings, Entrant, compare};
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
        3
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
        let mut entrants: Vec<Entrant> = Vec::new();
        for (position, artifact) in context.inputs("scores").iter().enumerate() {
            let scores = Scores::read(&artifact.path).map_err(StageError::other)?;
            let label = match settings.labels.get(position) {
                Some(label) => label.clone(),
                None if entrants.iter().any(|e| e.label == scores.system) => artifact.stage.clone(),
                None => scores.system.clone(),
            };
            entrants.push(Entrant {
                label,
                seeds: vec![scores],
            });
        }
        let published = settings.published.as_ref().map(|entry| &entry.settings);
        let table = compare(&settings.title, &entrants, &settings.compare, published)
            .map_err(StageError::other)?;
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
