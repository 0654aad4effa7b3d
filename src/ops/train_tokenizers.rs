//! `op: train_tokenizers`: the tokenizers that a model needs, each trained by a stage of [`super::train_tokenizer`].
//!
//! ```yaml
//! tokenizers:
//!   op: train_tokenizers
//!   clips: clips
//!   batch: 16
//!   modalities:
//!     camera: {tokenizer: vq_temporal_small}
//!     body: {tokenizer: vq_kinematic_small, batch: 8}
//! ```

use super::train_tokenizer::TrainTokenizer;
use crate::experiment::GroupEntry;

inventory::submit! {
    GroupEntry {
        name: "train_tokenizers",
        about: "Trains a tokenizer for each entry of `modalities`: one stage of `train_tokenizer` per modality.",
        op: &TrainTokenizer,
        members: "modalities",
        setting: "modality",
    }
}
