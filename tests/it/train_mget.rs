//! `op: train_mget` on small token shards: what it refuses, what it learns, and that killing it changes no byte.
#![allow(clippy::unwrap_used)] // a test that panics is a test that fails

use reviv::experiment::{
    ArtifactKind, Description, Entry, InputArtifact, InputFacts, Inputs, Op, Problem, StageContext,
    StageError, TokenFacts,
};
use reviv::formats::npy::{NpyArray, to_bytes};
use reviv::masking::TokenBudget;
use reviv::mget::Size;
use reviv::ops::train_mget::{Pixels, TrainMget, TrainMgetSettings};
use serde_json::{Value, json};
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};

const MODALITIES: [(&str, usize, u64); 2] = [("camera", 6, 16), ("gaze", 6, 12)];

fn write_tokens(folder: &Path) {
    for (split, clips, offset) in [("train", 48_u64, 0), ("validation", 24, 5)] {
        for (name, tokens, vocabulary) in MODALITIES {
            let folder = folder.join(split).join(name);
            std::fs::create_dir_all(&folder).unwrap();
            let file = std::fs::File::create(folder.join("shard-000000.tar")).unwrap();
            let mut tar = tar::Builder::new(file);
            for clip in 0..clips {
                let start = (clip * 7 + offset) % 11;
                let ids = (0..tokens as u64)
                    .map(|i| ((start + i) % vocabulary) as i64)
                    .collect();
                let array = ndarray::Array1::<i64>::from_vec(ids);
                let bytes = to_bytes(&NpyArray::from(&array));
                let mut header = tar::Header::new_gnu();
                header.set_size(bytes.len() as u64);
                header.set_mode(0o644);
                tar.append_data(&mut header, format!("clip-{clip:04}.npy"), bytes.as_slice())
                    .unwrap();
            }
            tar.finish().unwrap();
        }
    }
}

fn facts() -> BTreeMap<String, TokenFacts> {
    MODALITIES
        .iter()
        .map(|(name, tokens, vocabulary)| {
            let facts = TokenFacts {
                grid: vec![*tokens],
                vocabulary: *vocabulary,
            };
            ((*name).to_owned(), facts)
        })
        .collect()
}

struct Context {
    folder: PathBuf,
    inputs: Vec<InputArtifact>,
    interrupt_after: u64,
    done: u64,
    texts: Vec<String>,
}

impl Context {
    fn new(folder: &Path) -> Self {
        let tokens = folder.join("tokens");
        if !tokens.exists() {
            write_tokens(&tokens);
        }
        for part in ["output", "checkpoints"] {
            std::fs::create_dir_all(folder.join(part)).unwrap();
        }
        Self {
            inputs: vec![InputArtifact {
                stage: "tokens".into(),
                op: "tokenize".into(),
                path: tokens,
                contents: json!({"tokens": facts()}),
            }],
            folder: folder.to_path_buf(),
            interrupt_after: u64::MAX,
            done: 0,
            texts: Vec::new(),
        }
    }

    fn weights(&self) -> Vec<u8> {
        std::fs::read(self.folder.join("output/weights.safetensors")).unwrap()
    }
}

impl StageContext for Context {
    fn stage(&self) -> &'static str {
        "mget"
    }
    fn inputs(&self, port: &str) -> &[InputArtifact] {
        if port == "tokens" { &self.inputs } else { &[] }
    }
    fn output(&self) -> &Path {
        Box::leak(self.folder.join("output").into_boxed_path())
    }
    fn checkpoints(&self) -> &Path {
        Box::leak(self.folder.join("checkpoints").into_boxed_path())
    }
    fn seed(&self) -> u64 {
        5
    }
    fn data_root(&self, _name: &str) -> Option<&Path> {
        None
    }
    fn record(&mut self, _step: u64, scalars: &[(&str, f64)]) -> Result<(), StageError> {
        assert!(
            scalars.iter().all(|(_, value)| value.is_finite()),
            "{scalars:?}"
        );
        Ok(())
    }
    fn record_text(&mut self, _step: u64, _name: &str, text: &str) -> Result<(), StageError> {
        self.texts.push(text.to_owned());
        Ok(())
    }
    fn record_histogram(&mut self, _: u64, _: &str, _: &[f32]) -> Result<(), StageError> {
        Ok(())
    }
    fn progress(&mut self, done: u64, _total: u64, _unit: &str) {
        self.done = done;
    }
    fn log(&mut self, _line: &str) {}
    fn interrupted(&self) -> bool {
        self.done >= self.interrupt_after
    }
}

fn settings(loader_threads: usize) -> TrainMgetSettings {
    let mut settings = TrainMgetSettings::default();
    settings.size.settings = Size {
        width: 24,
        heads: 2,
        encoder_depth: 1,
        decoder_depth: 1,
        hidden: 0,
    };
    settings.masking.settings.input_tokens = TokenBudget::Fixed(8);
    settings.masking.settings.target_tokens = TokenBudget::Fixed(8);
    settings.training.steps = Some(200);
    settings.training.batch = 12;
    settings.training.micro_batch = 5;
    settings.training.learning_rate = 5e-3;
    settings.training.checkpoint_every = 7;
    settings.training.loader_threads = loader_threads;
    settings
}

#[test]
fn held_out_loss_beats_the_unigram_baseline_and_the_model_can_be_opened() {
    let folder = tempfile::tempdir().unwrap();
    let mut context = Context::new(folder.path());
    let contents = TrainMget.run(&settings(1), &mut context).unwrap();
    for (name, _, _) in MODALITIES {
        let loss = |kind: &str| contents[kind][name]["loss"].as_f64().unwrap();
        assert!(loss("validation") < 0.8 * loss("unigram"), "{contents:#}");
        assert!(context.texts.last().unwrap().contains(name));
    }
    let model = reviv::mget::Mget::open(
        &folder.path().join("output"),
        &reviv::engine::Compute::cpu(),
    )
    .unwrap();
    assert_eq!(json!(model.spec()), contents["mget"]);
}

#[test]
fn an_interrupted_run_continues_to_the_same_bytes() {
    let whole = tempfile::tempdir().unwrap();
    let mut context = Context::new(whole.path());
    let expected = TrainMget.run(&settings(1), &mut context).unwrap();
    let expected_weights = context.weights();

    let folder = tempfile::tempdir().unwrap();
    for (interrupt_after, threads) in [(3, 2), (90, 1), (91, 4)] {
        let mut context = Context::new(folder.path());
        context.interrupt_after = interrupt_after;
        let error = TrainMget.run(&settings(threads), &mut context).unwrap_err();
        assert!(matches!(error, StageError::Interrupted), "{error}");
    }
    let mut context = Context::new(folder.path());
    let contents = TrainMget.run(&settings(3), &mut context).unwrap();
    assert!(context.weights() == expected_weights);
    assert_eq!(contents, expected);
}

const CHILD: &str = "REVIV_TEST_TRAIN_MGET";

/// The process that gets killed: does nothing unless started by the test below.
#[test]
fn child() {
    if let Some(folder) = std::env::var_os(CHILD) {
        let mut context = Context::new(Path::new(&folder));
        TrainMget.run(&settings(2), &mut context).unwrap();
    }
}

#[test]
fn a_run_killed_at_any_moment_resumes_to_the_same_bytes() {
    let whole = tempfile::tempdir().unwrap();
    let mut context = Context::new(whole.path());
    TrainMget.run(&settings(1), &mut context).unwrap();

    let folder = tempfile::tempdir().unwrap();
    Context::new(folder.path());
    let start = || {
        Command::new(std::env::current_exe().unwrap())
            .args(["--exact", "train_mget::child"])
            .env(CHILD, folder.path())
            .stdout(Stdio::null())
            .spawn()
            .unwrap()
    };
    for milliseconds in [150, 420, 90, 700] {
        let mut child = start();
        std::thread::sleep(std::time::Duration::from_millis(milliseconds));
        child.kill().unwrap();
        child.wait().unwrap();
    }
    assert!(start().wait().unwrap().success());
    assert!(Context::new(folder.path()).weights() == context.weights());
}

#[test]
fn settings_that_cannot_work_are_refused_before_anything_runs() {
    let description = Description {
        tokens: facts(),
        clips: [("train".to_owned(), 48)].into(),
        ..Description::default()
    };
    let mut video = description.clone();
    video.tokens.insert(
        "rgb".to_owned(),
        TokenFacts {
            grid: vec![5, 4, 4],
            vocabulary: 64,
        },
    );
    let problems =
        |description: &Description, change: &dyn Fn(&mut TrainMgetSettings)| -> Vec<Problem> {
            let facts = vec![InputFacts {
                stage: "tokens",
                kind: ArtifactKind::Tokens,
                description,
            }];
            let inputs = Inputs::new(vec![("tokens", facts)]);
            let mut settings = settings(1);
            change(&mut settings);
            let mut problems = Vec::new();
            TrainMget.check(&settings, &inputs, &mut problems);
            problems
        };
    assert!(problems(&description, &|_| ()).is_empty());
    let first = |description: &Description, change: &dyn Fn(&mut TrainMgetSettings)| {
        let found = problems(description, change);
        let problem = found
            .first()
            .unwrap_or_else(|| panic!("nothing was refused"));
        format!("{} {} {}", problem.key, problem.message, problem.help)
    };
    let message = first(&description, &|s| s.modalities = vec!["body".into()]);
    assert!(
        message.contains("modality `body` has no tokenizer") && message.contains("camera"),
        "{message}"
    );
    let message = first(&video, &|s| s.size.settings.width = 20);
    assert!(
        message.contains("size.width") && message.contains("by 6"),
        "{message}"
    );
    let message = first(&description, &|s| {
        s.masking.settings.input_tokens = TokenBudget::Fixed(0);
    });
    assert!(
        message.contains("masking.input_tokens") && message.contains("is 0"),
        "{message}"
    );
    let message = first(&description, &|s| s.pixels = Pixels::Rgb);
    assert!(message.contains("no raw video"), "{message}");
    let message = first(&description, &|s| s.training.steps = None);
    assert!(message.contains("exactly one of"), "{message}");
}

#[test]
fn a_token_out_of_its_vocabulary_is_named() {
    let folder = tempfile::tempdir().unwrap();
    let mut context = Context::new(folder.path());
    let mut narrow = facts();
    narrow.get_mut("gaze").unwrap().vocabulary = 9;
    context.inputs[0].contents = json!({"tokens": narrow});
    let message = TrainMget
        .run(&settings(1), &mut context)
        .unwrap_err()
        .to_string();
    for part in ["shard-000000.tar", "clip-", "gaze", "vocabulary of 9"] {
        assert!(message.contains(part), "{message}");
    }
}

#[test]
fn settings_of_the_registry_are_the_settings_of_the_op() {
    // The registry's files and the defaults say the same.
    let read = |path: &str| -> Value {
        let root = Path::new(env!("CARGO_MANIFEST_DIR"))
            .join("registry")
            .join(path);
        let mut value: Value =
            serde_saphyr::from_str(&std::fs::read_to_string(root).unwrap()).unwrap();
        let map = value.as_object_mut().unwrap();
        for key in ["masking", "size", "about"] {
            map.remove(key);
        }
        value
    };
    let defaults = TrainMgetSettings::default();
    let size: Size = serde_json::from_value(read("size/laptop.yaml")).unwrap();
    assert_eq!(size, defaults.size.settings);
    let masking: reviv::masking::MaskingSettings =
        serde_json::from_value(read("masking/dirichlet_mixture.yaml")).unwrap();
    let expected = reviv::masking::MaskingSettings {
        weights: vec![1.0; 4],
        ..defaults.masking.settings
    };
    assert_eq!(masking, expected);
    for name in ["dirichlet", "one_to_one", "uniform", "task_specific"] {
        let settings: Result<reviv::masking::MaskingSettings, _> =
            serde_json::from_value(read(&format!("masking/{name}.yaml")));
        assert!(settings.is_ok(), "{name}");
    }
    let _: Entry<Size> = defaults.size;
}
