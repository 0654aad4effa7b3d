//! `gen/`: schedules, filters, and whole generations with the small MGET.

use std::collections::BTreeMap;
use std::path::Path;

use reviv::decoding::filter::{Filter, Sampling, TopK, kept_tokens};
use reviv::decoding::generate::generate_checked;
use reviv::decoding::generated::{Checks, StepTrace};
use reviv::decoding::plan::plan;
use reviv::decoding::schedule::{TemperatureSchedule, TokenSchedule, cosine, linear};
use reviv::decoding::settings::{Order, Scheme, TargetChanges};
use reviv::decoding::{DecodingSettings, MgetTokens, Sample, Slot, TokenModality};
use reviv::engine::{Parameters, Weights};
use reviv::mget::names::modality_from_release;
use reviv::mget::{Content, Mget};
use serde_json::Value;

use super::Outcome;
use super::mget::{parameters_of, spec_of};
use super::report::Report;
use super::vectors::{Vectors, json, stems};

pub fn check(folder: &Path, report: &mut Report) -> Outcome {
    schedules(&json(&folder.join("schedules.json"))?, report);
    for stem in stems(folder)? {
        match stem.as_str() {
            "inputs" => {}
            "filters" => filters(Vectors::read(folder, &stem)?, report)?,
            _ => generation(folder, &stem, report)?,
        }
    }
    Ok(())
}

fn list(value: &Value) -> impl Iterator<Item = &Value> + use<'_> {
    value.as_array().into_iter().flatten()
}

fn names(value: &Value) -> Vec<String> {
    list(value)
        .filter_map(|name| name.as_str().map(|name| ours(name).to_owned()))
        .collect()
}

/// Our name of a modality of the release.
fn ours(name: &str) -> &str {
    modality_from_release(name).unwrap_or(name)
}

fn count(value: &Value) -> usize {
    value.as_u64().unwrap_or(0) as usize
}

fn schedules(all: &Value, report: &mut Report) {
    for kind in ["linear", "cosine"] {
        for case in list(&all[kind]) {
            let (steps, tokens) = (count(&case["steps"]), count(&case["tokens"]));
            let expected: Vec<i64> = list(&case["schedule"]).filter_map(Value::as_i64).collect();
            let found: Vec<i64> = if kind == "linear" {
                linear(steps, tokens)
                    .into_iter()
                    .map(|n| n as i64)
                    .collect()
            } else {
                cosine(steps, tokens)
            };
            report.exact(
                format!("gen/schedules {kind} {steps} {tokens}"),
                &found,
                &expected,
            );
        }
    }
    for (index, case) in list(&all["temp"]).enumerate() {
        let counts: Vec<usize> = list(&case["token_schedule"]).map(count).collect();
        let expected: Vec<f64> = list(&case["values"]).filter_map(Value::as_f64).collect();
        let number = |key: &str| case[key].as_f64().unwrap_or(f64::NAN);
        let found = match case["kind"].as_str() {
            Some("linear") => TemperatureSchedule::Linear.values(number("T"), &counts),
            _ => TemperatureSchedule::Onex {
                min: number("min_t"),
                power: number("power"),
            }
            .values(number("max_t"), &counts),
        };
        report.relative(
            format!("gen/schedules temperature {index}"),
            &found,
            &expected,
            1e-12,
        );
    }
    for (index, case) in list(&all["chained"]).enumerate() {
        chained(index, case, report);
    }
}

/// Order, counts, temperatures, guidance and hidden modalities of several targets.
fn chained(index: usize, case: &Value, report: &mut Report) {
    let args = &case["args"];
    let (conditions, targets) = (names(&args["cond_domains"]), names(&args["target_domains"]));
    let mut settings = DecodingSettings {
        order: Order::Chained,
        uncond_drop: Some(conditions.clone()),
        grow: args["cfg_grow_conditioning"].as_bool().unwrap_or(false),
        ..DecodingSettings::default()
    };
    let mut modalities: Vec<TokenModality> = Vec::new();
    for name in &conditions {
        modalities.push(TokenModality {
            name: name.clone(),
            tokens: 1,
            vocabulary: None,
        });
    }
    for (i, name) in targets.iter().enumerate() {
        let text = |key: &str| args[key][i].as_str().unwrap_or("").to_owned();
        let number = |key: &str| args[key][i].as_f64();
        modalities.push(TokenModality {
            name: name.clone(),
            tokens: count(&args["tokens_per_target"][i]),
            vocabulary: Some(64),
        });
        let changes = TargetChanges {
            scheme: Some(scheme(&text("autoregression_schemes"))),
            steps: Some(count(&args["decoding_steps"][i])),
            schedule: Some(schedule(&text("token_decoding_schedules"))),
            temperature: number("temps"),
            temperature_schedule: Some(temperature_schedule(&text("temp_schedules"))),
            guidance: number("cfg_scales"),
            ..TargetChanges::default()
        };
        settings.targets.insert(name.clone(), changes);
    }
    let given: Vec<bool> = modalities.iter().map(|m| m.vocabulary.is_none()).collect();
    let open: Vec<usize> = modalities.iter().map(|m| m.tokens).collect();
    let wanted: Vec<&str> = targets.iter().map(String::as_str).collect();
    let Ok(chains) = plan(&settings, &modalities, &given, &open, &wanted) else {
        return report.problem(
            format!("gen/schedules chained {index}"),
            "has no plan".to_owned(),
        );
    };
    let mut found = Vec::new();
    for group in chains.iter().flat_map(|chain| &chain.groups) {
        let mut hidden: Vec<&str> = modalities
            .iter()
            .zip(&group.hidden)
            .filter(|(_, hidden)| **hidden)
            .map(|(m, _)| m.name.as_str())
            .collect();
        hidden.sort_unstable();
        for target in &group.targets {
            for (tokens, temperature) in target.counts.iter().zip(&target.temperatures) {
                let name = &modalities[target.modality].name;
                let guidance = target.settings.guidance;
                found.push(format!(
                    "{name} {tokens} {temperature:.9} {guidance} {hidden:?}"
                ));
            }
        }
    }
    let expected: Vec<String> = list(&case["steps"])
        .map(|step| {
            let mut hidden = names(&step["cfg_cond_domains"]);
            hidden.sort_unstable();
            let name = ours(step["target_domain"].as_str().unwrap_or(""));
            let number = |key: &str| step[key].as_f64().unwrap_or(f64::NAN);
            let (tokens, guidance) = (count(&step["num_tokens"]), number("cfg_scale"));
            format!(
                "{name} {tokens} {:.9} {guidance} {hidden:?}",
                number("temperature")
            )
        })
        .collect();
    report.exact(format!("gen/schedules chained {index}"), &found, &expected);
}

fn scheme(name: &str) -> Scheme {
    if name == "maskgit" {
        Scheme::Maskgit
    } else {
        Scheme::Roar
    }
}

fn schedule(name: &str) -> TokenSchedule {
    if name == "cosine" {
        TokenSchedule::Cosine
    } else {
        TokenSchedule::Linear
    }
}

fn temperature_schedule(name: &str) -> TemperatureSchedule {
    let mut parts = name.split(':');
    match parts.next() {
        Some("linear") => TemperatureSchedule::Linear,
        Some("onex") => {
            let mut number = || {
                parts
                    .next()
                    .and_then(|n| n.parse().ok())
                    .unwrap_or(f64::NAN)
            };
            TemperatureSchedule::Onex {
                min: number(),
                power: number(),
            }
        }
        _ => TemperatureSchedule::Constant,
    }
}

fn top_k(value: &Value, whole: bool) -> TopK {
    match value.as_f64() {
        None | Some(0.0) => TopK::Off,
        Some(number) if whole => TopK::Count(number as usize),
        Some(number) => TopK::Share(number),
    }
}

fn filters(mut file: Vectors, report: &mut Report) -> Outcome {
    for case in list(&file.settings["cases"].clone()) {
        let name = case["logits"].as_str().ok_or("logits")?;
        let logits = file.tensor(name)?;
        let (shape, values) = (logits.shape.clone(), logits.f32(name)?.to_vec());
        let filter = Filter {
            top_k: top_k(&case["top_k"], case["top_k_is_int"] == Value::Bool(true)),
            top_p: case["top_p"].as_f64().unwrap_or(0.0),
            temperature: 1.0,
            sampling: Sampling::Random,
        };
        let mut kept = vec![false; values.len()];
        for (row, logits) in values.chunks(shape[1]).enumerate() {
            let all = || (0..logits.len() as u32).collect();
            for token in kept_tokens(logits, &filter).unwrap_or_else(all) {
                kept[row * shape[1] + token as usize] = true;
            }
        }
        let output = format!("case{}.kept", case["id"]);
        if name == "ties" {
            // Which of several equal tokens survives is up to the sort: put our choice in the order of the file's.
            let theirs: Vec<bool> = file
                .tensor(&output)?
                .u8("kept")?
                .iter()
                .map(|k| *k != 0)
                .collect();
            let survivors = |kept: &[bool]| {
                let mut rows = Vec::new();
                for (logits, kept) in values.chunks(shape[1]).zip(kept.chunks(shape[1])) {
                    let own = logits
                        .iter()
                        .zip(kept)
                        .filter(|(_, k)| **k)
                        .map(|(l, _)| l.to_bits());
                    let mut own: Vec<u32> = own.collect();
                    own.sort_unstable();
                    rows.push(own);
                }
                rows
            };
            if survivors(&kept) == survivors(&theirs) {
                kept = theirs;
            }
        }
        file.compare_flags(report, &output, &shape, &kept)?;
    }
    file.finish(report);
    Ok(())
}

/// One whole generation, every step compared, each from our own result of the one before.
fn generation(folder: &Path, stem: &str, report: &mut Report) -> Outcome {
    let mut file = Vectors::read(folder, stem)?;
    let settings = file.settings.clone();
    let set = folder.parent().ok_or("a folder of vectors lies in a set")?;
    let model_settings = json(&set.join("mget/reviv256_a.json"))?["settings"].clone();
    let (spec, theirs) = spec_of(&model_settings)?;
    let mut model = Mget::empty(&spec, &super::compute())?;
    model.load(&parameters_of(&file.checkpoint()?, &model))?;
    let tokens = MgetTokens::new(&model);

    let inputs = Weights::read(&folder.join("inputs.safetensors"))?;
    let input = |name: &str| {
        inputs
            .tensors
            .get(name)
            .ok_or_else(|| format!("no `{name}`"))
    };
    let rgb: Vec<u32> = input("in.tok_rgb")?
        .i64("rgb")?
        .iter()
        .map(|id| *id as u32)
        .collect();
    let pixels = input("in.rgb@256")?.f32("pixels")?;
    let targets = names(&settings["targets"]);
    let first = targets.first().ok_or("a target")?.clone();
    let mut slots = Vec::new();
    for modality in &spec.modalities {
        slots.push(match modality.name.as_str() {
            "rgb" => Slot::input(rgb.clone()),
            "pixels" => Slot::Pixels(Content::Floats(pixels)),
            _ => Slot::masked(modality.count()),
        });
    }
    if let (Ok(places), Ok(partial)) = (
        file.tensor("in.partial_positions"),
        file.tensor("in.partial_ids"),
    ) {
        let index = spec.index(&first).ok_or("the target")?;
        if let Slot::Tokens { ids, known } = &mut slots[index] {
            for (place, id) in places.i64("positions")?.iter().zip(partial.i64("ids")?) {
                (ids[*place as usize], known[*place as usize]) = (*id as u32, true);
            }
        }
    }

    let number = |key: &str| settings[key].as_f64().unwrap_or(0.0);
    let mut decoding = DecodingSettings {
        order: Order::Chained,
        uncond_drop: Some(names(&settings["cfg_hidden_at_start"])),
        grow: settings["cfg_grow_conditioning"].as_bool().unwrap_or(false),
        ..DecodingSettings::default()
    };
    decoding.all.scheme = scheme(settings["scheme"].as_str().unwrap_or(""));
    decoding.all.steps = count(&settings["decoding_steps"]);
    decoding.all.schedule = schedule(settings["token_schedule"].as_str().unwrap_or(""));
    decoding.all.temperature = number("temperature");
    decoding.all.guidance = number("cfg_scale");
    decoding.all.top_p = number("top_p");
    decoding.all.top_k = top_k(&settings["top_k"], settings["top_k"].is_u64());
    decoding.all.sampling = Sampling::MostLikely;

    // Random positions are inputs: (modality, step within its target) -> what the reference drew.
    let mut positions = BTreeMap::new();
    let mut step_of: BTreeMap<usize, usize> = BTreeMap::new();
    for (global, step) in list(&settings["steps"]).enumerate() {
        let name = ours(step["target_domain"].as_str().unwrap_or(""));
        let modality = spec.index(name).ok_or("a target")?;
        let own = step_of.entry(modality).or_default();
        let drawn = file
            .tensor(&format!("step{global}.positions"))?
            .i64("positions")?;
        positions.insert((modality, *own), drawn.iter().map(|p| *p as u32).collect());
        *own += 1;
    }
    let mut trace: Vec<StepTrace> = Vec::new();
    let wanted: Vec<&str> = targets.iter().map(String::as_str).collect();
    let mut checks = Checks {
        positions,
        trace: Some(&mut trace),
    };
    let sample = Sample { id: 0, slots };
    let generated = generate_checked(&tokens, &decoding, &[sample], &wanted, 0, &mut checks)?;

    for (global, step) in trace.iter().enumerate() {
        let (rows, vocabulary) = (
            step.picks.len(),
            spec.modalities[step.modality].vocabulary().unwrap_or(0),
        );
        for (name, values) in [
            ("logits_cond", &step.conditional),
            ("logits_uncond", &step.unconditional),
            ("logits_combined", &step.combined),
        ] {
            let output = format!("step{global}.{name}");
            if file.has_output(&output) {
                file.compare(report, &output, &[rows, vocabulary], values)?;
            }
        }
        let samples: Vec<i64> = step.picks.iter().map(|p| i64::from(p.token)).collect();
        file.compare_ids(report, &format!("step{global}.samples"), &[rows], &samples)?;
        let output = format!("step{global}.confidence");
        if file.has_output(&output) {
            let confidence: Vec<f32> = step.picks.iter().map(|p| p.probability).collect();
            file.compare(report, &output, &[rows], &confidence)?;
            let selected: Vec<i64> = step.selected[0].iter().map(|p| i64::from(*p)).collect();
            let output = format!("step{global}.selected_positions_sorted");
            file.compare_ids(report, &output, &[selected.len()], &selected)?;
        }
    }
    for name in &targets {
        let index = spec.index(name).ok_or("a target")?;
        let ids: Vec<i64> = generated[0].targets[name]
            .ids
            .iter()
            .map(|id| i64::from(*id))
            .collect();
        let output = format!("final.{}", theirs[index]);
        file.compare_ids(report, &output, &[ids.len()], &ids)?;
        // Every token is decided in the end: none is unused.
        file.compare_flags(
            report,
            &format!("{output}.input_mask"),
            &[ids.len()],
            &vec![false; ids.len()],
        )?;
    }
    file.finish(report);
    Ok(())
}
