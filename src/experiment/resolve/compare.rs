//! The `compare:` block of a sweep.

use super::Resolver;
use crate::experiment::diagnostic::Diagnostic;
use crate::experiment::graph::Compare;
use crate::experiment::names;
use crate::experiment::problem::Code;
use crate::experiment::typed::Validator;
use crate::experiment::yaml::Node;
use std::collections::BTreeMap;

impl Resolver<'_> {
    /// The `compare:` block of a sweep.
    pub fn compare(&mut self, node: &Node, rows: &[String], columns: &[String]) -> Option<Compare> {
        let schema = self.catalog.definition("compare")?;
        let mut typer = Validator {
            catalog: self.catalog,
            registry: self.registry,
            sources: self.sources,
            diagnostics: self.diagnostics,
            traces: BTreeMap::new(),
            beside: Vec::new(),
            prefix: "compare.".to_owned(),
        };
        let value = typer.value(schema, node, "")?;
        let compare: Compare = serde_json::from_value(value).ok()?;
        let mut unknown = |key: &str, what: &str, name: &str, known: &[&str]| {
            if !known.contains(&name) {
                self.diagnostics.push(
                    Diagnostic::new(
                        Code::E0203,
                        node.at(key).map_or(node.span, |node| node.span),
                        format!("unknown {what} `{name}`"),
                    )
                    .help(names::suggest(name, known).unwrap_or_default()),
                );
            }
        };
        let rows: Vec<&str> = rows.iter().map(String::as_str).collect();
        if let Some(name) = &compare.baseline {
            unknown("baseline", "arm", name, &rows);
        }
        // `depth.abs_rel` stands for `depth.abs_rel@depth` and every other space of it.
        let stems = columns.iter().filter_map(|name| name.split_once('@'));
        let columns: Vec<&str> = columns
            .iter()
            .map(String::as_str)
            .chain(stems.map(|(stem, _)| stem))
            .collect();
        if !columns.is_empty() {
            for (index, name) in compare.columns.iter().enumerate() {
                unknown(&format!("columns.{index}"), "column", name, &columns);
            }
        }
        if let Some(name) = &compare.against {
            let known = self.registry.names("published");
            unknown("against", "published table", name, &known);
        }
        Some(compare)
    }
}
