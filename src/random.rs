//! Counter-based random streams.
//!
//! There is no stateful generator anywhere in `reviv`: every random number is a function of (seed, stream name, step,
//! sample). A stream is a `ChaCha8` generator keyed by the blake3 hash of those four, so draws do not depend on threads, on
//! what was drawn before, or on whether the run was interrupted.

use rand_chacha::ChaCha8Rng;
use rand_chacha::rand_core::SeedableRng;

/// A generator for one (seed, name, step, sample). It implements `rand::Rng`.
pub type StreamRng = ChaCha8Rng;

/// The stream of random numbers that belongs to `name` at `step` for `sample`.
///
/// Names are dotted and say who draws: `"masking.input"`, `"world.room"`, `"quantizer.dead_codes"`.
///
/// ```
/// use rand::RngExt;
/// let mut rng = reviv::random::stream(0, "masking.input", 7, 3);
/// let value: f64 = rng.random();
/// assert_eq!(value, reviv::random::stream(0, "masking.input", 7, 3).random::<f64>());
/// ```
#[must_use]
pub fn stream(seed: u64, name: &str, step: u64, sample: u64) -> StreamRng {
    let mut hasher = blake3::Hasher::new();
    hasher.update(b"reviv random 1\0");
    hasher.update(&seed.to_le_bytes());
    hasher.update(&step.to_le_bytes());
    hasher.update(&sample.to_le_bytes());
    hasher.update(name.as_bytes());
    ChaCha8Rng::from_seed(*hasher.finalize().as_bytes())
}
