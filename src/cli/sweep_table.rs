//! The `compare:` block of a sweep: `report/table.{md,tex,csv}`, `report/table_intervals.svg` and, in words,
//! `report/conclusion.md` of its run, which the run's page shows.

use super::compare::{published, rows_of};
use super::terminal::Failure;
use crate::evaluation::compare::{CompareSettings, IntervalSettings, compare};
use crate::evaluation::conclusion::conclusion;
use crate::evaluation::intervals;
use crate::evaluation::render::{Format, render};
use crate::evaluation::statistics::Over;
use crate::experiment::catalog::Catalog;
use crate::experiment::graph::Resample;
use crate::experiment::{Compare, Experiment};
use crate::run::execute::Outcome;
use crate::run::{files, report};

/// Writes the table of a finished sweep and its page anew. Gives the table for the terminal.
pub fn write(
    catalog: &Catalog,
    experiment: &Experiment,
    asked: &Compare,
    outcome: &Outcome,
) -> Result<String, Failure> {
    let run = &outcome.run;
    let entrants = rows_of(run, &outcome.schedule, &asked.columns)?;
    let against = asked.against.as_ref();
    let published = against.and_then(|name| published(catalog, &experiment.path, name));
    let over = asked.interval.over.iter().map(|what| match what {
        Resample::Seeds => Over::Seeds,
        Resample::Clips => Over::Clips,
    });
    let settings = CompareSettings {
        columns: asked.columns.clone(),
        baseline: asked.baseline.clone(),
        baselines: asked.baselines.clone(),
        interval: IntervalSettings {
            level: asked.interval.level,
            over: over.collect(),
            ..IntervalSettings::default()
        },
        ..CompareSettings::default()
    };
    let table = compare(&experiment.name, &entrants, &settings, published.as_ref())
        .map_err(|error| Failure::input(error.to_string(), "see `compare:` of the sweep"))?;
    let folder = run.path().join("report");
    for (name, format) in [
        (report::TABLE, Format::Markdown),
        ("table.tex", Format::Latex),
        ("table.csv", Format::Csv),
    ] {
        files::write(&folder.join(name), render(&table, format).as_bytes())
            .map_err(Failure::machine)?;
    }
    let said = conclusion(&table, asked.baseline.as_deref(), asked.interval.level);
    let text = said.join(" ");
    files::write(&folder.join(report::CONCLUSION), text.as_bytes()).map_err(Failure::machine)?;
    if let Some(plot) = intervals::svg(&table) {
        files::write(&folder.join(report::PLOT), plot.as_bytes()).map_err(Failure::machine)?;
    }
    report::write(run).map_err(Failure::machine)?;
    let rendered = render(&table, Format::Terminal);
    Ok(if text.is_empty() {
        rendered
    } else {
        format!("{rendered}\n{}\n", said.join("\n"))
    })
}
