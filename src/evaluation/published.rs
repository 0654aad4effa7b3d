//! Published rows: numbers from papers, with the conditions under which they were obtained. Registry entries `published: ...`.
//!
//! They stand beside a table as context. They are never compared: the clips, the data and often the metric differ.

use super::columns::Column;
use super::table::{Cell, Row, RowKind};
use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;

/// Rows of one published table.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize, schemars::JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct Published {
    /// Where the numbers are printed.
    pub source: String,
    /// Under which conditions: data, clips, training, alignment. Printed below every table that shows the rows.
    pub conditions: String,
    /// The printed rows, in the order in which tables show them.
    pub rows: Vec<PublishedRow>,
}

/// One printed row.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize, schemars::JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct PublishedRow {
    /// Name of the system, as tables show it.
    pub system: String,
    /// By column, in the column's unit.
    pub values: BTreeMap<String, f64>,
}

impl Published {
    /// Rows for a table with these columns; rows without any of them are left out.
    #[must_use]
    pub fn rows(&self, columns: &[Column]) -> Vec<Row> {
        self.rows
            .iter()
            .map(|row| Row {
                label: row.system.clone(),
                kind: RowKind::Published,
                cells: columns
                    .iter()
                    .map(|column| Cell {
                        value: row.values.get(&column.name).copied(),
                        ..Cell::default()
                    })
                    .collect(),
            })
            .filter(|row| row.cells.iter().any(|cell| cell.value.is_some()))
            .collect()
    }

    /// The note that belongs below.
    #[must_use]
    pub fn note(&self) -> String {
        format!(
            "published rows (context, not comparable): {}. {}",
            self.source, self.conditions
        )
    }
}
