//! Stages of other experiments: read once, copied with everything they need.

use super::{Resolver, To};
use crate::experiment::compose::Composer;
use crate::experiment::diagnostic::{Diagnostic, Span};
use crate::experiment::files::canonical;
use crate::experiment::graph::Graph;
use crate::experiment::names;
use crate::experiment::problem::Code;
use crate::experiment::source::Origin;
use crate::experiment::sweep;
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

impl Resolver<'_> {
    /// A stage of another experiment, or all stages of a group, with everything they need, put into the graph; with their names.
    pub(super) fn import(
        &mut self,
        name: &str,
        asked: Span,
        graph: &mut Graph,
        places: &mut BTreeMap<(PathBuf, String), usize>,
    ) -> Vec<(String, To)> {
        let unknown = vec![(name.to_owned(), To::Unknown)];
        let (file, stage) = name.rsplit_once('/').unwrap_or(("", name));
        let file = if Path::new(file).extension().is_some() {
            file.to_owned()
        } else {
            format!("{file}.yaml")
        };
        let mut composer = Composer::new(self.catalog, self.sources, self.diagnostics);
        let path = composer.relative(&file, asked);
        let identity = canonical(&path);
        if self.importing.contains(&identity) {
            composer.diagnostics.push(
                Diagnostic::new(
                    Code::E0302,
                    asked,
                    "experiments read stages of each other in a circle",
                )
                .label("this closes it"),
            );
            return unknown;
        }
        if !self.imports.contains_key(&identity) {
            let root = composer.named(&file, asked, Origin::Imported);
            let imported = root.and_then(|root| {
                if root.get("sweep").is_some() {
                    self.diagnostics.push(
                        Diagnostic::new(
                            Code::E0301,
                            asked,
                            format!("`{file}` is a sweep: its stages exist once per arm"),
                        )
                        .help("name a stage of an experiment"),
                    );
                    return None;
                }
                let seed = sweep::seed_of(root.get("seed"), self.diagnostics).unwrap_or(0);
                self.importing.push(identity.clone());
                let graph = self.graph(&root, seed);
                self.importing.pop();
                graph
            });
            self.imports.insert(identity.clone(), imported);
        }
        let Some(Some(imported)) = self.imports.get(&identity) else {
            return unknown;
        };
        let group = imported.groups.iter().find(|group| group.name == stage);
        let members: Vec<&str> = group.map_or_else(
            || vec![stage],
            |group| group.members.iter().map(String::as_str).collect(),
        );
        let stages = members
            .iter()
            .map(|name| imported.stages.iter().position(|s| s.name == *name));
        let Some(stages) = stages.collect::<Option<Vec<usize>>>() else {
            let mut known: Vec<&str> = imported.stages.iter().map(|s| s.name.as_str()).collect();
            known.extend(imported.groups.iter().map(|group| group.name.as_str()));
            self.diagnostics.push(
                Diagnostic::new(
                    Code::E0301,
                    asked,
                    format!("`{file}` has no stage `{stage}`"),
                )
                .help(names::suggest(stage, &known).unwrap_or_default()),
            );
            return unknown;
        };
        let prefix = Path::new(&file)
            .file_stem()
            .unwrap_or_default()
            .to_string_lossy()
            .into_owned();
        let mut ends = Vec::new();
        for index in stages {
            let at = copy(imported, index, &identity, &prefix, graph, places);
            let own = group.map_or(name, |_| graph.stages[at].name.as_str());
            ends.push((own.to_owned(), To::Imported(at)));
        }
        ends
    }
}

/// Copies a stage and what it reads into another graph, once.
fn copy(
    from: &Graph,
    index: usize,
    file: &Path,
    prefix: &str,
    into: &mut Graph,
    places: &mut BTreeMap<(PathBuf, String), usize>,
) -> usize {
    let stage = &from.stages[index];
    let key = (file.to_owned(), stage.name.clone());
    if let Some(&place) = places.get(&key) {
        return place;
    }
    let mut copied = stage.clone();
    for edge in &mut copied.edges {
        for source in &mut edge.from {
            *source = copy(from, *source, file, prefix, into, places);
        }
    }
    // A stage that the other experiment reads from a third keeps that name.
    if !copied.name.contains('/') {
        copied.name = format!("{prefix}/{}", stage.name);
        let path = stage.path.trim_start_matches("stages.");
        copied.path = format!("stages.{prefix}/{path}");
    }
    into.stages.push(copied);
    places.insert(key, into.stages.len() - 1);
    into.stages.len() - 1
}
