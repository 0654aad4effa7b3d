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
/// let mut rng = reviv_data::random::stream(0, "masking.input", 7, 3);
/// let value: f64 = rng.random();
/// assert_eq!(value, reviv_data::random::stream(0, "masking.input", 7, 3).random::<f64>());
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

#[cfg(test)]
mod tests {
    use super::stream;
    use rand::{Rng, RngExt};

    #[test]
    fn golden_values_hold_on_every_machine_and_in_every_version() {
        // From an independent implementation: ChaCha with 8 rounds, written after RFC 8439 with a 64-bit counter, keyed by
        // the reference blake3. Another value here means that every recorded experiment would give other numbers: change
        // the scheme's number instead.
        let first = |seed, name, step, sample| stream(seed, name, step, sample).next_u64();
        assert_eq!(first(0, "", 0, 0), 15_696_603_510_614_428_473);
        assert_eq!(first(0, "masking.input", 0, 0), 926_335_741_353_012_781);
        assert_eq!(first(0, "masking.input", 7, 3), 1_931_561_311_754_416_738);
        assert_eq!(
            first(u64::MAX, "world.room", 1 << 40, 12),
            17_083_979_371_614_305_747
        );
        let mut rng = stream(42, "quantizer.dead_codes", 500, 1);
        let uniform: [f64; 3] = std::array::from_fn(|_| rng.random());
        assert_eq!(
            uniform,
            [
                0.438_932_658_951_547_1,
                0.175_723_062_694_097_43,
                0.960_030_698_222_015_5
            ]
        );
    }

    #[test]
    fn each_of_the_four_keys_makes_another_stream() {
        let base = stream(1, "a", 2, 3).next_u64();
        for other in [
            stream(2, "a", 2, 3),
            stream(1, "b", 2, 3),
            stream(1, "a", 3, 3),
            stream(1, "a", 2, 4),
        ] {
            assert_ne!(
                {
                    let mut other = other;
                    other.next_u64()
                },
                base
            );
        }
        // Swapped numbers are another stream, too.
        assert_ne!(stream(1, "a", 3, 2).next_u64(), base);
    }
}
