//! The experiments that are shipped, through the binary: each checks and plans where its data are not, with the paper's numbers.

use reviv::experiment::catalog::Catalog;
use reviv::experiment::graph::Experiment;
use reviv::experiment::load::{Request, load};
use reviv::experiment::resolved;
use serde_json::Value;
use std::path::{Path, PathBuf};
use std::process::{Command, Output};

fn root() -> &'static Path {
    Path::new(env!("CARGO_MANIFEST_DIR"))
}

/// Runs the binary with no data set anywhere.
fn reviv(arguments: &[&str]) -> Output {
    let mut command = Command::new(env!("CARGO_BIN_EXE_reviv"));
    for (variable, _) in std::env::vars_os() {
        if variable.to_string_lossy().starts_with("REVIV_DATA_") {
            command.env_remove(variable);
        }
    }
    command
        .args(arguments)
        .current_dir(root())
        .output()
        .unwrap()
}

/// The files of `experiments/`, those below `paper/` included.
fn shipped() -> Vec<PathBuf> {
    let mut files = Vec::new();
    let mut open = vec![root().join("experiments")];
    while let Some(folder) = open.pop() {
        for entry in std::fs::read_dir(folder).unwrap() {
            let path = entry.unwrap().path();
            if path.is_dir() {
                open.push(path);
            } else if path.extension().is_some_and(|end| end == "yaml") {
                files.push(path.strip_prefix(root()).unwrap().to_owned());
            }
        }
    }
    files.sort();
    files
}

#[test]
fn what_a_run_resolves_reads_back_as_the_same_stages() {
    let catalog = Catalog::linked();
    let open = |path: &Path| {
        let request = Request {
            path: path.to_owned(),
            set: Vec::new(),
            seed: None,
            data_may_be_absent: true,
        };
        let (experiment, report) = load(&catalog, &request);
        experiment.unwrap_or_else(|| panic!("{}", report.render(false)))
    };
    let stages = |experiment: &Experiment| -> Vec<(String, Value, u64)> {
        let stages = &experiment.cells[0].graph.stages;
        stages
            .iter()
            .map(|stage| {
                (
                    stage.name.clone(),
                    stage.settings.json().clone(),
                    stage.seed,
                )
            })
            .collect()
    };
    let folder = tempfile::tempdir().unwrap();
    for name in ["quickstart", "tokenizers_small", "wearer"] {
        let first = open(&root().join(format!("experiments/{name}.yaml")));
        let again = folder.path().join("resolved.yaml");
        std::fs::write(&again, resolved::to_yaml(&first)).unwrap();
        assert_eq!(stages(&first), stages(&open(&again)), "{name}");
    }
}

#[test]
fn every_shipped_experiment_checks_and_plans_where_its_data_are_not() {
    let files = shipped();
    assert!(files.len() >= 10, "{files:?}");
    for file in files {
        let file = file.to_str().unwrap();
        for command in ["check", "plan"] {
            let output = reviv(&[command, file]);
            let said = String::from_utf8_lossy(&output.stderr);
            assert!(output.status.success(), "{command} {file}: {said}");
            assert!(!said.contains("error["), "{command} {file}: {said}");
            // To run it, the data have to be there: said before any compute.
            if said.contains("warning[W0702]") && command == "check" {
                let runs = tempfile::tempdir().unwrap();
                let output = reviv(&["run", file, "--runs", runs.path().to_str().unwrap()]);
                assert_eq!(output.status.code(), Some(1));
                assert!(String::from_utf8_lossy(&output.stderr).contains("error[E0601]"));
            }
        }
    }
}

fn plan(file: &str) -> Value {
    let output = reviv(&["plan", file, "--json"]);
    serde_json::from_slice(&output.stdout).unwrap()
}

/// Parameters of a stage by its op, and parts by name.
fn parameters(plan: &Value, op: &str) -> Vec<u64> {
    let stages = plan["stages"].as_array().unwrap();
    let of_op = stages.iter().filter(|stage| stage["op"] == op);
    of_op
        .filter_map(|stage| stage["plan"]["parameters"].as_u64())
        .collect()
}

/// Golden: counted from the released code's own constructors (256-pixel pathway, body codebook 2048).
#[test]
fn the_papers_models_have_the_papers_parameters() {
    let base = plan("experiments/paper/mget_base.yaml");
    assert_eq!(parameters(&base, "train_mget"), [403_504_128]);
    let tiny = plan("experiments/paper/mget_tiny.yaml");
    assert_eq!(parameters(&tiny, "train_mget"), [127_272_960]);
    let mget = base["stages"].as_array().unwrap();
    let mget = mget
        .iter()
        .find(|stage| stage["op"] == "train_mget")
        .unwrap();
    let tokens: Vec<(&str, u64, u64)> = mget["plan"]["tokens"]
        .as_array()
        .unwrap()
        .iter()
        .map(|t| {
            let number = |key: &str| t[key].as_u64().unwrap();
            (
                t["modality"].as_str().unwrap(),
                number("tokens"),
                number("vocabulary"),
            )
        })
        .collect();
    for (modality, tokens_of, vocabulary) in [
        ("body", 210, 2048),
        ("camera", 30, 256),
        ("depth", 5120, 64000),
        ("gaze", 30, 512),
        ("left_hand", 210, 1024),
        ("right_hand", 210, 1024),
        ("rgb", 5120, 64000),
    ] {
        assert!(
            tokens.contains(&(modality, tokens_of, vocabulary)),
            "{modality}: {tokens:?}"
        );
    }
    // 500 billion nominal tokens at batch 1024 and 4096 tokens per sample.
    let steps = 500_000_000_000_u64.div_ceil(4096 * 1024);
    assert_eq!(mget["plan"]["work"][0], steps);
}

/// What masking does on average belongs to its settings: not to a training seed, nor to which arm is planned first.
#[test]
fn stages_with_the_same_masking_have_the_same_simulated_tokens() {
    let sweep = plan("experiments/ablation_tiny.yaml");
    let cells = sweep["cells"].as_array().unwrap();
    let tokens = |arm: &str, seed: u64| {
        let label = format!("{arm}-s{seed}");
        let cell = cells.iter().position(|cell| *cell == label).unwrap();
        let mut stages = sweep["stages"].as_array().unwrap().iter();
        let uses = |stage: &&Value| stage["cells"].as_array().unwrap().contains(&cell.into());
        stages
            .find(|stage| stage["op"] == "train_mget" && uses(stage))
            .unwrap()["plan"]["tokens"]
            .clone()
    };
    for arm in ["full", "uniform", "body_specialist"] {
        assert_eq!(tokens(arm, 0), tokens(arm, 2), "{arm}");
    }
    assert_eq!(tokens("full", 1), tokens("half_data", 1));
    assert_ne!(tokens("full", 1), tokens("uniform", 1));
}

#[test]
fn the_papers_tokenizers_have_the_papers_parameters() {
    for (file, expected) in [
        ("body", vec![179_635_250]),
        ("hands", vec![179_635_250, 179_635_250]),
        ("gaze", vec![179_613_732]),
        ("camera", vec![179_635_250]),
    ] {
        let planned = plan(&format!("experiments/paper/tokenizer_{file}.yaml"));
        assert_eq!(parameters(&planned, "train_tokenizer"), expected, "{file}");
    }
    let sweep = plan("experiments/paper/ablation_vq.yaml");
    assert_eq!(sweep["cells"].as_array().unwrap().len(), 6);
    // Clips once, a tokenizer per arm.
    assert_eq!(sweep["stages"].as_array().unwrap().len(), 1 + 6);
}

#[test]
fn the_first_experiment_fits_on_one_screen() {
    let text = std::fs::read_to_string(root().join("experiments/quickstart.yaml")).unwrap();
    let longest = text.lines().map(|line| line.chars().count()).max();
    assert!(text.lines().count() <= 55, "{} lines", text.lines().count());
    assert!(longest <= Some(130), "{longest:?}");
}
