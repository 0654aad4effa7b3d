//! Finite scalar quantisation: each latent dimension is squashed into a few levels and rounded; the levels make the token.

/// The levels of each latent dimension, e.g. `8 8 8 5 5 5`: 64 000 tokens.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Fsq {
    levels: Vec<usize>,
}

impl Fsq {
    /// # Panics
    /// When there is no dimension, or one of fewer than two levels.
    #[must_use]
    pub fn new(levels: &[usize]) -> Self {
        assert!(!levels.is_empty() && levels.iter().all(|l| *l >= 2));
        Self {
            levels: levels.to_vec(),
        }
    }

    /// Latent dimensions.
    #[must_use]
    pub fn width(&self) -> usize {
        self.levels.len()
    }

    /// Half the range (a little more than the outermost level), offset and shift of dimension `i`: the squashed value is
    /// `tanh(z + shift) * half - offset`.
    #[must_use]
    pub fn squash(&self, i: usize) -> [f64; 3] {
        let levels = self.levels[i];
        let half = (levels as f64 - 1.0) * 1.001 / 2.0;
        let offset = if levels.is_multiple_of(2) { 0.5 } else { 0.0 };
        [half, offset, (offset / half).atanh()]
    }

    /// The squashed latents: each rounds to one of its levels.
    #[must_use]
    pub fn bound(&self, z: &[f32]) -> Vec<f32> {
        let squash: Vec<[f32; 3]> = (0..self.width())
            .map(|i| self.squash(i).map(|v| v as f32))
            .collect();
        let mut out = z.to_vec();
        for row in out.chunks_exact_mut(self.width()) {
            for (z, [half, offset, shift]) in row.iter_mut().zip(&squash) {
                *z = (*z + shift).tanh() * half - offset;
            }
        }
        out
    }

    /// Tokens of latents `[rows, width]`.
    #[must_use]
    pub fn encode(&self, z: &[f32]) -> Vec<u32> {
        self.index(&self.bound(z))
    }

    /// Tokens of squashed latents: halves round to even.
    #[must_use]
    pub fn index(&self, bounded: &[f32]) -> Vec<u32> {
        bounded
            .chunks_exact(self.width())
            .map(|row| {
                let mut basis = 1;
                let mut token = 0;
                for (value, levels) in row.iter().zip(&self.levels) {
                    let half = (levels / 2) as i64;
                    let digit =
                        (value.round_ties_even() as i64 + half).clamp(0, *levels as i64 - 1);
                    token += digit as usize * basis;
                    basis *= levels;
                }
                token as u32
            })
            .collect()
    }

    /// The codes of tokens, `[rows, width]`, each in [-1, 1].
    ///
    /// Tokens outside the vocabulary wrap; callers check them first.
    #[must_use]
    pub fn decode(&self, tokens: &[u32]) -> Vec<f32> {
        let mut out = Vec::with_capacity(tokens.len() * self.width());
        for token in tokens {
            let mut rest = *token as usize;
            for levels in &self.levels {
                let half = (levels / 2) as f32;
                out.push(((rest % levels) as f32 - half) / half);
                rest /= levels;
            }
        }
        out
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_reference_values_come_out() {
        let fsq = Fsq::new(&[8, 8, 8, 5, 5, 5]);
        assert_eq!(
            fsq.decode(&[8830, 42039]),
            [
                0.5, 0.75, -0.75, 0.0, 0.5, -1.0, 0.75, 0.5, -1.0, 0.0, -0.5, 0.5
            ]
        );
        assert_eq!(fsq.encode(&[0.3, -0.7, 2.0, -0.2, 0.9, -3.0]), [9173]);
        assert_eq!(fsq.encode(&[10.0; 6]), [63_999]);
        assert_eq!(fsq.encode(&[-10.0; 6]), [0]);
        assert_eq!(fsq.encode(&[0.0; 6]), [32_036]);
        assert!((fsq.squash(0)[2] - 0.143_695_4).abs() < 1e-7);
    }

    #[test]
    fn every_token_survives_the_round_trip() {
        let fsq = Fsq::new(&[8, 5, 4, 3]);
        let tokens: Vec<u32> = (0..8 * 5 * 4 * 3).collect();
        // Codes times half the levels are squashed values.
        let mut bounded = fsq.decode(&tokens);
        for row in bounded.chunks_exact_mut(4) {
            for (value, half) in row.iter_mut().zip([4.0, 2.0, 2.0, 1.0]) {
                *value *= half;
            }
        }
        assert_eq!(fsq.index(&bounded), tokens);
    }
}
