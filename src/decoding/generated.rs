//! What generating gives: tokens with a certainty, and on demand a trace of every step.

use super::filter::Pick;
use std::collections::BTreeMap;

/// Generated tokens of one sample.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct Generated {
    /// By modality.
    pub targets: BTreeMap<String, GeneratedTokens>,
}

/// Tokens of one target.
#[derive(Debug, Clone, PartialEq)]
pub struct GeneratedTokens {
    /// One per position; tokens of inputs stand unchanged.
    pub ids: Vec<u32>,
    /// 0 (the model knew nothing) to 1 (it was certain), from the entropy when the token was decided; 1 for inputs.
    pub certainty: Vec<f32>,
}

/// What a step saw and did, for checks against a reference.
#[derive(Debug, Clone, PartialEq)]
pub struct StepTrace {
    /// Of the model's list.
    pub modality: usize,
    /// The step that decided it.
    pub step: usize,
    /// The target positions of each sample.
    pub positions: Vec<Vec<u32>>,
    /// `[rows, vocabulary]`.
    pub conditional: Vec<f32>,
    /// Empty without guidance.
    pub unconditional: Vec<f32>,
    /// What was sampled from.
    pub combined: Vec<f32>,
    /// Every decision, in order.
    pub picks: Vec<Pick>,
    /// The decided positions of each sample, ascending.
    pub selected: Vec<Vec<u32>>,
}

/// Things that only checks need.
#[derive(Debug, Default)]
pub struct Checks<'a> {
    /// Random positions to take instead of our own, by (modality, step).
    pub positions: BTreeMap<(usize, usize), Vec<u32>>,
    /// Collects every step.
    pub trace: Option<&'a mut Vec<StepTrace>>,
}
