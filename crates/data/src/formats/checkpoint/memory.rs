//! Which entries share memory, and whether they may.

use super::Entry;
use crate::formats::pickle::{Scalar, TensorView};
use std::collections::{BTreeMap, BTreeSet};

/// More tensors than any model has.
pub(super) const MAX_ENTRIES: usize = 1 << 17;
/// The longest name of a tensor in bytes.
pub(super) const MAX_NAME: usize = 512;

/// Storage, type of the elements, offset, shape and strides of a view.
type Place = (String, Scalar, u64, Vec<u64>, Vec<u64>);

/// Entries, those that are the same view marked, and what overlaps otherwise: a file may be looked at all the same, but what would
/// be written of it could be much larger than the file.
pub(super) fn identify(
    tensors: Vec<(String, TensorView)>,
    memory: u64,
) -> Result<(Vec<Entry>, Option<String>), String> {
    let mut names = BTreeSet::new();
    let mut owners: BTreeMap<Place, usize> = BTreeMap::new();
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
            view.storage.scalar,
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
        let reason = format!("the tensors overlap: they claim {claimed} bytes of {memory}");
        return Ok((entries, Some(reason)));
    }
    // In bytes: views of one storage may have elements of different sizes.
    let mut spans: Vec<(&str, u64, u64, &str)> = entries
        .iter()
        .filter(|e| e.same_as.is_none() && e.view.elements() > 0 && e.view.is_contiguous())
        .map(|e| {
            let key = e.view.storage.key.as_str();
            let width = e.scalar().width() as u64;
            let (start, end) = (e.view.offset * width, e.view.end() * width);
            (key, start, end, e.name.as_str())
        })
        .collect();
    spans.sort_unstable();
    for pair in spans.windows(2) {
        let (first, second) = (pair[0], pair[1]);
        let same = (first.1, first.2) == (second.1, second.2);
        if first.0 == second.0 && second.1 < first.2 && !same {
            let reason = format!("`{}` and `{}` overlap", first.3, second.3);
            return Ok((entries, Some(reason)));
        }
    }
    Ok((entries, None))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::formats::pickle::Storage;

    /// A line of elements in one storage of 64 bytes.
    fn line(name: &str, scalar: Scalar, offset: u64, length: u64) -> (String, TensorView) {
        let view = TensorView {
            storage: Storage {
                key: String::new(),
                scalar,
                elements: 64 / scalar.width() as u64,
            },
            offset,
            shape: vec![length],
            strides: vec![1],
        };
        (name.to_owned(), view)
    }

    #[test]
    fn places_of_different_types_are_compared_in_bytes() {
        // Bytes 0..32 and 32..40: in elements 0..8 and 4..5.
        let apart = vec![
            line("mean", Scalar::F32, 0, 8),
            line("step", Scalar::I64, 4, 1),
        ];
        let (entries, _) = identify(apart, 64).unwrap();
        assert!(entries.iter().all(|e| e.same_as.is_none()));
        // Bytes 16..20 and 32..40: in elements both 4..5.
        let alike = vec![line("a", Scalar::F32, 4, 1), line("b", Scalar::I64, 4, 1)];
        assert_eq!(identify(alike, 64).unwrap().0[1].same_as, None);
        // Bytes 0..36 and 32..40: in elements 0..9 and 4..5.
        let over = vec![line("a", Scalar::F32, 0, 9), line("b", Scalar::I64, 4, 1)];
        assert_eq!(
            identify(over, 64).unwrap().1.as_deref(),
            Some("`a` and `b` overlap")
        );
        let same = vec![line("a", Scalar::F32, 4, 1), line("b", Scalar::F32, 4, 1)];
        assert_eq!(identify(same, 64).unwrap().0[1].same_as, Some(0));
    }

    #[test]
    fn a_tensor_without_elements_has_no_place() {
        let mut empty = line("empty", Scalar::F32, 0, 0);
        empty.1.shape = vec![0, 1 << 40, 1 << 40];
        empty.1.strides = vec![1, 1 << 40, 1];
        assert!(empty.1.is_contiguous());
        let (entries, _) = identify(vec![empty, line("a", Scalar::F32, 0, 16)], 64).unwrap();
        assert_eq!(entries[1].same_as, None);
    }
}
