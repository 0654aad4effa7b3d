//! Masking against the reference's own budgets.

use crate::shared::shared;
use reviv::masking::statistics::statistics;
use reviv::masking::{Alphas, Masking, MaskingSettings, Slot, TokenBudget, budget};
use serde_json::Value;

fn numbers(value: &Value) -> Vec<f64> {
    value
        .as_array()
        .unwrap()
        .iter()
        .map(|v| v.as_f64().unwrap())
        .collect()
}

fn counts(value: &Value) -> Vec<usize> {
    numbers(value).into_iter().map(|v| v as usize).collect()
}

fn names(value: &Value) -> Vec<String> {
    value
        .as_array()
        .unwrap()
        .iter()
        .map(|v| v.as_str().unwrap().to_owned())
        .collect()
}

#[test]
fn budgets_follow_from_proportions_as_in_the_reference() {
    let Some(path) = shared("vectors/parity/mask/deterministic.json") else {
        return;
    };
    let file: Value = serde_json::from_slice(&std::fs::read(path).unwrap()).unwrap();
    for case in file["cases"].as_array().unwrap() {
        let tokens = counts(&case["max_tokens"]);
        let side = |pi: &str, total: &str, winners: &str, room: &[usize]| {
            let shares: Vec<f32> = numbers(&case[pi]).into_iter().map(|v| v as f32).collect();
            let mut winners = counts(&case[winners]).into_iter();
            let total = case[total].as_u64().unwrap() as usize;
            let mut budgets = budget::allocate(&shares, total, || winners.next());
            budget::clamp(&mut budgets, room);
            budgets
        };
        let input = side("pi_input", "num_input", "remainder_argmax_input", &tokens);
        assert_eq!(input, counts(&case["input_budget"]));
        let room: Vec<usize> = tokens.iter().zip(&input).map(|(n, b)| n - b).collect();
        let target = side("pi_target", "num_target", "remainder_argmax_target", &room);
        assert_eq!(target, counts(&case["target_budget"]));
    }
}

#[test]
fn budget_statistics_agree_with_the_reference_within_sampling_error() {
    let Some(path) = shared("vectors/parity/mask/statistics.json") else {
        return;
    };
    let file: Value = serde_json::from_slice(&std::fs::read(path).unwrap()).unwrap();
    let mut compared = 0;
    for (name, policy) in file["policies"].as_object().unwrap() {
        // The reference's draws underflow at alpha 0.001 and become uniform; ours are exact.
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
            let one = |name: &String| (name.clone(), Alphas::Mixture(numbers(&policy[side][name])));
            modalities.iter().map(one).collect()
        };
        let components = policy["components"].as_array().unwrap();
        let settings = MaskingSettings {
            alpha: Alphas::Mixture(vec![1.0; components.len()]),
            input_alpha: alphas("input_alphas"),
            target_alpha: alphas("target_alphas"),
            input_tokens: TokenBudget::Fixed(policy["num_input"].as_u64().unwrap() as usize),
            target_tokens: TokenBudget::Fixed(policy["num_target"].as_u64().unwrap() as usize),
            ..Default::default()
        };
        let masking = Masking::new(&settings, &slots).unwrap();
        let absent = names(&policy["absent"]);
        let present: Vec<bool> = modalities.iter().map(|m| !absent.contains(m)).collect();
        for component in components {
            let index = component["component"].as_u64().unwrap() as usize;
            let draws = component["draws"].as_u64().unwrap() as usize;
            let found = statistics(&masking, &present, Some(index), draws, 11);
            let n = draws as f64;
            for side in ["input", "target"] {
                let means = numbers(&component[side]["mean"]);
                let deviations = numbers(&component[side]["std"]);
                for (i, modality) in found.modalities.iter().enumerate() {
                    let own = if side == "input" {
                        modality.input
                    } else {
                        modality.target
                    };
                    let error = ((own.std.powi(2) + deviations[i].powi(2)) / n).sqrt();
                    let difference = (own.mean - means[i]).abs();
                    assert!(
                        difference < 5.0 * error || difference == 0.0,
                        "{name}, component {index}, {side} {}: {} against {}",
                        modality.name,
                        own.mean,
                        means[i]
                    );
                    compared += 1;
                }
            }
            let share = component["no_target_share"].as_f64().unwrap();
            let error = (share.max(1.0 / n) * (1.0 - share) / n * 2.0).sqrt();
            assert!(
                (found.no_target - share).abs() <= 5.0 * error,
                "{name}, component {index}: {} without target against {share}",
                found.no_target
            );
        }
    }
    assert!(compared > 300, "{compared}");
}
