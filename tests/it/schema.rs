//! The schema for editors: what is checked in is what the binary writes, and it takes what the language takes.

use reviv::evaluation::columns::Column;
use reviv::evaluation::published::Published;
use reviv::evaluation::suite::Suite;
use reviv::experiment::catalog::Catalog;
use reviv::experiment::load::entry;
use reviv::experiment::schema;
use std::path::Path;

/// Asks the binary: this test program links ops of its own beside the product's.
#[test]
fn the_checked_in_schema_is_current() {
    let checked_in = Path::new(env!("CARGO_MANIFEST_DIR")).join("registry/schema.json");
    let folder = tempfile::tempdir().unwrap();
    let written = folder.path().join("schema.json");
    assert_cmd::Command::new(env!("CARGO_BIN_EXE_reviv"))
        .args(["schema", "-o"])
        .arg(&written)
        .assert()
        .success();
    assert!(
        std::fs::read(checked_in).unwrap_or_default() == std::fs::read(written).unwrap(),
        "registry/schema.json is stale: run `cargo run -- schema`"
    );
}

#[test]
fn the_schema_knows_ops_entries_and_settings() {
    let schema = schema::schema(&crate::language_ops::catalog());
    let rules = schema["$defs"]["stage"]["allOf"].as_array().unwrap();
    let mget = rules
        .iter()
        .find(|rule| rule["if"]["properties"]["op"]["const"] == "train_mget")
        .unwrap();
    let properties = &mget["then"]["properties"];
    assert_eq!(properties["tokenizers"]["type"], "array");
    assert_eq!(
        properties["masking"]["anyOf"][0]["enum"],
        serde_json::json!(["dirichlet", "dirichlet_mixture", "uniform"])
    );
    assert!(properties["masking"]["anyOf"][2]["properties"]["alpha"].is_object());
    assert_eq!(mget["then"]["additionalProperties"], false);
    // Nothing of the language's own marks is left for an editor to stumble over.
    assert!(!schema.to_string().contains("x-registry"));
}

#[test]
fn every_shipped_entry_is_sound() {
    let catalog = Catalog::linked();
    let root = Path::new(env!("CARGO_MANIFEST_DIR"));
    for entry in reviv::experiment::registry::Registry::new(&catalog, None).list(None) {
        // What this test program links in is not shipped.
        let Some(place) = entry.place.strip_suffix(" (built in)") else {
            continue;
        };
        let path = root.join(place);
        let request = reviv::experiment::load::Request {
            path,
            ..Default::default()
        };
        let (_, report) = reviv::experiment::load::check(&catalog, &request);
        assert!(!report.failed(), "{}", report.render(false));
        assert!(!entry.about.is_empty(), "{} has no `about`", entry.place);
    }
}

#[test]
fn every_shipped_experiment_is_sound() {
    let catalog = Catalog::linked();
    let root = Path::new(env!("CARGO_MANIFEST_DIR"));
    for (path, _) in catalog.experiments() {
        let request = reviv::experiment::load::Request {
            path: root.join(path),
            data_may_be_absent: true,
            ..Default::default()
        };
        let (_, report) = reviv::experiment::load::check(&catalog, &request);
        let wrong: Vec<_> = report
            .diagnostics
            .iter()
            // A video is the user's to give; everything else must be right as shipped.
            .filter(|d| !d.code.is_warning())
            .filter(|d| d.code != reviv::experiment::Code::E0204)
            .collect();
        assert!(wrong.is_empty(), "{}", report.render(false));
    }
}

#[test]
fn every_metric_that_anything_shipped_names_is_a_column() {
    let catalog = Catalog::linked();
    let root = Path::new(env!("CARGO_MANIFEST_DIR"));
    let registry = reviv::experiment::registry::Registry::new(&catalog, None);
    let place = root.join("x.yaml");
    let (mut suites, mut published) = (0, 0);
    for listed in registry.list(Some("suite")) {
        let suite: Suite = entry(&catalog, &place, &listed.name).unwrap();
        let columns = suite
            .columns()
            .unwrap_or_else(|error| panic!("{}: {error}", listed.name));
        assert!(
            columns.len() >= suite.metrics.len() && !columns.is_empty(),
            "{}",
            listed.name
        );
        suites += 1;
    }
    for listed in registry.list(Some("published")) {
        let rows: Published = entry(&catalog, &place, &listed.name).unwrap();
        assert!(!rows.rows.is_empty() && !rows.source.is_empty() && !rows.conditions.is_empty());
        for (row, name) in rows
            .rows
            .iter()
            .flat_map(|r| r.values.keys().map(move |k| (r, k)))
        {
            let column = Column::named(name);
            assert!(
                column.is_some(),
                "{}: {}: `{name}`",
                listed.name,
                row.system
            );
        }
        published += 1;
    }
    assert!(suites >= 15 && published >= 10);
    // What a sweep compares is what its evaluations compute, and its published rows have a number in it.
    let mut sweeps = 0;
    for (path, _) in catalog.experiments() {
        let request = reviv::experiment::load::Request {
            path: root.join(path),
            data_may_be_absent: true,
            ..Default::default()
        };
        let (experiment, _) = reviv::experiment::load::load(&catalog, &request);
        let Some((experiment, compare)) =
            experiment.and_then(|e| e.compare.clone().map(|c| (e, c)))
        else {
            continue;
        };
        sweeps += 1;
        let stages = || experiment.cells.iter().flat_map(|cell| &cell.graph.stages);
        for pattern in &compare.columns {
            let computed = stages()
                .flat_map(|stage| &stage.description.columns)
                .any(|name| Column::named(name).is_some_and(|c| c.answers_to(pattern)));
            assert!(computed, "{path}: `{pattern}` is computed by no stage");
        }
        let Some(name) = &compare.against else {
            continue;
        };
        let rows: Published = entry(&catalog, &place, name).unwrap();
        let columns: Vec<Column> = rows
            .rows
            .iter()
            .flat_map(|row| row.values.keys())
            .filter_map(|name| Column::named(name))
            .collect();
        let beside = |pattern: &String| columns.iter().any(|c| c.answers_to(pattern));
        assert!(
            compare.columns.iter().any(beside),
            "{path}: `{name}` stands beside nothing"
        );
    }
    assert!(sweeps >= 5, "{sweeps}");
}
