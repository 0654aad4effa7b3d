//! A codebook without a network: k-means on the patches themselves. A tokenizer with as many tokens and codes has to be
//! better than this, or its network learnt nothing.

use rand::seq::SliceRandom;

use crate::engine::ops::nearest;
use crate::random::stream;
use crate::tokenizer::patches::Patches;
use crate::tokenizer::trained::Prepared;

/// Patches that centres are fitted on, at most.
pub(super) const PATCHES: usize = 1 << 15;

/// Rounds of Lloyd's algorithm.
pub(super) const ROUNDS: usize = 15;

/// Centres of rows.
#[derive(Debug, Clone)]
pub struct Centres {
    /// `[centres, width]`.
    values: Vec<f32>,
    width: usize,
}

impl Centres {
    /// `count` centres of `rows`, `[rows, width]`; `None` without rows.
    #[must_use]
    pub fn fit(rows: &[f32], width: usize, count: usize, seed: u64) -> Option<Self> {
        let total = rows.len() / width;
        if total == 0 || count == 0 {
            return None;
        }
        let mut start: Vec<usize> = (0..total).collect();
        start.shuffle(&mut stream(seed, "kmeans.start", 0, 0));
        let mut values = Vec::with_capacity(count * width);
        for i in 0..count {
            let row = start[i % total];
            values.extend_from_slice(&rows[row * width..(row + 1) * width]);
        }
        for _ in 0..ROUNDS {
            let ids = closest(rows, &values, width);
            let mut sums = vec![0.0_f64; count * width];
            let mut counts = vec![0_u64; count];
            for (id, row) in ids.iter().zip(rows.chunks_exact(width)) {
                counts[*id as usize] += 1;
                let sum = &mut sums[*id as usize * width..][..width];
                sum.iter_mut()
                    .zip(row)
                    .for_each(|(sum, value)| *sum += f64::from(*value));
            }
            for (centre, count) in counts.iter().enumerate().filter(|(_, count)| **count > 0) {
                for i in centre * width..(centre + 1) * width {
                    values[i] = (sums[i] / *count as f64) as f32;
                }
            }
        }
        Some(Self { values, width })
    }

    /// Every row replaced by its nearest centre.
    #[must_use]
    pub fn project(&self, rows: &[f32]) -> Vec<f32> {
        closest(rows, &self.values, self.width)
            .iter()
            .flat_map(|id| &self.values[*id as usize * self.width..][..self.width])
            .copied()
            .collect()
    }
}

/// Centres of patches of signals.
#[derive(Debug, Clone)]
pub struct KMeans {
    patches: Patches,
    centres: Centres,
}

impl KMeans {
    /// `count` centres of the patches of `signals`; `None` without signals.
    #[must_use]
    pub fn fit(patches: &Patches, signals: &[Prepared], count: usize, seed: u64) -> Option<Self> {
        let mut order: Vec<usize> = (0..signals.len()).collect();
        order.shuffle(&mut stream(seed, "kmeans.signals", 0, 0));
        let (width, most) = (patches.width(), PATCHES.max(4 * count));
        let mut rows = Vec::new();
        for signal in order {
            if rows.len() / width >= most {
                break;
            }
            patches.cut(&signals[signal].values, &mut rows);
        }
        Some(Self {
            patches: patches.clone(),
            centres: Centres::fit(&rows, width, count, seed)?,
        })
    }

    /// The signal with every patch replaced by its nearest centre.
    #[must_use]
    pub fn reconstruct(&self, signal: &Prepared) -> Vec<f32> {
        let mut rows = Vec::new();
        self.patches.cut(&signal.values, &mut rows);
        self.patches.join(&self.centres.project(&rows))
    }
}

/// For each row of `x` the nearest centre: the largest `x c - |c|^2 / 2`.
fn closest(x: &[f32], centres: &[f32], width: usize) -> Vec<u32> {
    let widen = |rows: &[f32], last: &dyn Fn(&[f32]) -> f32| -> Vec<f32> {
        let mut wide = Vec::with_capacity(rows.len() / width * (width + 1));
        for row in rows.chunks_exact(width) {
            wide.extend_from_slice(row);
            wide.push(last(row));
        }
        wide
    };
    let half = |row: &[f32]| -0.5 * row.iter().map(|value| value * value).sum::<f32>();
    nearest(&widen(x, &|_| 1.0), &widen(centres, &half), width + 1)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::modality::Shape;

    #[test]
    fn as_many_centres_as_different_patches_reconstruct_them() {
        let shape = Shape::Temporal {
            samples: 4,
            channels: 2,
        };
        let patches = Patches::new(&shape, &[2]).unwrap();
        let signals: Vec<Prepared> = (0..30)
            .map(|i| Prepared {
                values: (0..8).map(|k| ((i % 3) * 10 + k / 4) as f32).collect(),
                valid: None,
            })
            .collect();
        let kmeans = KMeans::fit(&patches, &signals, 24, 1).unwrap();
        let found = kmeans.reconstruct(&signals[4]);
        let error: f32 = found
            .iter()
            .zip(&signals[4].values)
            .map(|(a, b)| (a - b).abs())
            .sum();
        assert!(error < 1e-3, "{found:?}");
        assert!(KMeans::fit(&patches, &[], 4, 1).is_none());
    }
}
