//! `op: train_tokenizer` and `op: tokenize` as an experiment runs them: from clips of the built-in world to token shards.

use crate::run_text::{artifacts, run_text};
use reviv::mget::{MgetSpec, ModalitySpec, Positions, Size};
use reviv::training::{TokenShards, TokenSource};

const EXPERIMENT: &str = "
experiment: tokens_of_a_tiny_world
about: Three tiny tokenizers.
stages:
  clips:
    op: clips
    source: {use: world_small, world: {size: 16, rooms: 3}}
    train: 24
    validation: 6
  tok_camera:
    op: train_tokenizer
    clips: clips
    modality: camera
    tokenizer: {use: vq_temporal_small, codebook: 16, width: 16, depth: 1, heads: 2}
    steps: 150
    learning_rate: 0.003
    warmup: {steps: 5}
    checkpoint_every: 20
  tok_left_hand:
    op: train_tokenizer
    clips: clips
    modality: left_hand
    tokenizer: {use: vq_kinematic_small, codebook: 16, width: 16, depth: 1, heads: 2}
    steps: 4
    batch: 4
    warmup: {steps: 0}
  tok_rgb:
    op: train_tokenizer
    clips: clips
    modality: rgb
    tokenizer: {use: video_tiny, channels: 4}
    steps: 3
    batch: 2
    warmup: {steps: 0}
  tokens:
    op: tokenize
    clips: clips
    tokenizers: [tok_camera, tok_left_hand, tok_rgb]
    pixels: rgb
";

#[test]
fn clips_become_tokens_that_the_model_reads_and_the_tokenizer_decodes() {
    let folder = tempfile::tempdir().unwrap();
    let artifacts = artifacts(folder.path(), EXPERIMENT);
    let of = |name: &str| {
        artifacts
            .iter()
            .find(|(found, _, _)| found.trim() == name)
            .unwrap_or_else(|| panic!("{name}: {artifacts:?}"))
    };

    let (_, path, contents) = of("train_tokenizer camera");
    let scores = &contents["scores"];
    let error = |kind: &str| scores[kind]["position_mm"].as_f64().unwrap();
    assert!(
        error("reconstruction") < error("mean"),
        "{} against {}",
        error("reconstruction"),
        error("mean")
    );
    assert!(error("kmeans") > 0.0 && scores["usage"].as_f64().unwrap() > 0.0);
    let page = std::fs::read_to_string(path.join("report/tokenizer.md")).unwrap();
    assert!(
        page.contains("position error, mm") && page.contains("perplexity"),
        "{page}"
    );
    let hand = &of("train_tokenizer left_hand").2;
    assert!(
        hand["scores"]["reconstruction"]["mpjpe_mm"]
            .as_f64()
            .unwrap()
            > 0.0
    );
    let video = &of("train_tokenizer rgb").2;
    assert!(
        video["scores"]["reconstruction"]["psnr_db"]
            .as_f64()
            .unwrap()
            > 0.0
    );

    let (_, tokens, contents) = of("tokenize");
    assert_eq!(
        contents["tokens"]["camera"]["grid"],
        serde_json::json!([15])
    );
    assert_eq!(contents["pixels"], serde_json::json!([16, 16, 16, 3]));
    let spec = MgetSpec {
        size: Size::default(),
        positions: Positions::Released,
        modalities: vec![
            ModalitySpec::tokens("camera", &[15], 16),
            ModalitySpec::tokens("left_hand", &[15, 7], 16),
            ModalitySpec::pixels("pixels", [16, 16, 16, 3], [4, 8, 8]),
            ModalitySpec::tokens("rgb", &[5, 2, 2], 200),
        ],
    };
    let mut hands = 0;
    for (split, clips) in [("train", 24), ("validation", 6)] {
        let shards = TokenShards::open(&tokens.join(split), "tiny", &spec).unwrap();
        assert_eq!(shards.len(), clips);
        for index in 0..clips {
            let sample = shards.read(index).unwrap();
            assert_eq!(sample.tokens["camera"].ids.len(), 15);
            assert_eq!(sample.tokens["rgb"].ids.len(), 20);
            assert_eq!(sample.pixels["pixels"].len(), 16 * 16 * 16 * 3);
            hands += usize::from(sample.tokens.contains_key("left_hand"));
        }
    }
    assert!(hands > 0, "no clip shows the left hand");

    let shards = TokenShards::open(&tokens.join("validation"), "tiny", &spec).unwrap();
    let grid = shards.read(0).unwrap().tokens["camera"].clone();
    for place in [path.clone(), tokens.join("tokenizers/camera")] {
        let tokenizer = reviv::tokenizer::open(&place, &reviv::engine::Compute::cpu()).unwrap();
        let signals = tokenizer.decode(std::slice::from_ref(&grid)).unwrap();
        assert_eq!(signals[0].values.shape(), [60, 9]);
    }
}

const MIXTURE: &str = "
experiment: a_mixture
about: Tokenizers of two data sets.
stages:
  large: {op: clips, source: {use: world_small, world: {size: 16, rooms: 3}}, train: 12, validation: 4}
  small: {op: clips, source: {use: world_small, world: {size: 16, rooms: 2}}, train: 4, validation: 2}
  tok_camera:
    op: train_tokenizer
    clips: [large, small]
    modality: camera
    tokenizer: {use: vq_temporal_small, codebook: 16, width: 16, depth: 1, heads: 2}
    weights: [1, 3]
    steps: 4
    warmup: {steps: 0}
    validate_every: 2
    keep: best
  tok_left_hand:
    op: train_tokenizer
    clips: [large, small]
    modality: left_hand
    tokenizer: {use: vq_kinematic_small, codebook: 16, width: 16, depth: 1, heads: 2}
    steps: 4
    batch: 4
    warmup: {steps: 0}
  tok_rgb:
    op: train_tokenizer
    clips: [large, small]
    modality: rgb
    tokenizer: {use: video_tiny, channels: 4}
    weights: [0, 1]
    steps: 2
    batch: 2
    warmup: {steps: 0}
  tokens: {op: tokenize, clips: small, tokenizers: [tok_camera, tok_left_hand, tok_rgb]}
";

#[test]
fn tokenizers_train_on_a_mixture_and_are_scored_on_all_of_it() {
    let folder = tempfile::tempdir().unwrap();
    let artifacts = artifacts(folder.path(), MIXTURE);
    let contents = |op: &str| {
        let found = artifacts.iter().find(|(name, _, _)| name == op);
        found.unwrap_or_else(|| panic!("{op}")).2.clone()
    };
    assert_eq!(contents("train_tokenizer camera")["scores"]["clips"], 6);
    assert_eq!(contents("train_tokenizer rgb")["scores"]["clips"], 6);
    let hands = &contents("train_tokenizer left_hand")["scores"];
    assert!(hands["reconstruction"]["mpjpe_mm"].as_f64().unwrap() > 0.0);
}

#[test]
fn what_cannot_be_mixed_is_refused_where_it_is_written() {
    let folder = tempfile::tempdir().unwrap();
    let refused = |from: &str, to: &str| {
        assert!(MIXTURE.contains(from));
        run_text(folder.path(), &MIXTURE.replace(from, to)).unwrap_err()
    };
    let weights = refused("weights: [1, 3]", "weights: [1, 3, 1]");
    assert!(weights.contains("3 weights for 2 data sets"), "{weights}");
    let negative = refused("weights: [1, 3]", "weights: [1, -3]");
    assert!(negative.contains("they must be positive"), "{negative}");
    let sizes = refused("{size: 16, rooms: 2}", "{size: 24, rooms: 2}");
    assert!(
        sizes.contains("`small` has `rgb` of another form") && sizes.contains("[16, 24, 24, 3]"),
        "{sizes}"
    );
    let empty = refused("rooms: 2}}, train: 4", "rooms: 2}}, train: 0");
    assert!(empty.contains("`small` have no `train` split"), "{empty}");
}
