//! The language: layers, references, substitutions, sweeps.

use crate::language_ops::{Folder, TINY, catalog};
use reviv::experiment::load::{Request, load_in};
use reviv::experiment::plan::plan;
use serde_json::json;
use std::collections::BTreeMap;

#[test]
fn an_experiment_becomes_a_graph_with_every_default_filled_in() {
    let folder = Folder::new(&[("tiny.yaml", TINY)]);
    let experiment = folder.sound("tiny.yaml", &[]);
    let graph = &experiment.cells[0].graph;
    let names: Vec<&str> = graph.stages.iter().map(|s| s.name.as_str()).collect();
    assert_eq!(names, ["clips", "tok_body", "tok_camera", "mget", "scores"]);
    assert_eq!(
        *graph.find("clips").unwrap().settings.json(),
        json!({
            "source": {"use": "world_small", "rooms": 3, "data": null},
            "train": 20, "only": null, "keep_invalid": false,
        })
    );
    assert_eq!(
        graph.find("mget").unwrap().settings.json()["masking"],
        json!({"use": "dirichlet", "policy": "dirichlet", "alpha": 0.5})
    );
    assert_eq!(graph.find("mget").unwrap().edges[0].from, [1, 2]);
    let plan = graph.plan(graph.find("mget").unwrap());
    assert_eq!(plan.parameters, Some((512 + 256) * 16));
}

#[test]
fn later_layers_win_and_tags_say_how() {
    let folder = Folder::new(&[
        ("tiny.yaml", TINY),
        (
            "more.yaml",
            "stages:\n  mget: {rate: 0.5, precision: mixed}\n",
        ),
        (
            "next.yaml",
            "\
extends: [tiny.yaml, more.yaml]
experiment: next
stages:
  tok_gaze: {op: train_tokenizer, clips: clips, modality: body}
  tok_camera: !unset
  mget:
    tokenizers: !append [tok_gaze]
    steps: 60
    precision: !unset
  scores: !replace {op: evaluate, model: mget}
",
        ),
    ]);
    let said = folder.says("next.yaml", &[]);
    assert!(said.contains("there is no stage `tok_camera`"), "{said}");
    let next = folder.sound(
        "next.yaml",
        &[
            "stages.mget.tokenizers=[tok_body, tok_gaze]",
            "stages.mget.rate=0.25",
        ],
    );
    let mget = next.cells[0].graph.find("mget").unwrap();
    assert_eq!(mget.settings.json()["steps"], 60);
    assert_eq!(mget.settings.json()["rate"], 0.25);
    assert_eq!(mget.settings.json()["precision"], "single");
    assert_eq!(next.name, "next");
}

#[test]
fn parameters_and_the_environment_keep_their_types() {
    let text = TINY
        .replace(
            "seed: 7\n",
            "seed: 7\nparams: {steps: 5, alpha: 0.25, name: bo, list: [tok_body]}\n",
        )
        .replace("steps: 50", "steps: ${params.steps}")
        .replace("alpha: 0.5", "alpha: \"${env.ALPHA}\"")
        .replace("modality: body", "modality: \"${params.name}dy\"")
        .replace("[tok_body, tok_camera]", "${params.list}");
    let folder = Folder::new(&[("a.yaml", &text)]);
    let (experiment, report) =
        folder.load_with("a.yaml", &["params.steps=9"], &[("ALPHA", "0.125")]);
    let experiment = experiment.unwrap_or_else(|| panic!("{}", report.render(false)));
    let graph = &experiment.cells[0].graph;
    let mget = graph.find("mget").unwrap();
    assert_eq!(mget.settings.json()["steps"], 9);
    assert_eq!(mget.settings.json()["masking"]["alpha"], 0.125);
    assert_eq!(mget.edges[0].from.len(), 1);
    assert_eq!(
        graph.find("tok_body").unwrap().settings.json()["modality"],
        "body"
    );
}

const SWEEP: &str = "\
sweep: many
base: tiny.yaml
seeds: [0, 1]
arms:
  full: {}
  uniform: {stages.mget.masking: uniform}
  longer: {stages.mget.steps: 70, stages.mget.rate: 0.5}
compare: {baseline: full, columns: [body.ga_mpjpe]}
";

#[test]
fn a_sweep_is_arms_times_grid_times_seeds_and_shares_what_is_the_same() {
    let folder = Folder::new(&[
        ("tiny.yaml", TINY),
        ("sweep.yaml", SWEEP),
        (
            "grid.yaml",
            "sweep: g\nbase: tiny.yaml\ngrid: {stages.mget.steps: [1, 2], stages.mget.masking: [uniform, {use: dirichlet}]}\n",
        ),
    ]);
    let sweep = folder.sound("sweep.yaml", &[]);
    let labels: Vec<String> = sweep
        .cells
        .iter()
        .map(reviv::experiment::Cell::label)
        .collect();
    assert_eq!(
        labels,
        [
            "full-s0",
            "full-s1",
            "uniform-s0",
            "uniform-s1",
            "longer-s0",
            "longer-s1"
        ]
    );
    let plan = reviv::experiment::plan::plan(&sweep, &|_| false, &mut |_| unreachable!()).unwrap();
    // Per seed: clips and two tokenizers once; per cell: a model and its scores.
    assert_eq!((plan.total, plan.stages.len()), (30, 2 * 3 + 6 * 2));
    let clips: Vec<&Vec<usize>> = plan
        .stages
        .iter()
        .filter(|stage| stage.name == "clips")
        .map(|stage| &stage.cells)
        .collect();
    assert_eq!(clips, [&vec![0, 2, 4], &vec![1, 3, 5]]);

    let pinned = folder.sound("sweep.yaml", &["stages.clips.seed=0", "seeds=[3, 4]"]);
    let plan = reviv::experiment::plan::plan(&pinned, &|_| true, &mut |_| unreachable!()).unwrap();
    assert_eq!(
        plan.stages
            .iter()
            .filter(|stage| stage.name == "clips")
            .count(),
        1
    );
    assert_eq!(plan.to_do().count(), 0);

    let grid = folder.sound("grid.yaml", &[]);
    let labels: Vec<&str> = grid.cells.iter().map(|cell| cell.arm.as_str()).collect();
    assert_eq!(
        labels,
        [
            "steps=1-masking=uniform",
            "steps=1-masking=dirichlet",
            "steps=2-masking=uniform",
            "steps=2-masking=dirichlet"
        ]
    );
    assert!(grid.cells.iter().all(|cell| cell.seed == 7));
}

#[test]
fn identity_depends_on_what_decides_the_bytes_and_on_nothing_else() {
    let folder = Folder::new(&[
        ("tiny.yaml", TINY),
        (
            "renamed.yaml",
            &TINY
                .replace("tok_body", "body_tokens")
                .replace("tiny", "other"),
        ),
        (
            "explicit.yaml",
            &TINY.replace("steps: 50", "steps: 5e1\n    rate: 0.001"),
        ),
        ("list.txt", "one"),
    ]);
    let keys = |name: &str, set: &[&str]| -> Vec<String> {
        let experiment = folder.sound(name, set);
        let keys = experiment.cells[0]
            .graph
            .keys(&mut |path| std::fs::read(path).map(|bytes| blake3::hash(&bytes)))
            .unwrap();
        keys.iter().map(ToString::to_string).collect()
    };
    let base = keys("tiny.yaml", &[]);
    assert_eq!(base, keys("tiny.yaml", &[]));
    assert_eq!(base, keys("renamed.yaml", &[]), "names do not matter");
    assert_eq!(
        base,
        keys("explicit.yaml", &[]),
        "a default written out is the default"
    );
    // clips, tok_body, tok_camera, mget, scores
    let differs =
        |other: &[String]| -> Vec<bool> { base.iter().zip(other).map(|(a, b)| a != b).collect() };
    assert_eq!(
        differs(&keys("tiny.yaml", &["stages.tok_camera.codebook=128"])),
        [false, false, true, true, true]
    );
    assert_eq!(differs(&keys("tiny.yaml", &["seed=8"])), [true; 5]);
    let path = format!("stages.clips.only={}", folder.path("list.txt").display());
    let with_file = keys("tiny.yaml", &[&path]);
    assert_eq!(differs(&with_file), [true; 5]);
    folder.write("list.txt", b"two");
    assert_ne!(
        with_file,
        keys("tiny.yaml", &[&path]),
        "the bytes of a file count"
    );
}

#[test]
fn a_stage_of_another_experiment_comes_with_what_it_needs_and_its_own_seed() {
    let folder = Folder::new(&[
        ("tiny.yaml", TINY),
        (
            "sub/reads.yaml",
            "experiment: reads\nseed: 1\nstages:\n  mget: {op: train_mget, tokenizers: [../tiny/tok_body, ../tiny/tok_camera]}\n",
        ),
        (
            "sub/sweep.yaml",
            "sweep: s\nbase: reads.yaml\nseeds: [1, 2, 3]\n",
        ),
    ]);
    let experiment = folder.sound("sub/reads.yaml", &[]);
    let graph = &experiment.cells[0].graph;
    let names: Vec<(&str, u64)> = graph
        .stages
        .iter()
        .map(|s| (s.name.as_str(), s.seed))
        .collect();
    assert_eq!(
        names,
        [
            ("tiny/clips", 7),
            ("tiny/tok_body", 7),
            ("tiny/tok_camera", 7),
            ("mget", 1)
        ]
    );
    let sweep = folder.sound("sub/sweep.yaml", &[]);
    let plan = reviv::experiment::plan::plan(&sweep, &|_| false, &mut |_| unreachable!()).unwrap();
    assert_eq!(
        plan.stages.len(),
        3 + 3,
        "tokenizers are trained once for all seeds"
    );
}

#[test]
fn why_names_every_layer_that_had_a_say() {
    let folder = Folder::new(&[
        ("tiny.yaml", TINY),
        (
            "next.yaml",
            "extends: tiny.yaml\nstages:\n  mget: {masking: {alpha: 0.75}}\n",
        ),
    ]);
    let experiment = folder.sound("next.yaml", &["stages.mget.masking.alpha=2"]);
    let catalog = crate::language_ops::catalog();
    let why = |key: &str| {
        let answers = reviv::experiment::why::explain(&catalog, &experiment, None, key).unwrap();
        let folder = format!("{}/", folder.0.path().display());
        let text = reviv::experiment::why::render(&answers).replace(&folder, "");
        // Columns are as wide as the folder's name asks for.
        let lines: Vec<String> = text
            .lines()
            .map(|line| {
                let indent = line.len() - line.trim_start().len();
                let words: Vec<&str> = line.split_whitespace().collect();
                format!("{}{}", " ".repeat(indent), words.join(" "))
            })
            .collect();
        lines.join("\n")
    };
    insta::assert_snapshot!(why("stages.mget.masking.alpha"), @r#"
    stages.mget.masking.alpha = 2.0
      set by 2.0 --set stages.mget.masking.alpha=2 the command line
      was 0.75 next.yaml:3 the file
      was 0.5 tiny.yaml:11 extended by `next.yaml`
      was 1.0 registry/masking/dirichlet.yaml (built in):4 the registry
"#);
    insta::assert_snapshot!(why("mget.rate"), @r#"
    stages.mget.rate = 0.001
      # Peak learning rate.
      set by 0.001 default of op `train_mget`
"#);
    insta::assert_snapshot!(why("clips"), @r#"
    stages.clips.op = clips
      set by clips the stage
    stages.clips.source.use = world_small
      set by world_small default of op `clips`
    stages.clips.source.rooms = 3
      set by 3 registry/source/world_small.yaml (built in):3 the registry
    stages.clips.source.data = null
      set by null default of op `clips`
    stages.clips.train = 20
      # Clips to train on.
      set by 20 tiny.yaml:5 extended by `next.yaml`
    stages.clips.only = null
      # A list of file names.
      set by null default of op `clips`
    stages.clips.keep_invalid = false
      # Keep signals that are not valid.
      set by false default of op `clips`
    stages.clips.seed = 7
      set by 7 the seed of the run
"#);
    let wrong = reviv::experiment::why::explain(&catalog, &experiment, None, "mget.stesp");
    assert_eq!(wrong.unwrap_err().1, "did you mean `steps`?");
}

#[test]
fn resolved_yaml_reads_back_as_the_same_experiment() {
    let folder = Folder::new(&[("tiny.yaml", TINY)]);
    let first = folder.sound("tiny.yaml", &["stages.mget.steps=12"]);
    let text = reviv::experiment::resolved::to_yaml(&first);
    assert!(
        text.contains("steps: 12  # from --set stages.mget.steps=12"),
        "{text}"
    );
    assert!(text.contains("rate: 0.001  # default"), "{text}");
    let named = text.lines().find(|line| line.contains("use: dirichlet"));
    assert!(named.unwrap().ends_with("tiny.yaml:11"), "{text}");
    folder.write("again.yaml", text.as_bytes());
    let again = folder.sound("again.yaml", &[]);
    let stages = |experiment: &reviv::experiment::Experiment| -> Vec<serde_json::Value> {
        let graph = &experiment.cells[0].graph;
        graph
            .stages
            .iter()
            .map(|stage| stage.settings.json().clone())
            .collect()
    };
    assert_eq!(stages(&first), stages(&again));
}

#[test]
fn data_sets_lie_where_data_yaml_or_the_environment_says() {
    let folder = Folder::new(&[
        ("a.yaml", &TINY.replace("train: 20", "source: recorded")),
        ("data.yaml", "adt: recordings\n"),
        ("recordings/x", ""),
        ("elsewhere/x", ""),
    ]);
    let experiment = folder.sound("a.yaml", &[]);
    assert_eq!(experiment.data["adt"], folder.path("recordings"));
    let elsewhere = folder.path("elsewhere").display().to_string();
    let (experiment, _) = folder.load_with("a.yaml", &[], &[("REVIV_DATA_ADT", &elsewhere)]);
    assert_eq!(experiment.unwrap().data["adt"], folder.path("elsewhere"));
}

#[test]
fn an_experiment_can_be_planned_where_its_data_is_not() {
    let folder = Folder::new(&[("a.yaml", &TINY.replace("train: 20", "source: recorded"))]);
    let request = Request {
        path: folder.path("a.yaml"),
        data_may_be_absent: true,
        ..Request::default()
    };
    let (experiment, report) = load_in(&catalog(), &request, &BTreeMap::new());
    let said: Vec<String> = report
        .diagnostics
        .iter()
        .map(|d| format!("{}: {}", d.code, d.message))
        .collect();
    assert_eq!(said, ["W0702: data set `adt`: nothing says where it lies"]);
    let experiment = experiment.unwrap();
    let hash = &mut |_: &std::path::Path| Err(std::io::ErrorKind::NotFound.into());
    let planned = plan(&experiment, &|_| false, hash).unwrap();
    assert_eq!(planned.stages.len(), 5);
    // To run it, the data must be there.
    assert!(folder.says("a.yaml", &[]).contains("error[E0601]"));
}

#[test]
fn why_explains_what_stands_beside_the_stages() {
    let text = TINY.replace("stages:\n", "params: {width: 8, deep: {er: 1}}\nstages:\n");
    let folder = Folder::new(&[
        ("tiny.yaml", &text),
        (
            "next.yaml",
            "extends: tiny.yaml\nexperiment: next\nparams: {width: 16}\n",
        ),
    ]);
    let experiment = folder.sound("next.yaml", &["params.width=32"]);
    let why = |key: &str| reviv::experiment::why::explain(&catalog(), &experiment, None, key);
    let width = why("params.width").unwrap().remove(0);
    let values: Vec<&str> = width.chain.iter().map(|link| link.value.as_str()).collect();
    assert_eq!(
        (width.value.as_str(), values),
        ("32", vec!["32", "16", "8"])
    );
    assert_eq!(width.chain[0].layer, "the command line");
    assert_eq!(width.chain[1].layer, "the file");
    let params: Vec<String> = why("params").unwrap().into_iter().map(|a| a.key).collect();
    assert_eq!(params, ["params.width", "params.deep.er"]);
    assert_eq!(why("experiment").unwrap()[0].chain[0].value, "next");
    assert_eq!(why("seed").unwrap()[0].value, "7");
    assert!(why("params.wide").is_err());
}
