//! Tables of scores, and comparing runs.

use crate::error::{of_command, refused};
use pyo3::prelude::*;
use reviv::cli::entrants_of;
use reviv::evaluation::compare::{CompareSettings, Method};
use reviv::evaluation::render::{Format, render};
use std::path::PathBuf;

/// Rows and columns with intervals.
#[pyclass(frozen, module = "reviv._reviv")]
pub struct Table {
    pub table: reviv::evaluation::table::Table,
}

#[pymethods]
impl Table {
    /// As `term`, `md`, `latex` or `csv`.
    fn render(&self, py: Python<'_>, format: &str) -> PyResult<String> {
        let format = Format::named(format).ok_or_else(|| {
            refused(
                py,
                format_args!("no format `{format}`"),
                "`term`, `md`, `latex`, `csv`",
            )
        })?;
        Ok(render(&self.table, format))
    }

    /// For notebooks.
    fn html(&self) -> String {
        reviv::run::markdown::html(&render(&self.table, Format::Markdown))
    }

    /// Every number with what qualifies it.
    fn json(&self, py: Python<'_>) -> PyResult<String> {
        serde_json::to_string(&self.table).map_err(|error| refused(py, error, ""))
    }
}

/// Runs, folders of scores and scores files in one table.
#[pyfunction]
pub fn compare(
    py: Python<'_>,
    runs: Vec<PathBuf>,
    baseline: Option<String>,
    columns: Vec<String>,
    level: f64,
    folder: PathBuf,
) -> PyResult<Table> {
    let mut settings = CompareSettings {
        baseline,
        columns,
        ..CompareSettings::default()
    };
    settings.interval.level = level;
    let made = py.detach(|| {
        let mut methods: Vec<Method> = Vec::new();
        for name in &runs {
            for mut method in entrants_of(name, &folder, &settings.columns)? {
                if methods.iter().any(|known| known.label == method.label) {
                    method.label = format!("{}/{}", name.display(), method.label);
                }
                methods.push(method);
            }
        }
        Ok(reviv::evaluation::compare::compare(
            "", &methods, &settings, None,
        ))
    });
    let table = made.map_err(|failure| of_command(py, failure))?;
    let table = table.map_err(|error| refused(py, error, "`reviv list runs` shows all runs"))?;
    Ok(Table { table })
}
