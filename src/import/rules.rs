//! What may happen to an entry of a released checkpoint. Nothing is dropped before it has been shown to be redundant.

use super::{Checkpoint, ImportError};
use crate::nn::positions::{self, GridOrder};
use serde_json::Value;

/// No element of a position table may be further from ours than this.
const TABLE_TOLERANCE: f32 = 1e-6;
/// What tells two places of a table apart.
const PLACE_TOLERANCE: f32 = 1e-5;

/// More values than any position table has: four times that of the release's video.
const MAX_TABLE: u64 = 1 << 24;

/// The fate of one entry.
#[derive(Debug, Clone, PartialEq)]
pub enum Rule {
    /// Written as `name` with `shape` (as many values as the entry has).
    Keep {
        /// Its name in our file.
        name: String,
        /// Its shape in our file.
        shape: Vec<usize>,
    },
    /// A second name of `owner`; must hold the same values.
    Alias {
        /// Name of the entry that is kept instead.
        owner: String,
    },
    /// Must be zero everywhere.
    Zero,
    /// A fixed position table that this product computes itself; written all the same where `keep`.
    Table {
        /// What the rows of the table stand for.
        layout: Layout,
        /// Whether it is written, under its own name.
        keep: bool,
    },
    /// Other constants that this product knows; must agree.
    Constant {
        /// What it must hold, in order, as exactly as its element type allows.
        values: Vec<f32>,
    },
    /// A convolution that the forward pass of this model never runs.
    NeverRuns,
    /// Belongs to something that this product does not have.
    Unsupported {
        /// What it belongs to, in words, for the manifest.
        why: &'static str,
    },
}

/// How a position table enumerates its places.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Layout {
    /// Time.
    Line,
    /// Time by joint group, in the release's order.
    Grid,
    /// Time by height by width.
    Volume,
}

/// A recognised model: one rule per entry, in the entries' order.
#[derive(Debug, Clone, PartialEq)]
pub struct Plan {
    /// `mget`, `camera`, `left_hand`, `cosmos_dv4x8x8`, ...: the name of our files.
    pub part: String,
    /// `mget`, `vq` or `cosmos`.
    pub family: &'static str,
    /// What happens to each entry of the checkpoint.
    pub rules: Vec<Rule>,
    /// What the tensors and arguments say about the model. Grids are filled in once position tables have been read.
    pub settings: Value,
    /// The token grid of a VQ-VAE, once its position tables have been read.
    pub grid: Option<Vec<usize>>,
}

impl Plan {
    /// How many tokens a tokenizer has.
    pub fn vocabulary(&self) -> u64 {
        let levels = self.settings["levels"].as_array();
        match levels {
            Some(levels) => levels.iter().filter_map(Value::as_u64).product(),
            None => self.settings["codebook"].as_u64().unwrap_or(0),
        }
    }
}

/// What was found for one entry, for the manifest.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Verdict {
    /// What became of the entry, in words: `kept as ...`, `left out: ...`.
    pub action: String,
    /// The grid a position table turned out to enumerate.
    pub grid: Option<Vec<usize>>,
}

impl Rule {
    /// The name and shape under which an entry is written, if it is.
    pub fn written(&self, entry: &super::Entry) -> Option<(String, Vec<usize>)> {
        match self {
            Self::Keep { name, shape } => Some((name.clone(), shape.clone())),
            Self::Table { keep: true, .. } => Some((entry.name.clone(), entry.shape())),
            _ => None,
        }
    }

    /// Keeps an entry under its own name and shape.
    pub fn keep(name: &str, shape: Vec<usize>) -> Self {
        Self::Keep {
            name: name.to_owned(),
            shape,
        }
    }

    /// Carries out the check of a rule. [`Rule::Keep`] has none here: values are checked while they are written.
    pub fn check(&self, checkpoint: &mut Checkpoint, index: usize) -> Result<Verdict, ImportError> {
        let name = checkpoint.entries()[index].name.clone();
        let path = checkpoint.path().to_owned();
        let refuse =
            |reason: String| Err(ImportError::refused(&path, format!("`{name}`: {reason}")));
        let mut grid = None;
        let action = match self {
            Self::Keep { name, .. } => format!("kept as `{name}`"),
            Self::Unsupported { why } => format!("left out: {why}"),
            Self::NeverRuns => "left out: this model never runs it".to_owned(),
            Self::Zero => {
                let mut zero = true;
                checkpoint.stream::<ImportError>(index, &mut |values| {
                    zero &= values.iter().all(|&v| v == 0.0);
                    Ok(())
                })?;
                if !zero {
                    return refuse("is not zero; dropping it would change the model".into());
                }
                "left out: zero".to_owned()
            }
            Self::Alias { owner } => {
                let entries = checkpoint.entries();
                let Some(of) = entries.iter().position(|e| e.name == *owner) else {
                    return refuse(format!("its owner `{owner}` is missing"));
                };
                if entries[of].shape() != entries[index].shape() {
                    return refuse(format!("has another shape than its owner `{owner}`"));
                }
                let shared = entries[index].same_as == Some(of)
                    || entries[of].same_as == Some(index)
                    || (entries[of].same_as.is_some()
                        && entries[of].same_as == entries[index].same_as);
                if shared {
                    format!("left out: the same memory as `{owner}`")
                } else if equal(checkpoint, index, of)? {
                    format!("left out: equal to `{owner}`")
                } else {
                    return refuse(format!(
                        "differs from `{owner}`, which it should be tied to"
                    ));
                }
            }
            Self::Constant { values } => {
                if entries_of(checkpoint, index) != values.len() as u64 {
                    return refuse(format!("has not {} values", values.len()));
                }
                let found = checkpoint.values(index)?;
                // What the entry's own type can tell apart.
                let tolerance = checkpoint.entries()[index].scalar().precision().max(1e-6);
                let same = found
                    .iter()
                    .zip(values)
                    .all(|(a, b)| (a - b).abs() <= tolerance * b.abs());
                if !same {
                    return refuse(format!(
                        "holds {:?}.., this product would use {:?}..",
                        &found[..found.len().min(8)],
                        &values[..values.len().min(8)]
                    ));
                }
                "left out: the same constant".to_owned()
            }
            Self::Table { layout, keep } => {
                let shape = checkpoint.entries()[index].shape();
                if entries_of(checkpoint, index) > MAX_TABLE {
                    return refuse(format!("a position table of shape {shape:?}"));
                }
                let found = checkpoint.values(index)?;
                let width = shape.last().copied().unwrap_or(0);
                let (place, expected) = match layout.expected(&found, width) {
                    Ok(table) => table,
                    Err(reason) => return refuse(reason),
                };
                let error = if found.len() == expected.len() {
                    distance(&found, &expected)
                } else {
                    f32::INFINITY
                };
                let scalar = checkpoint.entries()[index].scalar();
                // No value of a table is larger than one.
                let tolerance = TABLE_TOLERANCE + scalar.precision();
                if error > tolerance {
                    return refuse(format!(
                        "differs by {error:.1e} from the position table of a {place:?} grid; in {} it may differ by {tolerance:.1e}",
                        scalar.name()
                    ));
                }
                grid = Some(place.clone());
                let fate = if *keep { "kept" } else { "left out" };
                format!("{fate}: the position table of a {place:?} grid, within {error:.1e}")
            }
        };
        Ok(Verdict { action, grid })
    }
}

impl Layout {
    /// The grid that `table` enumerates, read from where its columns change, and our table of that grid.
    fn expected(self, table: &[f32], width: usize) -> Result<(Vec<usize>, Vec<f32>), String> {
        let divisor = match self {
            Self::Line => 2,
            Self::Grid => 4,
            Self::Volume => 6,
        };
        if width == 0 || !width.is_multiple_of(divisor) || table.is_empty() {
            return Err(format!("a position table of width {width}"));
        }
        let rows = table.len() / width;
        // The first row at which these columns differ from the first row's.
        let change = |from: usize, to: usize| {
            (1..rows)
                .find(|row| {
                    (from..to).any(|c| (table[row * width + c] - table[c]).abs() > PLACE_TOLERANCE)
                })
                .unwrap_or(rows)
        };
        let whole = |size: usize, of: usize| {
            of.is_multiple_of(size)
                .then_some(of / size)
                .ok_or_else(|| format!("a position table of {of} rows that repeats every {size}"))
        };
        Ok(match self {
            Self::Line => (vec![rows], positions::line(rows, width)),
            Self::Grid => {
                let times = change(0, width / 2);
                let groups = whole(times, rows)?;
                let table = positions::grid(times, groups, width, GridOrder::Released);
                (vec![times, groups], table)
            }
            Self::Volume => {
                let third = width / 3;
                let plane = change(0, third);
                let columns = change(third, 2 * third).min(plane);
                let grid = [whole(plane, rows)?, whole(columns, plane)?, columns];
                (grid.to_vec(), positions::volume(grid, width))
            }
        })
    }
}

fn entries_of(checkpoint: &Checkpoint, index: usize) -> u64 {
    checkpoint.entries()[index].view.elements()
}

/// The largest difference of two elements; infinite where one is not a number.
fn distance(a: &[f32], b: &[f32]) -> f32 {
    a.iter().zip(b).fold(0.0, |worst, (a, b)| {
        let off = (a - b).abs();
        if off.is_nan() {
            f32::INFINITY
        } else {
            worst.max(off)
        }
    })
}

/// Whether two entries hold the same values, bit for bit. The first is held in memory.
fn equal(checkpoint: &mut Checkpoint, a: usize, b: usize) -> Result<bool, ImportError> {
    let first = checkpoint.values(a)?;
    let (mut at, mut same) = (0, true);
    checkpoint.stream::<ImportError>(b, &mut |values| {
        let part = &first[at..at + values.len()];
        same &= part
            .iter()
            .zip(values)
            .all(|(x, y)| x.to_bits() == y.to_bits());
        at += values.len();
        Ok(())
    })?;
    Ok(same)
}
