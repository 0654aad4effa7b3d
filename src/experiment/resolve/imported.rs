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
    /// A stage of another experiment, with everything it needs, put into the graph.
    pub(super) fn import(
        &mut self,
        name: &str,
        asked: Span,
        graph: &mut Graph,
        places: &mut BTreeMap<(PathBuf, String), usize>,
    ) -> To {
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
            return To::Unknown;
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
            return To::Unknown;
        };
        let Some(wanted) = imported.stages.iter().position(|s| s.name == stage) else {
            let known: Vec<&str> = imported.stages.iter().map(|s| s.name.as_str()).collect();
            self.diagnostics.push(
                Diagnostic::new(
                    Code::E0301,
                    asked,
                    format!("`{file}` has no stage `{stage}`"),
                )
                .help(names::suggest(stage, &known).unwrap_or_default()),
            );
            return To::Unknown;
        };
        let prefix = Path::new(&file)
            .file_stem()
            .unwrap_or_default()
            .to_string_lossy()
            .into_owned();
        To::Imported(copy(imported, wanted, &identity, &prefix, graph, places))
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
    }
    into.stages.push(copied);
    places.insert(key, into.stages.len() - 1);
    into.stages.len() - 1
}
