//! How much of a codebook a tokenizer uses, over a whole split (Supp. A).

use super::outcome::MetricError;

/// Use of a codebook of `size` codes.
#[derive(Debug, Clone, PartialEq, Default, serde::Serialize)]
pub struct CodebookUse {
    /// Number of codes in the codebook.
    pub size: usize,
    /// Usage is bounded by `n_tokens / size`: print it beside.
    pub n_tokens: usize,
    /// Different codes that were used.
    pub distinct: usize,
    /// Distinct codes over the size; `None` without tokens.
    pub usage: Option<f64>,
    /// `exp(-Σ p ln p)`; `None` without tokens.
    pub perplexity: Option<f64>,
}

/// Counts codes over a whole split; feed it every clip, then ask.
#[derive(Debug, Clone)]
pub struct CodeCounts {
    counts: Vec<u64>,
}

impl CodeCounts {
    /// Counts for a codebook of `size` codes, all zero.
    #[must_use]
    pub fn new(size: usize) -> Self {
        Self {
            counts: vec![0; size],
        }
    }

    /// # Errors
    /// When a code is negative or not below the size.
    pub fn add(&mut self, code: i64) -> Result<(), MetricError> {
        let size = self.counts.len();
        let slot = usize::try_from(code)
            .ok()
            .and_then(|c| self.counts.get_mut(c));
        *slot.ok_or(MetricError::CodeOutside { code, size })? += 1;
        Ok(())
    }

    /// The use of the codebook by all codes added so far.
    #[must_use]
    pub fn summary(&self) -> CodebookUse {
        let total: u64 = self.counts.iter().sum();
        let distinct = self.counts.iter().filter(|&&c| c > 0).count();
        let entropy: f64 = self
            .counts
            .iter()
            .filter(|&&c| c > 0)
            .map(|&c| c as f64 / total as f64)
            .map(|p| -p * p.ln())
            .sum();
        CodebookUse {
            size: self.counts.len(),
            n_tokens: total as usize,
            distinct,
            usage: (total > 0).then(|| distinct as f64 / self.counts.len() as f64),
            perplexity: (total > 0).then(|| entropy.exp()),
        }
    }
}

/// [`CodebookUse`] of one list of codes.
///
/// # Errors
/// As [`CodeCounts::add`].
pub fn codebook_use(
    codes: impl IntoIterator<Item = i64>,
    size: usize,
) -> Result<CodebookUse, MetricError> {
    let mut counts = CodeCounts::new(size);
    for code in codes {
        counts.add(code)?;
    }
    Ok(counts.summary())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn usage_of_a_vocabulary_counts_codes_and_their_evenness() {
        let even = codebook_use([0, 1, 2, 3], 8).unwrap();
        assert_eq!((even.usage, even.n_tokens), (Some(0.5), 4));
        assert!((even.perplexity.unwrap() - 4.0).abs() < 1e-12);
        let one = codebook_use([5; 10], 8).unwrap();
        assert_eq!((one.usage, one.perplexity), (Some(0.125), Some(1.0)));
        assert_eq!(codebook_use([], 8).unwrap().perplexity, None);
        for outside in [-1, 8] {
            assert!(codebook_use([outside], 8).is_err());
        }
    }
}
