//! From a path to an [`Experiment`]: reads the layers, composes them, opens a sweep into its cells and resolves each.

use super::catalog::{Catalog, KindFacts};
use super::clashes::clashes;
use super::compose::Composer;
use super::data;
use super::diagnostic::{Diagnostic, Report, Span};
use super::entry::Kind;
use super::files::{beside, canonical, read};
use super::graph::{Cell, Experiment};
use super::problem::Code;
use super::registry::Registry;
use super::resolve::Resolver;
use super::settings::Settings;
use super::source::{Origin, Source, Sources};
use super::sweep;
use super::typed::Validator;
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

/// What to load, and what to change in it.
#[derive(Debug, Clone, Default)]
pub struct Request {
    /// The experiment or sweep.
    pub path: PathBuf,
    /// `--set` arguments: `stages.mget.steps=10`.
    pub set: Vec<String>,
    /// `--seed`: the seed of an experiment; for a sweep, the only one.
    pub seed: Option<u64>,
    /// For who only checks, plans or reads: a data set that is not on this machine is a warning.
    pub data_may_be_absent: bool,
}

/// Loads an experiment and checks everything that can be checked without compute.
///
/// The experiment is there when the report has no errors.
pub fn load(catalog: &Catalog, request: &Request) -> (Option<Experiment>, Report) {
    load_in(
        catalog,
        request,
        &std::env::vars_os()
            .filter_map(|(name, value)| Some((name.into_string().ok()?, value.into_string().ok()?)))
            .collect(),
    )
}

/// [`load`] with another environment.
pub fn load_in(
    catalog: &Catalog,
    request: &Request,
    environment: &BTreeMap<String, String>,
) -> (Option<Experiment>, Report) {
    let mut sources = Sources::default();
    let mut diagnostics = Vec::new();
    let experiment = build(
        catalog,
        request,
        environment,
        &mut sources,
        &mut diagnostics,
    );
    let mut report = Report {
        diagnostics,
        sources,
    };
    report.tidy();
    let experiment = experiment
        .filter(|_| !report.failed())
        .map(|mut experiment| {
            experiment.sources = report.sources.clone();
            experiment
        });
    (experiment, report)
}

/// Checks a file that may be an experiment, a sweep or a registry entry.
pub fn check(catalog: &Catalog, request: &Request) -> (Option<Experiment>, Report) {
    let text = read(&request.path).unwrap_or_default();
    let kind =
        super::registry::head(&text).and_then(|(kind, name)| Some((catalog.kind(kind)?, name)));
    let Some((kind, name)) = kind else {
        return load(catalog, request);
    };
    let mut report = Report::default();
    let layer = report.sources.add(Source {
        name: request.path.display().to_string(),
        path: Some(request.path.clone()),
        text: text.clone(),
        origin: Origin::File,
    });
    let mut registry = Registry::new(catalog, registry_of(&request.path).as_deref());
    registry.put(kind.kind, name, layer, &text, &request.path);
    let span = Span::point(layer, 0);
    entry_settings(catalog, &mut registry, kind, name, span, &mut report);
    report.tidy();
    (None, report)
}

/// The folder `registry` that an entry's file is in, or the one beside it.
fn registry_of(entry: &Path) -> Option<PathBuf> {
    let above = |path: &Path| {
        let mut folders = path.ancestors().skip(1);
        let found =
            folders.find(|folder| folder.file_name().is_some_and(|name| name == "registry"));
        found.map(Path::to_owned)
    };
    above(entry)
        .or_else(|| beside(entry, "registry"))
        .or_else(|| above(&canonical(entry)))
}

/// The settings of a registry entry, complete, as an experiment in `path` sees it; `None` where there is none, and where it has
/// mistakes.
pub fn entry<T: Kind + Clone>(catalog: &Catalog, path: &Path, name: &str) -> Option<T> {
    let facts = catalog.kind(T::KIND)?;
    let mut report = Report::default();
    let mut registry = Registry::new(catalog, beside(path, "registry").as_deref());
    let layer = report.sources.add(Source {
        name: path.display().to_string(),
        path: None,
        text: String::new(),
        origin: Origin::File,
    });
    let asked = Span::point(layer, 0);
    let settings = entry_settings(catalog, &mut registry, facts, name, asked, &mut report)?;
    settings.with(T::clone).ok()
}

/// The settings of an entry, every default filled in; `None` after a report.
fn entry_settings(
    catalog: &Catalog,
    registry: &mut Registry,
    kind: &KindFacts,
    name: &str,
    asked: Span,
    report: &mut Report,
) -> Option<Settings> {
    let (sources, diagnostics) = (&mut report.sources, &mut report.diagnostics);
    let node = registry.settings(kind.kind, name, asked, sources, diagnostics)?;
    let mut typer = Validator {
        catalog,
        registry,
        sources,
        diagnostics,
        traces: BTreeMap::new(),
        beside: vec!["about", "extends"],
        prefix: String::new(),
    };
    let value = typer.value(&kind.schema, &node, "")?;
    (kind.parse)(value)
        .map_err(|error| {
            let refused = Diagnostic::new(Code::E0202, asked, error.to_string());
            report.diagnostics.push(refused);
        })
        .ok()
}

fn build(
    catalog: &Catalog,
    request: &Request,
    environment: &BTreeMap<String, String>,
    sources: &mut Sources,
    diagnostics: &mut Vec<Diagnostic>,
) -> Option<Experiment> {
    let mut composer = Composer::new(catalog, sources, diagnostics);
    let root = composer.file(&request.path)?;
    let mut patches = composer.overrides(&request.set);
    if let Some(seed) = request.seed {
        patches.extend(composer.overrides(&[format!("seed={seed}")]));
    }
    let is_sweep = root.get("sweep").is_some();
    let plan = if is_sweep {
        sweep::open(&mut composer, root, patches)?
    } else {
        sweep::single(&mut composer, root, patches)
    };
    // Texts that are no YAML, or not there, make everything after them noise. Other mistakes come together.
    let fatal = [Code::E0101, Code::E0102, Code::E0103, Code::E0104];
    if diagnostics.iter().any(|d| fatal.contains(&d.code)) {
        return None;
    }
    let folder = beside(&request.path, "registry");
    let mut registry = Registry::new(catalog, folder.as_deref());
    for (entry, message, help) in &registry.problems {
        let layer = sources.add(Source {
            name: entry.place.clone(),
            path: None,
            text: entry.text.to_string(),
            origin: Origin::Registry,
        });
        diagnostics
            .push(Diagnostic::new(Code::E0205, Span::point(layer, 0), message.clone()).help(*help));
    }
    for clash in clashes(catalog) {
        diagnostics.push(Diagnostic::new(Code::E0205, plan.name_span, clash));
    }
    let data = data::roots(&request.path, environment, sources, diagnostics);
    let mut resolver = Resolver {
        catalog,
        registry: &mut registry,
        sources,
        diagnostics,
        data: &data,
        environment,
        data_may_be_absent: request.data_may_be_absent,
        imports: BTreeMap::new(),
        importing: vec![canonical(&request.path)],
    };
    let mut cells = Vec::new();
    for draft in plan.cells {
        let known = resolver.diagnostics.len();
        let graph = resolver.graph(&draft.root, draft.seed);
        if !draft.arm.is_empty() {
            for diagnostic in &mut resolver.diagnostics[known..] {
                diagnostic.notes.push(format!("in arm `{}`", draft.arm));
            }
        }
        if let Some(graph) = graph {
            cells.push(Cell {
                arm: draft.arm,
                seed: draft.seed,
                graph,
            });
        }
    }
    let mut columns: Vec<String> = cells
        .iter()
        .flat_map(|cell| &cell.graph.stages)
        .flat_map(|stage| stage.description.columns.clone())
        .collect();
    columns.sort();
    columns.dedup();
    let compare = plan
        .compare
        .and_then(|node| resolver.compare(&node, &plan.rows, &columns));
    Some(Experiment {
        name: plan.name,
        about: plan.about,
        path: request.path.clone(),
        cells,
        sweep: is_sweep,
        compare,
        data: data
            .into_iter()
            .map(|(name, root)| (name, root.path))
            .collect(),
        sources: Sources::default(),
    })
}
