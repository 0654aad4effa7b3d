//! A sweep with a `compare:` block through the binary: its table is shown, kept beside the run's page and shown on it; and
//! what is scored is known by its bytes.

use ndarray::Array2;
use reviv::formats::npz::Npz;
use std::path::Path;
use std::process::{Command, Output};

const BASE: &str = "
experiment: scored
stages:
  scores: {op: evaluate, truth_data: truth, predictions_data: near, suite: {use: world_gaze, metrics: [gaze.mse]}}
  other_scores: {op: evaluate, truth_data: other, predictions_data: other, suite: {use: world_gaze, metrics: [gaze.l2]}}
";

const SWEEP: &str = "
sweep: scored
base: base.yaml
about: Two systems that miss the gaze by more or less.
seeds: [0]
arms:
  near: {}
  far: {stages.scores.predictions_data: far}
compare:
  baseline: near
  columns: [gaze.mse]
  interval: {level: 0.9, over: [clips]}
  against: adt_gaze
";

fn write(folder: &Path, name: &str, miss: f64) {
    std::fs::create_dir_all(folder).unwrap();
    for clip in 0..4 {
        let gaze = Array2::from_shape_fn((60, 2), |(t, axis)| {
            0.4 + 0.002 * t as f64 + 0.01 * f64::from(clip) + miss * (axis as f64 + 1.0)
        });
        let path = folder.join(format!("{name}_{clip}.npz"));
        Npz::default().with("gaze", gaze).write(&path).unwrap();
    }
}

fn run(folder: &Path) -> Output {
    Command::new(env!("CARGO_BIN_EXE_reviv"))
        .args(["run", "sweep.yaml"])
        .current_dir(folder)
        .output()
        .unwrap()
}

#[test]
fn the_arms_of_a_sweep_are_compared_on_its_page() {
    let folder = tempfile::tempdir().unwrap();
    let at = |name: &str| folder.path().join(name);
    std::fs::write(at("base.yaml"), BASE).unwrap();
    std::fs::write(at("sweep.yaml"), SWEEP).unwrap();
    std::fs::write(
        at("data.yaml"),
        "truth: truth\nnear: near\nfar: far\nother: other\n",
    )
    .unwrap();
    for (name, miss) in [("truth", 0.0), ("near", 0.01), ("far", 0.1)] {
        write(&at(name), "clip", miss);
    }
    // Scores of other clips, of which the table has no column.
    write(&at("other"), "another", 0.0);
    let output = run(folder.path());
    let said = String::from_utf8_lossy(&output.stderr);
    assert!(output.status.success(), "{said}");
    assert!(said.contains("3 made"), "{said}");
    assert!(said.contains("near") && said.contains("far"), "{said}");
    let page = String::from_utf8(output.stdout).unwrap();
    let page = at(page.trim());
    let text = std::fs::read_to_string(&page).unwrap();
    let (before, _) = text.split_once("<h2>Comparison</h2>").unwrap();
    assert!(
        before.contains("class=\"said\""),
        "the conclusion opens the page"
    );
    assert!(
        text.contains("90 % interval"),
        "the block decides the level"
    );
    assert!(text.contains("published rows (context, not comparable)"));
    for name in ["table.md", "table.tex", "table.csv"] {
        assert!(page.with_file_name(name).is_file(), "{name}");
    }
    // The intervals are drawn, with the published row as context.
    assert!(text.contains("Every row of the comparison with its interval"));
    let plot = std::fs::read_to_string(page.with_file_name("table_intervals.svg")).unwrap();
    for row in ["near", "far", "(image centre)", "ReViV (published)"] {
        assert!(plot.contains(row), "{row}");
    }
    let run_name = page.ancestors().nth(2).unwrap().to_owned();
    let compared = Command::new(env!("CARGO_BIN_EXE_reviv"))
        .args([
            "compare",
            "--columns",
            "gaze.mse",
            "--against",
            "adt_gaze",
            "--plot",
            "plot.svg",
            "--format",
            "md",
        ])
        .arg(&run_name)
        .current_dir(folder.path())
        .output()
        .unwrap();
    let table = String::from_utf8_lossy(&compared.stdout).into_owned();
    assert!(
        compared.status.success(),
        "{}",
        String::from_utf8_lossy(&compared.stderr)
    );
    assert!(
        table.contains("published rows (context, not comparable)"),
        "{table}"
    );
    assert!(
        std::fs::read_to_string(at("plot.svg"))
            .unwrap()
            .contains("ReViV (published)")
    );
    let shown = Command::new(env!("CARGO_BIN_EXE_reviv"))
        .arg("show")
        .arg(&run_name)
        .current_dir(folder.path())
        .output()
        .unwrap();
    let shown = String::from_utf8_lossy(&shown.stdout).into_owned();
    assert!(shown.contains("90 % interval"), "{shown}");
    // Asked again: nothing to do, the same page.
    let again = run(folder.path());
    assert!(String::from_utf8_lossy(&again.stderr).contains("done before"));
    assert_eq!(std::fs::read_to_string(&page).unwrap(), text);
    // Another prediction under the same name is another input, and only what reads it is done again.
    write(&at("far"), "clip", 0.2);
    let changed = run(folder.path());
    let said = String::from_utf8_lossy(&changed.stderr).into_owned();
    assert!(said.contains("1 made, 2 found in the cache"), "{said}");
}
