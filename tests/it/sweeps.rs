//! What a sweep's names become, how much a sweep may be, and what `reviv why`, `check` and `show` say around one.

use crate::language_ops::{Folder, TINY, catalog};
use reviv::experiment::load::{Request, check};
use std::process::Command;

fn sweep(rest: &str) -> Folder {
    let text = format!("base: tiny.yaml\n{rest}\n");
    Folder::new(&[("tiny.yaml", TINY), ("sweep.yaml", &text)])
}

#[test]
fn a_sweep_whose_name_is_a_path_is_refused() {
    for name in ["masking/v1", "..", "/tmp/evil", "[a]"] {
        let said = sweep(&format!("sweep: {name}")).says("sweep.yaml", &[]);
        assert!(said.contains("cannot name a sweep"), "{name}: {said}");
    }
    sweep("sweep: masking_v1").sound("sweep.yaml", &[]);
}

#[test]
fn a_grid_key_that_is_no_name_does_not_become_one() {
    let folder = sweep("sweep: s\ngrid: {\"params./tmp/evil\": [1, 2], stages.mget.steps: [3]}");
    let experiment = folder.sound("sweep.yaml", &[]);
    let arms: Vec<&str> = experiment.cells.iter().map(|c| c.arm.as_str()).collect();
    assert_eq!(arms, ["key1=1-steps=3", "key1=2-steps=3"]);
}

#[test]
fn the_baseline_of_a_grid_is_one_of_its_rows() {
    let text = |baseline: &str| {
        format!(
            "sweep: s\narms: {{full: {{}}}}\ngrid: {{stages.mget.steps: [3, 4]}}\ncompare: {{baseline: {baseline}}}"
        )
    };
    let said = sweep(&text("full")).says("sweep.yaml", &[]);
    assert!(said.contains("unknown arm `full`"), "{said}");
    sweep(&text("full-steps=4")).sound("sweep.yaml", &[]);
}

#[test]
fn a_sweep_that_multiplies_a_large_experiment_is_refused_before_it_is_made() {
    let list = vec!["1"; 2000].join(", ");
    let seeds: Vec<String> = (0..1200).map(|seed| seed.to_string()).collect();
    let seeds = seeds.join(", ");
    let many = sweep(&format!(
        "sweep: s\nparams: {{big: [{list}]}}\nseeds: [{seeds}]"
    ));
    let grid = sweep(&format!(
        "sweep: s\ngrid: {{params.a: [[{list}]], params.b: [{seeds}]}}"
    ));
    for folder in [many, grid] {
        let said = folder.says("sweep.yaml", &[]);
        assert!(said.contains("are more than 2000000 values"), "{said}");
    }
}

#[test]
fn why_knows_the_history_of_edges_and_seeds_and_the_blocks_of_a_sweep() {
    let folder = sweep(
        "sweep: s\nstages: {mget: {tokenizers: [tok_body], seed: 3, steps: 9}}\narms: {full: {}, slow: {stages.mget.rate: 0.5}}",
    );
    let experiment = folder.sound("sweep.yaml", &[]);
    let why = |key: &str| {
        let found = reviv::experiment::why::explain(&catalog(), &experiment, Some("slow"), key);
        let chain = found.unwrap().remove(0).chain;
        let links = chain.into_iter().map(|link| (link.value, link.layer));
        links.collect::<Vec<_>>()
    };
    let link = |value: &str, layer: &str| (value.to_owned(), layer.to_owned());
    assert_eq!(
        why("mget.tokenizers"),
        [
            link("tok_body", "the sweep"),
            link("[tok_body, tok_camera]", "the base")
        ]
    );
    assert_eq!(why("mget.seed"), [link("3", "the sweep")]);
    assert_eq!(
        why("mget.steps"),
        [link("9", "the sweep"), link("50", "the base")]
    );
    assert_eq!(why("mget.rate"), [link("0.5", "arm `slow`")]);
}

#[test]
fn an_entry_is_checked_among_the_entries_of_its_project() {
    let folder = Folder::new(&[
        (
            "registry/masking/mine.yaml",
            "masking: mine\nabout: Mine.\nextends: theirs\n",
        ),
        (
            "registry/masking/theirs.yaml",
            "masking: theirs\nabout: Theirs.\npolicy: uniform\n",
        ),
    ]);
    let request = Request {
        path: folder.path("registry/masking/mine.yaml"),
        ..Request::default()
    };
    let (_, report) = check(&catalog(), &request);
    assert!(!report.failed(), "{}", report.render(false));
}

#[test]
fn a_name_that_several_runs_have_is_not_called_unknown() {
    let folder = Folder::new(&[
        ("runs/1122-a-1/run.json", ""),
        ("runs/1122-a-2/run.json", ""),
    ]);
    let output = Command::new(env!("CARGO_BIN_EXE_reviv"))
        .args(["show", "1122-a"])
        .current_dir(folder.0.path())
        .output()
        .unwrap();
    let said = String::from_utf8_lossy(&output.stderr);
    assert_eq!(output.status.code(), Some(1), "{said}");
    assert!(said.contains("2 runs fit `1122-a`"), "{said}");
    assert!(said.contains("1122-a-2"), "{said}");
}
