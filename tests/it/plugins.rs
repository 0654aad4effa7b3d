//! What another crate links in: ops, kinds and entries, and what is refused of them.

use crate::language_ops::Folder;
use reviv::experiment::catalog::{Catalog, EntryText};
use reviv::experiment::clashes::clashes;
use reviv::experiment::load::{Request, load};
use reviv::experiment::registry::Registry;
use reviv::experiment::{
    Arity, ArtifactKind, Description, Inputs, LinkedEntry, Op, Port, Problem, StageContext,
    StageError,
};
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use serde_json::Value;

// As a plug-in crate does it: this test program is one.
inventory::submit! {
    LinkedEntry {
        origin: "wrist_watch 0.1",
        text: "masking: wrist_watch\nabout: Linked in by a test.\nextends: uniform\ninput_tokens: 77\n",
    }
}

#[derive(Debug, Default, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
struct Length {
    tokens: Option<f64>,
}

#[derive(Debug, Default, Serialize, Deserialize, JsonSchema)]
#[serde(default)]
struct Settings {
    seed: u64,
    #[serde(flatten)]
    length: Length,
}

/// An op whose settings have the names of its input and of a key of every stage.
struct Ambiguous;

impl Op for Ambiguous {
    type Settings = Settings;
    fn name(&self) -> &'static str {
        "ambiguous"
    }
    fn version(&self) -> u32 {
        1
    }
    fn about(&self) -> &'static str {
        "Two things of one name."
    }
    fn inputs(&self) -> &'static [Port] {
        &[Port {
            name: "tokens",
            kinds: &[ArtifactKind::Tokens],
            arity: Arity::One,
            about: "tokens",
        }]
    }
    fn output(&self) -> ArtifactKind {
        ArtifactKind::Table
    }
    fn check(&self, _: &Settings, _: &Inputs<'_>, _: &mut Vec<Problem>) -> Description {
        Description::default()
    }
    fn run(&self, _: &Settings, _: &mut dyn StageContext) -> Result<Value, StageError> {
        Ok(Value::Null)
    }
}

#[test]
fn a_setting_and_an_input_of_one_name_are_refused() {
    let catalog = Catalog::of(&[&Ambiguous, &Ambiguous], &[], Vec::new());
    let found = clashes(&catalog);
    assert_eq!(
        found[0],
        "two ops named `ambiguous` are linked into this binary"
    );
    assert!(found[1].contains("a setting `seed`"), "{found:?}");
    assert!(found[2].contains("a setting `tokens`"), "{found:?}");
    assert_eq!(clashes(&Catalog::linked()), [""; 0]);
}

#[test]
fn a_linked_entry_is_an_entry_like_any_other() {
    let quickstart = concat!(env!("CARGO_MANIFEST_DIR"), "/experiments/quickstart.yaml");
    let text =
        format!("extends: {quickstart}\nstages: {{mget: {{masking: !replace wrist_watch}}}}\n");
    let folder = Folder::new(&[("a.yaml", &text)]);
    let catalog = Catalog::linked();
    let request = Request {
        path: folder.path("a.yaml"),
        ..Request::default()
    };
    let (experiment, report) = load(&catalog, &request);
    assert!(!report.failed(), "{}", report.render(false));
    let experiment = experiment.unwrap();
    let settings = &experiment.cells[0]
        .graph
        .find("mget")
        .unwrap()
        .settings
        .json();
    assert_eq!(settings["masking"]["use"], "wrist_watch");
    assert_eq!(settings["masking"]["input_tokens"], 77);
    assert!(
        experiment
            .sources
            .iter()
            .any(|source| source.name == "wrist_watch 0.1 (linked in)"),
        "it is copied into the record like any layer"
    );
}

#[test]
fn a_linked_entry_of_a_taken_name_is_refused_with_both_places() {
    let entry = |place: &str| EntryText {
        place: place.into(),
        text: format!("masking: uniform\nabout: Of {place}.\n").into(),
    };
    let places = [
        "registry/masking/uniform.yaml (built in)",
        "wrist_watch 0.1 (linked in)",
    ];
    let catalog = Catalog::of(&[], &[], places.map(entry).to_vec());
    let registry = Registry::new(&catalog, None);
    let (_, message, _) = &registry.problems[0];
    assert!(
        places.iter().all(|place| message.contains(place)),
        "{message}"
    );
}
