//! The section of a tokenizer on the page of its run.

use super::TrainTokenizerSettings;
use crate::experiment::TokenFacts;
use crate::modality::Shape;
use crate::training::tokenizer_scores::Scores;
use std::fmt::Write;

/// Words for the metrics; others are shown by name.
const METRICS: [(&str, &str); 6] = [
    ("mpjpe_mm", "joint position error, mm"),
    ("position_mm", "position error, mm"),
    ("rotation_deg", "rotation error, degrees"),
    ("distance_percent", "distance, % of the image width"),
    ("angle_deg", "angle, degrees"),
    ("psnr_db", "PSNR, dB (higher is better)"),
];

pub(super) fn markdown(
    settings: &TrainTokenizerSettings,
    tokenizer: &str,
    tokens: &TokenFacts,
    parameters: usize,
    shape: &Shape,
    scores: &Scores,
) -> String {
    let mut page = format!(
        "## Tokenizer of `{}`\n\n`{}`: {:?} tokens of {}, {parameters} parameters, {} steps of {} signals.\n\n",
        settings.modality,
        tokenizer,
        tokens.grid,
        tokens.vocabulary,
        settings.steps,
        settings.batch,
    );
    if scores.clips == 0 {
        page.push_str("No held-out clip has this modality: nothing was scored.\n");
        return page;
    }
    let _ = write!(
        page,
        "Reconstruction of {} held-out clips:\n\n| error | tokenizer | predicting the mean | k-means, {} codes | better than k-means by, 95 % interval over clips |\n|---|---:|---:|---:|---:|\n",
        scores.clips, tokens.vocabulary,
    );
    for (name, value) in &scores.reconstruction {
        let words = METRICS.iter().find(|(metric, _)| metric == name);
        let words = words.map_or_else(
            || name.replace("rmse_", "RMSE of channel "),
            |(_, words)| (*words).to_owned(),
        );
        let other = |errors: &std::collections::BTreeMap<String, f64>| {
            errors
                .get(name)
                .map_or_else(|| "not computed".to_owned(), |value| format!("{value:.3}"))
        };
        let gain = scores.gain.get(name).map_or_else(String::new, |gain| {
            format!("{:.3} [{:.3}, {:.3}]", gain.mean, gain.low, gain.high)
        });
        let _ = writeln!(
            page,
            "| {words} | {value:.3} | {} | {} | {gain} |",
            other(&scores.mean),
            other(&scores.kmeans),
        );
    }
    if let (Some(usage), Some(perplexity)) = (scores.usage, scores.perplexity) {
        let _ = write!(
            page,
            "\n{:.1}% of the codes occur in the {} tokens of these clips; perplexity {perplexity:.1} of {}.\n",
            100.0 * usage,
            scores.tokens,
            tokens.vocabulary,
        );
    }
    page.push_str("\nThe picture: ");
    page.push_str(match shape {
        Shape::Video { .. } => {
            "held-out clips from top to bottom, each as it is, as it comes back from its tokens"
        }
        _ => "a held-out clip, what comes back from its tokens",
    });
    page.push_str(if scores.kmeans.is_empty() {
        ".\n"
    } else {
        ", and from k-means.\n"
    });
    page
}
