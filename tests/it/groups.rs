//! An op that stands for several stages: `train_tokenizers`.

use reviv::experiment::catalog::Catalog;
use reviv::experiment::load::{Request, load};
use reviv::experiment::why::explain;
use reviv::experiment::{Experiment, resolved};
use std::path::Path;

const BY_HAND: &str = "\
experiment: hand
seed: 3
stages:
  clips: {op: clips, source: world_small, train: 8, validation: 2}
  a: {op: train_tokenizer, clips: clips, modality: camera, tokenizer: vq_temporal_small, steps: 20, batch: 4, warmup: {steps: 2}}
  b: {op: train_tokenizer, clips: clips, modality: gaze, tokenizer: {use: vq_temporal_small, codebook: 64}, steps: 9, batch: 4, warmup: {steps: 2}}
  c: {op: train_tokenizer, clips: clips, modality: body, tokenizer: vq_kinematic_small, steps: 20, batch: 2, seed: 5, warmup: {steps: 2}}
  tokens: {op: tokenize, clips: clips, tokenizers: [a, b, c], pixels: rgb}
";

const GROUP: &str = "\
experiment: group
seed: 3
stages:
  clips: {op: clips, source: world_small, train: 8, validation: 2}
  all:
    op: train_tokenizers
    clips: clips
    tokenizer: vq_temporal_small
    steps: 20
    batch: 4
    warmup: {steps: 2}
    modalities:
      camera:
      gaze: {tokenizer: {codebook: 64}, steps: 9}
      body: {tokenizer: vq_kinematic_small, batch: 2, seed: 5}
  tokens: {op: tokenize, clips: clips, tokenizers: all, pixels: rgb}
";

fn write(folder: &Path, name: &str, text: &str) {
    std::fs::write(folder.join(name), text).unwrap();
}

fn open(path: &Path, set: &[&str]) -> Result<Experiment, String> {
    let request = Request {
        path: path.to_owned(),
        set: set.iter().map(|&text| text.to_owned()).collect(),
        data_may_be_absent: true,
        ..Request::default()
    };
    let (experiment, report) = load(&Catalog::linked(), &request);
    experiment.ok_or_else(|| report.render(false))
}

fn keys(experiment: &Experiment) -> Vec<String> {
    let mut hash =
        |path: &Path| -> std::io::Result<blake3::Hash> { panic!("{} is not read", path.display()) };
    let keys = experiment.cells[0].graph.keys(&mut hash).unwrap();
    keys.iter().map(ToString::to_string).collect()
}

fn names(experiment: &Experiment) -> Vec<&str> {
    let stages = experiment.cells[0].graph.stages.iter();
    stages.map(|stage| stage.name.as_str()).collect()
}

#[test]
fn the_stages_of_a_group_have_the_keys_of_stages_written_by_hand() {
    let folder = tempfile::tempdir().unwrap();
    write(folder.path(), "hand.yaml", BY_HAND);
    write(folder.path(), "group.yaml", GROUP);
    let hand = open(&folder.path().join("hand.yaml"), &[]).unwrap();
    let group = open(&folder.path().join("group.yaml"), &[]).unwrap();
    assert_eq!(
        names(&group),
        ["clips", "all.camera", "all.gaze", "all.body", "tokens"]
    );
    assert_eq!(keys(&hand), keys(&group));
    // What a run writes down reads back as the same work.
    write(folder.path(), "again.yaml", &resolved::to_yaml(&group));
    let again = open(&folder.path().join("again.yaml"), &[]).unwrap();
    assert_eq!((names(&group), keys(&group)), (names(&again), keys(&again)));
}

#[test]
fn a_group_is_read_by_other_experiments_and_changed_by_layers() {
    let folder = tempfile::tempdir().unwrap();
    write(folder.path(), "group.yaml", GROUP);
    write(
        folder.path(),
        "reads.yaml",
        "experiment: reads\nstages:\n  t: {op: tokenize, clips: group/clips, tokenizers: [group/all]}\n",
    );
    let reads = open(&folder.path().join("reads.yaml"), &[]).unwrap();
    let expected = [
        "group/clips",
        "group/all.camera",
        "group/all.gaze",
        "group/all.body",
        "t",
    ];
    assert_eq!(names(&reads), expected);
    write(
        folder.path(),
        "layer.yaml",
        "\
extends: group.yaml
experiment: layer
stages:
  all:
    steps: 30
    modalities:
      gaze: !unset
      left_hand: {tokenizer: vq_kinematic_small}
  tokens: {tokenizers: [all.left_hand, all.body]}
",
    );
    let set = "stages.all.modalities.body.steps=11";
    let layer = open(&folder.path().join("layer.yaml"), &[set]).unwrap();
    let graph = &layer.cells[0].graph;
    let steps = |name: &str| graph.find(name).unwrap().settings.json()["steps"].clone();
    assert_eq!(
        names(&layer),
        ["clips", "all.camera", "all.body", "all.left_hand", "tokens"]
    );
    assert_eq!(graph.find("tokens").unwrap().edges[1].from, [3, 2]);
    assert_eq!([steps("all.camera"), steps("all.body")], [30, 11]);
}

#[test]
fn why_tells_what_an_entry_says_from_what_all_have_in_common() {
    let folder = tempfile::tempdir().unwrap();
    write(folder.path(), "group.yaml", GROUP);
    let experiment = open(&folder.path().join("group.yaml"), &[]).unwrap();
    let why = |key: &str| explain(&Catalog::linked(), &experiment, None, key);
    let own = why("stages.all.gaze.steps").unwrap().remove(0);
    // The key is the one that `--set` takes.
    assert_eq!(own.key, "stages.all.modalities.gaze.steps");
    let chain: Vec<&str> = own.chain.iter().map(|link| link.value.as_str()).collect();
    assert_eq!(chain, ["9", "20"]);
    assert!(own.chain[0].place.ends_with("group.yaml:14"), "{own:?}");
    assert!(own.chain[1].place.ends_with("group.yaml:9"), "{own:?}");
    assert_eq!(why(&own.key).unwrap(), [own]);
    let all: Vec<String> = why("all.batch")
        .unwrap()
        .into_iter()
        .map(|a| a.value)
        .collect();
    assert_eq!(all, ["4", "4", "2"]);
    assert!(why("all.bach").is_err());
}

#[test]
fn mistakes_in_a_group_are_said_where_they_are_written() {
    let folder = tempfile::tempdir().unwrap();
    let says = |from: &str, to: &str| {
        assert!(GROUP.contains(from), "{from}");
        write(folder.path(), "wrong.yaml", &GROUP.replace(from, to));
        open(&folder.path().join("wrong.yaml"), &[]).map_or_else(|said| said, |_| String::new())
    };
    let whole = &GROUP[GROUP.find("    modalities:").unwrap()..GROUP.find("  tokens:").unwrap()];
    for (from, to, expected) in [
        (whole, "", "needs `modalities`"),
        (whole, "    modalities: [camera]\n", "must be a map"),
        (
            "camera:\n",
            "camera: vq_temporal_small\n",
            "`camera` must be a map of settings",
        ),
        ("steps: 9}", "stpes: 9}", "unknown key `stpes`"),
        ("    batch: 4\n", "    btach: 4\n", "unknown key `btach`"),
        (
            "    batch: 4\n",
            "    modality: gaze\n",
            "`modality` is the key",
        ),
        (
            "    batch: 4\n",
            "    gaze: {batch: 4}\n",
            "stages.all.modalities.gaze",
        ),
        ("steps: 9}", "op: import}", "is one op's"),
        ("      camera:\n", "      cmaera:\n", "no modality `cmaera`"),
        ("tokenizers: all", "tokenizers: al", "did you mean `all`"),
        (
            "tokenizers: all,",
            "tokenizers: [all, all.body],",
            "two tokenizers of `body`",
        ),
        (
            "  all:\n",
            "  all.body: {op: clips}\n  all:\n",
            "two stages named `all.body`",
        ),
    ] {
        let said = says(from, to);
        assert!(said.contains(expected), "{expected}: {said}");
        // A mistake in what all have in common is one mistake.
        assert!(said.matches("error[").count() <= 3, "{said}");
    }
    let one = "  mget: {op: predict, model: all, clips: clips}\n";
    write(folder.path(), "one.yaml", &format!("{GROUP}{one}"));
    let said =
        open(&folder.path().join("one.yaml"), &[]).map_or_else(|said| said, |_| String::new());
    assert!(
        said.contains("takes one stage, and `all` stands for 3"),
        "{said}"
    );
}
