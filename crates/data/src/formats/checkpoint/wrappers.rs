//! Names of tensors without what training code put around them: `module.` of data parallelism, `_orig_mod.` of `torch.compile`,
//! `model.` and `state_dict.` of trainers, `ema.` of averaged weights.

use super::Checkpoint;
use std::collections::BTreeSet;

/// Parts that a wrapper puts anywhere into a name, because it wraps layers too.
const ANYWHERE: [&str; 5] = [
    "_orig_mod",
    "_fsdp_wrapped_module",
    "_checkpoint_wrapped_module",
    "_forward_module",
    "_ddp_module",
];
/// Parts that stand in front of every name of a file, or of none.
const IN_FRONT: [&str; 18] = [
    "module",
    "_module",
    "model",
    "_model",
    "models",
    "net",
    "network",
    "state_dict",
    "model_state_dict",
    "ema",
    "ema_model",
    "model_ema",
    "averaged_model",
    "shadow",
    "student",
    "generator",
    "tokenizer",
    "params",
];
/// What averages of weights count beside the weights.
const COUNTERS: [&str; 3] = ["n_averaged", "num_updates", "decay"];

impl Checkpoint {
    /// Whether a wrapper lies around layers, within names.
    #[must_use]
    pub fn has_wrapped_layers(&self) -> bool {
        let wrapped = |name: &str| name.split('.').any(|part| ANYWHERE.contains(&part));
        self.entries.iter().any(|entry| wrapped(&entry.name))
    }

    /// Takes wrappers off the names of the tensors, as long as names stay apart; whether there were any.
    pub fn unwrap_names(&mut self) -> bool {
        let names: Vec<&str> = self.entries.iter().map(|e| e.name.as_str()).collect();
        let Some((short, taken)) = unwrapped(&names) else {
            return false;
        };
        let counters: Vec<usize> = (0..short.len())
            .filter(|&i| {
                COUNTERS.contains(&short[i].as_str()) && self.entries[i].view.elements() == 1
            })
            .collect();
        for (entry, name) in self.entries.iter_mut().zip(short) {
            entry.name = name;
        }
        // From behind, so that what is before keeps its place.
        for &index in counters.iter().rev() {
            let counter = self.entries.remove(index);
            self.others.push(counter.name);
            for entry in &mut self.entries {
                entry.same_as = entry
                    .same_as
                    .filter(|&of| of != index)
                    .map(|of| of - usize::from(of > index));
            }
        }
        self.wrappers.extend(taken);
        true
    }
}

/// Names without their wrappers, and the wrappers; `None` where there are none, or two names would become one.
fn unwrapped(names: &[&str]) -> Option<(Vec<String>, Vec<String>)> {
    let mut taken = Vec::new();
    let mut note = |part: &str| {
        let part = format!("{part}.");
        if !taken.contains(&part) {
            taken.push(part);
        }
    };
    let mut parts: Vec<Vec<&str>> = names.iter().map(|name| name.split('.').collect()).collect();
    loop {
        let mut changed = false;
        for name in &mut parts {
            while let Some(at) = name[..name.len() - 1]
                .iter()
                .position(|part| ANYWHERE.contains(part))
            {
                note(name.remove(at));
                changed = true;
            }
        }
        let mut wrapped = parts
            .iter()
            .filter(|name| !COUNTERS.contains(&name.join(".").as_str()));
        let front = wrapped
            .next()
            .and_then(|name| (name.len() > 1).then(|| name[0]));
        if let Some(front) = front.filter(|front| IN_FRONT.contains(front))
            && wrapped.all(|name| name.len() > 1 && name[0] == front)
        {
            note(front);
            for name in parts
                .iter_mut()
                .filter(|name| name.len() > 1 && name[0] == front)
            {
                name.remove(0);
            }
            changed = true;
        }
        if !changed {
            break;
        }
    }
    let short: Vec<String> = parts.iter().map(|name| name.join(".")).collect();
    let distinct: BTreeSet<&String> = short.iter().collect();
    (!taken.is_empty() && distinct.len() == short.len()).then_some((short, taken))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn wrappers_are_taken_off_in_any_order_and_depth() {
        for (names, short, taken) in [
            (["module.a.b", "module.c"], ["a.b", "c"], &["module."][..]),
            (
                ["_orig_mod.a.b", "_orig_mod.c"],
                ["a.b", "c"],
                &["_orig_mod."],
            ),
            (
                ["module._orig_mod.model.a.b", "module._orig_mod.model.c"],
                ["a.b", "c"],
                &["_orig_mod.", "module.", "model."],
            ),
            (
                ["state_dict.ema.a.b", "state_dict.ema.c"],
                ["a.b", "c"],
                &["state_dict.", "ema."],
            ),
            (["a._orig_mod.b", "c"], ["a.b", "c"], &["_orig_mod."]),
            (
                ["module.a.b", "n_averaged"],
                ["a.b", "n_averaged"],
                &["module."],
            ),
        ] {
            let (found, wrappers) = unwrapped(&names).unwrap();
            assert_eq!(
                (found, wrappers.as_slice()),
                (
                    short.map(str::to_owned).to_vec(),
                    &taken.iter().map(|t| (*t).to_owned()).collect::<Vec<_>>()[..]
                )
            );
        }
    }

    #[test]
    fn names_that_are_not_wrapped_or_would_fall_together_stay() {
        assert_eq!(unwrapped(&["encoder.a", "decoder.a"]), None);
        assert_eq!(unwrapped(&["model.a", "ema.a"]), None);
        assert_eq!(unwrapped(&["model", "b"]), None);
        assert_eq!(unwrapped(&["a._orig_mod.b", "a.b"]), None);
        assert_eq!(unwrapped(&[]), None);
    }
}
