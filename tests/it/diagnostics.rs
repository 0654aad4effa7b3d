//! What a user sees when something is wrong: the words, the place, the way out.

use crate::language_ops::{Folder, TINY};
use insta::assert_snapshot;

/// What `check` says of one experiment.
fn says(text: &str) -> String {
    Folder::new(&[("a.yaml", text)]).says("a.yaml", &[])
}

/// [`TINY`] with one line changed.
fn changed(from: &str, to: &str) -> String {
    assert!(TINY.contains(from), "the test changes what is there");
    says(&TINY.replace(from, to))
}

#[test]
fn a_key_that_nothing_reads_is_an_error() {
    // apple/ml-4m#23: ten shipped configs carry a key that no script reads.
    assert_snapshot!(changed("    steps: 50\n", "    steps: 50\n    num_input_tokens_override: 128\n"), @r#"
    error[E0201]: unknown key `num_input_tokens_override`
      --> a.yaml:13:5
       |
    13 |     num_input_tokens_override: 128
       |     ^^^^^^^^^^^^^^^^^^^^^^^^^ nothing reads this
       |
       = help: one of `masking`, `op`, `precision`, `rate`, `seed`, `steps`, `tokenizers`
"#);
}

#[test]
fn a_misspelt_key_names_the_right_one() {
    assert_snapshot!(changed("    steps: 50\n", "    stesp: 50\n"), @r#"
    error[E0201]: unknown key `stesp`
      --> a.yaml:12:5
       |
    12 |     stesp: 50
       |     ^^^^^ nothing reads this
       |
       = help: did you mean `steps`?
"#);
}

#[test]
fn a_misspelt_entry_names_the_right_one() {
    assert_snapshot!(changed("{use: dirichlet, alpha: 0.5}", "dirichlt_mixture"), @r#"
    error[E0203]: unknown masking policy `dirichlt_mixture`
      --> a.yaml:11:14
       |
    11 |     masking: dirichlt_mixture
       |              ^^^^^^^^^^^^^^^^ not in the registry
       |
       = help: did you mean `dirichlet_mixture`? `reviv list masking` shows all 3
"#);
}

#[test]
fn every_error_of_a_file_comes_in_one_pass() {
    let text = "\
experiment: many
about: A test.
sed: 7
stages:
  clips: {op: clips, train: 0, keep_invalid: yes}
  clips2: {op: clisp}
  tok_body: {op: train_tokenizer, clips: clip, codebook: 1_000}
  mget:
    op: train_mget
    tokenizers: [clips, tok_body]
    masking: {use: dirichlet, alpha: large}
    steps: '50'
    precision: double
  scores: {op: evaluate}
  scores: {op: evaluate, model: mget}
";
    assert_snapshot!(says(text), @r#"
    error[E0201]: unknown key `sed`
     --> a.yaml:3:1
      |
    3 | sed: 7
      | ^^^ nothing reads this
      |
      = help: did you mean `seed`?

    error[E0202]: `train` is out of range: 0
     --> a.yaml:5:29
      |
    5 |   clips: {op: clips, train: 0, keep_invalid: yes}
      |                             ^ must be at least 1

    error[E0202]: `keep_invalid` must be `true` or `false`
     --> a.yaml:5:46
      |
    5 |   clips: {op: clips, train: 0, keep_invalid: yes}
      |                                              ^^^ this is text
      |
      = help: YAML 1.2 writes `true`

    error[E0203]: unknown op `clisp`
     --> a.yaml:6:16
      |
    6 |   clips2: {op: clisp}
      |                ^^^^^ no such op
      |
      = help: did you mean `clips`?
      = help: `reviv list ops` shows what each does

    error[E0204]: `modality` is missing
     --> a.yaml:7:13
      |
    7 |   tok_body: {op: train_tokenizer, clips: clip, codebook: 1_000}
      |             ^^^^^^^^^^^^^^^^^^^^^^^^^^^^^^^^^^^^^^^^^^^^^^^^^^^ needs `modality`
      |
      = help: add `modality`: The modality it is for

    error[E0301]: there is no stage `clip`
     --> a.yaml:7:42
      |
    7 |   tok_body: {op: train_tokenizer, clips: clip, codebook: 1_000}
      |                                          ^^^^ `clips` reads clips here
      |
      = help: did you mean `clips`?

    error[E0202]: `codebook` must be a whole number
     --> a.yaml:7:58
      |
    7 |   tok_body: {op: train_tokenizer, clips: clip, codebook: 1_000}
      |                                                          ^^^^^ this is text
      |
      = help: write `1000`, without quotes or `_`

    error[E0303]: stage `clips` makes clips, not tokenizer
      --> a.yaml:10:18
       |
     5 |   clips: {op: clips, train: 0, keep_invalid: yes}
       |               ----- makes clips
    ...
    10 |     tokenizers: [clips, tok_body]
       |                  ^^^^^ `tokenizers` reads tokenizer
       |
       = help: one of `tok_body`

    error[E0202]: `alpha` must be a number
      --> a.yaml:11:38
       |
    11 |     masking: {use: dirichlet, alpha: large}
       |                                      ^^^^^ this is text

    error[E0202]: `steps` must be a whole number
      --> a.yaml:12:12
       |
    12 |     steps: '50'
       |            ^^^^ this is text
       |
       = help: write `50`, without quotes or `_`

    error[E0203]: unknown value `double` of `precision`
      --> a.yaml:13:16
       |
    13 |     precision: double
       |                ^^^^^^ not one of its values
       |
       = help: one of `single`, `mixed`

    error[E0301]: stage `scores` needs `model`: the model to score
      --> a.yaml:14:3
       |
    14 |   scores: {op: evaluate}
       |   ^^^^^^ op `evaluate` reads mget here
       |
       = help: add `model: STAGE`

    error[E0201]: duplicate key `scores`
      --> a.yaml:15:3
       |
    14 |   scores: {op: evaluate}
       |   ------ first here
    15 |   scores: {op: evaluate, model: mget}
       |   ^^^^^^ again here
       |
       = help: keep one of the two
"#);
}

#[test]
fn an_edge_to_the_wrong_kind_shows_both_ends() {
    assert_snapshot!(changed("model: mget", "model: clips"), @r#"
    error[E0303]: stage `clips` makes clips, not mget
      --> a.yaml:13:33
       |
     5 |   clips: {op: clips, train: 20}
       |               ----- makes clips
    ...
    13 |   scores: {op: evaluate, model: clips}
       |                                 ^^^^^ `model` reads mget
       |
       = help: one of `mget`
"#);
}

#[test]
fn a_circle_is_named() {
    let text = "\
experiment: circle
stages:
  a: {op: evaluate, model: b}
  b: {op: train_mget, tokenizers: [a]}
";
    assert_snapshot!(says(text), @r#"
    error[E0302]: stages wait for each other
     --> a.yaml:3:28
      |
    3 |   a: {op: evaluate, model: b}
      |                            ^ this closes the circle
      |
      = note: `a` reads `b` reads `a`

    error[E0303]: stage `a` makes scores, not tokenizer
     --> a.yaml:4:36
      |
    3 |   a: {op: evaluate, model: b}
      |           -------- makes scores
    4 |   b: {op: train_mget, tokenizers: [a]}
      |                                    ^ `tokenizers` reads tokenizer
"#);
}

#[test]
fn what_does_not_fit_along_an_edge_is_found_before_any_compute() {
    assert_snapshot!(changed("modality: camera", "modality: gaze"), @r#"
    error[E0401]: the clips have no gaze
     --> a.yaml:7:61
      |
    7 |   tok_camera: {op: train_tokenizer, clips: clips, modality: gaze}
      |                                                             ^^^^ not in the clips
"#);
}

#[test]
fn a_change_inside_an_entry_is_shown_where_it_was_written() {
    assert_snapshot!(changed("alpha: 0.5", "alpha: -1"), @r#"
    error[E0202]: `alpha` is out of range: -1
      --> a.yaml:11:38
       |
    11 |     masking: {use: dirichlet, alpha: -1}
       |                                      ^^ must be at least 0.0001
"#);
}

#[test]
fn settings_of_another_entry_do_not_leak() {
    let folder = Folder::new(&[
        ("tiny.yaml", TINY),
        (
            "next.yaml",
            "extends: tiny.yaml\nstages:\n  mget: {masking: {use: uniform}}\n",
        ),
    ]);
    let next = folder.sound("next.yaml", &[]);
    assert_eq!(
        next.cells[0].graph.find("mget").unwrap().settings.json()["masking"],
        serde_json::json!({"use": "uniform", "policy": "uniform"})
    );
    folder.write(
        "wrong.yaml",
        b"extends: tiny.yaml\nstages:\n  mget: {masking: {use: uniform, alpha: 1}}\n",
    );
    assert_snapshot!(folder.says("wrong.yaml", &[]), @r#"
    error[E0201]: unknown key `alpha`
     --> wrong.yaml:3:34
      |
    3 |   mget: {masking: {use: uniform, alpha: 1}}
      |                                  ^^^^^ nothing reads this
      |
      = help: one of `policy`
"#);
}

#[test]
fn set_is_a_layer_with_its_own_place() {
    let folder = Folder::new(&[("tiny.yaml", TINY)]);
    assert_snapshot!(folder.says("tiny.yaml", &["stages.mget.stepz=10", "stages.mgett.steps=1"]), @r#"
    error[E0201]: unknown key `stepz`
     --> --set:1:1
      |
    1 | stages.mget.stepz=10
      | ^^^^^^^^^^^^^^^^^ nothing reads this
      |
      = help: did you mean `steps`?

    error[E0204]: stage `mgett` has no `op`
     --> --set:1:1
      |
    1 | stages.mgett.steps=1
      | ^^^^^^^^^^^^^^^^^^
      |
      = help: did you mean the stage `mget`?
"#);
    assert_snapshot!(folder.says("tiny.yaml", &["seed"]), @r#"
    error[E0102]: `--set` takes KEY=VALUE
     --> --set:1:1
      |
    1 | seed
      | ^^^^
      |
      = help: `--set stages.mget.steps=10`
"#);
}

#[test]
fn an_open_value_must_be_given() {
    let text = TINY.replace("steps: 50", "steps: ???");
    let folder = Folder::new(&[("a.yaml", &text)]);
    assert_snapshot!(folder.says("a.yaml", &[]), @r#"
    error[E0204]: `steps` must be given
      --> a.yaml:12:12
       |
    12 |     steps: ???
       |            ^^^ left open here
       |
       = help: give it in the file, or with `--set stages.mget.steps=VALUE`
"#);
    folder.sound("a.yaml", &["stages.mget.steps=3"]);
}

#[test]
fn substitutions_that_cannot_be_made_say_so() {
    let text = TINY
        .replace(
            "seed: 7\n",
            "seed: 7\nparams: {steps: 5, round: \"${params.round}\"}\n",
        )
        .replace("steps: 50", "steps: ${params.stesp}")
        .replace("alpha: 0.5", "alpha: \"${env.REVIV_NOT_SET}\"")
        .replace("train: 20", "train: \"${1 + 1}\"");
    assert_snapshot!(says(&text), @r#"
    error[E0105]: `${params.round}` stands for itself
     --> a.yaml:4:27
      |
    4 | params: {steps: 5, round: "${params.round}"}
      |                           ^^^^^^^^^^^^^^^^^
      |
      = help: break the circle

    error[E0105]: `${1 + 1}` is neither `${params.x}` nor `${env.X}`
     --> a.yaml:6:29
      |
    6 |   clips: {op: clips, train: "${1 + 1}"}
      |                             ^^^^^^^^^^
      |
      = help: the language has these two substitutions and no expressions; write `$${` for the characters `${`

    error[E0105]: the environment has no `REVIV_NOT_SET`
      --> a.yaml:12:38
       |
    12 |     masking: {use: dirichlet, alpha: "${env.REVIV_NOT_SET}"}
       |                                      ^^^^^^^^^^^^^^^^^^^^^^
       |
       = help: run with `REVIV_NOT_SET=...` before the command

    error[E0105]: unknown parameter `stesp`
      --> a.yaml:13:12
       |
    13 |     steps: ${params.stesp}
       |            ^^^^^^^^^^^^^^^
       |
       = help: did you mean `steps`?
"#);
    assert_snapshot!(changed("train: 20", "train: ${params.x}"), @r#"
    error[E0102]: while parsing a flow mapping, did not find expected ',' or '}'
     --> a.yaml:5:30
      |
    5 |   clips: {op: clips, train: ${params.x}}
      |                              ^
      |
      = help: inside `{ }` and `[ ]`, quote it: `"${params.x}"`
"#);
}

#[test]
fn missing_files_and_data_sets_are_found_before_any_compute() {
    assert_snapshot!(changed("train: 20", "only: nowhere/list.txt, source: recorded"), @r#"
    error[E0601]: there is no file `nowhere/list.txt`
     --> a.yaml:5:28
      |
    5 |   clips: {op: clips, only: nowhere/list.txt, source: recorded}
      |                            ^^^^^^^^^^^^^^^^ not found
      |
      = help: relative paths start at the file they are written in, those of `--set` and of registry entries at the current folder

    error[E0601]: data set `adt`: nothing says where it lies
     --> registry/source/recorded.yaml (built in):3:7
      |
    3 | data: adt
      |       ^^^
      |
      = note: `source` is set at a.yaml:5
      = help: set `REVIV_DATA_ADT=FOLDER`, or write `adt: FOLDER` into data.yaml
"#);
}

#[test]
fn files_that_extend_each_other_in_a_circle_are_named() {
    let folder = Folder::new(&[
        ("a.yaml", "extends: b.yaml\nexperiment: a\n"),
        ("b.yaml", "extends: a.yaml\n"),
        ("c.yaml", "extends: tny.yaml\n"),
        ("tiny.yaml", TINY),
    ]);
    assert_snapshot!(folder.says("a.yaml", &[]), @r#"
    error[E0104]: files extend each other in a circle
     --> b.yaml:1:10
      |
    1 | extends: a.yaml
      |          ^^^^^^ this closes it
      |
      = note: `a.yaml` extends `b.yaml` extends `a.yaml`
"#);
    assert_snapshot!(folder.says("c.yaml", &[]), @r#"
    error[E0101]: there is no file `tny.yaml`
     --> c.yaml:1:10
      |
    1 | extends: tny.yaml
      |          ^^^^^^^^
      |
      = help: did you mean `tiny.yaml`?
"#);
}

#[test]
fn a_sweep_reports_once_what_is_wrong_in_every_arm() {
    let folder = Folder::new(&[
        ("tiny.yaml", TINY),
        (
            "sweep.yaml",
            "\
sweep: many
base: tiny.yaml
seed: 3
seeds: [0, 1, 1]
arms:
  full: {}
  small: {stages.mget.step: 3}
  other: {stages.mgt.steps: 3}
  bad arm: 7
grid: {stages.mget.rate: 0.1}
compare: {baseline: ful, columns: [body.ga_mpjpe], interval: {level: 2}}
",
        ),
        (
            "compare.yaml",
            "\
sweep: compare
base: tiny.yaml
arms: {full: {}, small: {stages.mget.steps: 3}, bad: {stages.mget.rate: 5}}
compare: {baseline: ful, columns: [body.ga_mpjp], against: paper/ablation}
",
        ),
    ]);
    assert_snapshot!(folder.says("sweep.yaml", &[]), @r#"
    error[E0201]: unknown key `seed`
     --> sweep.yaml:3:1
      |
    3 | seed: 3
      | ^^^^ nothing reads this
      |
      = help: a sweep has `seeds: [0, 1, 2]`

    error[E0206]: seed 1 twice
     --> sweep.yaml:4:15
      |
    4 | seeds: [0, 1, 1]
      |               ^

    error[E0201]: unknown key `step`
     --> sweep.yaml:7:11
      |
    7 |   small: {stages.mget.step: 3}
      |           ^^^^^^^^^^^^^^^^ nothing reads this
      |
      = note: in arm `small`
      = help: did you mean `steps`?

    error[E0204]: stage `mgt` has no `op`
     --> sweep.yaml:8:11
      |
    8 |   other: {stages.mgt.steps: 3}
      |           ^^^^^^^^^^^^^^^^
      |
      = note: in arm `other`
      = help: did you mean the stage `mget`?

    error[E0202]: `bad arm` cannot name an arm
     --> sweep.yaml:9:3
      |
    9 |   bad arm: 7
      |   ^^^^^^^
      |
      = help: use letters, digits, `_` and `-`: it becomes part of file names

    error[E0202]: arm `bad arm` must be a map of changes
     --> sweep.yaml:9:12
      |
    9 |   bad arm: 7
      |            ^ this is a whole number
      |
      = help: `{stages.mget.masking: uniform}`; `{}` changes nothing

    error[E0202]: `stages.mget.rate` must be a list of at least one
      --> sweep.yaml:10:26
       |
    10 | grid: {stages.mget.rate: 0.1}
       |                          ^^^ this is a number

    error[E0202]: `level` is out of range: 2
      --> sweep.yaml:11:70
       |
    11 | compare: {baseline: ful, columns: [body.ga_mpjpe], interval: {level: 2}}
       |                                                                      ^ must be at least 0.5 and at most 0.9999
"#);
    assert_snapshot!(folder.says("compare.yaml", &[]), @r#"
    error[E0202]: `rate` is out of range: 5
     --> compare.yaml:3:73
      |
    3 | arms: {full: {}, small: {stages.mget.steps: 3}, bad: {stages.mget.rate: 5}}
      |                                                                         ^ must be at least 0 and at most 1
      |
      = note: in arm `bad`

    error[E0203]: unknown arm `ful`
     --> compare.yaml:4:21
      |
    4 | compare: {baseline: ful, columns: [body.ga_mpjp], against: paper/ablation}
      |                     ^^^
      |
      = help: did you mean `full`?

    error[E0203]: unknown column `body.ga_mpjp`
     --> compare.yaml:4:36
      |
    4 | compare: {baseline: ful, columns: [body.ga_mpjp], against: paper/ablation}
      |                                    ^^^^^^^^^^^^
      |
      = help: did you mean `body.ga_mpjpe`?

    error[E0203]: unknown published table `paper/ablation`
     --> compare.yaml:4:60
      |
    4 | compare: {baseline: ful, columns: [body.ga_mpjp], against: paper/ablation}
      |                                                            ^^^^^^^^^^^^^^
"#);
}

#[test]
fn two_entries_of_one_name_are_refused_naming_both_places() {
    let folder = Folder::new(&[
        ("tiny.yaml", TINY),
        (
            "registry/mine.yaml",
            "masking: uniform\npolicy: dirichlet\n",
        ),
    ]);
    assert_snapshot!(folder.says("tiny.yaml", &[]), @r#"
    error[E0205]: two masking entries are named `uniform`: registry/masking/uniform.yaml (built in) and registry/mine.yaml
     --> registry/mine.yaml:1:1
      |
    1 | masking: uniform
      | ^
      |
      = help: give it another name
"#);
}

#[test]
fn a_stage_of_another_experiment_that_is_not_there_is_named() {
    let folder = Folder::new(&[
        ("tiny.yaml", TINY),
        (
            "reads.yaml",
            "experiment: reads\nstages:\n  scores: {op: evaluate, model: tiny/mgt}\n  again: {op: evaluate, model: tinny/mget}\n  self: {op: evaluate, model: reads/scores}\n",
        ),
    ]);
    assert_snapshot!(folder.says("reads.yaml", &[]), @r#"
    error[E0301]: `tiny.yaml` has no stage `mgt`
     --> reads.yaml:3:33
      |
    3 |   scores: {op: evaluate, model: tiny/mgt}
      |                                 ^^^^^^^^
      |
      = help: did you mean `mget`?

    error[E0101]: there is no file `tinny.yaml`
     --> reads.yaml:4:32
      |
    4 |   again: {op: evaluate, model: tinny/mget}
      |                                ^^^^^^^^^^
      |
      = help: did you mean `tiny.yaml`?

    error[E0302]: experiments read stages of each other in a circle
     --> reads.yaml:5:31
      |
    5 |   self: {op: evaluate, model: reads/scores}
      |                               ^^^^^^^^^^^^ this closes it
"#);
}
