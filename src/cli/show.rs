//! `reviv show`: an op or a registry entry with its settings and their docs, or a run.

use super::terminal::{Failure, Terminal};
use crate::experiment::catalog::Catalog;
use crate::experiment::docs::{self, Setting};
use crate::experiment::files::beside;
use crate::experiment::registry::{Registry, noun};
use crate::run::RunDirectory;
use crate::run::report::TABLE;
use serde_json::json;
use std::fmt::Write as _;
use std::path::{Path, PathBuf};

/// Show an op, a registry entry, a run or the entries of a checkpoint file
#[derive(Debug, clap::Args)]
pub struct Show {
    /// An op, an entry (`uniform`, or `masking/uniform`), a run, or a checkpoint file
    #[arg(value_name = "RUN|ENTRY|OP|FILE")]
    name: PathBuf,
    /// Where runs are
    #[arg(long, default_value = "runs", value_name = "DIR")]
    runs: PathBuf,
    /// Write JSON to stdout
    #[arg(long)]
    json: bool,
}

impl super::Run for Show {
    fn run(self, terminal: &Terminal) -> Result<(), Failure> {
        if self.name.is_file() {
            return super::import::show(&self.name, self.json, terminal);
        }
        let name = self.name.to_string_lossy();
        let catalog = Catalog::linked();
        let registry = Registry::new(&catalog, beside(Path::new("./x"), "registry").as_deref());
        let mut found = false;
        let mut values = Vec::new();
        let mut text = String::new();
        let group = catalog.group(&name);
        if let Some(op) = group.map_or_else(|| catalog.op(&name), |group| Some(group.op)) {
            found = true;
            let settings = catalog
                .schema(op.name())
                .map(|schema| docs::settings(&catalog, schema))
                .unwrap_or_default();
            let shown = group.map_or_else(|| op.name(), |group| group.name);
            let about = group.map_or_else(|| op.about(), |group| group.about);
            let _ = writeln!(text, "op {shown} (version {})\n{about}\n", op.version());
            for port in op.inputs() {
                let kinds: Vec<&str> = port.kinds.iter().map(|kind| kind.name()).collect();
                let _ = writeln!(
                    text,
                    "  reads {}: {} ({})",
                    port.name,
                    kinds.join(" or "),
                    port.about
                );
            }
            if let Some(group) = group {
                let (map, one) = (group.members, op.name());
                let _ = writeln!(
                    text,
                    "  `{map}` is a map: each entry is a stage of `{one}` whose `{}` is the key.\n  Inputs and \
                     settings stand in an entry, or beside `{map}` for all of them.",
                    group.setting
                );
            }
            let _ = writeln!(text, "  makes {}\n", op.output());
            table(&mut text, &settings);
            values.push(json!({
                "op": shown, "version": op.version(), "about": about,
                "makes": op.output(), "settings": settings,
                "members": group.map(|group| group.members),
            }));
        }
        for entry in registry.list(None) {
            if entry.name != name && format!("{}/{}", entry.kind, entry.name) != name {
                continue;
            }
            if found {
                text.push('\n');
            }
            found = true;
            let settings = catalog
                .kind(&entry.kind)
                .map(|kind| docs::settings(&catalog, &kind.schema))
                .unwrap_or_default();
            let source = registry
                .text(&entry.kind, &entry.name)
                .map(|entry| entry.text.to_string())
                .unwrap_or_default();
            let _ = writeln!(
                text,
                "{} {}\n{}\n",
                noun(&entry.kind),
                entry.name,
                entry.place
            );
            for line in source.lines() {
                let _ = writeln!(text, "  {line}");
            }
            if !settings.is_empty() {
                text.push_str("\nsettings\n");
                table(&mut text, &settings);
            }
            values.push(json!({
                "kind": entry.kind, "name": entry.name, "about": entry.about,
                "place": entry.place, "text": source, "settings": settings,
            }));
        }
        let fitting = if found {
            Vec::new()
        } else {
            RunDirectory::fitting(&self.runs, &self.name).map_err(Failure::machine)?
        };
        if !found && let [run] = fitting.as_slice() {
            found = true;
            let record = run.read().map_err(Failure::machine)?;
            let _ = writeln!(text, "run {}\n  state       {}", run.name(), record.state);
            let _ = writeln!(text, "  experiment  {}", record.experiment);
            let _ = writeln!(text, "  created     {}", record.created);
            let _ = writeln!(text, "  identity    {}", record.identity);
            for (shard, part) in &record.parts {
                let _ = writeln!(
                    text,
                    "  part {shard}    {} on {} (process {})",
                    part.state, part.host, part.pid
                );
                if let Some(error) = &part.error {
                    let stage = error
                        .stage
                        .as_deref()
                        .map(|s| format!(" in `{s}`"))
                        .unwrap_or_default();
                    let _ = writeln!(text, "    {}{stage}: {}", error.code, error.message);
                }
            }
            if let Ok(table) = std::fs::read_to_string(run.report().with_file_name(TABLE)) {
                let _ = writeln!(text, "\n{table}");
            }
            values.push(serde_json::to_value(&record).map_err(Failure::machine)?);
        }
        if !found && fitting.len() > 1 {
            let names: Vec<String> = fitting.iter().map(RunDirectory::name).collect();
            return Err(Failure::input(
                format!("{} runs fit `{name}`", names.len()),
                format!("they are {}", names.join(", ")),
            ));
        }
        if !found {
            let all = registry.list(None);
            let mut known: Vec<&str> = all.iter().map(|entry| entry.name.as_str()).collect();
            known.extend(catalog.ops().iter().map(|op| op.name()));
            known.extend(catalog.groups().iter().map(|group| group.name));
            return Err(Failure::input(
                format!("there is no op, registry entry, run or file `{name}`"),
                crate::experiment::nearest(&name, known.into_iter()).map_or_else(
                    || "`reviv list` shows what there is".to_owned(),
                    |near| format!("did you mean `{near}`?"),
                ),
            ));
        }
        if self.json {
            terminal.json(&values);
        } else {
            terminal.data(text);
        }
        Ok(())
    }
}

fn table(text: &mut String, settings: &[Setting]) {
    let width = |get: fn(&Setting) -> usize| settings.iter().map(get).max().unwrap_or(0);
    let (keys, types) = (width(|s| s.key.len()), width(|s| s.form.len()));
    for setting in settings {
        let default = setting
            .default
            .as_ref()
            .map(|value| format!(" [default {value}]"))
            .unwrap_or_default();
        let _ = writeln!(
            text,
            "  {:keys$}  {:types$}  {}{default}",
            setting.key, setting.form, setting.about
        );
    }
}
