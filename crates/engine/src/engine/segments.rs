//! Which rows of packed tokens attend to which: variable lengths without padding.

use std::ops::Range;
use std::sync::Arc;

use super::EngineError;

/// One group of query rows and the key rows that all of them see.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Segment {
    /// Rows of the query tokens.
    pub queries: Range<usize>,
    /// May be empty: attention then gives zeros.
    pub keys: Range<usize>,
}

/// The segments of one attention call, over query tokens `[queries, D]` and key tokens `[keys, D]`.
///
/// Query ranges are ascending and do not overlap; rows in no segment get zeros. Key ranges may be shared between segments.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Segments {
    list: Arc<[Segment]>,
    queries: usize,
    keys: usize,
}

impl Segments {
    /// Segments over `queries` query rows and `keys` key rows.
    ///
    /// # Errors
    /// When a range is out of bounds, or query ranges overlap or are not ascending.
    pub fn new(list: Vec<Segment>, queries: usize, keys: usize) -> Result<Self, EngineError> {
        let mut last = 0;
        for segment in &list {
            let (q, k) = (&segment.queries, &segment.keys);
            if q.start < last || q.end < q.start || q.end > queries {
                return Err(EngineError::Segments(format!(
                    "query rows {q:?} overlap the segment before, or lie outside 0..{queries}"
                )));
            }
            if k.end < k.start || k.end > keys {
                return Err(EngineError::Segments(format!(
                    "key rows {k:?} lie outside 0..{keys}"
                )));
            }
            last = q.end;
        }
        Ok(Self {
            list: list.into(),
            queries,
            keys,
        })
    }

    /// Self-attention within consecutive runs of `lengths` rows: samples of a batch, or modalities of samples.
    #[must_use]
    pub fn within(lengths: &[usize]) -> Self {
        let mut end = 0;
        let list: Vec<Segment> = lengths
            .iter()
            .map(|length| {
                let rows = end..end + length;
                end += length;
                Segment {
                    queries: rows.clone(),
                    keys: rows,
                }
            })
            .collect();
        Self {
            list: list.into(),
            queries: end,
            keys: end,
        }
    }

    /// Self-attention of `batch` samples of `length` rows each.
    #[must_use]
    pub fn batch(batch: usize, length: usize) -> Self {
        Self::within(&vec![length; batch])
    }

    /// Cross-attention: run `i` of `query_lengths` sees run `i` of `key_lengths`.
    ///
    /// # Panics
    /// When the numbers of runs differ.
    #[must_use]
    pub fn across(query_lengths: &[usize], key_lengths: &[usize]) -> Self {
        assert_eq!(query_lengths.len(), key_lengths.len());
        let (mut q, mut k) = (0, 0);
        let list: Vec<Segment> = query_lengths
            .iter()
            .zip(key_lengths)
            .map(|(queries, keys)| {
                let segment = Segment {
                    queries: q..q + queries,
                    keys: k..k + keys,
                };
                (q, k) = (q + queries, k + keys);
                segment
            })
            .collect();
        Self {
            list: list.into(),
            queries: q,
            keys: k,
        }
    }

    /// In the order of their query rows.
    #[must_use]
    pub fn list(&self) -> &[Segment] {
        &self.list
    }

    /// The number of query rows.
    #[must_use]
    pub fn queries(&self) -> usize {
        self.queries
    }

    /// The number of key rows.
    #[must_use]
    pub fn keys(&self) -> usize {
        self.keys
    }

    /// `(segments, query rows, key rows)` if all segments are alike, adjacent and cover everything.
    #[must_use]
    pub fn uniform(&self) -> Option<(usize, usize, usize)> {
        let first = self.list.first()?;
        let (n, m) = (first.queries.len(), first.keys.len());
        let alike = self.list.iter().enumerate().all(|(index, segment)| {
            segment.queries == (index * n..(index + 1) * n)
                && segment.keys == (index * m..(index + 1) * m)
        });
        let count = self.list.len();
        (alike && count * n == self.queries && count * m == self.keys).then_some((count, n, m))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn overlapping_or_outside_rows_are_refused() {
        let segment = |q: Range<usize>, k: Range<usize>| Segment {
            queries: q,
            keys: k,
        };
        assert!(Segments::new(vec![segment(0..3, 0..2), segment(2..4, 0..2)], 4, 2).is_err());
        assert!(Segments::new(vec![segment(0..5, 0..2)], 4, 2).is_err());
        assert!(Segments::new(vec![segment(0..4, 1..3)], 4, 2).is_err());
        assert!(Segments::new(vec![segment(0..1, 0..2), segment(3..4, 0..0)], 4, 2).is_ok());
    }

    #[test]
    fn a_batch_is_uniform_and_ragged_runs_are_not() {
        assert_eq!(Segments::batch(3, 5).uniform(), Some((3, 5, 5)));
        assert_eq!(
            Segments::across(&[2, 2], &[4, 4]).uniform(),
            Some((2, 2, 4))
        );
        assert_eq!(Segments::within(&[2, 3]).uniform(), None);
    }
}
