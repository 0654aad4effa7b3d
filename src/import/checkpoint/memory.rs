//! Which entries share memory, and whether they may.

use super::Entry;
use crate::import::pickle::TensorView;
use std::collections::{BTreeMap, BTreeSet};

/// More tensors than any model has.
pub(super) const MAX_ENTRIES: usize = 1 << 17;
/// The longest name of a tensor in bytes.
pub(super) const MAX_NAME: usize = 512;

/// Marks entries that are the same view, and refuses tensors that overlap otherwise.
pub(super) fn identify(
    tensors: Vec<(String, TensorView)>,
    memory: u64,
) -> Result<Vec<Entry>, String> {
    let mut names = BTreeSet::new();
    let mut owners: BTreeMap<(String, u64, Vec<u64>, Vec<u64>), usize> = BTreeMap::new();
    let mut entries = Vec::with_capacity(tensors.len());
    let mut claimed = 0u64;
    for (index, (name, view)) in tensors.into_iter().enumerate() {
        if name.is_empty() || name.len() > MAX_NAME || name.chars().any(char::is_control) {
            return Err(format!("a tensor is called {name:?}"));
        }
        if !names.insert(name.clone()) {
            return Err(format!("two tensors are called `{name}`"));
        }
        let key = (
            view.storage.key.clone(),
            view.offset,
            view.shape.clone(),
            view.strides.clone(),
        );
        let owner = *owners.entry(key).or_insert(index);
        let entry = Entry {
            name,
            view,
            same_as: (owner != index).then_some(owner),
        };
        if owner == index {
            claimed = claimed.saturating_add(entry.bytes());
        }
        entries.push(entry);
    }
    if claimed > memory {
        return Err(format!(
            "the tensors overlap: they claim {claimed} bytes of {memory}"
        ));
    }
    let mut spans: Vec<(&str, u64, u64, &str)> = entries
        .iter()
        .filter(|e| e.same_as.is_none() && e.view.is_contiguous() && e.view.elements() > 0)
        .map(|e| {
            let key = e.view.storage.key.as_str();
            (key, e.view.offset, e.view.end(), e.name.as_str())
        })
        .collect();
    spans.sort_unstable();
    for pair in spans.windows(2) {
        let (first, second) = (pair[0], pair[1]);
        let same = (first.1, first.2) == (second.1, second.2);
        if first.0 == second.0 && second.1 < first.2 && !same {
            return Err(format!("`{}` and `{}` overlap", first.3, second.3));
        }
    }
    Ok(entries)
}
