//! Whatever a file holds, the language says what is wrong with it: no panic, bounded time, bounded memory.

use crate::language_ops::Folder;
use std::fmt::Write as _;
use std::time::{Duration, Instant};

/// The code and message of the first error, found within a second.
fn first(name: &str, bytes: &[u8]) -> String {
    let folder = Folder::new(&[]);
    folder.write(name, bytes);
    let start = Instant::now();
    let (experiment, report) = folder.load(name, &[]);
    let rendered = folder.clean(&report);
    assert!(
        start.elapsed() < Duration::from_secs(5),
        "bounded time for {name}"
    );
    assert!(experiment.is_none(), "{name} is no experiment");
    assert!(rendered.len() < 20_000, "a diagnostic is short");
    let first = &report.diagnostics[0];
    format!("{}: {}", first.code, first.message)
}

#[test]
fn files_that_are_no_experiments_are_told_apart() {
    assert_eq!(first("a.yaml", b""), "E0101: the file is empty");
    assert_eq!(
        first("a.yaml", b"# only a comment\n"),
        "E0101: the file is empty"
    );
    assert_eq!(first("a.yaml", b"---\n...\n"), "E0101: the file is empty");
    assert_eq!(
        first("a.yaml", b"PK\x03\x04\x00\x00binary"),
        "E0101: the file is binary: byte 4 is zero"
    );
    assert_eq!(
        first("a.yaml", b"experiment: \xff\xfe"),
        "E0101: the file is not UTF-8: byte 12 is no part of a character"
    );
    assert_eq!(
        first("a.yaml", &vec![b'a'; 10_000_000]),
        "E0101: the file has 1048577 bytes or more; an experiment has at most 1048576"
    );
    assert_eq!(
        first("a.yaml", b"just text"),
        "E0102: an experiment is a map of keys, this is text"
    );
    assert_eq!(
        first("a.yaml", b"- a\n- b\n"),
        "E0102: an experiment is a map of keys, this is a list"
    );
    assert_eq!(
        first("a.yaml", b"experiment: a\n---\nexperiment: b\n"),
        "E0103: a second document starts here"
    );
    assert_eq!(
        first("a.yaml", b"experimnt: a\nstages: {}\n"),
        "E0204: this is neither an experiment nor a sweep"
    );
}

#[test]
fn nesting_is_bounded() {
    let flow = format!("experiment: {}{}", "[".repeat(1000), "]".repeat(1000));
    let mut block = String::from("experiment: a\nparams:\n");
    for level in 0..1000 {
        let _ = writeln!(block, "{}k:", " ".repeat(level + 1));
    }
    for text in [flow, block, "[".repeat(100_000), "{a: ".repeat(100_000)] {
        assert_eq!(
            first("a.yaml", text.as_bytes()),
            "E0103: nested more than 64 levels deep"
        );
    }
}

#[test]
fn aliases_cannot_explode() {
    let mut lists =
        String::from("experiment: a\nparams:\n  l0: &l0 [x, x, x, x, x, x, x, x, x, x]\n");
    for level in 1..12 {
        let below = vec![format!("*l{}", level - 1); 10].join(", ");
        let _ = writeln!(lists, "  l{level}: &l{level} [{below}]");
    }
    let mut texts = format!(
        "experiment: a\nparams:\n  t: &t {}\n  l:\n",
        "x".repeat(500_000)
    );
    for _ in 0..50_000 {
        texts.push_str("  - *t\n");
    }
    for text in [lists, texts] {
        let said = first("a.yaml", text.as_bytes());
        assert_eq!(
            said,
            "E0103: more than 200000 values after aliases are expanded"
        );
    }
    assert!(first("a.yaml", b"experiment: &a [*a]\n").starts_with("E0102"));
}

#[test]
fn substitutions_cannot_explode() {
    let mut text = String::from("experiment: a\nparams:\n  p0: xxxxxxxxxxxxxxxx\n");
    for level in 1..40 {
        let below = level - 1;
        let _ = writeln!(text, "  p{level}: ${{params.p{below}}}${{params.p{below}}}");
    }
    text.push_str("stages:\n  clips: {op: clips, only: '${params.p39}'}\n");
    assert!(first("a.yaml", text.as_bytes()).starts_with("E0105"));
}

#[test]
fn extending_cannot_explode() {
    let folder = Folder::new(&[]);
    for level in 0..15 {
        let next = vec![format!("f{}.yaml", level + 1); 10].join(", ");
        folder.write(
            &format!("f{level}.yaml"),
            format!("extends: [{next}]\n").as_bytes(),
        );
    }
    folder.write("f15.yaml", b"experiment: a\n");
    let start = Instant::now();
    let (experiment, report) = folder.load("f0.yaml", &[]);
    assert!(experiment.is_none() && start.elapsed() < Duration::from_secs(5));
    assert!(
        report
            .diagnostics
            .iter()
            .any(|d| d.message == "too many files extend each other")
    );
}

#[test]
fn tabs_and_other_yaml_mistakes_have_a_place() {
    assert!(
        first("a.yaml", b"experiment: a\nstages:\n\tclips: {op: clips}\n").starts_with("E0102")
    );
    assert!(first("a.yaml", b"experiment: 'a\n").starts_with("E0102"));
    assert!(first("a.yaml", b"experiment: {a: 1\n").starts_with("E0102"));
    assert!(first("a.yaml", b"experiment: !python/object a\n").starts_with("E0103"));
    assert!(first("a.yaml", b"experiment: *nothing\n").starts_with("E0102"));
    assert!(first("a.yaml", b"experiment: a\n<<: {seed: 1}\nstages: {}\n").starts_with("E0103"));
}

#[test]
fn folders_and_missing_files_are_no_experiments() {
    let folder = Folder::new(&[("tiny.yaml", "experiment: a\n")]);
    assert!(folder.says("", &[]).contains("it is a folder"));
    let said = folder.says("tinny.yaml", &[]);
    assert!(
        said.contains("there is no file") && said.contains("did you mean `tiny.yaml`?"),
        "{said}"
    );
}

proptest::proptest! {
    #![proptest_config(proptest::prelude::ProptestConfig { cases: 200, ..Default::default() })]

    #[test]
    fn any_bytes_give_a_report(bytes in proptest::collection::vec(proptest::prelude::any::<u8>(), 0..300)) {
        let folder = Folder::new(&[]);
        folder.write("a.yaml", &bytes);
        let (experiment, report) = folder.load("a.yaml", &[]);
        proptest::prop_assert!(experiment.is_some() || report.failed());
        let _ = report.render(true);
    }

    #[test]
    fn any_change_of_one_byte_gives_a_report(at in 0usize..400, byte in proptest::prelude::any::<u8>()) {
        let folder = Folder::new(&[]);
        let mut bytes = crate::language_ops::TINY.as_bytes().to_vec();
        let at = at % bytes.len();
        bytes[at] = byte;
        folder.write("a.yaml", &bytes);
        let (experiment, report) = folder.load("a.yaml", &[]);
        proptest::prop_assert!(experiment.is_some() || report.failed());
        let _ = report.render(false);
    }
}
