//! `reviv list`: ops, registry entries, shipped experiments and runs, with their docs.

use super::terminal::{Failure, Terminal};
use crate::experiment::catalog::Catalog;
use crate::experiment::files::beside;
use crate::experiment::registry::Registry;
use crate::run::RunDirectory;
use serde::Serialize;
use std::path::{Path, PathBuf};

/// List ops, registry entries, experiments or runs
#[derive(Debug, clap::Args)]
pub struct List {
    /// `ops`, `experiments`, `runs`, or a kind of registry entries; everything but runs otherwise
    kind: Option<String>,
    /// Where runs are
    #[arg(long, default_value = "runs", value_name = "DIR")]
    runs: PathBuf,
    /// Write JSON to stdout
    #[arg(long)]
    json: bool,
}

#[derive(Serialize)]
struct Line {
    kind: String,
    name: String,
    about: String,
    /// Where it comes from, if it is not part of the binary.
    place: String,
}

impl super::Run for List {
    fn run(self, terminal: &Terminal) -> Result<(), Failure> {
        let catalog = Catalog::linked();
        let registry = Registry::new(&catalog, beside(Path::new("./x"), "registry").as_deref());
        for (_, message, _) in &registry.problems {
            terminal.note(format_args!("warning: {message}\n"));
        }
        let mut lines = Vec::new();
        let wanted = |kind: &str| self.kind.as_deref().is_none_or(|wanted| wanted == kind);
        if wanted("ops") {
            let ops = catalog.ops().iter().map(|op| (op.name(), op.about()));
            let groups = catalog.groups().iter().map(|it| (it.name, it.about));
            let mut ops: Vec<(&str, &str)> = ops.chain(groups).collect();
            ops.sort_unstable();
            lines.extend(ops.into_iter().map(|(name, about)| Line {
                kind: "ops".to_owned(),
                name: name.to_owned(),
                about: about.to_owned(),
                place: String::new(),
            }));
        }
        if wanted("experiments") {
            lines.extend(catalog.experiments().iter().map(|(path, text)| Line {
                kind: "experiments".to_owned(),
                name: (*path).to_owned(),
                about: about(text),
                place: String::new(),
            }));
        }
        for entry in registry.list(self.kind.as_deref()) {
            lines.push(Line {
                kind: entry.kind,
                name: entry.name,
                about: entry.about,
                place: entry.place,
            });
        }
        if self.kind.as_deref() == Some("runs") {
            let runs = RunDirectory::all(&self.runs).map_err(Failure::machine)?;
            for run in runs {
                let about = match run.read() {
                    Ok(record) => {
                        format!(
                            "{:11} {}  {}",
                            record.state.to_string(),
                            record.created,
                            record.experiment
                        )
                    }
                    Err(error) => format!("unreadable: {error}"),
                };
                lines.push(Line {
                    kind: "runs".to_owned(),
                    name: run.name(),
                    about,
                    place: String::new(),
                });
            }
        }
        if self.json {
            terminal.json(&lines);
            return Ok(());
        }
        if lines.is_empty() {
            return self.nothing(&catalog, &registry, terminal);
        }
        let width = lines
            .iter()
            .map(|line| line.name.chars().count())
            .max()
            .unwrap_or(0);
        let mut text = String::new();
        let mut last = "";
        for line in &lines {
            if line.kind != last && self.kind.is_none() {
                if !last.is_empty() {
                    text.push('\n');
                }
                text.push_str(&line.kind);
                if let Some(kind) = catalog.kind(&line.kind) {
                    text.push_str(": ");
                    text.push_str(kind.about);
                }
                text.push('\n');
            }
            last = &line.kind;
            let indent = if self.kind.is_none() { "  " } else { "" };
            let own = !line.place.is_empty() && !line.place.ends_with("(built in)");
            let place = if own {
                format!("  [{}]", line.place)
            } else {
                String::new()
            };
            let about = line.about.lines().next().unwrap_or("");
            let pad = " ".repeat(width - line.name.chars().count());
            text.push_str(format!("{indent}{}{pad}  {about}{place}", line.name).trim_end());
            text.push('\n');
        }
        terminal.data(text);
        Ok(())
    }
}

impl List {
    fn nothing(
        &self,
        catalog: &Catalog,
        registry: &Registry,
        terminal: &Terminal,
    ) -> Result<(), Failure> {
        let kind = self.kind.as_deref().unwrap_or("");
        let mut known = vec!["ops", "experiments", "runs"];
        known.extend(catalog.kinds().iter().map(|kind| kind.kind));
        known.extend(registry.kinds());
        known.sort_unstable();
        known.dedup();
        if known.contains(&kind) {
            terminal.note(format_args!("there are no {kind} yet\n"));
            return Ok(());
        }
        Err(Failure::input(
            format!("nothing of the kind `{kind}`"),
            crate::experiment::suggest(kind, &known).unwrap_or_default(),
        ))
    }
}

/// The first line of `about:` of an experiment.
fn about(text: &str) -> String {
    crate::experiment::yaml::parse(text, 0, &mut Vec::new())
        .and_then(|node| Some(node.get("about")?.text()?.trim().to_owned()))
        .unwrap_or_default()
}
