//! Wall-clock time per clip, one clip at a time, after a warm-up.

/// Statistics of per-clip seconds. All `None` when nothing is left after the warm-up.
#[derive(Debug, Clone, PartialEq, Default, serde::Serialize, serde::Deserialize)]
pub struct Runtime {
    /// Clips after the warm-up.
    pub n: usize,
    /// Of an even number of clips, the mean of the middle two.
    pub median: Option<f64>,
    /// Arithmetic mean.
    pub mean: Option<f64>,
    /// 90th percentile by nearest rank.
    pub p90: Option<f64>,
}

/// Warm-up clips when nothing else is said.
pub const DEFAULT_WARMUP: usize = 3;

/// Drops the first `warmup` samples and summarises the rest.
#[must_use]
pub fn runtime(seconds: &[f64], warmup: usize) -> Runtime {
    let mut rest = seconds.get(warmup..).unwrap_or_default().to_vec();
    rest.sort_by(f64::total_cmp);
    let n = rest.len();
    if n == 0 {
        return Runtime::default();
    }
    let half = n / 2;
    let median = if n % 2 == 1 {
        rest[half]
    } else {
        f64::midpoint(rest[half - 1], rest[half])
    };
    Runtime {
        n,
        median: Some(median),
        mean: Some(rest.iter().sum::<f64>() / n as f64),
        p90: Some(rest[(9 * n).div_ceil(10) - 1]),
    }
}
