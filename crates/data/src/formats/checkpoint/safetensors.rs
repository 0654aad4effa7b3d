//! Safetensors: a JSON header with types, shapes and places, then the values.

use super::memory::identify;
use super::{Checkpoint, CheckpointError, Format, Source};
use crate::formats::pickle::{Scalar, Storage, TensorView};
use serde_json::{Map, Value};
use std::collections::BTreeSet;
use std::fs::File;
use std::io::{BufReader, Read};
use std::path::Path;

/// A model of a thousand tensors has a header of a tenth of a megabyte.
const MAX_HEADER: u64 = 8 << 20;

impl Checkpoint {
    pub(super) fn safetensors(path: &Path, file: File) -> Result<Self, CheckpointError> {
        let refused = |reason: String| CheckpointError::refused(path, reason);
        let length = file.metadata().map_err(CheckpointError::io(path))?.len();
        let mut file = BufReader::new(file);
        let mut prefix = [0; 8];
        file.read_exact(&mut prefix)
            .map_err(CheckpointError::io(path))?;
        let header = u64::from_le_bytes(prefix);
        if header > length.saturating_sub(8).min(MAX_HEADER) {
            return Err(refused(if header <= MAX_HEADER {
                format!("cut off: a header of {header} bytes in a file of {length}")
            } else {
                format!("a header of {header} bytes")
            }));
        }
        let mut text = vec![0; header as usize];
        file.read_exact(&mut text)
            .map_err(CheckpointError::io(path))?;
        let parsed: Map<String, Value> = serde_json::from_slice(&text)
            .map_err(|e| refused(format!("the header is not JSON: {e}")))?;
        let available = length - 8 - header;
        let mut entries = Vec::new();
        for (name, entry) in parsed.iter().filter(|(name, _)| *name != "__metadata__") {
            let view =
                view(entry, available).map_err(|reason| refused(format!("`{name}`: {reason}")))?;
            entries.push((name.clone(), view));
        }
        let (entries, overlap) = identify(entries, available).map_err(refused)?;
        // Its own rule, where torch has none.
        if let Some(reason) = overlap {
            return Err(refused(reason));
        }
        Ok(Self {
            path: path.to_owned(),
            format: Format::Safetensors,
            entries,
            arguments: Map::new(),
            others: Vec::new(),
            wrappers: Vec::new(),
            opaque: Vec::new(),
            source: Source::Flat {
                file,
                start: 8 + header,
            },
            overlap: None,
            verified: BTreeSet::new(),
        })
    }
}

/// One entry of the header, checked against the `available` bytes behind it.
fn view(entry: &Value, available: u64) -> Result<TensorView, String> {
    const INVALID: &str = "its entry in the header is not valid";
    let name = entry["dtype"].as_str().ok_or(INVALID)?;
    let Some(scalar) = Scalar::of_safetensors(name) else {
        let name: String = name.chars().take(40).collect();
        return Err(format!("elements of type `{name}` are not read"));
    };
    let numbers = |value: &Value| -> Option<Vec<u64>> {
        value.as_array()?.iter().map(Value::as_u64).collect()
    };
    let shape = numbers(&entry["shape"])
        .filter(|shape| shape.len() <= 8)
        .ok_or(INVALID)?;
    let offsets = numbers(&entry["data_offsets"]).ok_or(INVALID)?;
    let [begin, end] = offsets[..] else {
        return Err(INVALID.to_owned());
    };
    let width = scalar.width() as u64;
    let elements = shape
        .iter()
        .try_fold(1u64, |n, &d| n.checked_mul(d))
        .ok_or(INVALID)?;
    let sound = begin <= end
        && elements.checked_mul(width) == Some(end - begin)
        && begin.is_multiple_of(width);
    if !sound {
        return Err(INVALID.to_owned());
    }
    if end > available {
        return Err(format!(
            "cut off: it lies in bytes {begin} to {end} behind the header, and there are {available}"
        ));
    }
    let mut strides = vec![1u64; shape.len()];
    for axis in (1..shape.len()).rev() {
        // Saturates only where there are no elements.
        strides[axis - 1] = strides[axis].saturating_mul(shape[axis].max(1));
    }
    Ok(TensorView {
        storage: Storage {
            key: String::new(),
            scalar,
            elements: available / width,
        },
        offset: begin / width,
        shape,
        strides,
    })
}
