//! `mask/`: budgets that follow from given proportions, exactly; budgets over many draws, within sampling error.

use std::path::Path;

use reviv::masking::statistics::statistics;
use reviv::masking::{Alphas, Masking, MaskingSettings, Slot, TokenBudget, budget};
use serde_json::Value;

use super::Outcome;
use super::report::{Report, Row};
use super::vectors::json;

/// How many standard errors two means may be apart.
const STANDARD_ERRORS: f64 = 5.0;

pub fn check(folder: &Path, report: &mut Report) -> Outcome {
    budgets(&json(&folder.join("deterministic.json"))?, report)?;
    averages(&json(&folder.join("statistics.json"))?, report)
}

fn numbers(value: &Value) -> Vec<f64> {
    value
        .as_array()
        .into_iter()
        .flatten()
        .filter_map(Value::as_f64)
        .collect()
}

fn counts(value: &Value) -> Vec<usize> {
    numbers(value)
        .into_iter()
        .map(|number| number as usize)
        .collect()
}

fn names(value: &Value) -> Vec<&str> {
    value
        .as_array()
        .into_iter()
        .flatten()
        .filter_map(Value::as_str)
        .collect()
}

fn count(value: &Value) -> Outcome<usize> {
    Ok(value.as_u64().ok_or("a count")? as usize)
}

fn budgets(file: &Value, report: &mut Report) -> Outcome {
    for (index, case) in file["cases"].as_array().into_iter().flatten().enumerate() {
        let tokens = counts(&case["max_tokens"]);
        let side = |name: &str, room: &[usize]| -> Outcome<Vec<usize>> {
            let shares: Vec<f32> = numbers(&case[format!("pi_{name}")])
                .into_iter()
                .map(|share| share as f32)
                .collect();
            let mut winners = counts(&case[format!("remainder_argmax_{name}")]).into_iter();
            let total = count(&case[format!("num_{name}")])?;
            let mut budgets = budget::allocate(&shares, total, || winners.next());
            budget::clamp(&mut budgets, room);
            Ok(budgets)
        };
        let input = side("input", &tokens)?;
        let room: Vec<usize> = tokens.iter().zip(&input).map(|(n, b)| n - b).collect();
        let target = side("target", &room)?;
        for (name, found) in [("input", input), ("target", target)] {
            let expected = counts(&case[format!("{name}_budget")]);
            report.exact(
                format!("mask/deterministic {index} {name}"),
                &found,
                &expected,
            );
        }
    }
    Ok(())
}

fn averages(file: &Value, report: &mut Report) -> Outcome {
    for (name, policy) in file["policies"].as_object().into_iter().flatten() {
        // At 0.001 the reference's gamma draws underflow and a share of samples becomes uniform; ours are exact.
        if name.starts_with("one_to_one") {
            continue;
        }
        let modalities = names(&policy["modalities"]);
        let slots: Vec<Slot> = modalities
            .iter()
            .zip(counts(&policy["max_tokens"]))
            .map(|(name, tokens)| Slot::both(name, tokens))
            .collect();
        let alphas = |side: &str| {
            let one = |name: &&str| {
                (
                    (*name).to_owned(),
                    Alphas::Mixture(numbers(&policy[side][*name])),
                )
            };
            modalities.iter().map(one).collect()
        };
        let components = policy["components"].as_array().ok_or("components")?;
        let settings = MaskingSettings {
            alpha: Alphas::Mixture(vec![1.0; components.len()]),
            input_alpha: alphas("input_alphas"),
            target_alpha: alphas("target_alphas"),
            input_tokens: TokenBudget::Fixed(count(&policy["num_input"])?),
            target_tokens: TokenBudget::Fixed(count(&policy["num_target"])?),
            ..MaskingSettings::default()
        };
        let masking = Masking::new(&settings, &slots)?;
        let absent = names(&policy["absent"]);
        let present: Vec<bool> = modalities
            .iter()
            .map(|name| !absent.contains(name))
            .collect();
        for component in components {
            let index = count(&component["component"])?;
            let draws = count(&component["draws"])?;
            let found = statistics(&masking, &present, Some(index), draws, 11);
            let mut compare = |what: String, difference: f64, standard_error: f64| {
                let error = if difference == 0.0 {
                    0.0
                } else {
                    difference / standard_error
                };
                report.add(Row {
                    name: format!("mask/statistics {name} component {index} {what}"),
                    error,
                    tolerance: STANDARD_ERRORS,
                    unit: "",
                    problem: None,
                });
            };
            for side in ["input", "target"] {
                let means = numbers(&component[side]["mean"]);
                let deviations = numbers(&component[side]["std"]);
                for (i, modality) in found.modalities.iter().enumerate() {
                    let own = if side == "input" {
                        modality.input
                    } else {
                        modality.target
                    };
                    let variance = own.std.powi(2) + deviations[i].powi(2);
                    compare(
                        format!("{side} {}", modality.name),
                        (own.mean - means[i]).abs(),
                        (variance / draws as f64).sqrt(),
                    );
                }
            }
            let share = component["no_target_share"].as_f64().ok_or("a share")?;
            let floor = share.max(1.0 / draws as f64);
            compare(
                "without target".to_owned(),
                (found.no_target - share).abs(),
                (2.0 * floor * (1.0 - floor) / draws as f64).sqrt(),
            );
        }
    }
    Ok(())
}
